"""Trains a policy: PPO on every core, or on a GPU.

    python train.py --robot a1                            # ROLT on the stiffness task, about 95 minutes on two cores
    python train.py --robot a1 --steps 20000 --out runs/try    # does it run? a minute
    python train.py --robot a1 --resume                   # goes on where it was stopped (Ctrl-C is safe)
    python train.py --robot a1 --task terrain --init runs/a1-stiffness-rolt-seed0/checkpoint.pt    # stairs, after flat ground
    python train.py --robot a1 --policy all               # every method of the paper in turn; skips what is finished
    python train.py --robot a1 --paper --device cuda      # the paper's size: 4096 robots, 400 million steps
    torchrun --nproc-per-node=2 train.py --robot a1 --paper --device cuda    # on two GPUs; on two machines with --nnodes=2
                                                                             # and a folder that both see as --out

Everything goes to runs/ROBOT-TASK-POLICY-seedN (or --out): policy.pt (for evaluate.py), checkpoint.pt (for --resume),
progress.csv (a row an iteration) and progress.png.

On a CPU every core gets a process of its own with its share of the robots; the processes sum their gradients
(torch.distributed). Two processes of one thread run nearly twice as fast as one process of two threads.
"""

# ruff: noqa: E402
import signal

if __name__ == "__main__":  # until the training has begun there is nothing to save: Ctrl-C ends it without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import math
import os
import sys
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from torch import nn

import checkpoint
from baselines import METHODS, STAGED, Stage, make_policy, training_stages
from checkpoint import CheckpointError
from cli import Parser, count, fail, lock_folder, num_cores, positive, seed, threads, writable_folder
from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import TASKS, first_task
from plots import learning_curve
from ppo import Critic, Learner, PPOConfig, RolloutBuffer, all_reduce, collect
from processes import orphaned, run
from rewards import REWARDS
from robots import ROBOTS
from rolt import ROLT, ROLTConfig

# What a run may not change when it is resumed; with several stages, which are shares of them, the steps neither.
IDENTITY = ("robot", "task", "policy", "envs", "epochs", "minibatches", "seed", "processes", "device", "init")
EPISODES = ("episodes", "returns", "lengths", "falls")  # figures of finished episodes, added up over a rollout


def parse_arguments(argv: list[str] | None = None):
    parser = Parser(__doc__)
    parser.add_argument("--robot", choices=ROBOTS, default="a1")
    parser.add_argument("--task", choices=TASKS, help="which faults are trained, see faults.py (default: the robot's first)")
    parser.add_argument("--policy", choices=(*METHODS, "all"), default="rolt")
    parser.add_argument("--envs", type=partial(count, most=2**16), default=512, help="robots simulated at once")
    parser.add_argument("--steps", type=count, default=6_000_000, help="env steps in total, over all robots")
    parser.add_argument("--epochs", type=partial(count, most=1000), default=PPOConfig.epochs, help="over each rollout")
    parser.add_argument("--minibatches", type=count, default=PPOConfig.minibatches, help="an epoch")
    parser.add_argument("--paper", action="store_true", help="4096 robots, 400M steps, 5 epochs of 4 minibatches")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="auto: cuda if there is one")
    parser.add_argument("--threads", type=threads, help="cores to use (default: all, or as many as divide --envs)")
    parser.add_argument("--out", type=Path, help="folder of the run (default: runs/ROBOT-TASK-POLICY-seedN)")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in that folder")
    parser.add_argument("--init", metavar="FILE", help="start from the weights in a policy.pt or checkpoint.pt: flat, then stairs")
    parser.add_argument("--save-minutes", type=positive, default=3.0, help="time between two checkpoints")
    args = parser.parse_args(argv)

    if args.paper:  # what is said beside it still counts
        parser.set_defaults(envs=4096, steps=400_000_000, epochs=5, minibatches=4)
        args = parser.parse_args(argv)
    try:
        args.task = args.task or first_task(args.robot)
    except ValueError as error:
        fail(error)
    if args.robot not in TASKS[args.task].robots:
        fail(f"the task {args.task} is for {', '.join(TASKS[args.task].robots)}, not for {args.robot}")
    if args.device == "cuda" and not torch.cuda.is_available():
        fail("torch finds no CUDA device; leave --device away to train on the CPU")
    if args.device == "auto":
        args.device = "cuda" if torch.cuda.is_available() else "cpu"
    if args.threads is None:
        args.threads = max(n for n in range(1, num_cores() + 1) if args.device == "cuda" or args.envs % n == 0)
    args.processes = int(os.environ.get("WORLD_SIZE", 1 if args.device == "cuda" else args.threads))
    if args.envs % args.processes:
        fail(f"{args.envs} robots do not divide among {args.processes} processes; change --envs or --threads")
    if args.epochs * args.minibatches < 2:
        fail("the learning rate follows from how far the first steps of an update went: at least 2 minibatches, or 2 epochs")
    if args.envs // args.processes * PPOConfig.steps < args.minibatches:
        fail(f"{args.envs} robots are too few for {args.minibatches} minibatches on {args.processes} processes")
    if args.policy == "all":
        if "RANK" in os.environ:
            fail("torchrun trains one policy at a time: name it instead of --policy all")
        if args.out or args.init:
            fail("every policy has a folder and a start of its own: leave --out and --init away with --policy all")
        return args
    args.out = args.out or Path("runs") / f"{args.robot}-{args.task}-{args.policy}-seed{args.seed}"
    saved = any(os.path.exists(args.out / name) for name in ("checkpoint.pt", "checkpoint.pt.previous"))
    if args.resume and not saved:
        fail(f"there is nothing to resume in {args.out}; leave --resume away to start there")
    if saved and not args.resume:
        fail(f"{args.out} holds a run already; go on with --resume, or choose another --out or --seed")
    writable_folder(args.out)
    return args


