"""Every number of the results goes through here: episodes on a world that plays back what was written by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import protocol
from env import CONTROL_DT, Observation
from faults import healthy, lock


class Playback:
    """Robot i walks 0.1 (i + 1) m and earns 1 a step. Those with a locked leg fall in step 3, begin again at 0, and fall in
    step 5 once more."""

    def __init__(self, robot, num_envs, seed, threads, situations, config, extras, **options):
        self.config, self.num_envs, self.step_number = config, num_envs, 0
        self.position = np.zeros((num_envs, 3))

    def pin_faults(self, faults):
        self.locked = np.array([bool(fault.locked) for fault in faults])

    def reset(self):
        return Observation(*(np.zeros((self.num_envs, 1), np.float32) for _ in range(6)))

    def step(self, action):
        self.step_number += 1
        before = self.position.copy()
        before[:, 0] += 0.1 * np.arange(1, self.num_envs + 1)
        fallen = self.locked & (self.step_number in (3, 5))
        self.position = np.where(fallen[:, None], 0.0, before)
        info = {"position": before, "diverged": np.zeros(self.num_envs, bool)}
        return self.reset(), np.ones(self.num_envs), fallen, np.zeros(self.num_envs, bool), info


@pytest.fixture
def policy(monkeypatch):
    monkeypatch.setattr(protocol, "LocomotionEnv", Playback)
    acts = lambda observation: torch.zeros(len(observation.legs), 12)  # noqa: E731
    return type("Policy", (), {"extras": (), "__call__": staticmethod(acts)})()


def test_an_episode_ends_with_the_first_fall(policy):
    outcome = protocol.run_episodes(policy, "a1", [healthy(), lock("FR_calf")], 0.75, 10 * CONTROL_DT)
    assert outcome["distance_m"] == pytest.approx([10 * 0.1, 3 * 0.2])
    assert outcome["fall_time_s"] == pytest.approx([10 * CONTROL_DT, 3 * CONTROL_DT])
    assert outcome["episode_return"] == pytest.approx([10, 3])


def test_rows_name_the_case_that_they_are_of(policy):
    args = SimpleNamespace(
        policies={"a.pt": (policy, {"policy": "mlp", "task": "stiffness", "seed": 7})}, scenes={},
        robot="a1", episodes=2, seconds=10 * CONTROL_DT, seed=0, threads=1,
    )  # fmt: skip
    rows = protocol.run_cases(args, {"healthy": healthy(), "FR": lock("FR_calf")}, 0.75)
    told = [(row["method"], row["seed"], row["case"], row["episode"], float(row["distance_m"])) for row in rows]
    assert told == [("mlp", 7, "healthy", 0, 1.0), ("mlp", 7, "healthy", 1, 2.0), ("mlp", 7, "FR", 0, 0.9), ("mlp", 7, "FR", 1, 1.2)]


def test_the_command_is_straight_on():
    config = protocol.straight_ahead(0.75, 20.0)
    assert config.forward_speed == (0.75, 0.75) and config.heading == (0.0, 0.0) and config.push_speed == 0.0
    assert config.episode_seconds > 20.0 and config.command_seconds >= 20.0
