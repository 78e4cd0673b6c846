"""PPO's mathematics by hand, and the masks' way from the rollout into the update."""

import copy
import math

import pytest
import torch

from baselines import make_policy
from env import EnvConfig, LocomotionEnv
from faults import TASKS
from ppo import (
    Critic, Learner, PPOConfig, RolloutBuffer, adapt_learning_rate, collect, compute_gae, pack_bits, ppo_loss, to_tensors,
    unpack_bits,
)  # fmt: skip


def column(*values):
    return torch.tensor(values, dtype=torch.float32)[:, None]


def test_gae_by_hand():
    """gamma 0.5, lambda 0.5. Three robots: one lives on, one dies in step 1, one runs out of time in step 1."""
    none, middle = torch.zeros(3, 1, dtype=torch.bool), torch.tensor([[False], [True], [False]])
    reward, value, following = column(1, 2, 3), column(4, 8, 16), column(8, 16, 32)
    # td errors: 1 + 4 - 4 = 1, 2 + 8 - 8 = 2, 3 + 16 - 16 = 3
    assert compute_gae(reward, value, following, none, none, 0.5, 0.5).flatten().tolist() == [1 + 2.75 / 4, 2.75, 3]
    # dead: step 1 has no future: 2 - 8 = -6; step 0 sees it through lambda
    assert compute_gae(reward, value, following, middle, none, 0.5, 0.5).flatten().tolist() == [1 - 6 / 4, -6, 3]
    # out of time: the future counts (2), the next episode's advantage does not
    assert compute_gae(reward, value, following, none, middle, 0.5, 0.5).flatten().tolist() == [1 + 2 / 4, 2, 3]


def test_loss_by_hand():
    config = PPOConfig(clip=0.2, value_weight=0.5, entropy_weight=0.1)
    # ratios 1, 2 (clipped to 1.2), 0.5 (with a bad action: clipped to 0.8), 0.5 (with a good one: not clipped)
    log_prob = torch.tensor([0.0, math.log(2), math.log(0.5), math.log(0.5)])
    advantage = torch.tensor([1.0, 1.0, -1.0, 1.0])
    # value errors: 1; clipped 0.2 from old instead of 2 away: 3 - 1.8; ...
    value, old, target = torch.tensor([1.0, 2.0, 0.1, 0.0]), torch.zeros(4), torch.tensor([0.0, 2.0, 0.0, 0.0])
    loss, parts = ppo_loss(log_prob, torch.zeros(4), advantage, value, old, target, torch.full((4,), 5.0), config)
    surrogate = -(1 + 1.2 - 0.8 + 0.5) / 4
    value_loss = (1 + 1.8**2 + 0.1**2 + 0) / 4
    assert parts["surrogate"].item() == pytest.approx(surrogate)
    assert parts["value_loss"].item() == pytest.approx(value_loss)
    assert parts["clip_fraction"].item() == 0.75
    assert loss.item() == pytest.approx(surrogate + 0.5 * value_loss - 0.1 * 5)


def test_learning_rate_follows_the_kl():
    assert adapt_learning_rate(3e-4, 0.021, 0.01) == pytest.approx(2e-4)
    assert adapt_learning_rate(2e-4, 0.004, 0.01) == pytest.approx(3e-4)
    assert adapt_learning_rate(2e-4, 0.010, 0.01) == 2e-4
    assert adapt_learning_rate(2e-4, 0.0, 0.01) == 2e-4  # no step has been taken yet
    assert adapt_learning_rate(1e-5, 1.0, 0.01) == 1e-5 and adapt_learning_rate(1e-2, 1e-4, 0.01) == 1e-2


@pytest.mark.parametrize("shape", [(12,), (3, 5), (17, 160)])
def test_packed_masks_come_back(shape):
    mask = torch.rand(7, *shape, generator=torch.Generator().manual_seed(0)) < 0.6
    packed = pack_bits(mask)
    assert pack_bits(torch.eye(8) > 0).flatten().tolist() == [1, 2, 4, 8, 16, 32, 64, 128]
    assert packed.dtype == torch.uint8 and packed.shape == (7, math.ceil(math.prod(shape) / 8))
    assert torch.equal(unpack_bits(packed, shape), mask.float())