class Progress:
    """One CSV row an iteration, and the live line."""

    def __init__(self, args, iteration: int, steps: int):
        self.path, self.resumed, self.total = args.out / "progress.csv", iteration, args.steps
        self.first, self.start, self.begun = steps, time.monotonic(), False

    def _begin(self, header: str) -> None:
        """Keeps the rows up to the checkpoint that we go on from; whole or not at all, as a run may be killed here, too."""
        rows = self.path.read_text(errors="replace").splitlines() if self.resumed and self.path.exists() else []
        whole = [row.split(",") for row in rows[1:] if row.count(",") == header.count(",")]
        kept = [",".join(row) for row in whole if row[0].isdecimal() and int(row[0]) <= self.resumed]
        if rows and rows[0] != header:  # of another version of this program, or damaged
            self.path.replace(self.path.with_name("progress.previous.csv"))
            kept = []
        temporary = self.path.with_name("progress.csv.tmp")
        temporary.write_text("\n".join([header, *kept, ""]))
        temporary.replace(self.path)
        self.begun = True

    def log(self, row: dict, episodes: np.ndarray) -> None:
        """Writes the row and prints the line (every tenth one if the output is not a terminal). episodes: sums of `EPISODES`
        over the last iterations."""
        number, returns, lengths, falls = episodes.tolist()
        recent = [x / number if number else math.nan for x in (returns, lengths * CONTROL_DT, falls)]
        row |= dict(zip(("episode_return", "episode_seconds", "falls"), recent))
        if not self.begun or not self.path.exists():
            self._begin(",".join(row))
        with open(self.path, "a") as file:
            file.write(",".join(f"{x:.6g}" if isinstance(x, float) else str(x) for x in row.values()) + "\n")

        steps, total = row["steps"], self.total
        rate = (steps - self.first) / (time.monotonic() - self.start)
        bar = "#" * int(20 * min(1, steps / total))
        line = (
            f"[{bar:.<20}] {steps / 1e6:.2f}/{total / 1e6:.2f}M {rate:,.0f}/s"
            f" {max(0, total - steps) / rate / 60:.0f} min left"
            f" | return {recent[0]:.1f} speed {row['speed']:.2f} of {row['commanded_speed']:.2f} m/s"
            f" episode {recent[1]:.1f} s falls {recent[2]:.0%} sigma {row['sigma']:.2f} KL {row['kl']:.3f}"
            + f" diverged {row['divergences']}" * (row["divergences"] > 0)
        )
        if sys.stdout.isatty():
            print(f"\r{line}\033[K", end="", flush=True)
        elif row["iteration"] % 10 == 1:
            print(line, flush=True)


