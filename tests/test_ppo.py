"""PPO's mathematics by hand, and the masks' way from the rollout into the update."""

import copy
import math

import pytest
import torch

from baselines import make_policy
from env import EnvConfig, LocomotionEnv
from faults import TASKS
from ppo import (
    Critic, Learner, PPOConfig, RolloutBuffer, adapt_learning_rate, collect, compute_gae, mean_action, ppo_loss, to_tensors,
)  # fmt: skip
from robots import A1


def column(*values):
    return torch.tensor(values, dtype=torch.float32)[:, None]


def test_gae_by_hand():
    """gamma 0.5, lambda 0.5. Three robots: one lives on, one dies in step 1, one runs out of time
    in step 1."""
    none, middle = torch.zeros(3, 1, dtype=torch.bool), torch.tensor([[False], [True], [False]])
    reward, value, following = column(1, 2, 3), column(4, 8, 16), column(8, 16, 32)
    # td errors: 1 + 4 - 4 = 1, 2 + 8 - 8 = 2, 3 + 16 - 16 = 3
    assert compute_gae(reward, value, following, none, none, 0.5, 0.5).flatten().tolist() == [1 + 2.75 / 4, 2.75, 3]
    # dead: step 1 has no future: 2 - 8 = -6; step 0 sees it through lambda
    assert compute_gae(reward, value, following, middle, none, 0.5, 0.5).flatten().tolist() == [1 - 6 / 4, -6, 3]
    # out of time: the future counts (2), the next episode's advantage does not
    assert compute_gae(reward, value, following, none, middle, 0.5, 0.5).flatten().tolist() == [1 + 2 / 4, 2, 3]


def test_loss_by_hand():
    config = PPOConfig(clip=0.2, value_weight=0.5)
    # ratios 1, 2 (clipped to 1.2), 0.5 (with a bad action: clipped to 0.8), 0.5 (with a good one:
    # not clipped)
    log_prob = torch.tensor([0.0, math.log(2), math.log(0.5), math.log(0.5)])
    advantage = torch.tensor([1.0, 1.0, -1.0, 1.0])
    # value errors: 1; clipped 0.2 from old instead of 2 away: 3 - 1.8; ...
    value, old, target = torch.tensor([1.0, 2.0, 0.1, 0.0]), torch.zeros(4), torch.tensor([0.0, 2.0, 0.0, 0.0])
    loss, parts = ppo_loss(log_prob, torch.zeros(4), advantage, value, old, target, torch.full((4,), 5.0), 0.1, config)
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




def rollout(policy_name="rolt", num_envs=8, bf16=False):
    torch.manual_seed(0)
    policy = make_policy(policy_name, A1, TASKS["stiffness"], False)
    env = LocomotionEnv("a1", num_envs, 0, 1, TASKS["stiffness"].training, extras=("privileged",))
    observation = env.reset(random_ages=True)
    critic = Critic(observation)
    torch.nn.init.normal_(policy.decoder.weight, std=0.2)  # as in a trained policy, dropout shows in the actions
    generator = torch.Generator().manual_seed(0)
    masks = policy.sample_masks(num_envs, generator)
    buffer = RolloutBuffer(24, observation, env.num_actions, masks, "cpu")
    collect(env, policy, critic, buffer, observation, generator, bf16)
    return policy, critic, buffer, generator


def ratio(policy, batch, std, masks, bf16=False):
    mean = mean_action(policy, batch["observation"], masks, bf16)
    log_prob = torch.distributions.Normal(mean, std).log_prob(batch["action"]).sum(-1)
    return (log_prob - batch["log_prob"]).exp()


@torch.no_grad()
def test_ratio_is_one_with_replayed_masks_and_not_with_fresh_ones():
    """The reason for consistent dropout, on a real rollout before any weight has moved."""
    policy, _, buffer, generator = rollout()
    same = buffer.minibatch(torch.arange(80, 88))  # step 10 of all 8 robots: the very batch that acted
    assert torch.equal(ratio(policy, same, buffer.std, same["masks"]), torch.ones(8))  # to the bit
    order = torch.randperm(len(buffer), generator=generator)[:64]
    batch = buffer.minibatch(order)  # in another order, sums are rounded differently: no more than that
    assert (ratio(policy, batch, buffer.std, batch["masks"]) - 1).abs().max() < 1e-4
    fresh = ratio(policy, batch, buffer.std, policy.sample_masks(64, generator))
    assert (fresh - 1).abs().median() > 0.1


@torch.no_grad()
def test_ratio_is_one_in_bf16_too():
    policy, _, buffer, generator = rollout(num_envs=64, bf16=True)
    batch = buffer.minibatch(torch.randperm(len(buffer), generator=generator)[:500])
    assert (ratio(policy, batch, buffer.std, batch["masks"], bf16=True) - 1).abs().max() < 1e-2
    assert (ratio(policy, batch, buffer.std, batch["masks"], bf16=False) - 1).abs().max() > 1e-4  # it was bf16 that acted


