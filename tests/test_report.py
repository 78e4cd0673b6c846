"""Statistics and verdicts, against numbers worked out by hand."""

import numpy as np
import pytest

import report
from walk import write_csv

SEEN = {"FR": 1, "RR": 0, "RL": 0}
WELL, SLOW = [[0.9, 0.9]] * 3, [[0.5, 0.5]] * 3  # three seeds, two episodes


def table(**shares) -> list[dict]:
    """Rows of methods: {case: [each seed's episodes' shares]}; who gets nowhere has fallen."""
    rows = []
    for method, cases in shares.items():
        for case, seeds in cases.items():
            for seed, episodes in enumerate(seeds):
                row = {"method": method, "case": case, "seed": seed, "seen": SEEN[case]}
                row |= {"leg_duty": 0.05 if (method, case) == ("mlp", "RL") else 0.5}
                for x in episodes:
                    rows.append(row | {"share": x, "fell": int(x == 0), "success": int(x >= 0.5)})
    return rows


def test_a_cell_is_the_mean_over_seeds_of_the_mean_over_episodes_its_interval_a_binomials():
    """Seed 0: 1 and 3; seed 1: 7 and 9. 2 and 8, hence 5; a drawn mean of seeds is 1 to 9."""
    rows = table(rolt={"FR": [[1, 3], [7, 9]]}, mlp={"FR": [[100], [100]]})
    seeds = report.by_seed(rows, "share", method="rolt", case="FR")
    assert [x.tolist() for x in seeds] == [[1, 3], [7, 9]]
    mean, low, high = report.mean_and_interval(seeds)
    assert mean == 5 and 1 <= low < 2 < 8 < high <= 9  # both seeds the same one: 1 in 4 draws
    assert report.by_seed(rows, "share", case="RL") == []

    seeds = [np.full(4, x) for x in (0.0, 0, 0, 1, 1)]  # of five drawn, 0 to 4 reach 1 in 95 %
    assert report.mean_and_interval(seeds) == pytest.approx((0.4, 0.0, 0.8))


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    scores = np.array([[9.0, 1, 2], [3, 4, 5], [6, 7, 0], [8, 10, 100]])
    assert report.interquartile_mean(scores)[0] == (3 + 4 + 5 + 6 + 7 + 8) / 6
    _, low, high = report.interquartile_mean(np.array([[1.0, 5], [1, 5]]))
    assert low == high == 3  # seeds are drawn within their case: both cases stay in


def test_the_probability_of_improvement_counts_pairs_of_seeds():
    """Case one: 1 beats neither of (1, 2), ties one; 3 beats both. Case two: never."""
    ours, theirs = np.array([[1.0, 0], [3, 0]]), np.array([[1.0, 9], [2, 9]])
    assert report.probability_better(ours, theirs) == pytest.approx((2.5 / 4 + 0) / 2)


def test_the_permutation_test_is_exact():
    """Of the 20 ways to deal out 1 to 6 by threes, only 123|456 and its mirror are as far apart."""
    low, high = np.array([1.0, 2, 3]), np.array([4.0, 5, 6])
    assert report.permutation_p(low, high) == report.permutation_p(high, low) == 2 / 20
    assert report.permutation_p(low, low) == 1


def test_trained_is_who_walks_on_what_it_has_seen():
    rows = table(rolt={"FR": [[0.9, 0.9]], "RR": [[0, 0]]}, mlp={"FR": [[0.7, 0.8]], "RR": [[1]]},
                 rma={"FR": [[1] * 9 + [0]], "RR": [[1]]})  # fmt: skip
    verdicts = [report.trained(rows, method) for method in ("rolt", "mlp", "rma")]
    assert verdicts == [True, False, False]


def test_a_verdict_takes_three_seeds_and_an_interval_off_zero():
    seeds = (1, 0.9, 1), (0, 0.1, 0), (1, 0, 1)
    good, bad, mixed = ([np.array([x, x]) for x in xs] for xs in seeds)
    assert report.judge(good, bad)[1] == "shows" and report.judge(bad, good)[1] == "does not"
    assert report.judge(good[:2], bad)[1:] == ("undecided", "3")
    assert report.judge(good, 0.8)[1] == "shows"
    words, verdict, needed = report.judge(mixed, 0.5)
    # the mean 2/3 is 1/6 above, the variance of the seeds 1/3: 1.96^2 / 3 * 36 = 46.1
    assert words.startswith("+0.17") and (verdict, needed) == ("undecided", "47")


def test_claims_and_comparisons_leave_out_who_is_untrained_and_legs_that_hang(tmp_path, capsys):
    rows = table(rolt={"FR": WELL, "RR": WELL, "RL": WELL},
                 mlp={"FR": WELL, "RR": [[0.1, 0.1]] * 3, "RL": WELL},
                 rma={"FR": SLOW, "RR": WELL, "RL": WELL})  # fmt: skip
    write_csv(tmp_path / "stiffness.csv", rows)
    report.claims(tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert "| 1.00 (1.00 to 1.00) | 0.8 | +0.20 (+0.20 to +0.20) | 3 | shows | - |" in lines[2]
    assert "| mlp | +1.00 (+1.00 to +1.00) | 3, 3 | shows | - |" in lines[3]  # RL does not count
    assert "| rma | | | rma: not trained | - |" in lines[4] and "roam: no data" in lines[5]

    report.compare(rows, {"unseen": ["RR", "RL"]})
    head, _, rolt, mlp = capsys.readouterr().out.strip().splitlines()
    assert head.startswith("| unseen (RR) |")
    assert rolt == "| rolt | 0.90 | | |" and mlp == "| mlp | 0.10 | 100% | - |"


def test_noise_is_measured_by_what_is_kept():
    rows = table(rolt={"FR": [[0.8, 0.8]], "RR": [[0.4, 0.2]]})
    claim = report.Claim("", "low_frequency", "kept", ("mlp",))
    assert report.measured(rows, "rolt", claim, ["RR"])[0] == pytest.approx([0.5, 0.25])


def test_a_comparison_gives_a_p_to_five_seeds_or_more(capsys):
    rows = table(rolt={"FR": WELL * 2, "RR": WELL * 2}, roam={"FR": WELL * 2, "RR": SLOW * 2})
    report.compare(rows, {"unseen": ["RR"]})
    assert capsys.readouterr().out.strip().endswith("| roam | 0.50 | 100% | 0.002 |")  # 2 of 924
