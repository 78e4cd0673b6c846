"""Lets the tests import the scripts, wherever pytest is started from."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))


@pytest.fixture(autouse=True)
def one_thread():
    """As in training: a process has one thread. Also makes float sums repeatable."""
    torch.set_num_threads(1)