@torch.no_grad()
def test_the_critic_sees_what_policies_do_not():
    """Another friction, another fault: another value, the same actions. Noise on heights is the
    policy's alone."""
    torch.manual_seed(0)
    policy = make_policy("mlp", A1, TASKS["terrain"], True)
    env = LocomotionEnv("a1", 4, 0, 1, extras=("privileged", "heights"), terrain=TASKS["terrain"].terrain)
    observation, generator = env.reset(), torch.Generator().manual_seed(0)
    critic, masks = Critic(observation), policy.sample_masks(4, generator)
    seen = to_tensors(observation, "cpu")
    told = seen._replace(privileged=seen.privileged + 1)
    assert torch.equal(policy(told), policy(seen)) and not torch.equal(critic(told), critic(seen))
    assert masks["height_noise"].std().item() == pytest.approx(5 * 0.06, rel=0.1)
    assert not torch.equal(policy(seen, masks), policy(seen))
    buffer = RolloutBuffer(4, observation, 12, masks, "cpu")
    collect(env, policy, critic, buffer, observation, generator)
    batch = buffer.minibatch(torch.arange(16))
    assert torch.equal(batch["value"], critic(batch["observation"]))  # of what is stored, which is clean
    assert torch.equal(buffer.observation.heights[0], seen.heights)
    assert torch.allclose(ratio(policy, batch, buffer.std, batch["masks"]), torch.ones(16), atol=1e-4)


def test_first_minibatch_of_an_update_has_ratio_one():
    """Seen from inside the learner: one minibatch, one epoch, dropout on. KL 0, nothing clipped."""
    policy, critic, buffer, generator = rollout()
    learner = Learner(policy, critic, PPOConfig(epochs=1, minibatches=1))
    stats = learner.update(buffer, generator)
    assert abs(stats["kl"]) < 1e-6 and stats["clip_fraction"] == 0.0
    assert stats["surrogate"] == pytest.approx(0.0, abs=1e-5)  # - mean of ratio * normalised advantage


def test_update_is_ppo_as_one_would_write_it_down():
    """Two epochs of three minibatches, half of the training done: minibatches, masks, entropy,
    clipping by plain autograd."""
    policy, critic, buffer, generator = rollout()
    plain_policy, plain_critic = copy.deepcopy((policy, critic))
    start = [p.clone() for module in (policy, critic) for p in module.parameters()]
    order = torch.Generator().set_state(generator.get_state())
    config = PPOConfig(epochs=2, minibatches=3, max_gradient_norm=15.0)
    learner = Learner(policy, critic, config)
    stats = learner.update(buffer, generator, progress=0.5)

    parameters = [*plain_policy.parameters(), *plain_critic.parameters()]
    groups = [{"params": plain_policy.parameters(), "lr": 1e-4}, {"params": plain_critic.parameters(), "lr": 1e-3}]
    optimizer, norms, kls = torch.optim.Adam(groups), [], []
    for _ in range(2):
        for index in torch.randperm(24 * 8, generator=order).split(64):
            batch = buffer.minibatch(index)
            old = torch.distributions.Normal(batch["mean"], buffer.std)
            new = torch.distributions.Normal(plain_policy(batch["observation"], batch["masks"]), plain_policy.std())
            advantage = (buffer.returns - buffer.value).flatten()  # before it was normalised
            advantage = ((advantage - advantage.mean()) / advantage.std(correction=0))[index]
            loss, _ = ppo_loss(
                new.log_prob(batch["action"]).sum(1), batch["log_prob"], advantage, plain_critic(batch["observation"]),
                batch["value"], batch["returns"], new.entropy().sum(1), 0.5 * config.entropy_weight, config,
            )  # fmt: skip
            optimizer.zero_grad()
            loss.backward()
            norms.append(torch.nn.utils.clip_grad_norm_(parameters, config.max_gradient_norm).item())
            optimizer.step()
            kls.append(torch.distributions.kl_divergence(old, new).sum(1).mean().item())
    assert min(norms) < config.max_gradient_norm < max(norms)  # some were clipped
    trained = [*policy.named_parameters(), *critic.named_parameters()]
    for (name, ours), plain, before in zip(trained, parameters, start):
        if not name.endswith("key_value.bias"):  # softmax does not see keys' biases: rounding, which Adam makes large
            assert (ours - plain).norm() < 0.005 * (ours - before).norm(), name
    assert stats["kl"] == pytest.approx(sum(kls) / 6, rel=0.01)
    assert learner.learning_rate == adapt_learning_rate(1e-4, stats["kl"], config.target_kl)



def test_timeouts_bootstrap_from_the_true_last_observation():
    policy, critic, buffer, _ = rollout()
    env = LocomotionEnv("a1", 2, 0, 1, config=EnvConfig(episode_seconds=0.1), extras=("privileged",))  # five steps
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
    """A twin of the env is given the buffer's actions. One of three robots begins on its back; all
    time out in step 5."""
    policy, critic, _, generator = rollout()
    env, twin = (LocomotionEnv("a1", 3, 0, 1, config=EnvConfig(episode_seconds=0.1), extras=("privileged",)) for _ in range(2))
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
    buffer.observation.legs[5] = float("nan")
    with pytest.raises(FloatingPointError, match="gradient of .* is not finite"):
        learner.update(buffer, generator)
    for module in (policy, critic):  # minibatches before the bad one may have moved the weights; nothing bad reached them
        assert all(torch.isfinite(p).all() for p in module.state_dict().values())
