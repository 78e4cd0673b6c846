"""PPO with consistent dropout (paper, section III-C; Schulman et al. 2017; Hausknecht and Wagener 2022).

One iteration is three phases, in this order in the file:
    collect         the policy acts for T steps; its dropout masks are stored with every transition
    compute_gae     advantages and returns
    Learner.update  epochs of minibatches through ppo_loss, with the stored masks replayed

PPO's ratio is pi_new(a|s) / pi_old(a|s). With dropout the policy that acted is pi_old(a|s, mask): so the mask is part of
what is remembered, as s and a are. On the first minibatch of an update no weight has moved, hence the ratio is exactly
1; with fresh masks it is not, and PPO would correct differences that are only the dice of the dropout.

Legend: T steps, N robots of this process, B samples of a minibatch, A actions of a robot.
"""

from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

from env import LocomotionEnv, Observation
from normalizer import Normalizer
from scandots import HEIGHT_SCALE

# Samples a pass of the update on a GPU. ROLT keeps 0.26 MB of each for its backward pass: 2.1 GB, beside the 0.5 GB of a
# rollout of 4096 robots. A whole minibatch of the paper's size (24576) in one pass would not leave room in 8 GB.
GPU_MICRO_BATCH = 8192


@dataclass(frozen=True)
class PPOConfig:
    steps: int = 24  # T, control steps of an iteration, legged_gym
    # ours: 1 of 12 minibatches of 1024 samples at 512 robots (legged_gym: 5 of 4, of 24576 at 4096). At this size the
    # gradient is mostly noise: of what an update gained on its own rollout, fresh rollouts of the same policy saw a
    # tenth. New samples cost a laptop little more than old ones, and do not repeat their noise.
    epochs: int = 1
    minibatches: int = 12
    discount: float = 0.99  # gamma, legged_gym
    gae_lambda: float = 0.95  # legged_gym
    clip: float = 0.2  # legged_gym
    entropy_weight: float = 0.005  # ours: legged_gym's 0.01 keeps sigma from shrinking within a short run
    value_weight: float = 1.0  # legged_gym
    max_gradient_norm: float = 1.0  # legged_gym
    learning_rate: float = 1e-4  # at the start, ours: at legged_gym's 1e-3 a transformer jumps before the rule reacts
    target_kl: float = 0.01  # legged_gym: the policy's learning rate follows it (see adapt_learning_rate)
    critic_learning_rate: float = 1e-3  # legged_gym's at the start; it has no KL to follow


class Critic(nn.Module):
    """V(s): an MLP on everything the policy sees, [512, 256, 128] ELU (legged_gym), without dropout."""

    def __init__(self, observation: Observation, normalizer: Normalizer):
        super().__init__()
        self.normalizer = normalizer  # the policy's
        sizes = [sum(field[0].size for field in seen(observation)), 512, 256, 128]
        layers = [module for a, b in zip(sizes, sizes[1:]) for module in (nn.Linear(a, b), nn.ELU())]
        self.network = nn.Sequential(*layers, nn.Linear(sizes[-1], 1))

    def forward(self, observation: Observation) -> Tensor:
        """(B,) value of each observation."""
        fields = seen(self.normalizer(observation))
        return self.network(torch.cat([field.flatten(1) for field in fields], dim=1)).squeeze(1)


def seen(observation: Observation) -> tuple:
    """What a critic reads: all but RMA's long history and ROAM's label."""
    return observation.legs, observation.action, observation.heights, observation.privileged


# ---------------------------------------------------------------------- masks as bits


def pack_bits(mask: Tensor) -> Tensor:
    """(B, ...) bool -> (B, ceil(bits / 8)) uint8, eight decisions a byte."""
    bits = mask.flatten(1)
    bits = nn.functional.pad(bits, (0, -bits.shape[1] % 8)).view(torch.int64)  # eight bytes of 0 or 1 in each number
    return (bits * 0x0102040810204080 >> 56).to(torch.uint8)  # moves byte i's lowest bit to bit 56 + i, the rest elsewhere


