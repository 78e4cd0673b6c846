"""Trains a policy: PPO on every core, or on a GPU.

    python train.py --robot a1                            # ROLT on the stiffness task, a few hours on two cores
    python train.py --robot a1 --steps 20000              # does it run? a minute
    python train.py --robot a1 --resume                   # goes on where it was stopped (Ctrl-C is safe)
    python train.py --robot a1 --policy all               # every method of the paper in turn; skips what is finished
    python train.py --robot a1 --paper --device cuda      # the paper's size: 4096 robots, 400 million steps
    torchrun --nproc-per-node=2 train.py --robot a1 --paper --device cuda    # on two GPUs; on two machines with --nnodes=2
                                                                             # and a folder that both see as --out

Everything goes to runs/ROBOT-TASK-POLICY-seedN (or --out): policy.pt (for evaluate.py), checkpoint.pt (for --resume),
progress.csv (a row an iteration) and progress.png.

On a CPU every core gets a process of its own with its share of the robots; the processes sum their gradients
(torch.distributed). Two processes of one thread run nearly twice as fast as one process of two threads.
"""

import csv
import math
import os
import signal
import sys
import tempfile
import time
from collections import deque
from pathlib import Path

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import nn

import checkpoint
from baselines import METHODS, Stage, make_policy, training_stages
from cli import Parser, count, fail, lock_folder, num_cores, positive, seed, writable_folder
from env import CONTROL_DT, LocomotionEnv
from faults import TASKS
from plots import learning_curve
from ppo import Critic, Learner, PPOConfig, RolloutBuffer, all_reduce, collect, to_tensors
from rewards import REWARDS
from robots import ROBOTS

# What a run may not change when it is resumed; of rma and roam, whose stages are shares of them, the steps neither.
IDENTITY = ("robot", "task", "policy", "envs", "epochs", "minibatches", "seed", "processes")
STAGED = ("rma", "roam")


def parse_arguments(argv: list[str] | None = None):
    parser = Parser(__doc__)
    parser.add_argument("--robot", choices=ROBOTS, default="a1")
    parser.add_argument("--task", choices=TASKS, help="which faults are trained, see faults.py (default: the robot's first)")
    parser.add_argument("--policy", choices=(*METHODS, "all"), default="rolt")
    parser.add_argument("--envs", type=count, default=512, help="robots simulated at once")
    parser.add_argument("--steps", type=count, default=6_000_000, help="env steps in total, over all robots")
    parser.add_argument("--epochs", type=count, default=PPOConfig.epochs, help="of PPO, over each rollout")
    parser.add_argument("--minibatches", type=count, default=PPOConfig.minibatches, help="an epoch")
    parser.add_argument("--paper", action="store_true", help="4096 robots, 400M steps, 5 epochs of 4 minibatches")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="auto: cuda if there is one")
    parser.add_argument("--threads", type=count, default=num_cores(), help="cores to use (default: all)")
    parser.add_argument("--out", type=Path, help="folder of the run (default: runs/ROBOT-TASK-POLICY-seedN)")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in that folder")
    parser.add_argument("--save-minutes", type=positive, default=3.0, help="time between two checkpoints")
    args = parser.parse_args(argv)

    if args.paper:
        args.envs, args.steps, args.epochs, args.minibatches = 4096, 400_000_000, 5, 4
    args.task = args.task or next(name for name, task in TASKS.items() if args.robot in task.robots)
    if args.robot not in TASKS[args.task].robots:
        fail(f"the task {args.task} is for {', '.join(TASKS[args.task].robots)}, not for {args.robot}")
    if args.device == "cuda" and not torch.cuda.is_available():
        fail("torch finds no CUDA device; leave --device away to train on the CPU")
    if args.device == "auto":
        args.device = "cuda" if torch.cuda.is_available() else "cpu"
    args.processes = int(os.environ.get("WORLD_SIZE", 1 if args.device == "cuda" else args.threads))
    if args.envs % args.processes:
        fail(f"{args.envs} robots do not divide among {args.processes} processes; change --envs or --threads")
    if args.envs // args.processes * PPOConfig.steps < args.minibatches:
        fail(f"{args.envs} robots are too few for {args.minibatches} minibatches on {args.processes} processes")
    if args.policy == "all":
        if args.out:
            fail("every policy has a folder of its own: leave --out away with --policy all")
        return args
    args.out = args.out or Path("runs") / f"{args.robot}-{args.task}-{args.policy}-seed{args.seed}"
    saved = args.out / "checkpoint.pt"
    if args.resume and not saved.exists():
        fail(f"there is nothing to resume in {args.out}; leave --resume away to start there")
    if saved.exists() and not args.resume:
        fail(f"{args.out} holds a run already; go on with --resume, or choose another --out or --seed")
    writable_folder(args.out)
    return args


