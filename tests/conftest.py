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
import train
from baselines import make_policy, training_stages
from env import EnvConfig, LocomotionEnv
from faults import TASKS
from ppo import collect, mean_action
from robots import A1, ROBOTS
from rolt import Decoder

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


def fresh_policy(name, task="stiffness", scan=False):
    """For the A1; the small last layer, which would hide differences, made large."""
    torch.manual_seed(0)
    policy = make_policy(name, A1, TASKS[task], scan)
    for module in policy.modules():
        if isinstance(module, Decoder):
            torch.nn.init.normal_(module.weight, std=0.2)
    return policy


def rollout_of(policy, stage=0, n=8, precision="fp32", task="stiffness"):
    """A stage of the training (train.py) with one rollout in its buffer, and its generator."""
    words = f"--task {task} --envs {n} --epochs 2 --minibatches 2 --precision {precision}"
    args = train.parse_arguments(f"{words} --threads 1 --device cpu --out none".split())
    stage = training_stages(policy, TASKS[task])[stage]
    run = train.StageRun(0, stage, args, 0, policy, "cpu")
    run.generator = torch.Generator().manual_seed(0)
    world = run.env, run.actor, run.critic, run.buffer, run.observation
    collect(*world, run.generator, run.learner.bf16)
    return run


@torch.no_grad()
def ratio(run, batch):
    """PPO's, of a minibatch of such a rollout."""
    mean = mean_action(run.actor, batch["observation"], batch["masks"], run.learner.bf16)
    log_prob = torch.distributions.Normal(mean, run.buffer.std).log_prob(batch["action"]).sum(-1)
    return (log_prob - batch["log_prob"]).exp()


def env_of(n, robot="a1", config=EnvConfig(), **options):
    """An env of n robots, of one thread, just reset."""
    env = LocomotionEnv(robot, n, num_threads=1, config=config, **options)
    env.reset()
    return env


def env_with(*faults, robot="a1", config=QUIET, **options):
    """An env of one robot a fault, just reset."""
    odds = [(1.0, fault) for fault in faults]
    env = LocomotionEnv(robot, len(faults), 0, 1, odds, config, **options)
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


def go_on_alike(one, two, rng, steps):
    """Both envs, given the same random actions, answer and lock alike to the bit."""
    for _ in range(steps):
        action = rng.normal(size=(one.num_envs, one.num_actions))
        answers = []
        for env in (one, two):
            seen, *answer, info = env.step(action)
            answers.append([*seen, *answer, info["position"], env.world.bind("eq_active")])
        assert all(map(np.array_equal, *answers))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(autouse=True)
def as_in_training():
    """A process has one thread, which also makes float sums repeatable. `train.main` catches the
    signals: afterwards Ctrl-C ends pytest again."""
    torch.set_num_threads(1)
    yield
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
