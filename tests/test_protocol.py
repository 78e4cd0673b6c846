"""Every number of the results goes through here: episodes on a world that plays back what was written by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import protocol
from env import CONTROL_DT, Observation
from faults import healthy, lock, skate


class Playback:
    """Robot i walks 0.1 (i + 1) m and earns 1 a step. Those with a locked leg fall in step 3, begin again at 0, and fall in
    step 5 once more; those that skate diverge in step 4."""

    def __init__(self, robot, num_envs, seed, threads, situations, config, extras, **options):
        self.config, self.num_envs, self.step_number = config, num_envs, 0
        self.position, self.divergences = np.zeros((num_envs, 3)), 0

    def pin_faults(self, faults):
        self.locked, self.skating = np.array([(bool(fault.locked), bool(fault.skating)) for fault in faults]).T

    def reset(self):
        return Observation(*(np.zeros((self.num_envs, 1), np.float32) for _ in range(6)))

    def step(self, action):
        self.step_number += 1
        before = self.position.copy()
        before[:, 0] += 0.1 * np.arange(1, self.num_envs + 1)
        diverged = self.skating & (self.step_number == 4)
        fallen = self.locked & (self.step_number in (3, 5)) | diverged
        before[diverged], self.divergences = 1e9, self.divergences + diverged.sum()
        self.position = np.where(fallen[:, None], 0.0, before)
        info = {"position": before, "diverged": diverged}
        return self.reset(), 1.0 - diverged, fallen, np.zeros(self.num_envs, bool), info


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


def test_a_simulation_that_diverges_ends_where_it_last_was_and_is_told(policy, capsys):
    outcome = protocol.run_episodes(policy, "a1", [healthy(), skate("FR")], 0.75, 10 * CONTROL_DT)
    assert outcome["distance_m"] == pytest.approx([10 * 0.1, 3 * 0.2]) and outcome["episode_return"] == pytest.approx([10, 3])
    assert outcome["fall_time_s"] == pytest.approx([10 * CONTROL_DT, 4 * CONTROL_DT])
    assert capsys.readouterr().err == "simulations that diverged, counted as falls: 1\n"


def test_rows_name_the_case_that_they_are_of(policy):
    args = SimpleNamespace(
        policies={"a.pt": (policy, {"policy": "mlp", "method": "mlp", "task": "stiffness", "seed": 7})}, scenes={},
        robot="a1", episodes=2, seconds=10 * CONTROL_DT, seed=0, threads=1,
    )  # fmt: skip
    rows = protocol.run_cases(args, {"healthy": healthy(), "FR": lock("FR_calf")}, 0.75)
    told = [(row["method"], row["seed"], row["case"], row["episode"], float(row["distance_m"])) for row in rows]
    assert told == [("mlp", 7, "healthy", 0, 1.0), ("mlp", 7, "healthy", 1, 2.0), ("mlp", 7, "FR", 0, 0.9), ("mlp", 7, "FR", 1, 1.2)]


def test_seeds_are_put_together_and_shown_one_by_one(capsys):
    rows = [{"method": "rolt", "seed": i // 2, "case": "FR", "distance_m": f"{x}"} for i, x in enumerate((1, 3, 5, 7))]
    rows += [{"method": "mlp", "seed": 0, "case": "FR", "distance_m": "2.0"}]
    table = protocol.print_table(rows, ["FR"], ["FR"], "distance_m", "distance")
    assert table["rolt"] == (pytest.approx([4.0]), pytest.approx([5**0.5])) and table["mlp"][0] == [2.0]
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["rolt", "4.00", "±", "2.24"] in lines and ["mlp", "2.00", "±", "0.00"] in lines
    assert ["seed", "0", "2.00", "±", "1.00"] in lines and ["seed", "1", "6.00", "±", "1.00"] in lines
    assert sum(line[:1] == ["seed"] for line in lines) == 2  # of a method with one seed there is nothing to add


def test_the_command_is_straight_on():
    config = protocol.straight_ahead(0.75, 20.0)
    assert config.forward_speed == (0.75, 0.75) and config.heading == (0.0, 0.0) and config.push_speed == 0.0
    assert config.episode_seconds > 20.0 and config.command_seconds >= 20.0
