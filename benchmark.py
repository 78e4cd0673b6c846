"""How near to this machine's limit training runs, and how long a newcomer waits for a walk.

    python benchmark.py --policies rolt mlp    # one core, whole iterations; half a minute
    python benchmark.py walk                   # trains until the speed is 80 % of the command

The limit is what cannot be left away: MuJoCo's bare `Batch.step`, and the policy's and critic's
matrix products at the rate of one large product (in bf16 where training uses it). What is left are
masks, norms, attention's small products, copies, the optimiser. Times are of one thread, as in
training; on a shared machine only ratios are steady.
"""

import argparse
import csv
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

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
    dtype, times = torch.bfloat16 if bf16 else torch.float32, []
    a, b = torch.randn(1024, 512).to(dtype), torch.randn(512, 512).to(dtype)
    for _ in range(50):
        timed(torch.matmul, times)(a, b)
    return 2 * 1024 * 512 * 512 / statistics.median(times)


def iterations(robot: str, name: str, scan: bool, rounds: int = 4, num_envs: int = 256) -> None:
    """Prints the time of a whole training iteration, by part, and which share the limit has."""
    task, generator = TASKS[first_task(robot)], torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    policy = make_policy(name, ROBOTS[robot], task, scan)
    stage = training_stages(policy, task)[0]
    config, extras = EnvConfig(leg_frames=policy.leg_frames), {*stage.extras, "privileged"}
    env = LocomotionEnv(robot, num_envs, 0, 1, stage.faults, config, tuple(extras))
    observation = env.reset(random_ages=True)
    critic, T = Critic(observation), PPOConfig.steps
    learner = Learner(stage.actor, critic, PPOConfig(minibatches=num_envs * T // 1024), BF16)
    masks = policy.sample_masks(num_envs, generator)
    buffer = RolloutBuffer(T, observation, env.num_actions, masks, "cpu")
    parts = (env, stage.actor, critic, buffer)

    with FlopCounterMode(display=False) as counter:
        observation, _ = collect(*parts, observation, generator, BF16)
        learner.update(buffer, generator)
    operations = counter.get_total_flops() / len(buffer)  # a sample

    bare, step, acting, update = [], [], [], []
    env.world.step, env.step = timed(env.world.step, bare), timed(env.step, step)
    for _ in range(rounds):
        observation, _ = timed(collect, acting)(*parts, observation, generator, BF16)
        timed(learner.update, update)(buffer, generator)
    del env.world.step, env.step  # or the world and its threads would never go: a cycle

    samples = rounds * len(buffer)  # from here on in us a sample
    bare, step, acting, update = (1e6 * sum(x) / samples for x in (bare, step, acting, update))
    whole, limit = acting + update, bare + 1e6 * operations / product_rate(BF16)
    rate = f"{1e6 / whole:,.0f} env steps/s, {limit / whole:.0%} of the limit"
    words = f"physics {bare:.0f}, rest of env.step {step - bare:.0f}, acting {acting - step:.0f}"
    print(f"{robot} {name}{' with scan' * scan}: {rate} ({words}, update {update:.0f} us)")


def time_to_walk(robot: str, name: str, most_steps: int = 5_000_000) -> None:
    """Trains on all cores until the speed has been 80 % of the command over ten iterations."""
    with tempfile.TemporaryDirectory() as folder:
        program, file = Path(__file__).parent / "train.py", Path(folder) / "progress.csv"
        words = ["--robot", robot, "--policy", name, "--out", folder, "--save-minutes", "1000"]
        start, rows, says = time.monotonic(), [], f"does not walk in {most_steps / 1e6:.0f}M steps"
        training = subprocess.Popen([sys.executable, program, *words], stdout=subprocess.DEVNULL)
        while training.poll() is None and (not rows or int(rows[-1]["steps"]) < most_steps):
            time.sleep(2)
            if file.exists():  # its last row may be half written
                table = csv.DictReader(file.read_text().splitlines())
                rows = [row for row in table if row["divergences"] is not None]
            speed = sum(float(row["speed"]) for row in rows[-10:])
            command = sum(float(row["commanded_speed"]) for row in rows[-10:])
            if len(rows) >= 10 and speed >= 0.8 * command:
                minutes, steps = (time.monotonic() - start) / 60, int(rows[-1]["steps"]) / 1e6
                says = f"walks after {minutes:.1f} minutes, {steps:.2f}M env steps"
                break
        print(f"{robot} {name}: {says}", flush=True)
        training.terminate()
        training.wait()


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
            time_to_walk(robot, name) if args.what == "walk" else iterations(robot, name, args.scan)


if __name__ == "__main__":
    main()
