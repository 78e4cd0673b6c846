"""Lets the tests import the scripts, wherever pytest is started from."""

import os
import signal
import sys
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # read by `import torch`; the tests are of the CPU

import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import checkpoint
from baselines import make_policy
from faults import TASKS
from robots import ROBOTS

CARD = {"robot": "a1", "task": "stiffness", "policy": "rolt", "scan": False}
CARD |= {"seed": 0, "steps": 0, "stages": {}, "init": None, "curve": torch.ones(2, 5)}


def save_policy(path, weights=None, **card):
    """A policy.pt with these weights (default: fresh ones); returns its path as a word."""
    card = CARD | card
    if weights is None:
        robot, task = ROBOTS[card["robot"]], TASKS[card["task"]]
        weights = make_policy(card["policy"], robot, task, card["scan"]).state_dict()
    checkpoint.save(card | {"weights": weights, "critic": {}}, Path(path))
    return str(path)


@pytest.fixture(autouse=True)
def as_in_training():
    """A process has one thread, which also makes float sums repeatable. `train.main` catches the
    signals: afterwards Ctrl-C ends pytest again."""
    torch.set_num_threads(1)
    yield
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
