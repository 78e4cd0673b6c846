"""Trains a policy: PPO on every core, or on a GPU.

    python train.py --robot a1                      # ROLT on the stiffness task
    python train.py --steps 50000 --out runs/try    # does it run? half a minute
    python train.py --robot a1 --resume             # goes on where it was stopped (Ctrl-C is safe)
    python train.py --task terrain --init runs/a1-stiffness-rolt-seed0/checkpoint.pt    # stairs
    torchrun --nproc-per-node=2 train.py --paper --device cuda    # the paper's size, on two GPUs

Everything goes to runs/ROBOT-TASK-POLICY-seedN (or --out): policy.pt (for evaluate.py),
checkpoint.pt (for --resume), progress.csv (a row per iteration) and progress.png; policy-2M.pt and
so on are snapshots, five in a run.

On a CPU every core gets a process with its share of the robots, and gradients are averaged: two
processes of one thread run nearly twice as fast as one process of two threads.
"""

import argparse
import math
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
from plots import learning_curves
from ppo import Critic, Learner, PPOConfig, RolloutBuffer, average, collect
from robots import ROBOTS
from walk import write_csv

FREE = ("out", "resume", "paper", "threads", "save_minutes")  # may change when a run is resumed
LOSSES = ("surrogate", "value_loss", "clip_fraction", "kl", "other_loss")


def parse_arguments(argv: list[str] | None = None):
    def count(text: str) -> int:
        """A whole number above 0; 6e6 is fine."""
        if not (float(text) > 0 and float(text).is_integer()):
            raise ValueError
        return int(float(text))

    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
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
    add("--init", metavar="FILE", help="a policy.pt to start from: flat, then stairs")
    add("--seed", type=int, default=0)
    add("--device", choices=devices, default=devices[-1], help="default: cuda if there is one")
    add("--precision", choices=("auto", "fp32", "bf16"), default="auto", help="auto: bf16 if fast")
    add("--threads", type=count, help="cores to use (default: all, or as many as divide --envs)")
    add("--out", help="folder of the run (default: runs/ROBOT-TASK-POLICY-seedN)")
    add("--resume", action="store_true", help="go on from the checkpoint in that folder")
    add("--save-minutes", type=float, default=3.0, help="time between two checkpoints")
    args = parser.parse_args(argv)
    if args.paper:  # what is said beside it still counts
        parser.set_defaults(envs=4096, steps=400_000_000, epochs=5, minibatches=4)
        args = parser.parse_args(argv)

    args.task = args.task or first_task(args.robot)
    task = TASKS[args.task]
    args.scan |= task.terrain is not None
    if args.seed < 0:
        parser.error("a seed is from 0 on")
    if "" in (args.out, args.init):
        parser.error("the name of a file or folder is empty")
    name = f"{args.robot}-{args.task}-{args.policy}-seed{args.seed}"
    args.out = Path(args.out or f"runs/{name}")
    if args.robot not in task.robots:
        parser.error(f"the task {args.task} is for {', '.join(task.robots)}, not for {args.robot}")

    cuda = args.device == "cuda"
    fast = cuda or torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    if args.precision == "auto":
        args.precision = "bf16" if fast else "fp32"
    elif args.precision == "bf16" and not fast:
        print("warning: no bf16 on this processor; --precision fp32 is faster", file=sys.stderr)

    if args.threads is None:
        cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count()
        args.threads = max(n for n in range(1, cores + 1) if cuda or args.envs % n == 0)
    torchrun = dist.is_torchelastic_launched()
    args.processes = int(os.environ["WORLD_SIZE"]) if torchrun else 1 if cuda else args.threads
    if args.envs % args.processes:
        parser.error(f"{args.envs} robots do not divide among {args.processes} processes")
    samples = args.envs // args.processes * PPOConfig.steps
    if samples < args.minibatches or args.epochs * args.minibatches < 2:
        parser.error("a rollout has to fill its minibatches; an update takes two steps at least")

    if args.resume != (args.out / "checkpoint.pt").exists():
        what = "nothing to resume" if args.resume else "a run already: --resume, or another --out"
        parser.error(f"{args.out} holds {what}")
    return args


