"""The Gymnasium env, where Gymnasium is installed."""

import numpy as np
import pytest

checker = pytest.importorskip("gymnasium.utils.env_checker")

from env import EnvConfig  # noqa: E402
from vector_env import WalkingRobots  # noqa: E402


def test_it_keeps_gymnasiums_contract():
    envs = WalkingRobots("a1", 4, num_threads=1, config=EnvConfig(episode_seconds=0.2))
    checker.check_reset_seed_determinism(envs)
    checker.check_reset_return_type(envs)
    zeros, tries = np.zeros((4, 12), dtype=np.float32), []
    for _ in range(2):
        envs.reset(seed=1)
        tries.append(envs.step(zeros))
    assert checker.data_equivalence(tries[0], tries[1])
    observation, _ = envs.reset(seed=0)
    assert observation in envs.observation_space and set(observation) == {"legs", "action"}
    for step in range(1, 11):
        observation, reward, terminated, truncated, info = envs.step(zeros)
        assert observation in envs.observation_space and reward.shape == (4,)
        assert truncated.all() == (step == 10) and ("final_obs" in info) == (step == 10)
    last = info["final_obs"][2]
    assert last in envs.single_observation_space
    assert not np.array_equal(last["legs"], observation["legs"][2])  # the next episode's
