"""The benchmark runs at a tiny size and ends in figures that parse."""

import json

import benchmark


def test_json_is_the_last_line_and_has_ratios(capsys):
    benchmark.main(["--robots", "a1", "--policies", "rolt", "--envs", "4", "--rounds", "1", "--threads", "1", "--json"])
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    for key in ("flat_env_step", "terrain_env_step", "terrain_scandots", "rolt_learner", "rolt_latency", "rolt_speedup", "rolt_of_limit"):
        assert report[f"a1_{key}_ratio"] > 0
    assert report["a1_flat_env_step_ratio"] < 1
    phases = [report[f"a1_rolt_one_{phase}_ratio"] for phase in ("simulate", "act", "update")]
    assert abs(sum(phases) - 1) < 1e-6 and min(phases) > 0
