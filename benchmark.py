"""How near to the limit of this machine training runs, and how long a newcomer waits for a walk.

    python benchmark.py                       # one core: physics, policy, whole iterations; half a minute
    python benchmark.py --policies rolt mlp --robots a1 --scan
    python benchmark.py walk                  # trains until the robots walk at 80 % of their command, ROLT and MLP

The limit is what cannot be left away: MuJoCo's bare `Batch.step`, and the policy's and critic's
matrix products at the rate of one large product (in bf16 where training uses it). What is left are
masks, norms, attention's small products, copies, the optimiser. Times are of one thread, as in
training, and medians: on a shared machine only ratios are steady.
"""

import argparse
import csv
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from baselines import METHODS, make_policy, training_stages
from env import EnvConfig, LocomotionEnv
from faults import TASKS, first_task
from ppo import Critic, Learner, PPOConfig, RolloutBuffer, collect
from robots import ROBOTS

BF16 = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


def timed(function, times: list[float]):
    """`function`, which now also appends what each call takes to `times`."""

    def call(*args, **options):
        start = time.perf_counter()
        result = function(*args, **options)
        times.append(time.perf_counter() - start)
        return result

    return call


def product_rate(bf16: bool) -> float:
    """Floating-point operations a second of a large product, on one thread."""
    a, b = torch.randn(1024, 512), torch.randn(512, 512)
    if bf16:
        a, b = a.bfloat16(), b.bfloat16()
    times = []
    for _ in range(50):
        timed(torch.matmul, times)(a, b)
    return 2 * 1024 * 512 * 512 / statistics.median(times)


def iterations(robot: str, name: str, scan: bool, rounds: int = 4, num_envs: int = 256) -> None:
    """Prints what a whole iteration of training takes, by part, and which share of the limit that
    is."""
    task = TASKS[first_task(robot)]
    torch.manual_seed(0)
    policy = make_policy(name, ROBOTS[robot], task, scan)
    stage = training_stages(policy, task)[0]
    extras = tuple({*stage.extras, "privileged"})
    env = LocomotionEnv(robot, num_envs, 0, 1, stage.faults, EnvConfig(leg_frames=policy.leg_frames), extras)
    observation, generator = env.reset(random_ages=True), torch.Generator().manual_seed(0)
    critic = Critic(observation)
    learner = Learner(stage.actor, critic, PPOConfig(minibatches=num_envs * PPOConfig.steps // 1024), BF16)
    buffer = RolloutBuffer(PPOConfig.steps, observation, env.num_actions, policy.sample_masks(num_envs, generator), "cpu")

    with FlopCounterMode(display=False) as counter:
        observation, _ = collect(env, stage.actor, critic, buffer, observation, generator, BF16)
        learner.update(buffer, generator)
    operations = counter.get_total_flops() / len(buffer)  # a sample

    bare, step, acting, update = [], [], [], []
    env.world.step, env.step = timed(env.world.step, bare), timed(env.step, step)
    for _ in range(rounds):
        observation, _ = timed(collect, acting)(env, stage.actor, critic, buffer, observation, generator, BF16)
        timed(learner.update, update)(buffer, generator)
    del env.world.step, env.step  # or the world and its threads would never go: they hold themselves

    samples = rounds * len(buffer)
    whole, physics = (sum(acting) + sum(update)) / samples, sum(bare) / samples
    limit = physics + operations / product_rate(BF16)
    parts = {"physics": physics, "rest of env.step": sum(step) / samples - physics}
    parts |= {"acting": (sum(acting) - sum(step)) / samples, "update": sum(update) / samples}
    words = ", ".join(f"{part} {1e6 * seconds:.0f}" for part, seconds in parts.items())
    print(f"{robot} {name}{' with scan' * scan}: {1 / whole:,.0f} env steps/s, {limit / whole:.0%} of the limit ({words} us)")


def time_to_walk(robot: str, name: str, most_steps: int = 5_000_000) -> None:
    """Trains on all cores until the speed has been 80 % of the command over ten iterations; prints
    minutes and steps."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["--robot", robot, "--policy", name, "--out", folder, "--save-minutes", "1000"]
        start = time.monotonic()
        training = subprocess.Popen([sys.executable, Path(__file__).parent / "train.py", *words], stdout=subprocess.DEVNULL)
        rows = []
        while training.poll() is None and (not rows or int(rows[-1]["steps"]) < most_steps):
            time.sleep(2)
            if (Path(folder) / "progress.csv").exists():
                with open(Path(folder) / "progress.csv", newline="") as file:
                    rows = [row for row in csv.DictReader(file) if row["divergences"] is not None]
            speed, command = (np.sum([float(row[key]) for row in rows[-10:]]) for key in ("speed", "commanded_speed"))
            if len(rows) >= 10 and speed >= 0.8 * command:
                minutes = (time.monotonic() - start) / 60
                print(f"{robot} {name}: walks after {minutes:.1f} minutes, {int(rows[-1]['steps']) / 1e6:.2f}M env steps", flush=True)
                break
        else:
            print(f"{robot} {name}: does not walk yet after {most_steps / 1e6:.0f}M env steps", flush=True)
        training.terminate()
        training.wait()


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, usage=argparse.SUPPRESS
    )
    parser.add_argument("what", nargs="?", choices=("rates", "walk"), default="rates")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=["a1"])
    parser.add_argument("--policies", nargs="+", choices=METHODS, default=["rolt", "mlp"])
    parser.add_argument("--scan", action="store_true", help="with the height scan")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    for robot in args.robots:
        for name in args.policies:
            time_to_walk(robot, name) if args.what == "walk" else iterations(robot, name, args.scan)


if __name__ == "__main__":
    main()