def unpack_bits(packed: Tensor, shape: tuple[int, ...]) -> Tensor:
    """(B, bytes) uint8 -> (B, *shape) float, 0 or 1: the inverse of `pack_bits`.

    Looked up byte by byte, and in the type that dropout multiplies by: on a CPU four times as fast as shifting bits into
    bools and converting those.
    """
    byte = torch.arange(256, dtype=torch.uint8, device=packed.device)
    bits_of = (byte[:, None] >> byte[:8] & 1).float()  # (256, 8)
    bits = nn.functional.embedding(packed.int(), bits_of)  # (B, bytes, 8)
    return bits.flatten(1)[:, : torch.Size(shape).numel()].unflatten(1, shape)


# ---------------------------------------------------------------------- collect


class RolloutBuffer:
    """T x N transitions, allocated once. `masks[name]` holds each policy's dropout masks, packed to bits."""

    def __init__(self, T: int, observation: Observation, num_actions: int, masks: dict[str, Tensor], device):
        N = len(observation.legs)

        def zeros(*shape: int, dtype=torch.float32) -> Tensor:
            return torch.zeros(T, N, *shape, dtype=dtype, device=device)

        self.observation = Observation(*(zeros(*field.shape[1:]) for field in observation))
        self.action, self.mean = zeros(num_actions), zeros(num_actions)
        self.sigma = torch.zeros(num_actions, device=device)  # one for all: it does not depend on the state
        self.log_prob, self.value, self.next_value, self.reward = zeros(), zeros(), zeros(), zeros()
        self.terminated, self.truncated = zeros(dtype=torch.bool), zeros(dtype=torch.bool)
        self.advantage, self.value_target = zeros(), zeros()
        self.mask_shapes = {name: tuple(mask.shape[1:]) for name, mask in masks.items()}
        self.masks = {name: zeros(pack_bits(mask).shape[1], dtype=torch.uint8) for name, mask in masks.items()}

    def __len__(self) -> int:
        return self.reward.numel()

    def minibatch(self, index: Tensor) -> dict:
        """The samples `index` (B,) of the flattened T*N, masks unpacked, ready for `ppo_loss`."""
        names = ("action", "mean", "log_prob", "value", "advantage", "value_target")
        batch = {name: getattr(self, name).flatten(0, 1)[index] for name in names}
        batch["observation"] = Observation(*(field.flatten(0, 1)[index] for field in self.observation))
        batch["masks"] = {
            name: unpack_bits(packed.flatten(0, 1)[index], self.mask_shapes[name])
            for name, packed in self.masks.items()
        }
        return batch


def gaussian(mean: Tensor, sigma: Tensor) -> Normal:
    """Unchecked: a NaN is caught where its name is known, in `Learner._step`."""
    return Normal(mean, sigma, validate_args=False)


def to_tensors(observation: Observation, device) -> Observation:
    return Observation(*(torch.from_numpy(field).to(device) for field in observation))


@torch.no_grad()
def collect(
    env: LocomotionEnv, policy, critic: Critic, buffer: RolloutBuffer, observation: Observation, generator
) -> tuple[Observation, list[dict]]:
    """T steps of every robot into `buffer`. Returns the observation to go on from and each step's info."""
    device, infos = buffer.reward.device, []
    buffer.sigma.copy_(policy.sigma())
    for t in range(len(buffer.reward)):
        observation = to_tensors(observation, device)
        if policy.height_noise:  # in the buffer too: the update must see what the rollout saw
            noise = torch.randn(observation.heights.shape, generator=generator, device=device)
            observation = observation._replace(heights=observation.heights + HEIGHT_SCALE * policy.height_noise * noise)
        masks = policy.sample_masks(env.num_envs, generator)
        mean = policy(observation, masks)
        noise = torch.randn(mean.shape, generator=generator, device=device)
        action = mean + buffer.sigma * noise

        for stored, field in zip(buffer.observation, observation):
            stored[t] = field
        for name in buffer.masks:
            buffer.masks[name][t] = pack_bits(masks[name])
        buffer.action[t], buffer.mean[t], buffer.value[t] = action, mean, critic(observation)
        buffer.log_prob[t] = gaussian(mean, buffer.sigma).log_prob(action).sum(-1)

        observation, reward, terminated, truncated, info = env.step(action.cpu().numpy())
        buffer.reward[t] = torch.from_numpy(reward)
        buffer.terminated[t], buffer.truncated[t] = torch.from_numpy(terminated), torch.from_numpy(truncated)
        buffer.next_value[t] = 0
        if len(info["truncated_ids"]):  # the next observation in the buffer is of another episode: ask the true one
            ids = torch.from_numpy(info["truncated_ids"]).to(device)
            buffer.next_value[t, ids] = critic(to_tensors(info["final_observation"], device))  # clean heights: the noise's mean
        infos.append(info)
    last_value = critic(to_tensors(observation, device))
    following = torch.cat([buffer.value[1:], last_value[None]])
    buffer.next_value = torch.where(buffer.truncated, buffer.next_value, following)
    return observation, infos


