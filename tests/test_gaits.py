"""The gait measures on contacts written by hand, and the experiment as a user runs it."""

import csv
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import checkpoint
import evaluate
import render
from baselines import make_policy
from faults import disable, half_lock, healthy, lock, tow, weaken
from gaits import duty_factor, feet_down, measure, stride_frequency, without_chatter
from protocol import case_name
from robots import ROBOTS

ROOT = Path(__file__).resolve().parent.parent


def pattern(*feet: str) -> np.ndarray:
    """(T, L) from one word a foot, # on the ground and . in the air."""
    return np.array([[mark == "#" for mark in foot] for foot in feet]).T


TROT = pattern("##..##..##..", "..##..##..##", "############", "............")


def test_duty_factor_and_feet_down_by_hand():
    assert duty_factor(TROT) == pytest.approx([0.5, 0.5, 1.0, 0.0])
    assert feet_down(TROT) == pytest.approx(2.0)
    assert duty_factor(pattern("###.###.")) == pytest.approx([0.75])


def test_stride_frequency_by_hand():
    """Touchdowns at 4, 8 and at 2, 6, 10: a stride of 4 steps of 20 ms is 12.5 Hz. No touchdown or a single one: no stride."""
    assert stride_frequency(TROT, 0.02) == pytest.approx([12.5, 12.5, 0.0, 0.0])
    assert stride_frequency(pattern("..####..", ".#..#..#"), 0.1) == pytest.approx([0.0, 2 / 0.6])


def test_chatter_of_a_single_step_is_no_stride():
    assert np.array_equal(without_chatter(pattern("###.###...#...##")), pattern("#######.......##"))
    assert np.array_equal(without_chatter(TROT), TROT)


def test_a_gait_is_measured_after_the_start_or_not_at_all():
    """2 s of standing do not count; less than 1 s after them is too little."""
    dt, standing = 0.1, np.ones((20, 2), dtype=bool)
    stepping = np.tile(pattern("##..", "..##"), (3, 1))
    gait = measure(np.concatenate([standing, stepping]), dt)
    assert gait["stride_hz"][1] == pytest.approx(2.5) and gait["feet_down"] == pytest.approx(1.0)
    assert gait["duty_factor"] == pytest.approx([0.5, 0.5])
    assert measure(np.concatenate([standing, stepping[:9]]), dt) is None


def test_names_of_the_cases():
    """The paper's words where it has one; the fault's own otherwise, so that no two faults share a name."""
    assert [case_name(fault) for fault in (healthy(), lock("FL_calf"), disable("ML_thigh"))] == ["healthy", "FL", "MLT"]
    others = lock("FL_hip"), lock("FL_calf") + lock("RR_calf"), weaken("FL", 0.5), half_lock("RR_calf", -1.5), tow("RR")
    assert [case_name(fault) for fault in others] == [str(fault) for fault in others]


