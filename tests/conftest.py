"""Lets the tests import the scripts, wherever pytest is started from; what several tests use."""

import os
import signal
import sys
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # read by `import torch`; the tests are of the CPU

import numpy as np
import pytest
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import checkpoint
from baselines import make_policy
from env import EnvConfig, LocomotionEnv
from faults import TASKS
from robots import ROBOTS

CARD = {"robot": "a1", "task": "stiffness", "policy": "rolt", "scan": False}
CARD |= {"seed": 0, "steps": 0, "stages": {}, "init": None, "curve": torch.ones(2, 5)}
QUIET = EnvConfig(  # nothing is left to chance
    push_speed=0.0, start_speed=0.0, start_pose=(1.0, 1.0), friction=(1.0, 1.0),
    forward_speed=(0.5, 0.5), heading=(0.0, 0.0),
)  # fmt: skip


def save_policy(path, weights=None, **card):
    """A policy.pt with these weights (default: fresh ones); returns its path as a word."""
    card = CARD | card
    if weights is None:
        robot, task = ROBOTS[card["robot"]], TASKS[card["task"]]
        weights = make_policy(card["policy"], robot, task, card["scan"]).state_dict()
    checkpoint.save(card | {"weights": weights, "critic": {}}, Path(path))
    return str(path)


def env_of(n, robot="a1", config=EnvConfig(), **options):
    """An env of n robots, of one thread, just reset."""
    env = LocomotionEnv(robot, n, num_threads=1, config=config, **options)
    env.reset()
    return env


def env_with(*faults, robot="a1", config=QUIET, **options):
    """An env of one robot a fault, just reset."""
    options = {"num_threads": 1, "faults": [(1.0, fault) for fault in faults]} | options
    env = LocomotionEnv(robot, len(faults), config=config, **options)
    env.pin_faults(list(faults))
    env.reset()
    return env


def rest(env, steps=1):
    """Zero actions; what the env answers to the last of them."""
    for _ in range(steps):
        answer = env.step(np.zeros((env.num_envs, env.num_actions)))
    return answer


def flail(env, rng, steps=1):
    """Random actions; what the env answers to the last of them."""
    for _ in range(steps):
        answer = env.step(rng.normal(size=(env.num_envs, env.num_actions)))
    return answer


@pytest.fixture(autouse=True)
def as_in_training():
    """A process has one thread, which also makes float sums repeatable. `train.main` catches the
    signals: afterwards Ctrl-C ends pytest again."""
    torch.set_num_threads(1)
    yield
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
