"""PPO's mathematics by hand, and the masks' way from the rollout into the update."""

import copy
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch.distributions import Normal, kl_divergence

from conftest import env_of, fresh_policy, ratio, rollout_of
from env import EnvConfig
from ppo import Learner, PPOConfig, RolloutBuffer
from ppo import adapt_learning_rate, collect, compute_gae, ppo_loss, to_tensors


def test_gae_by_hand():
    """gamma 0.5, lambda 0.5. Three robots in step 1: one lives on, one dies, one's time is out."""
    none, middle = torch.tensor([[False] * 3, [False, True, False]])[:, :, None]
    reward, value, following = torch.tensor([[1.0, 2, 3], [4, 8, 16], [8, 16, 32]])[:, :, None]

    def gae(terminated, truncated):
        advantage = compute_gae(reward, value, following, terminated, truncated, 0.5, 0.5)
        return advantage.flatten().tolist()

    # td errors: 1 + 4 - 4 = 1, 2 + 8 - 8 = 2, 3 + 16 - 16 = 3
    assert gae(none, none) == [1 + 2.75 / 4, 2.75, 3]
    # dead: step 1 has no future: 2 - 8 = -6; step 0 sees it through lambda
    assert gae(middle, none) == [1 - 6 / 4, -6, 3]
    # out of time: the future counts (2), the next episode's advantage does not
    assert gae(none, middle) == [1 + 2 / 4, 2, 3]


def test_loss_by_hand():
    config = PPOConfig(clip=0.2, value_weight=0.5)
    # ratios 1, 2 (clipped to 1.2), 0.5 (with a bad action: to 0.8), 0.5 (with a good one: not)
    log_prob, advantage = torch.tensor([1.0, 2, 0.5, 0.5]).log(), torch.tensor([1.0, 1, -1, 1])
    # value errors: 1; clipped 0.2 from old instead of 2 away: 3 - 1.8; ...
    value, target = torch.tensor([[1.0, 2, 0.1, 0], [0, 2, 0, 0]])
    old, entropy = torch.zeros(4), torch.full((4,), 5.0)
    loss, parts = ppo_loss(log_prob, old, advantage, value, old, target, entropy, 0.1, config)
    surrogate = -(1 + 1.2 - 0.8 + 0.5) / 4
    value_loss = (1 + 1.8**2 + 0.1**2 + 0) / 4
    by_hand = {"surrogate": surrogate, "value_loss": value_loss, "clip_fraction": 0.75}
    assert {name: part.item() for name, part in parts.items()} == pytest.approx(by_hand)
    assert loss.item() == pytest.approx(surrogate + 0.5 * value_loss - 0.1 * 5)


def test_learning_rate_follows_the_kl():
    assert adapt_learning_rate(3e-4, 0.021, 0.01) == pytest.approx(2e-4)
    assert adapt_learning_rate(2e-4, 0.004, 0.01) == pytest.approx(3e-4)
    assert adapt_learning_rate(2e-4, 0.010, 0.01) == 2e-4
    assert adapt_learning_rate(2e-4, 0.0, 0.01) == 2e-4  # no step has been taken yet
    assert adapt_learning_rate(1e-5, 1.0, 0.01) == 1e-5
    assert adapt_learning_rate(1e-2, 1e-4, 0.01) == 1e-2


def test_ratio_is_one_with_replayed_masks_and_not_with_fresh_ones():
    """The reason for consistent dropout, on a real rollout before any weight has moved."""
    run = rollout_of(fresh_policy("rolt"))
    same = run.buffer.minibatch(torch.arange(80, 88))  # step 10 of all 8 robots, acting at once
    assert torch.equal(ratio(run, same), torch.ones(8))  # to the bit
    order = torch.randperm(len(run.buffer), generator=run.generator)[:64]
    batch = run.buffer.minibatch(order)  # in another order sums are rounded differently, no more
    assert (ratio(run, batch) - 1).abs().max() < 1e-4
    batch["masks"] = run.actor.sample_masks(64, run.generator)
    assert (ratio(run, batch) - 1).abs().median() > 0.1