def test_masks_of_the_papers_batch_stay_under_100_megabytes():
    """4096 robots x 24 steps of ROLT on four legs."""
    masks = make_policy("rolt", LocomotionEnv("a1", 1).robot).sample_masks(1, torch.Generator())
    assert 4096 * 24 * sum(pack_bits(mask).shape[1] for mask in masks.values()) < 100e6


def rollout(policy_name="rolt", num_envs=8):
    torch.manual_seed(0)
    env = LocomotionEnv("a1", num_envs, 0, 1, TASKS["stiffness"].training)
    observation = env.reset(random_ages=True)
    policy = make_policy(policy_name, env.robot)
    critic = Critic(observation, policy.normalizer)
    torch.nn.init.normal_(policy.decoder.weight, std=0.2)  # as in a trained policy, dropout shows in the actions
    generator = torch.Generator().manual_seed(0)
    masks = policy.sample_masks(num_envs, generator)
    buffer = RolloutBuffer(24, observation, env.num_actions, masks, "cpu")
    collect(env, policy, critic, buffer, observation, generator)
    return policy, critic, buffer, generator


def ratio(policy, batch, sigma, masks):
    log_prob = torch.distributions.Normal(policy(batch["observation"], masks), sigma).log_prob(batch["action"]).sum(-1)
    return (log_prob - batch["log_prob"]).exp()


@torch.no_grad()
def test_ratio_is_one_with_replayed_masks_and_not_with_fresh_ones():
    """The reason for consistent dropout, on a real rollout before any weight has moved."""
    policy, _, buffer, generator = rollout()
    same = buffer.minibatch(torch.arange(80, 88))  # step 10 of all 8 robots: the very batch that acted
    assert torch.equal(ratio(policy, same, buffer.sigma, same["masks"]), torch.ones(8))  # to the bit
    order = torch.randperm(len(buffer), generator=generator)[:64]
    batch = buffer.minibatch(order)  # in another order, sums are rounded differently: no more than that
    assert (ratio(policy, batch, buffer.sigma, batch["masks"]) - 1).abs().max() < 1e-4
    fresh = ratio(policy, batch, buffer.sigma, policy.sample_masks(64, generator))
    assert (fresh - 1).abs().median() > 0.1


def test_first_minibatch_of_an_update_has_ratio_one():
    """Seen from inside the learner: one minibatch, one epoch, dropout on. KL 0, nothing clipped."""
    policy, critic, buffer, generator = rollout()
    learner = Learner(policy, critic, PPOConfig(epochs=1, minibatches=1))
    stats = learner.update(buffer, generator)
    assert abs(stats["kl"]) < 1e-6 and stats["clip_fraction"] == 0.0
    assert stats["surrogate"] == pytest.approx(0.0, abs=1e-5)  # - mean of ratio * normalised advantage


def test_update_is_ppo_as_one_would_write_it_down(monkeypatch):
    """Two epochs of three minibatches, each in one pass: the learner's flat buffer, micro-batches and minibatch indexing
    against plain autograd, Adam and clip_grad_norm_."""
    monkeypatch.setattr("rolt.ROLT.micro_batch", 40)
    policy, critic, buffer, generator = rollout()
    plain_policy, plain_critic = copy.deepcopy((policy, critic))
    start = [p.clone() for module in (policy, critic) for p in module.parameters()]
    order = torch.Generator().set_state(generator.get_state())
    config = PPOConfig(epochs=2, minibatches=3, max_gradient_norm=4.0)
    learner = Learner(policy, critic, config)
    stats = learner.update(buffer, generator)

    parameters = [*plain_policy.parameters(), *plain_critic.parameters()]
    groups = [{"params": plain_policy.parameters(), "lr": 1e-4}, {"params": plain_critic.parameters(), "lr": 1e-3}]
    optimizer, norms, kls = torch.optim.Adam(groups), [], []
    for _ in range(2):
        for index in torch.randperm(24 * 8, generator=order).split(64):
            batch = buffer.minibatch(index)
            old = torch.distributions.Normal(batch["mean"], buffer.sigma)
            new = torch.distributions.Normal(plain_policy(batch["observation"], batch["masks"]), plain_policy.sigma())
            advantage = (buffer.value_target - buffer.value).flatten()  # before it was normalised
            advantage = ((advantage - advantage.mean()) / advantage.std(correction=0))[index]
            loss, _ = ppo_loss(
                new.log_prob(batch["action"]).sum(1), batch["log_prob"], advantage, plain_critic(batch["observation"]),
                batch["value"], batch["value_target"], new.entropy().sum(1), config,
            )  # fmt: skip
            optimizer.zero_grad()
            loss.backward()
            norms.append(torch.nn.utils.clip_grad_norm_(parameters, config.max_gradient_norm).item())
            optimizer.step()
            kls.append(torch.distributions.kl_divergence(old, new).sum(1).mean().item())
    assert min(norms) < config.max_gradient_norm < max(norms)  # some were clipped
    trained = [*policy.named_parameters(), *critic.named_parameters()]
    for (name, ours), plain, before in zip(trained, parameters, start):
        if not name.endswith("key.bias"):  # softmax does not see it: its gradient is rounding, which Adam makes large
            assert (ours - plain).norm() < 0.005 * (ours - before).norm(), name
    assert stats["kl"] == pytest.approx(sum(kls) / 6, rel=0.01)
    assert learner.learning_rate == adapt_learning_rate(1e-4, stats["kl"], config.target_kl)


