"""What is measured of sudden faults, maps and senses, by hand and on short walks."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest

import beyond
import evaluate
from env import CONTROL_DT
from conftest import save_policy


def played(x: np.ndarray, steps: int, fell: bool) -> SimpleNamespace:
    """A walk of one robot that is at x (T,) m."""
    return SimpleNamespace(poses=x[:, None, None], steps=[steps], fell=[fell])


def test_recovery_is_the_time_until_the_last_second_was_fast_enough():
    """0.8 m/s; 0.2 m/s from 5 to 13 s; then 0.8: 80 % of that, 0.64, is the mean over a second of
    which 0.733 were fast: 1 + 0.74 s after the fault's end, on the grid of 20 ms."""
    t = np.arange(1000) * CONTROL_DT
    x = np.where(t < 5, 0.8 * t, np.where(t < 13, 4 + 0.2 * (t - 5), 5.6 + 0.8 * (t - 13)))
    told = beyond.recovery(played(x, 1000, False), 0)
    assert float(told["recovery_s"]) == pytest.approx(1.74, abs=0.001)
    assert float(told["during"]) == pytest.approx(0.25)
    fallen = beyond.recovery(played(x, 700, True), 0)
    assert float(fallen["recovery_s"]) == 8 and float(fallen["during"]) == pytest.approx(0.25)
    assert beyond.recovery(played(x, 300, True), 0) == {"during": "0.000", "recovery_s": "8.000"}


def test_experiments_of_ours(tmp_path):
    files = [save_policy(tmp_path / f"{steps}.pt", steps=steps) for steps in (10**6, 2 * 10**6)]

    def run(name, *words):
        words = [name, *words, "--episodes", "1", "--threads", "1", "--out", str(tmp_path)]
        evaluate.main([*words, "--seconds", "0.1"])
        picture = "matrix-pairs" if "--pairs" in words else name
        if name == "curves":
            return []
        with open(tmp_path / f"{picture}.csv", newline="") as file:
            assert (tmp_path / f"{picture}.png").exists()
            return list(csv.DictReader(file))

    one, both = ["--checkpoints", files[0]], ["--checkpoints", *files]
    run("curves", *one)
    grown = run("growth", *both)
    assert [row["case"] for row in grown] == ["1.0"] * 3 + ["2.0"] * 3
    assert {row["method"] for row in grown} == {"rolt"}
    cells = run("matrix", *one)
    assert len(cells) == 12 * 5 and cells[-1]["case"] == "RL_calf, weaken to 0.25"
    pairs = run("matrix", *one, "--pairs")
    assert len(pairs) == 6 * 5 and pairs[0]["case"] == "FR+FL, lock"
    two = save_policy(tmp_path / "two.pt", task="two-legs")
    taught = run("legs", "--checkpoints", files[0], two)
    assert {row["method"] for row in taught} == {"rolt stiffness", "rolt two-legs"}
    assert len(taught) == 2 * (1 + 4 + 4) and taught[-1]["case"] == "disable:RL_calf"
    failing = run("senses", *one)
    assert [row["case"] for row in failing] == list("01234") and "freeze" in failing[0]