def test_ratio_is_one_in_bf16_too():
    run = rollout_of(fresh_policy("rolt"), n=64, precision="bf16")
    batch = run.buffer.minibatch(torch.randperm(len(run.buffer), generator=run.generator)[:500])
    assert (ratio(run, batch) - 1).abs().max() < 1e-2
    run.learner.bf16 = False
    assert (ratio(run, batch) - 1).abs().max() > 1e-4  # it was bf16 that acted


@torch.no_grad()
def test_the_critic_sees_what_policies_do_not():
    """Another fault: another value, the same actions. Noise on heights is the policy's alone."""
    run = rollout_of(fresh_policy("mlp", "terrain", True), task="terrain")
    policy, critic, batch = run.actor, run.critic, run.buffer.minibatch(torch.arange(8))
    seen, noise = batch["observation"], batch["masks"]["height_noise"]
    told = seen._replace(privileged=seen.privileged + 1)
    assert torch.equal(policy(told), policy(seen)) and not torch.equal(critic(told), critic(seen))
    assert noise.std().item() == pytest.approx(20 * 0.06, rel=0.1)
    assert not torch.equal(policy(seen, batch["masks"]), policy(seen))
    assert torch.equal(batch["value"], critic(seen))  # of what is stored: clean
    assert torch.equal(seen.heights, to_tensors(run.observation, "cpu").heights)
    assert torch.allclose(ratio(run, batch), torch.ones(8), atol=1e-4)


def test_update_is_ppo_as_one_would_write_it_down():
    """Two epochs of three minibatches, half of the training done, by plain autograd."""
    run = rollout_of(fresh_policy("rolt"))
    policy, critic, buffer, generator = run.actor, run.critic, run.buffer, run.generator
    plain_policy, plain_critic = copy.deepcopy((policy, critic))
    start = [p.clone() for module in (policy, critic) for p in module.parameters()]
    order = torch.Generator().set_state(generator.get_state())
    config = PPOConfig(epochs=2, minibatches=3, max_gradient_norm=15.0)
    stats = Learner(policy, critic, config).update(buffer, generator, progress=0.5)

    parameters = [*plain_policy.parameters(), *plain_critic.parameters()]
    optimizer = torch.optim.Adam(plain_policy.parameters(), lr=1e-4)
    optimizer.add_param_group({"params": plain_critic.parameters(), "lr": 1e-3})
    advantages = (buffer.returns - buffer.value).flatten()  # before they are normalised
    advantages = (advantages - advantages.mean()) / advantages.std(correction=0)
    norms, kls = [], []
    for _ in range(2):
        for index in torch.randperm(24 * 8, generator=order).split(64):
            batch = buffer.minibatch(index)
            seen, old = batch["observation"], Normal(batch["mean"], buffer.std)
            new = Normal(plain_policy(seen, batch["masks"]), plain_policy.std())
            log_prob, entropy = new.log_prob(batch["action"]).sum(1), new.entropy().sum(1)
            loss, _ = ppo_loss(
                log_prob, batch["log_prob"], advantages[index], plain_critic(seen), batch["value"],
                batch["returns"], entropy, 0.5 * config.entropy_weight, config,
            )  # fmt: skip
            optimizer.zero_grad()
            loss.backward()
            norm = torch.nn.utils.clip_grad_norm_(parameters, config.max_gradient_norm)
            optimizer.step()
            norms.append(norm.item())
            kls.append(kl_divergence(old, new).sum(1).mean().item())

    assert min(norms) < config.max_gradient_norm < max(norms)  # some were clipped
    trained = [*policy.named_parameters(), *critic.named_parameters()]
    for (name, ours), plain, before in zip(trained, parameters, start):
        if not name.endswith("key_value.bias"):  # unseen by softmax: rounding, which Adam enlarges
            assert (ours - plain).norm() < 0.005 * (ours - before).norm(), name
    assert stats["kl"] == pytest.approx(sum(kls) / 6, rel=0.01)
    assert stats["learning_rate"] == adapt_learning_rate(1e-4, stats["kl"], config.target_kl)


