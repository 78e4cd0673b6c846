"""The env as a Gymnasium vector env, for who brings a library of their own (pip install gymnasium;
PYTHONPATH is this repository's folder).

    envs = WalkingRobots("a1", 64, faults=[(0.5, "healthy"), (0.5, "lock:FR_calf")])
    observation, info = envs.reset(seed=0)
"""

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from env import MAX_ACTION, LocomotionEnv


class WalkingRobots(VectorEnv):
    """Arguments are LocomotionEnv's, observations dictionaries of its fields. Whose episode ends
    starts over in the same step; after time-outs info["final_obs"] has what was seen last. After a
    fall it has not: what cannot go on needs no bootstrap."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, robot: str, num_envs: int, **options):
        self.make = lambda **seed: LocomotionEnv(robot, num_envs, **options | seed)
        self.env, self.num_envs = self.make(), num_envs
        fields = self._told(self.env.reset()).items()
        boxes = {name: gym.spaces.Box(-np.inf, np.inf, x.shape[1:]) for name, x in fields}
        self.single_observation_space = gym.spaces.Dict(boxes)
        actions = (self.env.num_actions,)
        self.single_action_space = gym.spaces.Box(-MAX_ACTION, MAX_ACTION, actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:  # else the random numbers go on
            self.env = self.make(seed=seed)
        return self._told(self.env.reset()), {}

    def step(self, actions):
        observation, reward, terminated, truncated, told = self.env.step(np.asarray(actions))
        info = {key: told[key] for key in ("position", "speed", "commanded_speed", "diverged")}
        if truncated.any():
            final = self._told(told["final_observation"])
            info["final_obs"], info["_final_obs"] = np.full(self.num_envs, None), truncated
            for i, robot in enumerate(told["truncated_ids"]):
                info["final_obs"][robot] = {name: x[i] for name, x in final.items()}
        return self._told(observation), reward, terminated, truncated, info

    @staticmethod
    def _told(observation) -> dict[str, np.ndarray]:
        return {name: x for name, x in observation._asdict().items() if x.size}
