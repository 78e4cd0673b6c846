"""From rows to tables and charts: what several seeds say together, and a verdict on each claim.

    python evaluate.py claims    # from the CSV files that the tests have left in --out

The unit is the seed: it stands for a training, an episode only for a start. Intervals are of 95 %,
by a bootstrap of seeds and of episodes within each; with three seeds that is little more than their
range. Comparisons over many cases are rliable's (Agarwal et al. 2021): interquartile mean and
probability of improvement. `rows` are those of a CSV file (walk.py); S seeds, C cases.
"""

import math
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

import plots
from walk import read_csv, write_csv

DRAWS = 2000
SEEDS, P_SEEDS = 3, 5  # ours: fewer give no verdict; no p (of 3 and 3 the least is 0.1)
USED = 0.1  # share of the time down when healthy; below, a leg's fault tests nothing
TRAINED, FALLS = 0.8, 0.05  # of the command, of episodes: worse on what it has seen = not trained


def by_seed(rows: list[dict], column: str, **where) -> list[np.ndarray]:
    """The column's numbers, an array per seed, where other columns have these values."""
    seeds = {}
    for row in rows:
        if row[column] != "" and all(row[key] == value for key, value in where.items()):
            seeds.setdefault(row["seed"], []).append(float(row[column]))
    return [np.array(numbers) for numbers in seeds.values()]