class Progress:
    """One CSV row an iteration, the picture of it, and the live line."""

    def __init__(self, args, iteration: int, steps: int):
        self.args, self.path, self.start, self.first = args, args.out / "progress.csv", time.time(), steps
        self.recent = deque(maxlen=20)  # iterations, for figures of episodes, which end now and then
        rows = []
        if iteration and self.path.exists():  # drop what was logged after the checkpoint that we go on from
            with open(self.path, newline="") as file:
                rows = list(csv.reader(file))[: iteration + 1]
        with open(self.path, "w", newline="") as file:
            csv.writer(file).writerows(rows)

    def log(self, row: dict, sums: dict[str, float]) -> None:
        """Writes the row and prints the line (every tenth one if the output is not a terminal)."""
        self.recent.append(sums)
        number, returns, lengths, falls = (
            sum(sums[name] for sums in self.recent) for name in ("episodes", "returns", "lengths", "falls")
        )
        recent = [x / number if number else math.nan for x in (returns, lengths * CONTROL_DT, falls)]
        row |= dict(zip(("episode_return", "episode_seconds", "falls"), recent))
        with open(self.path, "a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()})

        steps, total = row["steps"], self.args.steps
        rate = (steps - self.first) / (time.time() - self.start)
        bar = "#" * int(20 * min(1, steps / total))
        line = (
            f"[{bar:.<20}] {steps / 1e6:.2f}/{total / 1e6:.2f}M {rate:,.0f}/s"
            f" {max(0, total - steps) / rate / 60:.0f} min left"
            f" | return {recent[0]:.1f} speed {row['speed']:.2f} of {row['commanded_speed']:.2f} m/s"
            f" episode {recent[1]:.1f} s falls {recent[2]:.0%} sigma {row['sigma']:.2f} KL {row['kl']:.3f}"
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
        self.number, self.actor = number, stage.actor
        self.env = LocomotionEnv(args.robot, share, seeds, threads, stage.faults, extras=stage.extras)
        self.observation = self.env.reset(random_ages=True)
        self.critic = (Critic(self.observation, stage.actor.normalizer) if stage.critic is None else stage.critic).to(device)
        policy.requires_grad_(False)
        for module in stage.trained:
            module.requires_grad_(True)
        masks = stage.actor.sample_masks(share, torch.Generator(device)) if stage.actor.replays_masks else {}
        self.buffer = RolloutBuffer(PPOConfig.steps, self.observation, self.env.num_actions, masks, device)
        config = PPOConfig(epochs=args.epochs, minibatches=args.minibatches)
        self.learner = stage.learner(stage.actor, self.critic, config)


def train(rank: int, args, sync: str | None) -> None:
    """The training loop of one process."""
    device = torch.device("cpu")
    if args.device == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.cuda.set_device(device)
    if args.processes > 1:
        backend = "nccl" if args.device == "cuda" else "gloo"
        dist.init_process_group(backend, init_method=sync, rank=rank, world_size=args.processes)
    torch.set_num_threads(1)
    task, robot = TASKS[args.task], ROBOTS[args.robot]
    torch.manual_seed(args.seed)  # the same weights in every process
    policy = make_policy(args.policy, robot, task).to(device)
    stages = training_stages(policy, task)
    ends = [args.steps * sum(stage.share for stage in stages[: i + 1]) for i in range(len(stages) - 1)] + [args.steps]
    generator = torch.Generator(device).manual_seed(args.seed * 1_000_003 + rank)  # actions, masks, minibatches
    part = Part(0, stages[0], args, rank, policy, device)
    iteration, steps = 0, 0

    if args.resume:
        saved = checkpoint.load_newest(args.out / "checkpoint.pt")
        iteration, steps = saved["iteration"], saved["steps"]
        if saved["stage"]:
            part = Part(saved["stage"], stages[saved["stage"]], args, rank, policy, device)
        policy.load_state_dict(saved["weights"])
        part.critic.load_state_dict(saved["critic"])
        part.learner.load_state_dict(saved["learner"])
        part.env.load_state_dict(from_plain(saved["processes"][rank]["env"]))
        generator.set_state(saved["processes"][rank]["generator"])
        part.observation = part.env.observe()

    def save() -> None:
        """Process 0 writes the files; the others tell it their part."""
        mine = {"env": to_plain(part.env.state_dict()), "generator": generator.get_state()}
        everyone = [mine] * args.processes
        if args.processes > 1:
            dist.gather_object(mine, everyone if rank == 0 else None)
        if rank == 0:
            content = {key: getattr(args, key) for key in ("robot", "task", "policy", "seed")} | {"steps": steps}
            content["weights"] = {name: tensor.cpu() for name, tensor in policy.state_dict().items()}
            checkpoint.save(content, args.out / "policy.pt")
            content |= {"critic": part.critic.state_dict(), "learner": part.learner.state_dict(), "processes": everyone}
            content |= {"iteration": iteration, "stage": part.number, "identity": identity(args)}
            checkpoint.save_next(content, args.out / "checkpoint.pt")
            learning_curve(args.out / "progress.csv", args.out / "progress.png")

    stop = []  # Ctrl-C and SIGTERM end the run after the iteration that they interrupt
    handlers = {n: signal.signal(n, lambda *_: stop.append(True)) for n in (signal.SIGINT, signal.SIGTERM)}
    progress = Progress(args, iteration, steps) if rank == 0 else None
    saved_at = time.time()
    while steps < args.steps:
        if steps >= ends[part.number]:
            number = part.number + 1
            part = Part(number, stages[number], args, rank, policy, device)
        if part.learner.measures and not part.actor.normalizer.count:  # the first rollout is for the normalizer alone
            part.observation, _ = collect(part.env, part.actor, part.critic, part.buffer, part.observation, generator)
            part.actor.normalizer.update(part.buffer.observation, all_reduce)
        started = time.perf_counter()
        part.observation, infos = collect(part.env, part.actor, part.critic, part.buffer, part.observation, generator)
        collected = time.perf_counter()
        losses = part.learner.update(part.buffer, generator)
        updated = time.perf_counter()
        iteration, steps = iteration + 1, steps + len(part.buffer) * args.processes

        means, sums = summarise(infos, part.buffer, part.env)
        overdue = rank == 0 and time.time() - saved_at > 60 * args.save_minutes
        shared = sum_over_processes(means | sums | {"stop": bool(stop), "save": overdue}, device)  # all must agree
        if rank == 0:
            row = {"iteration": iteration, "steps": steps, "stage": part.number}
            row |= {name: shared[name] / args.processes for name in means}
            row |= {"sigma": part.actor.sigma().mean().item(), "learning_rate": part.learner.learning_rate} | losses
            row |= {"collect_seconds": collected - started, "update_seconds": updated - collected}
            progress.log(row | {"divergences": int(shared["divergences"])}, shared)
        if shared["save"] or shared["stop"] or steps >= args.steps:
            save()
            saved_at = time.time()
        if shared["stop"]:
            break

    for number, handler in handlers.items():
        signal.signal(number, handler)
    if rank == 0:
        policy_file = args.out / "policy.pt"
        if steps < args.steps:
            print(f"\nstopped at {steps:,} steps and saved; the same command with --resume goes on")
        print(f"\ntrained: {policy_file}\ntest it: python evaluate.py {args.task} --checkpoints {policy_file}")
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


def guarded(rank: int, args, sync: str | None) -> None:
    """`train`, with what a user can mend said in one line."""
    try:
        train(rank, args, sync)
    except (OSError, FloatingPointError, ValueError) as error:
        print(f"\nerror: {error}", file=sys.stderr)
        os._exit(1)  # at once: the other processes wait for this one and are ended by the parent


def identity(args) -> dict:
    return {key: getattr(args, key) for key in (*IDENTITY, *(("steps",) if args.policy in STAGED else ()))}


def train_all(words: list[str], args) -> None:
    """Every method of the task, one after the other: what is finished is skipped, what was stopped goes on."""
    words = [word for word in words if word != "--resume"]
    for policy in METHODS:
        out = Path("runs") / f"{args.robot}-{args.task}-{policy}-seed{args.seed}"

        def steps_done() -> int:
            return checkpoint.load(out / "policy.pt")["steps"] if (out / "checkpoint.pt").exists() else 0

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
        saved = checkpoint.load_newest(args.out / "checkpoint.pt", say=True) if args.resume else {"identity": identity(args)}
        was = saved.get("identity", {})
    except checkpoint.CheckpointError as error:
        fail(error)
    differing = [f"{key} was {was.get(key)}, is {now}" for key, now in identity(args).items() if was.get(key) != now]
    if differing:
        fail(f"the run in {args.out} was another one: {'; '.join(differing)}")
    lock = lock_folder(args.out) if os.environ.get("RANK", "0") == "0" else None  # noqa: F841 (held until the end)
    if "RANK" in os.environ:  # started by torchrun, which has made the processes
        guarded(int(os.environ["RANK"]), args, "env://")
    elif args.processes == 1:
        guarded(0, args, None)
    else:
        with tempfile.TemporaryDirectory() as folder:
            children = mp.spawn(guarded, (args, f"file://{folder}/sync"), nprocs=args.processes, join=False)
            for signum in (signal.SIGINT, signal.SIGTERM):  # the children save and end; this process waits for them
                signal.signal(signum, lambda number, _: [os.kill(p.pid, number) for p in children.processes if p.is_alive()])
            try:
                while not children.join():
                    pass
            except mp.ProcessExitedException as error:
                sys.exit(f"process {error.error_index} ended early; {args.out} holds the last checkpoint: add --resume")


if __name__ == "__main__":
    main()