@torch.no_grad()
def test_the_buffer_holds_what_the_env_answered():
    """A twin of the env is given the same actions. One of three robots begins on its back."""
    run = rollout_of(fresh_policy("rolt"))
    how = {"config": EnvConfig(episode_seconds=0.1), "extras": ("privileged",)}
    env, twin = env_of(3, **how), env_of(3, **how)
    observation = env.observe()
    for world in (env, twin):
        world._qpos[1, 2:7] = [0.5, 0, 1, 0, 0]
    buffer = RolloutBuffer(8, observation, 12, run.actor.sample_masks(3, run.generator), "cpu")
    following, _ = collect(env, run.actor, run.critic, buffer, observation, run.generator)
    for t in range(8):
        seen, *answer, info = twin.step(buffer.action[t].numpy())
        for stored, true in zip((buffer.reward, buffer.terminated, buffer.truncated), answer):
            assert stored[t].tolist() == true.tolist()
        if buffer.truncated[t].any():  # bootstrapped from the true last observation
            true_value = run.critic(to_tensors(info["final_observation"], "cpu"))
            assert torch.allclose(buffer.next_value[t, info["truncated_ids"]], true_value)
            assert not torch.allclose(buffer.next_value[t], buffer.value[t + 1])
    assert buffer.terminated[0].tolist() == [False, True, False]
    assert buffer.truncated[4].any() and buffer.reward.std() > 0
    assert torch.equal(buffer.next_value[3], buffer.value[4])  # inside an episode: the next one
    assert (following.legs == seen.legs).all()
    last = buffer.next_value[-1]
    assert torch.equal(last, run.critic(to_tensors(seen, "cpu"))) and last.abs().min() > 0


def test_a_gradient_that_is_not_finite_stops_training_before_it_reaches_a_weight():
    run = rollout_of(fresh_policy("rolt"))
    run.buffer.observation.legs[5] = float("nan")
    with pytest.raises(FloatingPointError, match="a gradient is not finite"):
        run.learner.update(run.buffer, run.generator)
    state = run.actor.state_dict() | run.critic.state_dict()  # moved by good minibatches, perhaps
    assert all(torch.isfinite(p).all() for p in state.values())


def updated(world_size: int, rank: int = 0) -> dict:
    """One update on this rank's share of a rollout of another policy: its means are moved."""
    torch.set_num_threads(1)
    run = rollout_of(fresh_policy("rolt"))
    buffer = run.buffer
    buffer.mean += 0.1
    buffer.log_prob += torch.rand(buffer.log_prob.shape)
    mine = slice(rank * 8 // world_size, (rank + 1) * 8 // world_size)
    buffer.observation = type(buffer.observation)(*(x[:, mine] for x in buffer.observation))
    buffer.masks = {name: mask[:, mine] for name, mask in buffer.masks.items()}
    for name in "action mean log_prob reward value next_value terminated truncated".split():
        setattr(buffer, name, getattr(buffer, name)[:, mine])

    learner = Learner(run.actor, run.critic, PPOConfig(epochs=1, minibatches=1))
    stats = learner.update(buffer, torch.Generator().manual_seed(rank))
    gradient = torch.cat([p.grad.flatten() for p in learner.parameters])
    result = {"gradient": gradient, "learning_rate": learner.optimizer.param_groups[0]["lr"]}
    return result | {"stats": stats, "weights": run.actor.state_dict()}


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
    assert all(map(torch.equal, first["weights"].values(), second["weights"].values()))
    assert one["gradient"].norm() > 0.1
    assert torch.allclose(first["gradient"], one["gradient"], atol=1e-5)
    assert first["learning_rate"] == one["learning_rate"] != PPOConfig.learning_rate  # moved by KL
    assert first["stats"] == pytest.approx(one["stats"], abs=1e-4)
