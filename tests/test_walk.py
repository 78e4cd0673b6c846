"""Every number of the results: walks on a world that plays back what was written by hand, gaits."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import walk
from env import CONTROL_DT, Observation
from faults import healthy, lock, skate
from robots import A1


class Playback:
    """Robot i walks 0.1 (i + 1) m and earns 1 a step. Those with a locked leg fall in step 3, begin
    again at 0, and fall in step 5 once more; those that skate diverge in step 4."""

    robot = A1

    def __init__(self, robot, num_envs, seed, threads, situations, config, extras, **options):
        self.config, self.num_envs, self.step_number = config, num_envs, 0
        self.position = np.zeros((num_envs, 3))
        self.model = SimpleNamespace(sensor=lambda name: SimpleNamespace(adr=[0]))
        self.world = SimpleNamespace(bind=lambda name: np.zeros((num_envs, 1)))

    def pin_faults(self, faults):
        words = [(bool(fault.locked), bool(fault.skating)) for fault in faults]
        self.locked, self.skating = np.array(words).T

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
    acts = lambda observation: torch.zeros(len(observation.legs), 12)  # noqa: E731
    return type("Policy", (), {"extras": (), "leg_frames": True, "__call__": staticmethod(acts)})()


def test_an_episode_ends_with_the_first_fall(policy):
    walked = walk.take_a_walk(policy, "a1", [healthy(), lock("FR_calf")], 0.75, 10 * CONTROL_DT)
    assert walked.distance == pytest.approx([10 * 0.1, 3 * 0.2])
    assert walked.fall_time == pytest.approx([10 * CONTROL_DT, 3 * CONTROL_DT])
    assert walked.returns == pytest.approx([10, 3]) and walked.fell.tolist() == [False, True]


def test_a_simulation_that_diverges_ends_where_it_last_was_and_is_told(policy, capsys):
    walked = walk.take_a_walk(policy, "a1", [healthy(), skate("FR")], 0.75, 10 * CONTROL_DT)
    assert walked.distance == pytest.approx([10 * 0.1, 3 * 0.2])
    assert walked.returns == pytest.approx([10, 3])
    assert walked.fall_time == pytest.approx([10 * CONTROL_DT, 4 * CONTROL_DT])
    assert capsys.readouterr().err == "simulations that diverged, counted as falls: 1\n"


def test_rows_name_their_case_and_overspeed_is_no_success(policy):
    args = SimpleNamespace(robot="a1", episodes=2, seconds=10 * CONTROL_DT, seed=0, threads=1)
    policies = {"a.pt": (policy, {"policy": "mlp", "seed": 7})}
    cases = {"healthy": healthy(), "FR": lock("FR_calf")}
    rows = walk.walk_cases(args, policies, cases, speed=8.0)  # 1.6 m commanded
    assert {(row["method"], row["seed"]) for row in rows} == {("mlp", 7)}
    told = [(row["case"], row["episode"], float(row["distance_m"])) for row in rows]
    assert told == [("healthy", 0, 1.0), ("healthy", 1, 2.0), ("FR", 0, 0.9), ("FR", 1, 1.2)]
    assert [float(row["share"]) for row in rows] == [0.625, 1.0, 0.5625, 0.75]
    assert [(row["fell"], row["success"]) for row in rows] == [(0, 1), (0, 1), (1, 0), (1, 0)]
    fast = walk.walk_cases(args, policies, {"healthy": healthy()}, speed=1.0)
    assert [float(row["share"]) for row in fast] == [1.0, 1.0]
    assert float(fast[1]["distance_m"]) == 2.0


def test_a_cell_is_the_mean_over_seeds_of_the_mean_over_episodes():
    """Seed 0: 1 and 3; seed 1: 7 four times. 2 and 7, hence 4.5 and a deviation of 2.5."""
    walked, common = [(0, 1), (0, 3)] + [(1, 7)] * 4, {"method": "rolt", "case": "FR"}
    rows = [common | {"seed": seed, "distance_m": x} for seed, x in walked]
    assert walk.cell(rows, "rolt", "FR", "distance_m") == (4.5, 2.5)
    assert walk.cell(rows[:2], "rolt", "FR", "distance_m") == (2.0, 1.0)  # one seed: its episodes


def pattern(*feet: str) -> np.ndarray:
    """(T, L) from one word a foot, # on the ground and . in the air."""
    return np.array([[mark == "#" for mark in foot] for foot in feet]).T


TROT = pattern("##..##..##..", "..##..##..##", "############", "............")


def test_stride_frequency_by_hand():
    """Touchdowns at 4, 8 and at 2, 6, 10: a stride of 4 steps of 20 ms is 12.5 Hz."""
    assert walk.stride_frequency(TROT, 0.02) == pytest.approx([12.5, 12.5, 0.0, 0.0])
    few = pattern("..####..", ".#..#..#")  # a single touchdown is no stride
    assert walk.stride_frequency(few, 0.1) == pytest.approx([0.0, 2 / 0.6])


def test_chatter_of_a_single_step_is_no_stride():
    before, after = pattern("###.###...#...##"), pattern("#######.......##")
    assert np.array_equal(walk.without_chatter(before), after)
    assert np.array_equal(walk.without_chatter(TROT), TROT)


def test_a_gait_is_measured_after_the_start_or_not_at_all():
    """2 s of standing (100 steps) do not count; less than 1 s (50 steps) after is too little."""
    contacts = np.concatenate([np.ones((100, 4), dtype=bool), np.tile(TROT, (5, 1))])[:, None]
    measured = walk.gait(SimpleNamespace(contacts=contacts, steps=[160]), 0)
    assert measured["duty"] == pytest.approx([0.5, 0.5, 1.0, 0.0])
    assert measured["feet_down"] == pytest.approx(2.0)
    assert measured["stride_hz"] == pytest.approx([12.5, 12.5, 0.0, 0.0])
    assert walk.gait(SimpleNamespace(contacts=contacts, steps=[149]), 0) is None