class StageRun:
    """A stage under way (most methods have one): its robots, buffer, critic and learner."""

    def __init__(self, number: int, stage: Stage, args, rank: int, policy, device, critic=None):
        """critic: of the stage before. One that trains none (RMA's adaptation) keeps it, so that
        --init can start from this run."""
        n, local = args.envs // args.processes, os.environ.get("LOCAL_WORLD_SIZE", args.processes)
        self.number, self.actor = number, stage.actor
        self.env = LocomotionEnv(
            args.robot, n, seed=(args.seed, rank, number), faults=stage.faults,
            num_threads=max(1, args.threads // int(local)),  # its share of this machine
            config=EnvConfig(leg_frames=policy.leg_frames),
            extras=(*stage.extras, "privileged"), terrain=TASKS[args.task].terrain,
        )  # fmt: skip
        self.observation = self.env.reset(random_ages=True)

        kept = critic if stage.learner is not Learner else None
        self.critic = (stage.critic or kept or Critic(self.observation)).to(device)
        policy.requires_grad_(False)
        for trained in stage.trained:
            trained.requires_grad_(True)
        replays, actions = self.actor.replays_masks, self.env.num_actions
        masks = self.actor.sample_masks(n, torch.Generator(device)) if replays else {}
        self.buffer = RolloutBuffer(PPOConfig.steps, self.observation, actions, masks, device)
        ppo = PPOConfig(epochs=args.epochs, minibatches=args.minibatches)
        self.learner = stage.learner(self.actor, self.critic, ppo, args.precision == "bf16")
        self.parts = {"weights": policy, "critic": self.critic, "optimizer": self.learner.optimizer}


def train(rank: int, args, sync: str) -> None:
    """The training of one process. sync: where the processes meet (dist's init_method)."""
    signals = []  # Ctrl-C and SIGTERM: all processes save and end after the iteration
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

    options = {key: x for key, x in vars(args).items() if key not in FREE}
    saved = {"stage": 0, "iteration": 0, "steps": 0, "options": options}
    if args.resume:
        saved = checkpoint.load(args.out / "checkpoint.pt")
    if other := [f"--{k} {x}" for k, x in saved["options"].items() if options.get(k) != x]:
        words = f"the run in {args.out} had {', '.join(other).replace('processes', 'threads')}"
        raise checkpoint.CheckpointError(f"{words}: say so, or choose another --out")
    task, robot = TASKS[args.task], ROBOTS[args.robot]
    torch.manual_seed(args.seed)  # the same weights in every process
    policy = make_policy(args.policy, robot, task, args.scan).to(device)
    generator = torch.Generator(device).manual_seed(args.seed * 1_000_003 + rank)
    stages = training_stages(policy, task)
    lengths = {stage.name: round(args.steps * stage.share) for stage in stages}
    ends = np.cumsum([0, *lengths.values()]).tolist()  # stage i is from ends[i] to ends[i + 1]
    if rank == 0:
        plan = ", then ".join(f"{length:,} steps ({name})" for name, length in lengths.items())
        plan += f"; {args.envs} robots, {args.processes} processes, {args.precision}"
        print(f"{args.policy}: {plan}", flush=True)

    iteration, steps = saved["iteration"], saved["steps"]
    run = StageRun(saved["stage"], stages[saved["stage"]], args, rank, policy, device)
    if args.resume:
        for name, part in run.parts.items():
            part.load_state_dict(saved[name])
        run.env.load_state_dict(saved["processes"][rank]["env"])
        run.observation = run.env.observe()
        generator.set_state(saved["processes"][rank]["generator"])
        torch.set_rng_state(saved["torch"])
    elif args.init:
        checkpoint.start_from(args.init, policy, run.critic)

    def save(snapshot: bool) -> None:
        """All that the next iteration depends on; each process sends its part to process 0."""
        mine = {"env": run.env.state_dict(), "generator": generator.get_state()}
        everyone = [mine] * args.processes
        if args.processes > 1:
            dist.gather_object(mine, everyone if rank == 0 else None)
        if rank == 0:
            content = options | {"steps": steps, "stages": lengths, "options": options}
            content |= {name: part.state_dict() for name, part in run.parts.items()}
            content |= {"stage": run.number, "iteration": iteration, "processes": everyone}
            curve = [[float(row[name]) for name in checkpoint.CURVE] for row in rows[::10]]
            content |= {"torch": torch.get_rng_state(), "rows": rows, "curve": torch.tensor(curve)}
            checkpoint.save(content, args.out / "checkpoint.pt")
            checkpoint.save_policy(content, args.out / "policy.pt")
            if snapshot:  # to see how a policy grew
                checkpoint.save_policy(content, args.out / f"policy-{steps / 1e6:.2g}M.pt")
            curves = {args.policy: [content["curve"].numpy()]}
            learning_curves(curves, args.out / "progress.png", args.out.name)

    rows = saved.get("rows", [])  # of progress.csv; later ones of an earlier try are dropped
    if rank == 0 and rows:
        write_csv(args.out / "progress.csv", rows)
    began = saved_at = time.monotonic()
    stop = False
    while steps < ends[-1] and not stop:
        if steps >= ends[run.number + 1]:
            i = run.number + 1
            run = StageRun(i, stages[i], args, rank, policy, device, run.critic)
        begin, end = ends[run.number : run.number + 2]
        started = time.perf_counter()
        run.observation, infos = collect(
            run.env, run.actor, run.critic, run.buffer, run.observation, generator, run.learner.bf16
        )
        collected = time.perf_counter()
        losses = run.learner.update(run.buffer, generator, (steps - begin) / (end - begin))
        updated = time.perf_counter()
        fifths = steps * 5 // ends[1]  # of the first stage; each leaves a snapshot
        iteration, steps = iteration + 1, steps + len(run.buffer) * args.processes

        due = rank == 0 and time.monotonic() - saved_at > 60 * args.save_minutes
        figures = summarise(infos, run.buffer, run.env) | {"due": due, "stop": bool(signals)}
        sums = torch.tensor([float(x) for x in figures.values()], dtype=torch.float64)
        figures = dict(zip(figures, average(sums.to(device)).tolist()))
        due, stop = figures.pop("due"), figures.pop("stop")  # on which all processes must agree
        if rank == 0:
            row = {"iteration": iteration, "steps": steps, "stage": run.number} | figures
            row |= dict.fromkeys(LOSSES, math.nan) | losses | {"std": run.actor.std().mean().item()}
            row |= {"collect_seconds": collected - started, "update_seconds": updated - collected}
            rate = (steps - saved["steps"]) / (time.monotonic() - began)
            log(row, rows, args.out / "progress.csv", ends[-1], rate)
        snapshot = steps * 5 // ends[1] > fifths
        if due or stop or snapshot or steps >= ends[-1]:
            save(snapshot)
            saved_at = time.monotonic()

    if rank == 0 and saved["steps"] >= ends[-1]:
        print(f"it was finished already; the policy: {args.out / 'policy.pt'}")
    elif rank == 0 and steps < ends[-1]:
        print(f"\nstopped at {steps:,} steps and saved; the same command with --resume goes on")
    elif rank == 0:
        print(f"\nthe policy: {args.out / 'policy.pt'}; what to do with it: evaluate.py --help")
    if args.processes > 1:
        dist.destroy_process_group()


def summarise(infos: list[dict], buffer: RolloutBuffer, env: LocomotionEnv) -> dict[str, float]:
    """What a rollout was like on this process's robots."""

    def every(name: str) -> np.ndarray:
        return np.concatenate([info[name] for info in infos])

    figures = {"speed": every("speed").mean(), "commanded_speed": every("commanded_speed").mean()}
    figures["row"] = env.row.mean()  # of the terrain: how far the curriculum is
    for term in infos[0]["rewards"]:
        figures[f"reward_{term}"] = np.mean([info["rewards"][term] for info in infos])
    returns, lengths = every("episode_returns"), every("episode_lengths")  # of those that ended
    figures |= {"divergences": every("diverged").sum(), "falls": buffer.terminated.sum()}
    return figures | {"episodes": len(returns), "returns": returns.sum(), "lengths": lengths.sum()}


def log(row: dict, rows: list[dict], path: Path, total: int, rate: float) -> None:
    """Adds an iteration's row, and what the episodes of the last 20 were like, to `rows` and to the
    CSV file, and shows it. total: steps of the run; rate: steps a second."""
    names, last = ("episodes", "returns", "lengths", "falls"), rows[-19:] + [row]
    episodes, *sums = (sum(float(row[name]) for row in last) for name in names)
    returns, lengths, falls = (x / episodes if episodes else math.nan for x in sums)
    row |= {"episode_return": returns, "episode_seconds": lengths * CONTROL_DT}
    row |= {"fall_share": falls}
    rows.append({k: f"{x:.6g}" if isinstance(x, float) else x for k, x in row.items()})
    write_csv(path, rows[-1:], "a" if len(rows) > 1 else "w")

    steps = row["steps"]
    line = (
        f"[{'#' * int(20 * steps / total):.<20.20}] {steps / 1e6:.2f}/{total / 1e6:.2f}M"
        f" {rate:,.0f}/s {max(0, total - steps) / rate / 60:.0f} min left"
        f" | speed {row['speed']:.2f} of {row['commanded_speed']:.2f} m/s std {row['std']:.2f}"
    )
    if episodes:
        line += f" return {returns:.1f} falls {falls:.0%} after {row['episode_seconds']:.1f} s"
    if sys.stdout.isatty():
        print(f"\r{line}\033[K", end="", flush=True)
    elif row["iteration"] % 10 == 1:  # not to fill a log
        print(line, flush=True)


def guarded(rank: int, args, sync: str) -> None:
    """`train`; what a user can mend ends it in one line."""
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        train(rank, args, sync)
    except (checkpoint.CheckpointError, OSError, FloatingPointError) as error:
        sys.exit(f"error: {error}")
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "allocate" not in str(error):  # torch's word
            raise
        sys.exit(f"error: not enough memory for {args.envs} robots: choose fewer with --envs")


def main(argv: list[str] | None = None) -> None:
    args = parse_arguments(argv)
    if dist.is_torchelastic_launched():  # torchrun has made the processes
        return guarded(int(os.environ["RANK"]), args, "env://")
    if args.processes == 1:
        return guarded(0, args, "")
    with tempfile.TemporaryDirectory() as folder:
        others = (args, f"file://{folder}/sync")
        context = torch.multiprocessing.spawn(guarded, others, args.processes, join=False)

        def stop(*_) -> None:  # the processes save and end by themselves
            for process in context.processes:
                process.terminate()

        signal.signal(signal.SIGINT, stop)
        signal.signal(signal.SIGTERM, stop)
        try:
            while not context.join():
                pass
        except torch.multiprocessing.ProcessExitedException as error:
            killed = f"error: a training process was ended by {error.signal_name}"
            sys.exit(killed if error.signal_name else error.exit_code)  # else it has said why


if __name__ == "__main__":
    main()
