"""Two processes with half of the robots each learn what one process learns with all of them."""

from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from baselines import make_policy
from env import Observation
from ppo import Critic, Learner, PPOConfig, RolloutBuffer
from faults import TASKS
from robots import A1

T, N = 3, 8  # steps, robots of all processes


def updated(world_size: int, rank: int = 0) -> dict:
    """One update, with a single minibatch, on this rank's share of a made-up rollout."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    policy = make_policy("rolt", A1, TASKS["stiffness"], False)
    shapes = (4, 10, 21), (12,), (25,), (0,), (0,), (0,)
    observation = Observation(*(torch.randn(T, N, *shape) for shape in shapes))
    critic = Critic(Observation(*(field[0].numpy() for field in observation)))
    masks = policy.sample_masks(N, torch.Generator().manual_seed(0))
    buffer = RolloutBuffer(T, Observation(*(field[0] for field in observation)), 12, masks, "cpu")
    buffer.observation, buffer.std = observation, policy.std().detach()
    buffer.action, buffer.mean = torch.randn(T, N, 12), 0.1 * torch.randn(T, N, 12)
    buffer.log_prob, buffer.reward = torch.full((T, N), -14.0) + torch.rand(T, N), torch.randn(T, N)
    buffer.value, buffer.next_value = torch.randn(T, N), torch.randn(T, N)
    for name, mask in masks.items():
        buffer.masks[name][:] = mask

    mine = slice(rank * N // world_size, (rank + 1) * N // world_size)
    buffer.observation = Observation(*(field[:, mine] for field in buffer.observation))
    fields = "action mean log_prob reward value next_value terminated truncated"
    for name in fields.split():
        setattr(buffer, name, getattr(buffer, name)[:, mine])
    buffer.masks = {name: packed[:, mine] for name, packed in buffer.masks.items()}

    learner = Learner(policy, critic, PPOConfig(epochs=1, minibatches=1))
    stats = learner.update(buffer, torch.Generator().manual_seed(rank))
    gradient = torch.cat([p.grad.flatten() for p in learner.parameters])
    result = {"gradient": gradient, "learning_rate": learner.optimizer.param_groups[0]["lr"]}
    return result | {"stats": stats, "weights": policy.state_dict()}


def rank_of_two(rank: int, folder: str) -> None:
    dist.init_process_group("gloo", init_method=f"file://{folder}/sync", rank=rank, world_size=2)
    result = updated(2, rank)
    dist.destroy_process_group()
    names = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]
    assert not [name for name in names if "gloo" in name]  # a thread of it left may abort the exit
    torch.save(result, f"{folder}/{rank}.pt")


def test_two_ranks_of_half_the_robots_follow_one_rank_of_all(tmp_path):
    mp.spawn(rank_of_two, (str(tmp_path),), nprocs=2)
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    one = updated(1)
    assert torch.equal(first["gradient"], second["gradient"]) and first["stats"] == second["stats"]
    for name in one["weights"]:
        assert torch.equal(first["weights"][name], second["weights"][name])
    assert one["gradient"].norm() > 0.1
    assert torch.allclose(first["gradient"], one["gradient"], atol=1e-5)
    assert first["learning_rate"] == one["learning_rate"] != PPOConfig.learning_rate  # moved by KL
    assert first["stats"] == pytest.approx(one["stats"], abs=1e-4)
