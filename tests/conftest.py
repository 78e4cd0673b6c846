"""Lets the tests import the scripts, wherever pytest is started from."""

import os
import sys
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # read when torch is imported: the tests are of the CPU, and so are their subprocesses

import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))


@pytest.fixture(autouse=True)
def one_thread():
    """As in training: a process has one thread. Also makes float sums repeatable."""
    torch.set_num_threads(1)
