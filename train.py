"""Trains a policy: PPO on every core, or on a GPU.

    python train.py --robot a1                      # ROLT on the stiffness task
    python train.py --steps 50000 --out runs/try    # does it run? half a minute
    python train.py --robot a1 --resume             # goes on where it was stopped (Ctrl-C is safe)
    python train.py --task terrain --init runs/a1-stiffness-rolt-seed0/checkpoint.pt    # stairs
    torchrun --nproc-per-node=2 train.py --paper --device cuda    # the paper's size, on two GPUs

Everything goes to runs/ROBOT-TASK-POLICY-seedN (or --out): policy.pt (for evaluate.py),
checkpoint.pt (for --resume), progress.csv (a row an iteration) and progress.png.

On a CPU every core gets a process with its share of the robots, and gradients are averaged: two
processes of one thread run nearly twice as fast as one process of two threads.
"""

import argparse
import csv
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist

import checkpoint
from baselines import METHODS, Stage, make_policy, training_stages
from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import TASKS, first_task
from plots import learning_curve
from ppo import Critic, PPOConfig, RolloutBuffer, all_reduce, collect
from rewards import REWARDS
from robots import ROBOTS

# What a run may not change when it is resumed.
IDENTITY = (
    "robot", "task", "policy", "scan", "steps", "envs", "epochs", "minibatches", "seed", "device",
    "precision", "processes", "init",
)  # fmt: skip
EPISODES = ("episodes", "returns", "lengths", "falls")  # that ended, added up over a rollout


def parse_arguments(argv: list[str] | None = None):
    def count(text: str) -> int:
        """A whole number above 0; 6e6 is fine."""
        if not (float(text) > 0 and float(text).is_integer()):
            raise ValueError
        return int(float(text))

    style = {"formatter_class": argparse.RawDescriptionHelpFormatter, "usage": argparse.SUPPRESS}
    parser = argparse.ArgumentParser(description=__doc__, **style)
    add = parser.add_argument
    add("--robot", choices=ROBOTS, default="a1")
    add("--task", choices=TASKS, help="faults to train with (default: the robot's first one)")
    add("--policy", choices=METHODS, default="rolt")
    add("--steps", type=count, default=10_000_000, help="of all robots; later stages come on top")
    add("--envs", type=count, default=512, help="robots simulated at once")
    add("--epochs", type=count, default=PPOConfig.epochs, help="over each rollout")
    add("--minibatches", type=count, default=PPOConfig.minibatches, help="an epoch")
    add("--paper", action="store_true", help="4096 robots, 400M steps, 5 epochs of 4 minibatches")
    add("--scan", action="store_true", help="the height scan on flat ground, too (as in the paper)")
    add("--init", metavar="FILE", help="a checkpoint.pt to start from: flat, then stairs")
    add("--seed", type=int, default=0)
    add("--device", choices=("auto", "cpu", "cuda"), default="auto", help="auto: cuda if any")
    add("--precision", choices=("auto", "fp32", "bf16"), default="auto", help="auto: bf16 if fast")
    add("--threads", type=count, help="cores to use (default: all, or as many as divide --envs)")
    add("--out", type=Path, help="folder of the run (default: runs/ROBOT-TASK-POLICY-seedN)")
    add("--resume", action="store_true", help="go on from the checkpoint in that folder")
    add("--save-minutes", type=float, default=3.0, help="time between two checkpoints")
    args = parser.parse_args(argv)
    if args.paper:  # what is said beside it still counts
        parser.set_defaults(envs=4096, steps=400_000_000, epochs=5, minibatches=4)
        args = parser.parse_args(argv)

    args.task = args.task or first_task(args.robot)
    task = TASKS[args.task]
    args.scan |= task.terrain is not None
    args.out = args.out or Path(f"runs/{args.robot}-{args.task}-{args.policy}-seed{args.seed}")
    if args.robot not in task.robots:
        parser.error(f"the task {args.task} is for {', '.join(task.robots)}, not for {args.robot}")

    if args.device == "cuda" and not torch.cuda.is_available():
        parser.error("torch finds no CUDA device; leave --device away to train on the CPU")
    if args.device == "auto":
        args.device = "cuda" if torch.cuda.is_available() else "cpu"
    cuda, cpu = args.device == "cuda", torch.cpu
    fast = cuda or cpu._is_avx512_bf16_supported() or cpu._is_amx_tile_supported()
    if args.precision == "auto":
        args.precision = "bf16" if fast else "fp32"
    elif args.precision == "bf16" and not fast:
        print("warning: no bf16 on this processor; --precision fp32 is faster", file=sys.stderr)

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if args.threads is None:
        args.threads = max(n for n in range(1, cores + 1) if cuda or args.envs % n == 0)
    args.processes = int(os.environ.get("WORLD_SIZE", 1 if cuda else args.threads))
    if args.envs % args.processes:
        parser.error(f"{args.envs} robots do not divide among {args.processes} processes")
    samples = args.envs // args.processes * PPOConfig.steps
    if samples < args.minibatches or args.epochs * args.minibatches < 2:
        parser.error("a rollout has to fill its minibatches; an update takes two steps at least")

    if args.resume != (args.out / "checkpoint.pt").exists():
        what = "nothing to resume" if args.resume else "a run already: --resume, or another --out"
        parser.error(f"{args.out} holds {what}")
    return args


