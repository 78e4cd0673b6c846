"""How near to the limit of this machine each part runs: ratios first, absolute figures behind them.

    python benchmark.py              # about half a minute
    python benchmark.py --robot a1 --envs 256

Simulation: `env.step` against the bare `Batch.step` that it contains. Learner: forward and backward of the policy against
plain matrix products of the same shapes, on one thread, as in training. Both sides of a ratio are timed in turn, round
by round, and medians are compared: on a shared machine nothing else can be trusted.
"""

import statistics
import time

import numpy as np
import torch
from torch import Tensor, nn

from baselines import make_policy
from cli import Parser, count, num_cores
from env import LocomotionEnv
from faults import TASKS
from ppo import to_tensors
from robots import ROBOTS
from rolt import ROLT


def seconds(function) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def time_simulation(robot: str, num_envs: int, threads: int, steps: int = 150) -> tuple[float, float]:
    """(seconds of env.step, seconds of the bare physics in it), for `steps` control steps under random actions."""
    env = LocomotionEnv(robot, num_envs, 0, threads, TASKS["stiffness"].training)
    env.reset(random_ages=True)
    bare_step, bare = env.world.step, []
    env.world.step = lambda **options: bare.append(seconds(lambda: bare_step(**options)))
    rng, total = np.random.default_rng(0), []
    for _ in range(steps):
        action = 0.5 * rng.normal(size=(num_envs, env.num_actions))
        total.append(seconds(lambda: env.step(action)))
    return sum(total[10:]), sum(bare[10:])


def product_shapes(policy: nn.Module, observation, masks) -> list[tuple[int, int, int]]:
    """(rows, inputs, outputs) of every linear layer in one forward pass."""
    shapes, hooks = [], []

    def record(module: nn.Linear, inputs: tuple[Tensor], output: Tensor) -> None:
        shapes.append((output.numel() // module.out_features, module.in_features, module.out_features))

    for module in policy.modules():
        if isinstance(module, nn.Linear):
            hooks.append(module.register_forward_hook(record))
    policy(observation, masks)
    for hook in hooks:
        hook.remove()
    return shapes


def time_learner(robot: str, batch: int, rounds: int = 25) -> tuple[float, float, float]:
    """(median seconds of a forward and backward pass, of its matrix products alone, GFLOP of those)."""
    env = LocomotionEnv(robot, batch, 0)
    observation = to_tensors(env.reset(), "cpu")
    policy = make_policy("rolt", env.robot)
    masks = policy.sample_masks(batch, torch.Generator().manual_seed(0))
    shapes = product_shapes(policy, observation, masks)
    operands = [(torch.randn(m, k), torch.randn(n, k), torch.randn(m, n)) for m, k, n in shapes]

    def forward_and_backward() -> None:
        policy.zero_grad(set_to_none=False)
        policy(observation, masks).square().sum().backward()

    def products() -> None:
        for x, weight, gradient in operands:
            _ = x @ weight.T, gradient @ weight, gradient.T @ x  # the output, and the gradients of x and of the weight

    times = [(seconds(forward_and_backward), seconds(products)) for _ in range(rounds)][3:]
    network, plain = (statistics.median(column) for column in zip(*times))
    return network, plain, sum(6 * m * k * n for m, k, n in shapes) / 1e9


def main(argv: list[str] | None = None) -> None:
    parser = Parser(__doc__)
    parser.add_argument("--robot", choices=ROBOTS, default="a1")
    parser.add_argument("--envs", type=count, default=256)
    parser.add_argument("--threads", type=count, default=num_cores())
    args = parser.parse_args(argv)

    total, bare = time_simulation(args.robot, args.envs, args.threads)
    steps = 140 * args.envs
    print(f"simulation  env.step takes {total / bare:.2f} times its bare Batch.step")
    rates = f"{steps / total:,.0f} env steps/s, bare {steps / bare:,.0f}"
    print(f"            {rates} ({args.envs} robots, {args.threads} threads)")
    torch.set_num_threads(1)
    network, plain, work = time_learner(args.robot, ROLT.micro_batch)
    print(f"learner     forward and backward run at {plain / network:.0%} of the rate of their matrix products")
    rates = f"{ROLT.micro_batch / network:,.0f} samples/s, {work / network:.0f} GFLOP/s of {work / plain:.0f}"
    print(f"            {rates} (one thread)")


if __name__ == "__main__":
    main()
