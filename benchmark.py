"""How near to this machine's limit training runs, and how long a newcomer waits for a walk.

    python benchmark.py --policies rolt mlp    # one core, whole iterations; half a minute
    python benchmark.py walk                   # 2M steps: when was it at 80 % of the command?

The limit is what cannot be left away: MuJoCo's bare `Batch.step`, and the policy's and critic's
matrix products at the rate of one large product (in bf16 where training uses it). Times are of one
thread, as in training; on a shared machine only ratios are steady.
"""

import argparse
import subprocess
import sys
import tempfile
import time
import timeit
from pathlib import Path

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

import train
from baselines import METHODS, make_policy, training_stages
from faults import TASKS
from ppo import collect
from robots import ROBOTS


def timed(function, times: list[float]):
    """`function`, which now also appends what each call takes to `times`."""

    def call(*args, **options):
        start = time.perf_counter()
        result = function(*args, **options)
        times.append(time.perf_counter() - start)
        return result

    return call


def iterations(words: list[str]) -> None:
    """Prints the time of a whole training iteration, by part, and which share the limit has."""
    small = ["--envs", "256", "--minibatches", "6", "--threads", "1", "--device", "cpu"]
    args = train.parse_arguments([*words, *small, "--out", tempfile.gettempdir() + "/none"])
    policy = make_policy(args.policy, ROBOTS[args.robot], TASKS[args.task], args.scan)
    stage, bf16 = training_stages(policy, TASKS[args.task])[0], args.precision == "bf16"
    run, generator = train.StageRun(0, stage, args, 0, policy, "cpu"), torch.Generator()
    parts = (run.env, run.actor, run.critic, run.buffer)

    with FlopCounterMode(display=False) as counter:
        observation, _ = collect(*parts, run.observation, generator, bf16)
        run.learner.update(run.buffer, generator)
    operations = counter.get_total_flops() / len(run.buffer)  # a sample

    bare, step, acting, update = [], [], [], []
    world = run.env.world
    world.step, run.env.step = timed(world.step, bare), timed(run.env.step, step)
    for _ in range(4):
        observation, _ = timed(collect, acting)(*parts, observation, generator, bf16)
        timed(run.learner.update, update)(run.buffer, generator)
    del world.step, run.env.step  # or the world and its threads would never go: a cycle

    a, b = torch.randn(2, 512, 512, dtype=torch.bfloat16 if bf16 else torch.float32)
    product = min(timeit.repeat(lambda: a @ b, number=1, repeat=100))  # s

    samples = len(acting) * len(run.buffer)  # from here on in us a sample
    bare, step, acting, update = (1e6 * sum(x) / samples for x in (bare, step, acting, update))
    whole, limit = acting + update, bare + 1e6 * operations * product / (2 * 512**3)
    rate = f"{1e6 / whole:,.0f} env steps/s, {limit / whole:.0%} of the limit"
    parts = f"physics {bare:.0f}, rest of env.step {step - bare:.0f}, acting {acting - step:.0f}"
    print(f"{' '.join(words)}: {rate} ({parts}, update {update:.0f} us)")


def time_to_walk(words: list[str]) -> None:
    """Trains on all cores; prints when the speed was 80 % of the command over ten iterations."""
    with tempfile.TemporaryDirectory() as folder:
        program = [sys.executable, Path(__file__).parent / "train.py", "--steps", "2e6"]
        subprocess.run([*program, *words, "--out", folder], stdout=subprocess.DEVNULL, check=True)
        rows = np.genfromtxt(f"{folder}/progress.csv", delimiter=",", names=True)
    minutes = np.cumsum(rows["collect_seconds"] + rows["update_seconds"]) / 60
    excess = np.convolve(rows["speed"] - 0.8 * rows["commanded_speed"], np.ones(10), "valid")
    walks = np.flatnonzero(excess >= 0) + 9  # excess[0] is of iterations 0 to 9
    says = "does not walk in 2M steps"
    if len(walks):
        i = walks[0]
        says = f"walks after {minutes[i]:.1f} minutes, {rows['steps'][i] / 1e6:.2f}M env steps"
    print(f"{' '.join(words)}: {says}", flush=True)


def main(argv: list[str] | None = None) -> None:
    style = {"formatter_class": argparse.RawDescriptionHelpFormatter, "usage": argparse.SUPPRESS}
    parser = argparse.ArgumentParser(description=__doc__, **style)
    parser.add_argument("what", nargs="?", choices=("rates", "walk"), default="rates")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=["a1"])
    parser.add_argument("--policies", nargs="+", choices=METHODS, default=["rolt", "mlp"])
    parser.add_argument("--scan", action="store_true", help="with the height scan")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    for robot in args.robots:
        for name in args.policies:
            words = ["--robot", robot, "--policy", name]
            if args.scan:
                words.append("--scan")
            time_to_walk(words) if args.what == "walk" else iterations(words)


if __name__ == "__main__":
    main()
