"""PPO with consistent dropout (paper, III-C; Schulman et al. 2017; Hausknecht, Wagener 2022).

One iteration is three phases, in this order in the file:
    collect         the policy acts for T steps; its dropout masks are stored with every transition
    compute_gae     advantages and returns
    Learner.update  epochs of minibatches through ppo_loss, with the stored masks replayed

PPO's ratio is pi_new(a|s) / pi_old(a|s). With dropout the policy that acted is pi_old(a|s, mask):
so the mask is remembered, as s and a are. Before a weight has moved the ratio is then exactly 1.

Legend: T steps, N robots of this process, B samples of a minibatch, A actions of a robot.
"""

from dataclasses import dataclass

import torch
import torch.distributed as dist
import torch.distributed.nn  # now, not by torch.optim later: that keeps the group alive
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

from rolt import Masks, Observation

Normal.set_default_validate_args(False)  # what is not finite is stopped in `Learner.update`


@dataclass(frozen=True)
class PPOConfig:
    steps: int = 24  # T, control steps of an iteration, legged_gym
    epochs: int = 1  # ours (legged_gym: 5): new samples do not repeat the old ones' noise (NOTES 6)
    minibatches: int = 12  # ours: of 1024 samples at 512 robots (legged_gym: 4 of 24576 at 4096)
    discount: float = 0.99  # gamma, legged_gym
    gae_lambda: float = 0.95  # legged_gym
    clip: float = 0.2  # legged_gym
    entropy_weight: float = 0.005  # first; falls to 0, ours: else a short run's sigma stays large
    value_weight: float = 1.0  # legged_gym
    max_gradient_norm: float = 1.0  # legged_gym
    learning_rate: float = 1e-4  # first, ours: at 1e-3 a transformer jumps before the rule reacts
    target_kl: float = 0.01  # legged_gym: the policy's rate follows it, `adapt_learning_rate`
    critic_learning_rate: float = 1e-3  # legged_gym's first; it has no KL to follow


def network(*sizes: int) -> nn.Sequential:
    """Linear layers with ELU between them (legged_gym)."""
    layers = [module for a, b in zip(sizes, sizes[1:]) for module in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers[:-1])


def proprioception(legs: Tensor) -> Tensor:
    """(B, L, H, 3J + 12) -> (B, H * (L*3J + 12)): all legs' joints, and the first leg's trunk."""
    joints = legs[..., :-12].transpose(1, 2).flatten(2)  # (B, H, L*3J)
    return torch.cat([joints, legs[:, 0, :, -12:]], dim=2).flatten(1)


class Critic(nn.Module):
    """V(s), for all methods (but ROAM's last stage) an MLP [512, 256, 128] ELU (legged_gym). In
    training only, so it sees what no policy does: faults, clean heights (Pinto et al. 2018; NOTES
    10)."""

    def __init__(self, observation: Observation):
        super().__init__()
        inputs = self.inputs(to_tensors(observation, "cpu")).shape[1]
        self.network = network(inputs, 512, 256, 128, 1)

    def inputs(self, observation: Observation) -> Tensor:
        heights = observation.heights.flatten(1)
        return torch.cat([proprioception(observation.legs), observation.privileged, heights], dim=1)

    def forward(self, observation: Observation) -> Tensor:
        return self.network(self.inputs(observation)).squeeze(1)  # (B, 1) -> (B,)


class RolloutBuffer:
    """T x N transitions, allocated once, the dropout masks of each, and the policy's std (A,)."""

    def __init__(self, T: int, observation: Observation, num_actions: int, masks: Masks, device):
        N = len(observation.legs)

        def zeros(*shape: int, dtype=torch.float32) -> Tensor:
            return torch.zeros(T, N, *shape, dtype=dtype, device=device)

        self.observation = Observation(*(zeros(*field.shape[1:]) for field in observation))
        self.action, self.mean = zeros(num_actions), zeros(num_actions)
        self.log_prob, self.value, self.next_value, self.reward = zeros(), zeros(), zeros(), zeros()
        self.terminated, self.truncated = zeros(dtype=torch.bool), zeros(dtype=torch.bool)
        self.advantage, self.returns = zeros(), zeros()
        self.masks = {name: zeros(*m.shape[1:], dtype=m.dtype) for name, m in masks.items()}

    def __len__(self) -> int:
        return self.reward.numel()

    def minibatch(self, index: Tensor) -> dict:
        """The samples `index` (B,) of the flattened T*N, ready for `Learner.loss`."""
        names = ("action", "mean", "log_prob", "value", "advantage", "returns")
        batch = {name: getattr(self, name).flatten(0, 1)[index] for name in names}
        batch["masks"] = {name: mask.flatten(0, 1)[index] for name, mask in self.masks.items()}
        observation = (field.flatten(0, 1)[index] for field in self.observation)
        return batch | {"observation": Observation(*observation)}