class Part:
    """One stage of the training (most methods have one): its robots, buffer, critic and learner."""

    def __init__(self, number: int, stage: Stage, args, rank: int, policy, device):
        threads, n = 1, args.envs // args.processes
        if args.device == "cuda":  # torchrun's processes share the cores of their machine
            threads = max(1, args.threads // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))
        config = EnvConfig(leg_frames=policy.leg_frames)
        extras = tuple({*stage.extras, "privileged"})
        seeds, terrain = (args.seed, rank, number), TASKS[args.task].terrain
        actor, bf16 = stage.actor, args.precision == "bf16"
        env = LocomotionEnv(args.robot, n, seeds, threads, stage.faults, config, extras, terrain)
        observation = env.reset(random_ages=True)
        self.number, self.actor, self.env, self.observation = number, actor, env, observation

        self.critic = (stage.critic or Critic(observation)).to(device)
        policy.requires_grad_(False)
        for trained in stage.trained:
            trained.requires_grad_(True)
        masks = actor.sample_masks(n, torch.Generator(device)) if actor.replays_masks else {}
        self.buffer = RolloutBuffer(PPOConfig.steps, observation, env.num_actions, masks, device)
        ppo = PPOConfig(epochs=args.epochs, minibatches=args.minibatches)
        self.learner = stage.learner(actor, self.critic, ppo, bf16)


def train(rank: int, args, sync: str | None = None) -> None:
    """The training of one process. sync: where the processes meet (dist's init_method)."""
    signals, stop = [], False  # Ctrl-C and SIGTERM: all processes save and end after the iteration
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: signals.append(True))
    device, backend = torch.device("cpu"), "gloo"
    if args.device == "cuda":
        device, backend = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))), "nccl"
        torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")  # TF32, in rollout and update alike
    if args.processes > 1:
        dist.init_process_group(backend, sync, rank=rank, world_size=args.processes)
    torch.set_num_threads(1)

    task, robot, bf16 = TASKS[args.task], ROBOTS[args.robot], args.precision == "bf16"
    torch.manual_seed(args.seed)  # the same weights in every process
    policy = make_policy(args.policy, robot, task, args.scan).to(device)
    stages = training_stages(policy, task)
    lengths = {stage.name: round(args.steps * stage.share) for stage in stages}
    ends = np.cumsum(list(lengths.values())).tolist()  # of each stage, in env steps
    generator = torch.Generator(device).manual_seed(args.seed * 1_000_003 + rank)
    part = Part(0, stages[0], args, rank, policy, device)
    iteration = steps = 0
    recent = np.zeros((20, len(EPISODES)))  # a row an iteration: in one alone few episodes end
    if rank == 0:
        plan = ", then ".join(f"{length:,} steps ({name})" for name, length in lengths.items())
        plan += f"; {args.envs} robots, {args.processes} processes, {args.precision}"
        print(f"{args.policy}: {plan}", flush=True)

    if args.resume:
        saved = checkpoint.load(args.out / "checkpoint.pt")
        was = saved["identity"]
        changed = [f"--{k} {was.get(k)}" for k in IDENTITY if was.get(k) != getattr(args, k)]
        if changed:
            words = f"the run in {args.out} had {', '.join(changed)}"
            raise checkpoint.CheckpointError(f"{words}: say so, or choose another --out")
        iteration, steps, recent = saved["iteration"], saved["steps"], saved["recent"].numpy()
        part = Part(saved["stage"], stages[saved["stage"]], args, rank, policy, device)
        policy.load_state_dict(saved["weights"])
        part.critic.load_state_dict(saved["critic"])
        part.learner.load_state_dict(saved["learner"])
        mine = saved["processes"][rank]
        part.env.load_state_dict({key: to_array(value) for key, value in mine["env"].items()})
        generator.set_state(mine["generator"])
        torch.set_rng_state(saved["torch"])
        part.observation = part.env.observe()
    elif args.init:
        checkpoint.start_from(args.init, policy, part.critic)

    def save() -> None:
        """All that the next iteration depends on; each process sends its part to process 0."""
        env = {key: to_tensor(value) for key, value in part.env.state_dict().items()}
        mine = {"env": env, "generator": generator.get_state()}
        everyone = [mine] * args.processes
        if args.processes > 1:
            dist.gather_object(mine, everyone if rank == 0 else None)
        if rank == 0:
            words = ("robot", "task", "policy", "scan", "seed", "init")
            card = {key: getattr(args, key) for key in words} | {"steps": steps, "stages": lengths}
            card["weights"] = {name: x.cpu() for name, x in policy.state_dict().items()}
            content = {"critic": part.critic.state_dict(), "learner": part.learner.state_dict()}
            content |= {"iteration": iteration, "stage": part.number}
            content |= {"recent": torch.from_numpy(recent), "processes": everyone}
            content["torch"] = torch.get_rng_state()
            content["identity"] = {key: getattr(args, key) for key in IDENTITY}
            checkpoint.save(card | content, args.out / "checkpoint.pt")
            checkpoint.save(card, args.out / "policy.pt")
            if steps >= ends[0] * snapshots / 5:  # to see how a policy grew
                checkpoint.save(card, args.out / f"policy-{steps / 1e6:.1f}M.pt")
            learning_curve(args.out / "progress.csv", args.out / "progress.png")

    progress = Progress(args.out / "progress.csv", iteration, steps, ends[-1])
    saved_at = time.monotonic()
    snapshots = steps * 5 // ends[0] + 1  # the next one, of five in the first stage
    while steps < ends[-1] and not stop:
        if steps >= ends[part.number]:
            part = Part(part.number + 1, stages[part.number + 1], args, rank, policy, device)
        begun = ends[part.number - 1] if part.number else 0
        started = time.perf_counter()
        part.observation, infos = collect(
            part.env, part.actor, part.critic, part.buffer, part.observation, generator, bf16
        )
        collected = time.perf_counter()
        done = (steps - begun) / (ends[part.number] - begun)
        losses = part.learner.update(part.buffer, generator, done)
        updated = time.perf_counter()
        iteration, steps = iteration + 1, steps + len(part.buffer) * args.processes

        due = rank == 0 and time.monotonic() - saved_at > 60 * args.save_minutes
        figures = summarise(infos, part.buffer, part.env) | {"due": due, "stop": bool(signals)}
        sums = torch.tensor([float(x) for x in figures.values()], dtype=torch.float64)
        figures = dict(zip(figures, all_reduce(sums.to(device)).tolist()))
        recent = np.vstack([recent[1:], [figures.pop(name) for name in EPISODES]])
        due, stop = figures.pop("due"), figures.pop("stop")  # on which all processes must agree
        if rank == 0:
            row = {"iteration": iteration, "steps": steps, "stage": part.number}
            row |= {name: figure / args.processes for name, figure in figures.items()}
            row["std"] = part.actor.std().mean().item()
            row |= {"learning_rate": part.learner.learning_rate} | losses
            row |= {"collect_seconds": collected - started, "update_seconds": updated - collected}
            progress.log(row, *recent.sum(axis=0))
        if due or stop or steps >= ends[-1] or steps >= ends[0] * snapshots / 5:
            save()
            saved_at, snapshots = time.monotonic(), steps * 5 // ends[0] + 1

    if rank == 0 and steps < ends[-1]:
        print(f"\nstopped at {steps:,} steps and saved; the same command with --resume goes on")
    elif rank == 0:
        print(f"\nthe policy: {args.out / 'policy.pt'}; what to do with it: evaluate.py --help")
    if args.processes > 1:
        dist.destroy_process_group()


