"""How near to the limit of this machine each part runs: ratios first, absolute figures behind them.

    python benchmark.py                                   # A1 and hexapod, ROLT and MLP; about a minute
    python benchmark.py --robots a1 --policies rolt
    python benchmark.py --json                            # the last line has it all as JSON; ratios end in _ratio

    env.step    against the bare `Batch.step` that it contains, on the same threads; and what the scandots take of it
    learner     forward and backward of the policy against its matrix products alone, on one thread, as in training
    latency     one action for one robot on one thread, against the 20 ms that a 50 Hz controller has
    training    whole iterations by phase, on one rank (a process of one thread) and on one a core; and, as this machine's
                own limit, how many times as fast as one rank of nothing but matrix products as many of them are

The matrix products are those of the linear layers, and in attention queries times keys and weights times values, forward
and backward, at their shapes and called as torch calls them: small batched products reach a fraction of the rate of large
ones, and are timed as what they are. Both sides of a ratio are timed in turn, round by round, and medians are taken: on
a shared machine nothing else can be trusted. All on the CPU, and on an untrained policy: weights do not change the cost.
"""

import json
import statistics
import sys
import tempfile
import time
from functools import partial

import numpy as np
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor, nn

from baselines import METHODS, STAGED, make_policy
from cli import Parser, count, num_cores, threads
from env import CONTROL_DT, LocomotionEnv
from faults import TASKS, first_task
from ppo import Critic, Learner, PPOConfig, RolloutBuffer, all_reduce, collect, to_tensors
from robots import ROBOTS
from rolt import EncoderLayer
from terrain import TRAINING_MAP, Terrain

try:
    import resource
except ImportError:  # Windows
    resource = None

ONE_STAGE = tuple(name for name in METHODS if name not in STAGED)  # what one critic and one learner train


def seconds(function, clock=time.perf_counter) -> float:
    start = clock()
    function()
    return clock() - start


def timed(function, times: list[float]):
    """`function`, which now also appends what each call takes to `times`."""

    def call(*args, **options):
        start = time.perf_counter()
        result = function(*args, **options)
        times.append(time.perf_counter() - start)
        return result

    return call


def make_env(robot: str, num_envs: int, seed: int, threads: int, **options) -> LocomotionEnv:
    """With the faults of the first task that is for this robot, as train.py has it by default."""
    return LocomotionEnv(robot, num_envs, seed, threads, TASKS[first_task(robot)].training, **options)


# ---------------------------------------------------------------------- one part at a time


def time_simulation(robot: str, num_envs: int, threads: int, steps: int, terrain: Terrain | None) -> dict[str, float]:
    """Control steps under random actions."""
    env = make_env(robot, num_envs, 0, threads, terrain=terrain)
    env.reset(random_ages=True)
    total, bare, scan, rng = [], [], [], np.random.default_rng(0)
    env.world.step, env.scan.read = timed(env.world.step, bare), timed(env.scan.read, scan)
    step = timed(env.step, total)
    for i in range(steps + 10):
        if i == 10:  # warm
            for times in (total, bare, scan):
                times.clear()
        step(0.5 * rng.normal(size=(num_envs, env.num_actions)))
    del env.world.step, env.scan.read  # or the world and its threads would never go: they hold themselves
    return {
        "env_step_ratio": sum(bare) / sum(total),
        "scandots_ratio": sum(scan) / sum(total),
        "env_steps_per_second": steps * num_envs / sum(total),
        "bare_steps_per_second": steps * num_envs / sum(bare),
    }