def to_tensors(observation: Observation, device) -> Observation:
    return Observation(*(torch.from_numpy(field).to(device) for field in observation))


def mean_action(policy, observation: Observation, masks: Masks | None, bf16: bool) -> Tensor:
    """(B, A), hidden layers in bfloat16 if asked for: in rollout and update alike (NOTES 13)."""
    with torch.autocast(observation.legs.device.type, torch.bfloat16, enabled=bf16):
        return policy(observation, masks)


@torch.no_grad()
def collect(
    env, policy, critic: Critic, buffer: RolloutBuffer, observation: Observation,
    generator: torch.Generator, bf16: bool = False,
) -> tuple[Observation, list[dict]]:  # fmt: skip
    """T steps of every robot into `buffer`. Returns the observation to go on from, all infos."""
    device, infos = buffer.reward.device, []
    buffer.std = policy.std()
    for t in range(len(buffer.reward)):
        observation = to_tensors(observation, device)
        masks = policy.sample_masks(env.num_envs, generator)
        mean = mean_action(policy, observation, masks, bf16)
        action = mean + buffer.std * torch.randn(mean.shape, generator=generator, device=device)

        for stored, field in zip(buffer.observation, observation):
            stored[t] = field
        for name in buffer.masks:  # the masks are part of the transition
            buffer.masks[name][t] = masks[name]
        buffer.action[t], buffer.mean[t], buffer.value[t] = action, mean, critic(observation)
        buffer.log_prob[t] = Normal(mean, buffer.std).log_prob(action).sum(-1)

        observation, reward, terminated, truncated, info = env.step(action.cpu().numpy())
        buffer.reward[t] = torch.from_numpy(reward)
        buffer.terminated[t] = torch.from_numpy(terminated)
        buffer.truncated[t] = torch.from_numpy(truncated)
        if len(info["truncated_ids"]):  # the next one here is of another episode: ask the true one
            ids = torch.from_numpy(info["truncated_ids"]).to(device)
            buffer.next_value[t, ids] = critic(to_tensors(info["final_observation"], device))
        infos.append(info)

    following = torch.cat([buffer.value[1:], critic(to_tensors(observation, device))[None]])
    buffer.next_value = torch.where(buffer.truncated, buffer.next_value, following)
    return observation, infos


def compute_gae(
    reward: Tensor, value: Tensor, next_value: Tensor,
    terminated: Tensor, truncated: Tensor, gamma: float, lam: float,
) -> Tensor:  # fmt: skip
    """Generalised advantage estimation (Schulman et al. 2016), all (T, N). next_value[t] is V of
    where step t led to, before any reset. A termination has no future: V does not count. A time-out
    has one that we stop watching: V counts, but no later advantage does."""
    advantage, running = torch.zeros_like(reward), torch.zeros_like(reward[0])
    delta = reward + gamma * next_value * ~terminated - value  # the TD error
    for t in reversed(range(len(reward))):
        running = delta[t] + gamma * lam * running * ~(terminated[t] | truncated[t])
        advantage[t] = running
    return advantage


def ppo_loss(
    log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor,
    value: Tensor, old_value: Tensor, returns: Tensor,
    entropy: Tensor, entropy_weight: float, config: PPOConfig,
) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
    """Clipped surrogate and value loss, entropy bonus; inputs (B,). Returns the mean, its parts."""
    ratio = (log_prob - old_log_prob).exp()
    clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
    surrogate = -torch.min(ratio * advantage, clipped * advantage).mean()
    clipped_value = old_value + (value - old_value).clamp(-config.clip, config.clip)
    value_loss = torch.max((value - returns) ** 2, (clipped_value - returns) ** 2).mean()
    loss = surrogate + config.value_weight * value_loss - entropy_weight * entropy.mean()
    clip_fraction = ((ratio - 1).abs() > config.clip).float().mean()
    return loss, {"surrogate": surrogate, "value_loss": value_loss, "clip_fraction": clip_fraction}