# ---------------------------------------------------------------------- the mathematics


def compute_gae(
    reward: Tensor, value: Tensor, next_value: Tensor, terminated: Tensor, truncated: Tensor, gamma: float, lam: float
) -> Tensor:
    """Generalised advantage estimation (Schulman et al. 2016), all (T, N) -> (T, N).

    next_value[t] is V of the state that step t led to, before any reset. A termination has no future: its value does
    not count. A time-out has one that we stop watching: its value counts, but no later step's advantage does.
    """
    advantage, running = torch.zeros_like(reward), torch.zeros_like(reward[0])
    delta = reward + gamma * next_value * ~terminated - value  # the TD error
    for t in reversed(range(len(reward))):
        running = delta[t] + gamma * lam * running * ~(terminated[t] | truncated[t])
        advantage[t] = running
    return advantage


def ppo_loss(
    log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor,
    value: Tensor, old_value: Tensor, value_target: Tensor, entropy: Tensor, config: PPOConfig,
) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
    """The clipped surrogate loss, the clipped value loss and the entropy bonus; all inputs (B,).

    Returns the mean loss, and what it is made of.
    """
    ratio = (log_prob - old_log_prob).exp()
    clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
    surrogate = -torch.min(ratio * advantage, clipped * advantage).mean()
    clipped_value = old_value + (value - old_value).clamp(-config.clip, config.clip)
    value_loss = torch.max((value - value_target) ** 2, (clipped_value - value_target) ** 2).mean()
    loss = surrogate + config.value_weight * value_loss - config.entropy_weight * entropy.mean()
    clip_fraction = ((ratio - 1).abs() > config.clip).float().mean()
    return loss, {"surrogate": surrogate, "value_loss": value_loss, "clip_fraction": clip_fraction}


def adapt_learning_rate(rate: float, kl: float, target: float) -> float:
    """legged_gym's rule: slower when the policy moved too far, faster when it hardly moved.

    Applied once an update, to the mean KL of its minibatches. legged_gym applies it after each of its minibatches of
    24576; after each of ours, where KL is 0 at first and noisy then, the rate swung between 1e-5 and 5e-4, and
    the surrogate gained a third of what it gains at the same KL with a steady rate.
    """
    if kl > 2 * target:
        return max(1e-5, rate / 1.5)
    return min(1e-2, rate * 1.5) if 0 < kl < target / 2 else rate


# ---------------------------------------------------------------------- update


def all_reduce(tensor: Tensor) -> Tensor:
    """Sum over all processes, in place; alone, the tensor itself."""
    if dist.is_initialized():
        dist.all_reduce(tensor)
    return tensor