def bootstrap(seeds: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """(DRAWS,) means of S seeds drawn with replacement, each of as many episodes as it has."""
    S = len(seeds)
    means = [rng.choice(x, (DRAWS, S, len(x))).mean(axis=2) for x in seeds]  # S times (DRAWS, S)
    drawn = rng.integers(S, size=(1, DRAWS, S))
    return np.take_along_axis(np.stack(means), drawn, axis=0)[0].mean(axis=1)


def interval(draws: np.ndarray) -> tuple[float, float]:
    low, high = np.percentile(draws, (2.5, 97.5))
    return float(low), float(high)


def mean_and_interval(seeds: list[np.ndarray]) -> tuple[float, float, float]:
    """Mean over seeds of the mean over episodes, and its 95 %."""
    mean = float(np.mean([x.mean() for x in seeds]))
    return mean, *interval(bootstrap(seeds, np.random.default_rng(0)))


def with_interval(mean: float, low: float, high: float) -> str:
    return f"{mean:.2f} ({low:.2f} to {high:.2f})" if low < high else f"{mean:.2f}"


def interquartile_mean(scores: np.ndarray) -> tuple[float, float, float]:
    """Of (S, C) the mean of the middle half, and its 95 %: seeds drawn for each case by itself."""
    (S, C), rng = scores.shape, np.random.default_rng(0)
    drawn = np.take_along_axis(scores[None], rng.integers(S, size=(DRAWS, S, C)), axis=1)
    flat = np.sort(np.concatenate([scores[None], drawn]).reshape(DRAWS + 1, -1), axis=1)
    cut = flat.shape[1] // 4
    means = flat[:, cut : flat.shape[1] - cut].mean(axis=1)
    return float(means[0]), *interval(means[1:])


def probability_better(a: np.ndarray, b: np.ndarray) -> float:
    """That a seed of a, (S, C), scores above one of b in the same case; half for a tie."""
    return float(((a[:, None] > b) + 0.5 * (a[:, None] == b)).mean())


def permutation_p(a: np.ndarray, b: np.ndarray) -> float:
    """Exact and two-sided, of the difference of means of (S,) and (S',): the share of all ways to
    deal out the seeds that give as large a one."""
    both = np.concatenate([a, b])
    chosen = np.array(list(combinations(range(len(both)), len(a))))
    ours, total = both[chosen].sum(axis=1), both.sum()
    gaps = np.abs(ours / len(a) - (total - ours) / len(b))
    return float((gaps >= abs(a.mean() - b.mean()) - 1e-12).mean())


def trained(rows: list[dict], method: str) -> bool:
    """Does the method walk on what it has seen?"""
    seen = {row["case"] for row in rows if int(row["seen"])}
    for case in seen:
        share, fell = (by_seed(rows, x, method=method, case=case) for x in ("share", "fell"))
        if np.mean(share) < TRAINED or np.mean(fell) > FALLS:
            return False
    return True


def uses(rows: list[dict], method: str, case: str) -> bool:
    """Does every seed of the method use the leg that this case harms?"""
    duties = by_seed(rows, "leg_duty", method=method, case=case)
    return not any((x < USED).any() for x in duties)


def scores(rows: list[dict], method: str, cases: list[str], column="share") -> np.ndarray:
    """(S, C), each the mean over episodes."""
    values = [by_seed(rows, column, method=method, case=case) for case in cases]
    return np.array([[x.mean() for x in seeds] for seeds in values]).T


def compare(rows: list[dict], groups: dict[str, list[str]], best: str = "rolt") -> None:
    """Prints a table over groups of cases: shares of the commanded distance, of the methods that
    are trained, in cases whose leg all of them use. p: where both have P_SEEDS."""
    methods = [m for m in dict.fromkeys(row["method"] for row in rows) if trained(rows, m)]
    for name, cases in groups.items():
        cases = [case for case in cases if all(uses(rows, m, case) for m in methods)]
        if not cases:
            continue
        name += f" ({', '.join(cases)})"
        print(f"\n| {name} | IQM of the share walked | {best} is better | p |\n|---|---|---|---|")
        ours = scores(rows, best, cases) if best in methods else None
        for method in methods:
            theirs = scores(rows, method, cases)
            iqm, low, high = interquartile_mean(theirs)
            line = f"| {method} | {with_interval(iqm, low, high)}"
            if ours is None or method == best:
                print(line, "| | |")
                continue
            p = f"{permutation_p(ours.mean(axis=1), theirs.mean(axis=1)):.3f}"
            p = p if min(len(ours), len(theirs)) >= P_SEEDS else "-"
            print(line, f"| {probability_better(ours, theirs):.0%} | {p} |")


def report(args, rows: list[dict], columns: dict[str, str], title: str, seen=(), x="") -> None:
    """Writes EXPERIMENT.csv and .png, prints a table of each of the columns {column: what}: mean
    over seeds of the mean over episodes (95 % interval). seen: cases that were trained on, where
    who does not walk is not trained; x: see `chart`."""
    for row in rows:
        row["seen"] = int(row["case"] in seen)
    path = args.out / args.experiment
    write_csv(path.with_suffix(".csv"), rows)
    methods, cases = ([*dict.fromkeys(row[key] for row in rows)] for key in ("method", "case"))
    unused = {(row["method"], row["case"]) for row in rows if float(row.get("leg_duty", 1)) < USED}
    heads = {m: m if trained(rows, m) else f"{m}, not trained" for m in methods}
    labels = [f"{case} (seen)" if case in seen and not x else case for case in cases]
    panels = {}
    for column, what in columns.items():
        print(f"\n{title}: {what}\n")
        print("|", *(f"| {head}" for head in heads.values()), "|")
        print("|---" * (len(methods) + 1) + "|")
        panels[what] = {head: [] for head in heads.values()}
        for case, label in zip(cases, labels):
            line = f"| {label} |"
            for method, head in heads.items():
                seeds = by_seed(rows, column, method=method, case=case)
                mean, low, high = mean_and_interval(seeds) if seeds else (np.nan,) * 3
                panels[what][head].append((mean, low, high, [x.mean() for x in seeds]))
                line += f" {with_interval(mean, low, high)}"
                line += " * |" if (method, case) in unused else " |"
            print(line)
    if unused:
        print("\n* the leg is hardly used when healthy by one of the seeds or more: no test")
    plots.chart(panels, labels, path.with_suffix(".png"), title, x)


class Claim(NamedTuple):
    """ROLT's measure over these cases is above a number or above each of these methods'."""

    text: str
    test: str  # whose CSV file
    measure: str
    against: tuple[str | float, ...]
    cases: tuple[str, ...] = ()  # () = all unseen


UNSHARED = ("mlp", "rma", "roam")
NOISE = ("no-pe-drop", "no-feature-drop", "mlp", "roll-drop", "rma")
CLAIMS = (
    Claim("walks with hind legs that it never saw limping", "stiffness", "success", (0.8,),
          ("RR", "RL")),
    Claim("... better than without shared legs", "stiffness", "success", UNSHARED, ("RR", "RL")),
    Claim("... or with a position for each leg", "stiffness", "success", ("module-pe",),
          ("RR", "RL")),
    Claim("... better than our controls, FL too", "stiffness", "success",
          ("no-identity", "mirrored-mlp", "no-leg-frames")),
    Claim("walks with FL locked (added later: RESULTS.md)", "stiffness", "success",
          (0.8, "module-pe", *UNSHARED), ("FL",)),
    Claim("stays up with motors it never saw dead", "damage", "upright", (0.95,)),
    Claim("... and gets on", "damage", "success", (0.8, "module-pe", *UNSHARED)),
    Claim("displaced patches cost it the least", "low_frequency", "kept", NOISE),
    Claim("so does noise on every point", "high_frequency", "kept", NOISE),
    *(Claim(f"Go1, {case}: further than RMA", "real_world", "share", ("rma",), (case,))
      for case in ("weaken", "box", "skates")),
)  # fmt: skip


def measured(rows: list[dict], method: str, claim: Claim, cases: list[str]) -> list[np.ndarray]:
    """The claim's measure of each seed's episodes. upright: no fall; kept: the share walked, over
    the seed's own without noise."""
    some = [row for row in rows if row["method"] == method and row["case"] in cases]
    if claim.measure == "upright":
        return [1 - fell for fell in by_seed(some, "fell")]
    if claim.measure == "kept":
        clean = [row for row in rows if row["method"] == method and int(row["seen"])]
        pairs = zip(by_seed(some, "share"), by_seed(clean, "share"))
        return [noisy / clean.mean() for noisy, clean in pairs]
    return by_seed(some, claim.measure)


def judge(ours: list[np.ndarray], theirs: list[np.ndarray] | float) -> tuple[str, str, str]:
    """The difference with its interval, the verdict (decided where the two intervals are apart),
    and how many seeds would decide, were the difference and the spread of seeds to stay."""
    number, rng = isinstance(theirs, float), np.random.default_rng(0)
    draws = [bootstrap(ours, rng), np.full(DRAWS, theirs) if number else bootstrap(theirs, rng)]
    (low, high), (their_low, their_high) = map(interval, draws)
    a = np.array([x.mean() for x in ours])
    b = np.array([theirs] if number else [x.mean() for x in theirs])
    gap, enough = a.mean() - b.mean(), len(a) >= SEEDS and (number or len(b) >= SEEDS)
    verdict = "undecided"
    if enough and (low > their_high or high < their_low):
        verdict = "shows" if gap > 0 else "does not"
    needed = "-" if verdict != "undecided" else f"{SEEDS}"
    if enough and verdict == "undecided":
        spread = a.std(ddof=1) + (0 if number else b.std(ddof=1))
        more = (len(a) if number else max(len(a), len(b))) + 1
        needed = f"{max(more, math.ceil((1.96 * spread / gap) ** 2))}" if gap else "more"
    low, high = interval(draws[0] - draws[1])
    return f"{gap:+.2f} ({low:+.2f} to {high:+.2f})", verdict, needed


def claims(folder: Path) -> None:
    """Prints the table of claims."""
    columns = "ROLT ...", "test", "ROLT", "than", "difference", "seeds", "verdict", "would decide"
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for claim in CLAIMS:
        path = folder / f"{claim.test}.csv"
        rows = read_csv(path) if path.exists() else []
        there = {row["method"] for row in rows}
        for other in claim.against:
            line = f"| {claim.text} | {claim.test}, {claim.measure} "
            number = isinstance(other, float)
            methods = ["rolt"] if number else ["rolt", other]
            why = [f"{m}: no data" for m in methods if m not in there]
            why = why or [f"{m}: not trained" for m in methods if not trained(rows, m)]
            if why:
                print(line + f"| | {other} | | | {', '.join(why)} | - |")
                continue
            unseen = dict.fromkeys(row["case"] for row in rows if not int(row["seen"]))
            cases = [case for case in claim.cases or unseen if case in unseen]
            cases = [case for case in cases if all(uses(rows, m, case) for m in methods)]
            if not cases:
                print(line + f"| | {other} | | | no leg that both use | - |")
                continue
            ours = measured(rows, "rolt", claim, cases)
            theirs = other if number else measured(rows, other, claim, cases)
            mean, low, high = mean_and_interval(ours)
            gap, verdict, needed = judge(ours, theirs)
            seeds = f"{len(ours)}" if number else f"{len(ours)}, {len(theirs)}"
            line += f"| {mean:.2f} ({low:.2f} to {high:.2f}) | {other} | {gap} | {seeds} "
            print(line + f"| {verdict} | {needed} |")