def adapt_learning_rate(rate: float, kl: float, target: float) -> float:
    """legged_gym's rule, but once an update (NOTES 7): slower when the policy moved too far, faster
    when it hardly moved."""
    if kl > 2 * target:
        return max(1e-5, rate / 1.5)
    return min(1e-2, rate * 1.5) if 0 < kl < target / 2 else rate


def average(tensor: Tensor) -> Tensor:
    """Mean over all processes, which have equally many samples; alone, the tensor itself."""
    if not dist.is_initialized():
        return tensor
    dist.all_reduce(tensor)
    return tensor / dist.get_world_size()


class Learner:
    """Policy, critic and optimiser; a copy in each process, which has its own samples. Trains the
    parameters that require a gradient. Later stages of baselines (baselines.py) override `loss`."""

    first_rate: float | None = None  # of what it trains; None = the config's

    def __init__(self, policy, critic: nn.Module, config: PPOConfig, bf16: bool = False):
        self.policy, self.critic, self.config, self.bf16 = policy, critic, config, bf16
        actor = [p for p in policy.parameters() if p.requires_grad]
        values = [p for p in critic.parameters() if p.requires_grad]
        self.parameters = actor + values
        actor_group = {"params": actor, "lr": self.first_rate or config.learning_rate}
        critic_group = {"params": values, "lr": config.critic_learning_rate}
        self.optimizer = torch.optim.Adam([actor_group, critic_group], fused=True)

    def update(self, buffer: RolloutBuffer, generator: torch.Generator, progress=0.0) -> dict:
        """PPO's epochs on one rollout. progress: of the training, 0 to 1. Returns the means of
        `loss`'s figures; FloatingPointError before what is not finite reaches a weight."""
        config = self.config
        advantage = compute_gae(
            buffer.reward, buffer.value, buffer.next_value, buffer.terminated, buffer.truncated,
            config.discount, config.gae_lambda,
        )  # fmt: skip
        buffer.returns = advantage + buffer.value
        x = advantage.double()  # to zero mean and unit deviation over the samples of all processes
        mean, square = average(torch.stack([x.mean(), (x**2).mean()]))
        deviation = (square - mean**2).clamp(min=0).sqrt()
        buffer.advantage = ((x - mean) / (deviation + 1e-8)).float()

        totals = {}
        size = len(buffer) // config.minibatches
        for _ in range(config.epochs):
            order = torch.randperm(len(buffer), generator=generator, device=generator.device)
            for index in order[: size * config.minibatches].split(size):
                loss, stats = self.loss(buffer.minibatch(index), buffer.std, progress)
                self.optimizer.zero_grad()
                loss.backward()
                gradients = [p.grad for p in self.parameters if p.grad is not None]
                averaged = average(nn.utils.parameters_to_vector(gradients))  # in one message
                nn.utils.vector_to_parameters(averaged, gradients)
                norm = nn.utils.clip_grad_norm_(self.parameters, config.max_gradient_norm)
                if not torch.isfinite(norm):
                    why = "a gradient is not finite: try another seed or learning rate"
                    raise FloatingPointError(why)
                self.optimizer.step()
                for name, value in stats.items():
                    totals[name] = totals.get(name, 0.0) + value.detach()

        means = average(torch.stack(list(totals.values()))) / (config.epochs * config.minibatches)
        stats = dict(zip(totals, means.tolist()))
        actor = self.optimizer.param_groups[0]
        if "kl" in stats:
            actor["lr"] = adapt_learning_rate(actor["lr"], stats["kl"], config.target_kl)
        return stats | {"learning_rate": actor["lr"]}

    def loss(self, batch: dict, old_std: Tensor, progress: float) -> tuple[Tensor, dict]:
        """The mean loss of a minibatch, and its parts. The rollout's masks are replayed."""
        mean = mean_action(self.policy, batch["observation"], batch["masks"], self.bf16)
        old, new = Normal(batch["mean"], old_std), Normal(mean, self.policy.std())
        loss, stats = ppo_loss(
            new.log_prob(batch["action"]).sum(-1), batch["log_prob"], batch["advantage"],
            self.critic(batch["observation"]), batch["value"], batch["returns"],
            new.entropy().sum(-1), (1 - progress) * self.config.entropy_weight, self.config,
        )  # fmt: skip
        return loss, stats | {"kl": kl_divergence(old, new).sum(-1).mean()}