class Learner:
    """Policy, critic and optimiser. Each process holds a copy and its own samples; gradients are summed over all.

    Trains the parameters that require a gradient. The baselines' later stages (baselines.py) override `loss`.
    """

    measures = True  # the update ends by showing the rollout to the policy's normalizer
    STATS = ("surrogate", "value_loss", "clip_fraction", "kl", "other_loss")  # what `update` reports

    def __init__(self, policy, critic: nn.Module, config: PPOConfig):
        self.policy, self.critic, self.config = policy, critic, config
        named = [*policy.named_parameters(), *((f"critic.{n}", p) for n, p in critic.named_parameters())]
        self.named_parameters = [(name, p) for name, p in named if p.requires_grad]
        parameters = [p for _, p in self.named_parameters]
        groups = [
            {"params": [p for p in policy.parameters() if p.requires_grad], "lr": config.learning_rate},
            {"params": [p for p in critic.parameters() if p.requires_grad], "lr": config.critic_learning_rate},
        ]
        self.optimizer = torch.optim.Adam(groups, fused=True)
        self.learning_rate = config.learning_rate  # the policy's
        self.num_processes = dist.get_world_size() if dist.is_initialized() else 1
        # every gradient is a slice of one flat buffer, followed by what else a minibatch sums: one all-reduce
        sizes = [p.numel() for p in parameters]
        self.flat = torch.zeros(sum(sizes) + len(self.STATS), device=parameters[0].device)
        self.gradient, self.stats = self.flat[: -len(self.STATS)], self.flat[-len(self.STATS) :]
        for p, part in zip(parameters, self.gradient.split(sizes)):
            p.grad = part.view_as(p)

    def state_dict(self) -> dict:
        return {"optimizer": self.optimizer.state_dict(), "learning_rate": self.learning_rate}

    def load_state_dict(self, state: dict) -> None:
        self.optimizer.load_state_dict(state["optimizer"])
        self.learning_rate = state["learning_rate"]

    def update(self, buffer: RolloutBuffer, generator: torch.Generator) -> dict[str, float]:
        """PPO's epochs on one rollout. Returns means over all minibatches.

        Raises FloatingPointError with the name of the first tensor that is not finite, before it reaches a weight.
        """
        config = self.config
        buffer.advantage = compute_gae(
            buffer.reward, buffer.value, buffer.next_value, buffer.terminated, buffer.truncated,
            config.discount, config.gae_lambda,
        )  # fmt: skip
        buffer.value_target = buffer.advantage + buffer.value
        buffer.advantage = self._normalise(buffer.advantage)

        size = len(buffer) // config.minibatches
        micro = min(size, self.policy.micro_batch if buffer.reward.device.type == "cpu" else GPU_MICRO_BATCH)
        totals = torch.zeros_like(self.stats)
        for _ in range(config.epochs):
            order = torch.randperm(len(buffer), generator=generator, device=generator.device)
            for index in order[: size * config.minibatches].split(size):  # a minibatch: one step of the optimiser
                self.flat.zero_()
                for part in index.split(micro):
                    share = len(part) / size / self.num_processes  # of the minibatch over all processes
                    loss, stats = self.loss(buffer.minibatch(part), buffer.sigma)
                    (loss * share).backward()
                    for i, name in enumerate(self.STATS):
                        self.stats[i] += share * stats.get(name, 0.0)
                all_reduce(self.flat)
                self._step()
                totals += self.stats
        means = (totals / (config.epochs * config.minibatches)).tolist()
        stats = dict(zip(self.STATS, means))
        self.learning_rate = adapt_learning_rate(self.learning_rate, stats["kl"], config.target_kl)
        self.optimizer.param_groups[0]["lr"] = self.learning_rate
        if self.measures:
            self.policy.normalizer.update(buffer.observation, all_reduce)
        return stats

    def loss(self, batch: dict, old_sigma: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean loss of a micro-batch, and what it is made of (some of `STATS`)."""
        mean = self.policy(batch["observation"], batch["masks"])
        old, new = gaussian(batch["mean"], old_sigma), gaussian(mean, self.policy.sigma())
        loss, stats = ppo_loss(
            new.log_prob(batch["action"]).sum(-1), batch["log_prob"], batch["advantage"],
            self.critic(batch["observation"]), batch["value"], batch["value_target"], new.entropy().sum(-1), self.config,
        )  # fmt: skip
        with torch.no_grad():
            stats["kl"] = kl_divergence(old, new).sum(-1).mean()
        return loss, {name: value.detach() for name, value in stats.items()}

    def _step(self) -> None:
        """One step of the optimiser, with clipped gradient."""
        norm = self.gradient.norm()
        if not torch.isfinite(norm + self.stats.sum()):
            bad = [name for name, p in self.named_parameters if not torch.isfinite(p.grad).all()] or ["the loss"]
            raise FloatingPointError(f"training has diverged: the gradient of {bad[0]} is not finite")
        self.gradient.mul_((self.config.max_gradient_norm / (norm + 1e-6)).clamp(max=1.0))
        self.optimizer.step()

    def _normalise(self, advantage: Tensor) -> Tensor:
        """Zero mean and unit deviation over the samples of all processes."""
        x = advantage.double()
        count, total, squares = all_reduce(torch.stack([torch.full_like(x, 1.0).sum(), x.sum(), (x**2).sum()]))
        mean = total / count
        return ((x - mean) / ((squares / count - mean**2).clamp(min=0).sqrt() + 1e-8)).float()