@pytest.mark.parametrize(
    "robot, task, cases, methods", [("a1", "stiffness", 5, ["rolt", "mlp"]), ("hexapod", "damage", 13, ["mlp"])]
)
def test_gaits_of_every_fault(robot, task, cases, methods, tmp_path, monkeypatch):
    """Frames are stand-ins: what is drawn is render.py's, and takes its time."""
    monkeypatch.setattr("render.problem", lambda: None if robot == "a1" else "no frames here")
    monkeypatch.setattr("render.draw", lambda walk, i, steps, width, height: [np.zeros((20, 30, 3), np.uint8)] * len(steps))
    files = []
    for method in methods:
        content = {"robot": robot, "task": task, "steps": 0, "seed": 0, "policy": method}
        files.append(str(tmp_path / f"{method}.pt"))
        checkpoint.save(content | {"weights": make_policy(method, ROBOTS[robot]).state_dict()}, Path(files[-1]))
    quick = ["--episodes", "2", "--seconds", "0.2", "--out", str(tmp_path)]
    evaluate.main(["gaits", "--robot", robot, "--checkpoints", *files, *quick])
    with open(tmp_path / f"gaits-{robot}.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(methods) * cases * 2 * len(ROBOTS[robot].legs)
    assert {row["feet_down"] for row in rows} == {""} and {row["seconds"] for row in rows} == {"0.20"}  # too short
    assert (tmp_path / f"gaits-{robot}.png").stat().st_size > 1000


def test_the_rows_hold_the_gait_of_their_leg_and_episode(tmp_path, monkeypatch):
    """A stand-in walks with the contacts of TROT for 4.8 s (3.6 in episode 1 of the second case); 2 s on they count."""
    contacts = np.tile(TROT, (20, 1))  # (240, 4)
    walk = SimpleNamespace(contacts=np.stack([contacts] * 10, axis=1), steps=[240, 240, 240, 180] + [240] * 6, poses=contacts)
    monkeypatch.setattr("render.record", lambda *arguments: walk)
    monkeypatch.setattr("render.problem", lambda: "no frames here")
    content = {"robot": "a1", "task": "stiffness", "steps": 0, "seed": 0, "policy": "mlp"}
    checkpoint.save(content | {"weights": make_policy("mlp", ROBOTS["a1"]).state_dict()}, tmp_path / "policy.pt")
    evaluate.main(["gaits", "--checkpoints", str(tmp_path / "policy.pt"), "--episodes", "2", "--out", str(tmp_path)])
    with open(tmp_path / "gaits-a1.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["case"], row["episode"], row["leg"]) for row in rows[11:14]] == [("FR", "0", "RL"), ("FR", "1", "FR"), ("FR", "1", "FL")]
    assert [row["seconds"] for row in rows[11:14]] == ["4.80", "3.60", "3.60"]
    assert [row["duty_factor"] for row in rows[:4]] == ["0.500", "0.500", "1.000", "0.000"]
    assert [row["stride_hz"] for row in rows[:4]] == ["12.500", "12.500", "0.000", "0.000"]
    assert {row["feet_down"] for row in rows} == {"2.000"}


@pytest.mark.parametrize("way, says", [("disable", "MUJOCO_GL is disable"), ("nonsense", "MUJOCO_GL is nonsense")])
def test_where_nothing_can_be_rendered_the_numbers_come_all_the_same(way, says, tmp_path):
    card = {"robot": "a1", "task": "stiffness", "policy": "rolt", "steps": 0, "seed": 0}
    checkpoint.save(card | {"weights": make_policy("rolt", ROBOTS["a1"]).state_dict()}, tmp_path / "policy.pt")
    command = ["evaluate.py", "gaits", "--checkpoints", tmp_path / "policy.pt", "--episodes", "1", "--seconds", "0.1"]
    done = subprocess.run(
        [sys.executable, str(ROOT / command[0]), *map(str, command[1:]), "--out", str(tmp_path), "--video", "film.gif"],
        env={"MUJOCO_GL": way, "PATH": "/usr/bin:/bin"}, capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert done.stdout.count(says) == 1 and (tmp_path / "gaits-a1.csv").exists() and (tmp_path / "gaits-a1.png").exists()
    assert done.returncode == 2 and says in done.stderr and done.stderr.count("\n") == 1  # the film that was asked for


def test_a_film_shows_every_case_and_who_falls_stays_as_it_fell(tmp_path, monkeypatch):
    """Stand-ins: the first robot falls after 6 of 20 steps, and a frame is as bright as its step."""
    sheets = []
    monkeypatch.setattr("render.record", lambda *args: SimpleNamespace(steps=[6 if args[2] == [lock("FL_calf")] else 20]))
    monkeypatch.setattr("render.draw", lambda walk, i, steps, w, h: [np.full((h, w, 3), step, np.uint8) for step in steps])
    monkeypatch.setattr("render.write_gif", lambda frames, path, seconds: sheets.extend(frames))
    render.film_cases(None, "a1", {"FL": (lock("FL_calf"), 0.7, {}), "healthy": (healthy(), 0.7, {})}, 0.4, tmp_path)
    assert [sheet.shape for sheet in sheets] == [(160, 480, 3)] * 5  # every fourth step; two cases side by side
    assert [sheet[100, 100, 0] for sheet in sheets] == [0, 4, 4, 4, 4]
    assert [sheet[100, 340, 0] for sheet in sheets] == [0, 4, 8, 12, 16]


def test_a_video_is_a_gif_of_robots_that_walk(capsys):
    for words in (["stiffness", "--video", "film.mp4"], ["dropout_ratio", "--video", "film.gif"]):
        with pytest.raises(SystemExit):
            evaluate.main(words)
        assert "--video is a .gif file" in capsys.readouterr().err