def to_tensor(value):
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def to_array(value):
    return value.numpy() if isinstance(value, torch.Tensor) else value


def summarise(infos: list[dict], buffer: RolloutBuffer, env: LocomotionEnv) -> dict[str, float]:
    """What a rollout was like on this process's robots."""
    names, T = ("speed", "commanded_speed"), len(infos)
    figures = {name: sum(i[name].mean() for i in infos) / T for name in names}
    figures["row"] = env.row.mean()  # of the terrain: how far the curriculum is
    for name in (term.__name__ for term in REWARDS):
        figures[f"reward_{name}"] = sum(i["rewards"][name].mean() for i in infos) / T
    figures["divergences"] = sum(i["diverged"].sum() for i in infos)
    figures["episodes"] = sum(len(i["episode_returns"]) for i in infos)
    figures["returns"] = sum(i["episode_returns"].sum() for i in infos)
    figures["lengths"] = sum(i["episode_lengths"].sum() for i in infos)
    return figures | {"falls": buffer.terminated.sum()}


class Progress:
    """One CSV row an iteration, and the live line."""

    def __init__(self, path: Path, iteration: int, steps: int, total: int):
        """iteration: from which a run goes on; later rows of an earlier try are dropped."""
        self.path, self.total, self.first, self.start = path, total, steps, time.monotonic()
        self.rows, self.written = [], None  # and the columns of the file as it is
        if iteration:
            with open(path, newline="") as file:
                self.rows = [x for x in csv.DictReader(file) if int(x["iteration"]) <= iteration]

    def log(self, row: dict, episodes: float, returns: float, lengths: float, falls: float) -> None:
        """Writes the row and prints the line. The last four: sums over the last iterations."""
        sums = (returns, lengths * CONTROL_DT, falls)
        recent = [x / episodes if episodes else np.nan for x in sums]
        row |= dict(zip(("episode_return", "episode_seconds", "falls"), recent))
        row = {name: f"{x:.6g}" if isinstance(x, float) else str(x) for name, x in row.items()}
        self.rows.append(row)
        if self.written and row.keys() <= self.written.keys():
            with open(self.path, "a", newline="") as file:
                csv.DictWriter(file, self.written, restval="nan").writerow(row)
        else:  # the first row, or the first one of another stage with other losses
            self.written = dict.fromkeys(name for row in self.rows for name in row)
            with open(f"{self.path}.tmp", "w", newline="") as file:
                writer = csv.DictWriter(file, self.written, restval="nan")
                writer.writeheader()
                writer.writerows(self.rows)
            os.replace(f"{self.path}.tmp", self.path)

        steps, total = int(row["steps"]), self.total
        rate = (steps - self.first) / (time.monotonic() - self.start)
        speed, command, std = (float(row[name]) for name in ("speed", "commanded_speed", "std"))
        line = (
            f"[{'#' * int(20 * steps / total):.<20.20}] {steps / 1e6:.2f}/{total / 1e6:.2f}M"
            f" {rate:,.0f}/s {max(0, total - steps) / rate / 60:.0f} min left"
            f" | return {recent[0]:.1f} speed {speed:.2f} of {command:.2f} m/s"
            f" episode {recent[1]:.1f} s falls {recent[2]:.0%} std {std:.2f}"
        )
        if sys.stdout.isatty():
            print(f"\r{line}\033[K", end="", flush=True)
        elif int(row["iteration"]) % 10 == 1:  # not to fill a log
            print(line, flush=True)