def matrix_products(policy: nn.Module, observation, masks) -> tuple[list, list]:
    """The products of a forward and backward pass, of the linear layers and of attention, as pairs of random operands."""
    linear, attention, hooks = [], [], []

    def of_linear(module: nn.Linear, inputs: tuple[Tensor], output: Tensor) -> None:
        m, k, n = output.numel() // module.out_features, module.in_features, module.out_features
        x, weight, gradient = torch.randn(m, k), torch.randn(n, k), torch.randn(m, n)
        linear.extend([(x, weight.T), (gradient.T, x)])
        if inputs[0].requires_grad:  # not of the observation
            linear.append((gradient, weight))

    def of_attention(module: EncoderLayer, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
        B, heads, queries, T = output[1].shape
        d = output[0].shape[-1] // heads
        q, k, v, gradient = (torch.randn(B * heads, rows, d) for rows in (queries, T, T, queries))
        weights = torch.randn(B * heads, queries, T)  # and the gradient of the scores, which has its shape
        attention.extend([(q, k.mT), (weights, v)])  # forward
        attention.extend([(gradient, v.mT), (weights.mT, gradient), (weights, k), (weights.mT, q)])  # backward

    for module in policy.modules():
        if isinstance(module, nn.Linear):
            hooks.append(module.register_forward_hook(of_linear))
        elif isinstance(module, EncoderLayer):
            hooks.append(module.register_forward_hook(of_attention))
    policy(observation, masks)
    for hook in hooks:
        hook.remove()
    return linear, attention


def time_learner(robot: str, name: str, rounds: int) -> dict[str, float]:
    """Forward and backward of one micro-batch. CPU time: what other programs take of the core does not count."""
    policy = make_policy(name, ROBOTS[robot])
    B = policy.micro_batch
    one = make_env(robot, 1, 0, 1).reset()
    observation = type(one)(*(field.repeat(B, *[1] * (field.dim() - 1)) for field in to_tensors(one, "cpu")))
    masks = policy.sample_masks(B, torch.Generator().manual_seed(0)) if policy.replays_masks else {}
    masks = {key: mask.float() for key, mask in masks.items()}  # as the update unpacks them
    linear, attention = matrix_products(policy, observation, masks)

    def network() -> None:
        policy.zero_grad(set_to_none=False)
        policy(observation, masks).square().sum().backward()

    def products(pairs) -> None:
        for a, b in pairs:
            a @ b

    runs = network, lambda: products(linear), lambda: products(attention)
    times = [[seconds(run, time.thread_time) for run in runs] for _ in range(rounds + 2)][2:]
    work = sum(2 * a.numel() * b.shape[-1] for a, b in linear + attention) / 1e9
    whole = statistics.median(network for network, _, _ in times)
    bare = statistics.median(of_linear + of_attention for _, of_linear, of_attention in times)
    return {
        "learner_ratio": statistics.median((b + c) / a for a, b, c in times),
        "learner_linear_ratio": statistics.median(b / a for a, b, _ in times),
        "learner_samples_per_second": B / whole,
        "learner_gflops": work / whole,
        "products_gflops": work / bare,
    }


@torch.no_grad()
def time_action(robot: str, name: str, calls: int) -> dict[str, float]:
    """From the observation's arrays to the action's."""
    policy, observation = make_policy(name, ROBOTS[robot]), make_env(robot, 1, 0, 1).reset()
    times = [seconds(lambda: policy(to_tensors(observation, "cpu")).numpy()) for _ in range(calls + 10)][10:]
    median, late = np.quantile(times, [0.5, 0.99])
    return {"latency_ratio": median / CONTROL_DT, "latency_median_ms": 1e3 * median, "latency_99th_ms": 1e3 * late}


# ---------------------------------------------------------------------- all together


def time_training(robot: str, name: str, num_envs: int, rank: int) -> dict[str, float]:
    """Seconds by phase of one iteration on this rank's robots (after a short one, to warm up)."""
    env = make_env(robot, num_envs, rank, 1)
    observation = env.reset(random_ages=True)
    torch.manual_seed(0)  # the same weights on every rank
    policy = make_policy(name, env.robot)
    critic, generator = Critic(observation, policy.normalizer), torch.Generator().manual_seed(rank)
    learner = Learner(policy, critic, PPOConfig(minibatches=max(1, num_envs * PPOConfig.steps // 512)))
    masks = policy.sample_masks(num_envs, generator) if policy.replays_masks else {}
    step = env.step
    for T in (2, PPOConfig.steps):
        simulate, acting, update = [], [], []
        env.step = timed(step, simulate)
        buffer = RolloutBuffer(T, observation, env.num_actions, masks, "cpu")
        observation, _ = timed(collect, acting)(env, policy, critic, buffer, observation, generator)
        timed(learner.update, update)(buffer, generator)
    del env.step  # as above
    return {"simulate": sum(simulate), "act": sum(acting) - sum(simulate), "update": sum(update)}


def product_rate(duration: float = 0.3) -> float:
    """Matrix products a second on one thread."""
    x, weight, done, start = torch.randn(2048, 160), torch.randn(160, 160), 0, time.perf_counter()
    while time.perf_counter() - start < duration:
        x @ weight
        done += 1
    return done / (time.perf_counter() - start)


def rank_of_many(rank: int, args, sync: str, results) -> None:
    """What one of `args.threads` processes does while the others do the same."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=sync, rank=rank, world_size=args.threads)
    limits = []
    for _ in range(3):
        alone = torch.zeros(args.threads)
        for turn in range(args.threads):
            dist.barrier()
            alone[turn] = product_rate() if turn == rank else 0.0
        dist.barrier()
        together = torch.tensor(product_rate())
        limits.append((all_reduce(together) / all_reduce(alone).mean()).item())
    figures = {"limit": statistics.median(limits)}
    for robot in args.robots:
        for name in args.policies:
            dist.barrier()
            figures[robot, name] = time_training(robot, name, args.envs // 4, rank)
    figures["memory"] = all_reduce(torch.tensor(peak_memory())).item()
    if rank == 0:
        results.put(figures)
    dist.destroy_process_group()


def peak_memory() -> float:
    """MB that this process has held at most; NaN where the system does not say."""
    if resource is None:
        return float("nan")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


# ---------------------------------------------------------------------- report


def show(title: str, figures: dict[str, float], report: dict[str, float]) -> None:
    """Prints the figures, ratios first, and adds them to the report."""
    report |= {f"{title}_{key}".replace(" ", "_"): value for key, value in figures.items()}
    ratios = [f"{key.removesuffix('_ratio')} {value:.3f}" for key, value in figures.items() if key.endswith("_ratio")]
    others = [f"{key} {value:,.4g}" for key, value in figures.items() if not key.endswith("_ratio")]
    print(f"{title + ':':14}{', '.join(ratios).replace('_', ' ')}")
    print(f"{'':14}{', '.join(others).replace('_', ' ')}", flush=True)


def main(argv: list[str] | None = None) -> None:
    parser = Parser(__doc__)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=["a1", "hexapod"])
    parser.add_argument("--policies", nargs="+", choices=ONE_STAGE, default=["rolt", "mlp"])
    robots = partial(count, most=2**16)
    parser.add_argument("--envs", type=robots, default=256, help="robots simulated; each rank of the training has a quarter")
    parser.add_argument("--rounds", type=partial(count, most=10_000), default=20, help="fewer are quicker and noisier")
    parser.add_argument("--threads", type=threads, default=num_cores(), help="of the simulation, and ranks (default: cores)")
    parser.add_argument("--json", action="store_true", help="all figures once more, as one line of JSON")
    args = parser.parse_args(argv)
    args.envs = max(4, args.envs)
    torch.set_num_threads(1)
    report, one = {"ranks": args.threads}, {}

    for robot in args.robots:
        for title, terrain in ((f"{robot} flat", None), (f"{robot} terrain", TRAINING_MAP)):
            show(title, time_simulation(robot, args.envs, args.threads, 5 * args.rounds, terrain), report)
        for name in args.policies:
            one[robot, name] = time_training(robot, name, args.envs // 4, 0)
            figures = time_learner(robot, name, args.rounds) | time_action(robot, name, 25 * args.rounds)
            show(f"{robot} {name}", figures, report)
    everyone = {"limit": 1.0, "memory": peak_memory()} | one
    if args.threads > 1:
        with tempfile.TemporaryDirectory() as folder:
            results = mp.get_context("spawn").SimpleQueue()
            mp.spawn(rank_of_many, (args, f"file://{folder}/sync", results), nprocs=args.threads)
            everyone = results.get()
    figures = {"products_speedup_ratio": everyone["limit"], "peak_memory_mb": everyone["memory"]}
    show(f"{args.threads} ranks", figures, report)
    for pair, alone in one.items():
        steps, figures = args.envs // 4 * PPOConfig.steps, {}
        for who, ranks, phases in (("one", 1, alone), ("all", args.threads, everyone[pair])):
            total = sum(phases.values())
            figures |= {f"{who}_{phase}_ratio": part / total for phase, part in phases.items()}
            figures[f"{who}_steps_per_second"] = ranks * steps / total
        speedup = figures["all_steps_per_second"] / figures["one_steps_per_second"]
        show(" ".join(pair), {"speedup_ratio": speedup, "of_limit_ratio": speedup / everyone["limit"]} | figures, report)
    if args.json:
        print(json.dumps(report))


if __name__ == "__main__":
    main()
