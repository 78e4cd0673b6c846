"""Every number of the results: walks on a world that plays back what was written by hand, gaits."""

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import walk
from baselines import make_policy
from beyond import recovery
from checkpoint import load_policy
from conftest import ROOT
from env import CONTROL_DT, Observation
from faults import HEALTHY, TASKS
from robots import A1
from terrain import Terrain


class Playback:
    """Robot i walks 0.1 (i + 1) m and earns 1 a step. Those with a locked leg fall in step 3, begin
    again at 0, and fall in step 5 once more; those that skate diverge in step 4."""

    robot = A1

    def __init__(self, robot, num_envs, seed, threads, situations, config, extras, **options):
        self.num_envs, self.step_number = num_envs, 0
        self.position = np.zeros((num_envs, 3))
        self.model = SimpleNamespace(sensor=lambda name: SimpleNamespace(adr=[0]))
        self.world = SimpleNamespace(bind=lambda name: np.zeros((num_envs, 1)))

    def pin_faults(self, faults):
        self.locked, self.skating = np.array([("lock" in x, "skate" in x) for x in faults]).T

    def reset(self):
        return Observation(*(np.zeros((self.num_envs, 1), np.float32) for _ in range(6)))

    def step(self, action):
        self.step_number += 1
        before = self.position.copy()
        before[:, 0] += 0.1 * np.arange(1, self.num_envs + 1)
        diverged = self.skating & (self.step_number == 4)
        fallen = self.locked & (self.step_number in (3, 5)) | diverged
        before[diverged] = 1e9
        self.position = np.where(fallen[:, None], 0.0, before)
        info = {"position": before, "diverged": diverged}
        return self.reset(), 1.0 - diverged, fallen, np.zeros(self.num_envs, bool), info


@pytest.fixture
def policy(monkeypatch):
    monkeypatch.setattr(walk, "LocomotionEnv", Playback)
    return Mock(side_effect=lambda x: torch.zeros(len(x.legs), 12), extras=(), leg_frames=True)


def test_an_episode_ends_with_the_first_fall_or_where_what_diverges_last_was(policy, capsys):
    faults = [HEALTHY, "lock:FR_calf", "skate:FR"]
    walked = walk.take_a_walk(policy, "a1", faults, 0.75, 10 * CONTROL_DT)
    assert walked.distance == pytest.approx([10 * 0.1, 3 * 0.2, 3 * 0.3])
    assert walked.fall_time == pytest.approx([10 * CONTROL_DT, 3 * CONTROL_DT, 4 * CONTROL_DT])
    assert walked.returns == pytest.approx([10, 3, 3])
    assert walked.fell.tolist() == [False, True, True]
    assert capsys.readouterr().err == "simulations that diverged, counted as falls: 1\n"


def test_rows_name_their_case_and_overspeed_is_no_success(policy):
    args = SimpleNamespace(robot="a1", episodes=2, seconds=10 * CONTROL_DT, seed=0, threads=1)
    policies = {"a.pt": (policy, {"policy": "mlp", "seed": 7})}
    cases = {"healthy": HEALTHY, "FR": "lock:FR_calf"}
    rows = walk.walk_cases(args, policies, cases, speed=8.0)  # 1.6 m commanded
    assert {(row["method"], row["seed"]) for row in rows} == {("mlp", 7)}
    told = [(row["case"], row["episode"], float(row["distance_m"])) for row in rows]
    assert told == [("healthy", 0, 1.0), ("healthy", 1, 2.0), ("FR", 0, 0.9), ("FR", 1, 1.2)]
    assert [float(row["share"]) for row in rows] == [0.625, 1.0, 0.5625, 0.75]
    assert [(row["fell"], row["success"]) for row in rows] == [(0, 1), (0, 1), (1, 0), (1, 0)]
    fast = walk.walk_cases(args, policies, {"healthy": HEALTHY}, speed=1.0)
    assert [float(row["share"]) for row in fast] == [1.0, 1.0]
    assert float(fast[1]["distance_m"]) == 2.0


def test_a_gait_is_measured_after_the_start_or_not_at_all():
    """2 s of standing (100 steps) do not count; less than 1 s (50 steps) after is too little."""
    feet = "##..##..##..", "..##..##..##", "############", "............"  # "#": on the ground
    trot = np.array([[mark == "#" for mark in foot] for foot in feet]).T
    contacts = np.concatenate([np.ones((100, 4), dtype=bool), np.tile(trot, (5, 1))])[:, None]
    contacts = np.concatenate([contacts, contacts[::-1]], axis=1)  # the second robot fell too soon
    walked = SimpleNamespace(contacts=contacts, steps=[160, 149])
    assert walk.duty(walked, range(2)) == pytest.approx([0.5, 0.5, 1.0, 0.0])
    assert np.isnan(walk.duty(walked, range(1, 2))).all()


@pytest.mark.parametrize("path", sorted((ROOT / "checkpoints").glob("*.pt")), ids=lambda p: p.stem)
def test_what_is_shipped_walks(path):
    """Healthy, 3 s at its test's speed, at 60 % of it or more: it takes a moment to start. On the
    easiest steps: who stops in front of higher ones (the MLP) has its row in RESULTS.md."""
    policy, card = load_policy(path)
    stairs = Terrain(("stairs",), (-2,)) if card["task"] == "terrain" else None
    speed, robots = 0.5 if stairs else 0.75, [HEALTHY] * 4
    walked = walk.take_a_walk(policy, card["robot"], robots, speed, 3.0, 0, 1, terrain=stairs)
    assert not walked.fell.any() and walked.distance.mean() > 0.6 * speed * 3.0


def test_methods_act_as_they_did_when_their_results_were_measured():
    """Where a fresh policy's robot is after 0.6 s in front of stairs: model, env, scan in one."""
    places = {
        "mlp": -0.1991, "mirrored-mlp": -0.1902, "roll-drop": -0.1991, "rma": -0.1794,
        "roam": -0.1991, "module-pe": -0.2058, "no-pe-drop": -0.1671, "no-feature-drop": -0.1896,
        "no-leg-frames": -0.1923, "no-identity": -0.1718, "rolt": -0.1896,
    }  # fmt: skip
    course = Terrain(("stairs",), (0,))
    for name, x in places.items():
        torch.manual_seed(0)
        policy = make_policy(name, A1, TASKS["terrain"], True)
        walked = walk.take_a_walk(policy, "a1", ["lock:FR_calf"], 0.75, 0.6, 0, 1, terrain=course)
        assert walked.poses[-1, 0, 0] == pytest.approx(x, abs=1e-3)


def test_recovery_is_the_time_until_the_last_second_was_fast_enough():
    """0.8 m/s; 0.2 m/s from 5 to 13 s; then 0.8: 80 % of that, 0.64, is the mean over a second of
    which 0.733 were fast: 1 + 0.74 s after the fault's end, on the grid of 20 ms."""
    t = np.arange(1000) * CONTROL_DT
    x = np.where(t < 5, 0.8 * t, np.where(t < 13, 4 + 0.2 * (t - 5), 5.6 + 0.8 * (t - 13)))
    told, fallen, early = (
        recovery(SimpleNamespace(poses=x[:, None, None], steps=[steps], fell=[fell]), 0)
        for steps, fell in ((1000, False), (700, True), (300, True))
    )
    assert told == {"during": "0.250", "recovery_s": "1.740"}
    assert fallen == {"during": "0.250", "recovery_s": "8.000"}
    assert early == {"during": "0.000", "recovery_s": "8.000"}