def sum_over_processes(figures: dict[str, float], device) -> dict[str, float]:
    values = all_reduce(torch.tensor([float(x) for x in figures.values()], dtype=torch.float64, device=device))
    return dict(zip(figures, values.tolist()))


def summarise(infos: list[dict], buffer: RolloutBuffer, env: LocomotionEnv) -> tuple[dict, dict]:
    """What a rollout was like on this process's robots: figures to average over processes, and figures to add up."""
    means = {name: sum(i[name].mean() for i in infos) / len(infos) for name in ("speed", "commanded_speed")}
    means["row"] = env.row.mean()  # of the terrain: how far the curriculum is
    for term in REWARDS:
        means[f"reward_{term.__name__}"] = sum(i["rewards"][term.__name__].mean() for i in infos) / len(infos)
    sums = {
        "episodes": sum(len(i["episode_returns"]) for i in infos),
        "returns": sum(i["episode_returns"].sum() for i in infos),
        "lengths": sum(i["episode_lengths"].sum() for i in infos),
        "falls": buffer.terminated.sum(),
        "divergences": env.divergences,
    }
    return means, sums


class Part:
    """One stage of the training (most methods have one): its robots, buffer, critic and learner."""

    def __init__(self, number: int, stage: Stage, args, rank: int, policy: nn.Module, device: torch.device):
        # of the simulation; on a GPU the processes of this machine (torchrun's) share its cores
        threads = max(1, args.threads // int(os.environ.get("LOCAL_WORLD_SIZE", 1))) if args.device == "cuda" else 1
        share, seeds = args.envs // args.processes, (args.seed, rank, number)
        self.number, self.actor, self.begun = number, stage.actor, False
        terrain = TASKS[args.task].terrain
        self.env = LocomotionEnv(args.robot, share, seeds, threads, stage.faults, extras=stage.extras, terrain=terrain)
        self.observation = self.env.reset(random_ages=True)
        self.critic = (Critic(self.observation, stage.actor.normalizer) if stage.critic is None else stage.critic).to(device)
        policy.requires_grad_(False)
        for module in stage.trained:
            module.requires_grad_(True)
        masks = stage.actor.sample_masks(share, torch.Generator(device)) if stage.actor.replays_masks else {}
        self.buffer = RolloutBuffer(PPOConfig.steps, self.observation, self.env.num_actions, masks, device)
        config = PPOConfig(epochs=args.epochs, minibatches=args.minibatches)
        self.learner = stage.learner(stage.actor, self.critic, config)


def train(rank: int, args, sync: str | None, stop: list) -> None:
    """The training loop of one process. It saves and ends after the iteration in which `stop` is no longer empty."""
    lock = lock_folder(args.out) if rank == 0 else None  # noqa: F841 (held until the end)
    device = torch.device("cpu")
    if args.device == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")  # TF32, in rollout and update alike
        torch.backends.cudnn.deterministic = True  # RMA's convolutions
    if args.processes > 1:
        backend = "nccl" if args.device == "cuda" else "gloo"
        gpu = device if args.device == "cuda" else None
        dist.init_process_group(backend, init_method=sync, rank=rank, world_size=args.processes, device_id=gpu)
    torch.set_num_threads(1)
    task, robot = TASKS[args.task], ROBOTS[args.robot]
    torch.manual_seed(args.seed)  # the same weights in every process
    policy = make_policy(args.policy, robot, task).to(device)
    stages = training_stages(policy, task)
    ends = [args.steps * sum(stage.share for stage in stages[: i + 1]) for i in range(len(stages) - 1)] + [args.steps]
    generator = torch.Generator(device).manual_seed(args.seed * 1_000_003 + rank)  # actions, masks, minibatches
    part = Part(0, stages[0], args, rank, policy, device)
    if args.init and not args.resume:
        checkpoint.start_from(args.init, policy, part.critic)
    iteration, steps = 0, 0
    recent = np.zeros((20, len(EPISODES)))  # of the last iterations: episodes end now and then

    def state() -> dict:
        """What checkpoint.pt holds: all that the next iteration depends on (of this process, for all of them)."""
        content = {key: getattr(args, key) for key in ("robot", "task", "policy", "seed", "init")} | {"steps": steps}
        content["weights"] = {name: tensor.cpu() for name, tensor in policy.state_dict().items()}
        content |= {"critic": part.critic.state_dict(), "learner": part.learner.state_dict()}
        content |= {"iteration": iteration, "stage": part.number, "recent": torch.from_numpy(recent)}
        mine = {"env": to_plain(part.env.state_dict()), "generator": generator.get_state()}
        content |= {"processes": [mine] * args.processes, "torch": torch.get_rng_state()}
        return content | {"identity": identity(args)}

    if args.resume:
        saved = checkpoint.load_newest(args.out / "checkpoint.pt")
        place = [saved.get(key) for key in ("iteration", "steps", "stage")]
        if any(type(n) is not int or n < 0 for n in place) or place[2] >= len(stages):
            raise CheckpointError(f"the checkpoint in {args.out} does not say where it was made")
        if place[2]:
            part = Part(place[2], stages[place[2]], args, rank, policy, device)
        part.learner.optimizer.step()  # with gradients that are still 0: moves nothing, but makes the state that is compared
        own = state()
        for key in own:
            if key != "identity" and (why := checkpoint.misfit(saved.get(key), own[key], key)):
                raise CheckpointError(f"the checkpoint in {args.out} does not fit this run: {why}")
        (iteration, steps, _), recent, mine = place, saved["recent"].numpy(), saved["processes"][rank]
        policy.load_state_dict(saved["weights"])
        part.critic.load_state_dict(saved["critic"])
        try:
            part.learner.load_state_dict(saved["learner"])
            part.env.load_state_dict(from_plain(mine["env"]))
            generator.set_state(mine["generator"])
            torch.set_rng_state(saved["torch"])
        except (ValueError, LookupError, OverflowError, RuntimeError) as error:  # e.g. no random state, a fault that is not
            raise CheckpointError(f"the checkpoint in {args.out} does not fit this run: {error}") from error
        part.observation, part.begun = part.env.observe(), True

    def save() -> None:
        """Process 0 writes the files; the others tell it their part."""
        content = state()
        if args.processes > 1:
            dist.gather_object(content["processes"][rank], content["processes"] if rank == 0 else None)
        if rank == 0:
            with open(progress.path) as file:
                os.fsync(file.fileno())  # no checkpoint without its rows
            checkpoint.save({key: content[key] for key in (*checkpoint.CARD, "init", "weights")}, args.out / "policy.pt")
            checkpoint.save_next(content, args.out / "checkpoint.pt")
            learning_curve(progress.path, args.out / "progress.png")
        if args.processes > 1:
            dist.barrier()  # what any process reads next is the new file

    progress = Progress(args, iteration, steps)
    saved_at = time.monotonic()
    while steps < args.steps:
        if steps >= ends[part.number]:
            number, divergences = part.number + 1, part.env.divergences
            part = Part(number, stages[number], args, rank, policy, device)
            part.env.divergences = divergences  # of the whole run
        if not part.begun and part.learner.measures and (args.init or not part.actor.normalizer.count):
            # A rollout for the normalizer alone, not among the steps. After --init only the heights are measured anew: on
            # flat ground they hardly vary. To forget the joints' statistics, too, makes a robot that walks fall.
            part.observation, _ = collect(part.env, part.actor, part.critic, part.buffer, part.observation, generator)
            part.actor.normalizer.update(part.buffer.observation, all_reduce, forget=("heights",))
        part.begun = True
        started = time.perf_counter()
        part.observation, infos = collect(part.env, part.actor, part.critic, part.buffer, part.observation, generator)
        collected = time.perf_counter()
        losses = part.learner.update(part.buffer, generator)
        updated = time.perf_counter()
        iteration, steps = iteration + 1, steps + len(part.buffer) * args.processes

        means, sums = summarise(infos, part.buffer, part.env)
        overdue = rank == 0 and time.monotonic() - saved_at > 60 * args.save_minutes
        told = {"stop": bool(stop) or orphaned(), "save": overdue}  # on which all must agree
        shared = sum_over_processes(means | sums | told, device)
        recent = np.vstack([recent[1:], [shared[name] for name in EPISODES]])
        if rank == 0:
            row = {"iteration": iteration, "steps": steps, "stage": part.number}
            row |= {name: shared[name] / args.processes for name in means}
            row |= {"sigma": part.actor.sigma().mean().item(), "learning_rate": part.learner.learning_rate} | losses
            row |= {"collect_seconds": collected - started, "update_seconds": updated - collected}
            progress.log(row | {"divergences": int(shared["divergences"])}, recent.sum(axis=0))
        if shared["save"] or shared["stop"] or steps >= args.steps:
            save()
            saved_at = time.monotonic()
        if shared["stop"]:
            break

    if rank == 0:
        policy_file = args.out / "policy.pt"
        if steps < args.steps:
            print(f"\nstopped at {steps:,} steps and saved; the same command with --resume goes on")
        test = {"stiffness": "stiffness", "damage": "damage", "terrain": "stairs"}.get(args.task)  # or it is a task of your own
        words = f"{test} --robot {args.robot} --checkpoints" if test else f"watch --robot {args.robot} --checkpoint"
        print(f"\ntrained: {policy_file}\ntest it: python evaluate.py {words} {policy_file}")
    if args.processes > 1:
        dist.destroy_process_group()


def to_plain(value):
    """Numpy arrays as tensors, all the way down: what a checkpoint may hold."""
    if isinstance(value, dict):
        return {key: to_plain(item) for key, item in value.items()}
    return torch.from_numpy(value) if hasattr(value, "__array__") else value


def from_plain(value):
    """The inverse of `to_plain`."""
    if isinstance(value, dict):
        return {key: from_plain(item) for key, item in value.items()}
    return value.numpy() if isinstance(value, torch.Tensor) else value


def identity(args) -> dict:
    """What a run may not change when it is resumed: its options, and the constants in the code."""
    options = {key: getattr(args, key) for key in (*IDENTITY, *(("steps",) if args.policy in STAGED else ()))}
    configs = [PPOConfig(epochs=args.epochs, minibatches=args.minibatches), EnvConfig(), ROBOTS[args.robot]]
    method = METHODS[args.policy]
    if getattr(method, "func", method) is ROLT:  # `func` and `keywords`: of a partial, an ablation
        configs.append(getattr(method, "keywords", {}).get("config", ROLTConfig()))
    constants = {f"{type(c).__name__}.{name}": str(value) for c in configs for name, value in asdict(c).items()}
    for module in ("baselines", "env", "episode", "normalizer", "rewards", "robots", "rolt", "scandots", "terrain"):
        for name, value in vars(sys.modules[module]).items():
            if name.isupper() and isinstance(value, (int, float, tuple)):
                constants[name] = str(value)
    constants |= {f"weight of {term.__name__}": str(weight) for term, weight in REWARDS.items()}
    constants["faults"] = ", ".join(f"{share:g} {fault}" for share, fault in TASKS[args.task].training)
    return options | constants | {"terrain": str(TASKS[args.task].terrain)}


def train_all(words: list[str], args) -> None:
    """Every method of the task, one after the other: what is finished is skipped, what was stopped goes on."""
    words = [word for word in words if word != "--resume"]
    for policy in METHODS:
        out = Path("runs") / f"{args.robot}-{args.task}-{policy}-seed{args.seed}"

        def steps_done() -> int:
            return checkpoint.load_policy(out / "policy.pt")[1]["steps"] if (out / "checkpoint.pt").exists() else 0

        done = steps_done()
        print(f"{policy}: {done:,} of {args.steps:,} steps", flush=True)
        if done < args.steps:
            main([*words, "--policy", policy, *(["--resume"] if done else [])])
            if steps_done() < args.steps:
                return  # interrupted


def main(argv: list[str] | None = None) -> None:
    args = parse_arguments(argv)
    try:
        if args.policy == "all":
            return train_all(sys.argv[1:] if argv is None else argv, args)
        if args.resume:
            was, now = checkpoint.load_newest(args.out / "checkpoint.pt", say=True).get("identity"), identity(args)
            if not isinstance(was, dict):
                fail(f"{args.out / 'checkpoint.pt'} is a policy, not a training to resume")
            differing = [f"{key} was {was[key]}, is {now[key]}" for key in now if key in was and was[key] != now[key]]
            if differing:
                way = "set it back (processes: --threads), or choose another --out"
                fail(f"the run in {args.out} was another one: {'; '.join(differing)}; {way}")
    except CheckpointError as error:
        fail(error)
    run(train, args)


if __name__ == "__main__":
    main()