def guarded(rank: int, args, sync: str | None = None) -> None:
    """`train`; what a user can mend ends it in one line."""
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        return train(rank, args, sync)
    except FloatingPointError as error:  # --resume would come to the same point again, to the bit
        why = f"{error}: start anew with another --seed, or another learning rate in PPOConfig"
    except (checkpoint.CheckpointError, OSError) as error:
        why = error
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "allocate" not in str(error):  # torch's word
            raise
        why = f"there is not enough memory for {args.envs} robots: choose fewer with --envs"
    sys.exit(f"error: {why}")


def main(argv: list[str] | None = None) -> None:
    args = parse_arguments(argv)
    if args.processes == 1 or "RANK" in os.environ:  # torchrun has made the processes
        return guarded(int(os.environ.get("RANK", 0)), args, "env://")
    with tempfile.TemporaryDirectory() as folder:
        options = (args, f"file://{folder}/sync")
        context = torch.multiprocessing.spawn(guarded, options, args.processes, join=False)
        for number in (signal.SIGINT, signal.SIGTERM):  # the processes save and end by themselves
            signal.signal(number, lambda *_: [p.terminate() for p in context.processes])
        try:
            while not context.join():
                pass
        except torch.multiprocessing.ProcessExitedException as error:
            killed = f"error: a training process was ended by {error.signal_name}"
            sys.exit(killed if error.signal_name else error.exit_code)  # else it has said why


if __name__ == "__main__":
    main()