def test_micro_batches_sum_to_the_minibatch(monkeypatch):
    gradients = []
    for size in (192, 50):
        monkeypatch.setattr("rolt.ROLT.micro_batch", size)
        policy, critic, buffer, generator = rollout()
        learner = Learner(policy, critic, PPOConfig(epochs=1, minibatches=1))
        learner.update(buffer, generator)
        gradients.append(learner.gradient.clone())
    assert torch.allclose(*gradients, atol=1e-5)
    assert gradients[0].norm() > 0


def test_timeouts_bootstrap_from_the_true_last_observation():
    policy, critic, buffer, _ = rollout()
    env = LocomotionEnv("a1", 2, 0, 1, config=EnvConfig(episode_seconds=0.1))  # five steps
    observation, generator = env.reset(), torch.Generator().manual_seed(0)
    buffer = RolloutBuffer(8, observation, 12, policy.sample_masks(2, generator), "cpu")
    _, infos = collect(env, policy, critic, buffer, observation, generator)
    assert buffer.truncated[:, 0].tolist() == [False] * 4 + [True] + [False] * 3
    last = infos[4]["final_observation"]
    with torch.no_grad():
        true_value = critic(to_tensors(last, "cpu"))
    assert torch.allclose(buffer.next_value[4], true_value)
    assert torch.equal(buffer.next_value[3], buffer.value[4])  # inside an episode: the next one in the buffer
    assert not torch.allclose(buffer.next_value[4], buffer.value[5])


def test_the_buffer_holds_what_the_env_answered():
    """A twin of the env is given the buffer's actions. One of three robots begins on its back; all time out in step 5."""
    policy, critic, _, generator = rollout()
    env, twin = (LocomotionEnv("a1", 3, 0, 1, config=EnvConfig(episode_seconds=0.1)) for _ in range(2))
    observation, _ = env.reset(), twin.reset()
    for world in (env, twin):
        world._qpos[1, 2:7] = [0.5, 0, 1, 0, 0]
    buffer = RolloutBuffer(8, observation, 12, policy.sample_masks(3, generator), "cpu")
    following, _ = collect(env, policy, critic, buffer, observation, generator)
    for t in range(8):
        seen, reward, terminated, truncated, _ = twin.step(buffer.action[t].numpy())
        assert buffer.reward[t].tolist() == reward.tolist()
        assert (buffer.terminated[t].tolist(), buffer.truncated[t].tolist()) == (terminated.tolist(), truncated.tolist())
    assert buffer.terminated[0].tolist() == [False, True, False] and buffer.truncated[4].any() and buffer.reward.std() > 0
    assert (following.legs == seen.legs).all()
    with torch.no_grad():
        assert torch.equal(buffer.next_value[-1], critic(to_tensors(seen, "cpu"))) and buffer.next_value[-1].abs().min() > 0


def test_a_gradient_that_is_not_finite_stops_training_and_names_its_tensor():
    policy, critic, buffer, generator = rollout()
    learner = Learner(policy, critic, PPOConfig())
    buffer.observation.heights[5] = float("nan")
    with pytest.raises(FloatingPointError, match="gradient of .* is not finite"):
        learner.update(buffer, generator)
    for module in (policy, critic):  # minibatches before the bad one may have moved the weights; nothing bad reached them
        assert all(torch.isfinite(p).all() for p in module.state_dict().values())
