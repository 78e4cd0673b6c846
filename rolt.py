"""ROLT, the robust locomotion transformer: the paper's section III in one file.

Where each equation is:
    eq. 1  e^l = MLP(s^l)             `leg_embedding`, one network for all legs
    eq. 2  e^a = W a_{t-1} + b        `action_embedding`, by which the legs find out which one they are
    eq. 3  e^prop = [e^l..., e^a]     `tokens`, followed by the 12 height patches e^h = linear(s^h) + p_e
    III-B  two encoder layers, linear decoder on the leg tokens        `EncoderLayer`, `forward`
    III-C  feature dropout and position embedding (PE) dropout         `sample_masks`, `drop`, `tokens`

Why no position embedding on the legs: with one, each leg learns a controller of its own, and what the front right leg
has learned about limping stays there. Without one the legs share everything; where a leg is on the robot it must find
out by comparing its own previous action with the action token.

Why the masks are data: PPO compares the policy that acted with the policy that is updated. Drawn anew in the update,
dropout would make them differ before a single weight has moved. So the rollout's masks are stored with the
transition and passed to `forward` again (ppo.py); None, at test, means no dropout.

Legend: B samples, L legs, J joints a leg, H steps of history, P = 12 patches, T = L + 1 + P tokens, D = 160 width.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from env import HISTORY, Observation
from normalizer import Normalizer
from scandots import NUM_PATCHES, PATCH, SCAN_SHAPE

LOG_SIGMA_BOUNDS = (math.log(0.05), math.log(2.0))  # ours

Masks = dict[str, Tensor]  # name -> (B, ...), True or 1 = keep; empty for a policy without dropout


@dataclass(frozen=True)
class ROLTConfig:
    """The model's hyper-parameters; the last three lines are the paper's ablations."""

    width: int = 160  # D, paper
    layers: int = 2  # paper
    heads: int = 4  # ours: the paper names no number; 4 heads of 40
    feedforward: int = 320  # ours: twice the width keeps it light
    # ours: legged_gym's 1.0 falls for longer first; a run from 0.5 (on an earlier env) only learned to stand
    initial_sigma: float = 0.7
    feature_dropout: float = 0.1  # paper; 0 = the ablation No Feature Drop
    pe_dropout: float = 0.75  # paper; 0 = the ablation No PE Drop
    leg_pe: bool = False  # True = the ablation Module PE: a learned vector a leg instead of the action token


def draw_mask(shape: tuple[int, ...], p: float, generator: torch.Generator) -> Tensor:
    """Bools of this shape, False with probability p to within 1e-5 (too coarse for Roll-Drop's rate of 1e-4).

    A 64-bit random number makes four decisions of 16 bits each: a third of the time of torch.rand, and ROLT on four legs
    needs 6,732 decisions a robot and step.
    """
    size = math.prod(shape)
    numbers = torch.empty(math.ceil(size / 4), dtype=torch.int64, device=generator.device)
    numbers.random_(-(2**63), None, generator=generator)  # all 64 bits
    decisions = numbers.view(torch.int16)[:size]  # (size,) uniform from -2^15 to 2^15 - 1
    return (decisions >= round(p * 2**16) - 2**15).view(shape)


def drop(x: Tensor, keep: Tensor | None, p: float) -> Tensor:
    """Consistent dropout: a stored mask `keep` of x's shape, kept values scaled by 1 / (1 - p); None = identity."""
    return x if keep is None else x * keep.to(x.dtype) * (1 / (1 - p))


def add_dropped(x: Tensor, change: Tensor, keep: Tensor | None, p: float) -> Tensor:
    """x + drop(change), in one pass over memory."""
    return x + change if keep is None else torch.addcmul(x, change, keep.to(x.dtype), value=1 / (1 - p))


class EncoderLayer(nn.Module):
    """Pre-norm transformer layer (ViT's; the paper names none) with dropout after attention and after the MLP."""

    def __init__(self, config: ROLTConfig):
        super().__init__()
        D = config.width
        assert D % config.heads == 0, "the width must be a multiple of the number of heads"
        self.heads, self.p = config.heads, config.feature_dropout
        self.norm_attention, self.norm_feedforward = nn.LayerNorm(D), nn.LayerNorm(D)
        self.query, self.key, self.value, self.merge = (nn.Linear(D, D) for _ in range(4))
        self.feedforward = nn.Sequential(nn.Linear(D, config.feedforward), nn.GELU(), nn.Linear(config.feedforward, D))

    def forward(self, x: Tensor, queries: int, keep_attention: Tensor | None, keep_feedforward: Tensor | None):
        """Updates the first `queries` tokens only, from all of them.

        What a token becomes depends on the other tokens' keys and values, never on their queries: leaving out those
        that nobody reads afterwards changes nothing in the rest.

        Args: x (B, T, D); masks (B, queries, D) or None.
        Returns: tokens (B, queries, D), attention weights (B, heads, queries, T).
        """
        B, T, D = x.shape
        normed = self.norm_attention(x)
        active, x = (normed, x) if queries == T else (normed[:, :queries], x[:, :queries])
        q, k, v = self._split(self.query(active)), self._split(self.key(normed)), self._split(self.value(normed))
        weights = torch.softmax(q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5, dim=-1)  # (B, heads, queries, T)
        mixed = (weights @ v).transpose(1, 2).reshape(B, queries, D)  # (B, heads, queries, d) -> (B, queries, D)
        x = add_dropped(x, self.merge(mixed), keep_attention, self.p)
        return add_dropped(x, self.feedforward(self.norm_feedforward(x)), keep_feedforward, self.p), weights

    def _split(self, x: Tensor) -> Tensor:
        """(B, T, D) -> (B, heads, T, d)"""
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class ROLT(nn.Module):
    """Gaussian policy: the mean of every joint's action from the transformer, and a learned sigma a kind of joint."""

    # what a policy tells train.py and evaluate.py of itself
    extras = ()  # of the observation (env.py), that it reads
    height_noise = 0.0  # m, added to the heights in training: none, "training only under clean observations" (paper)
    replays_masks = True  # in the update
    # samples a pass of the update on a CPU: 133 MB of activations. Of 128 to 1024 the fastest where others use the memory, too
    # (11 % faster than 128); alone on the machine 128 is as fast
    micro_batch = 512

    def __init__(self, num_legs: int, num_joints: int, config: ROLTConfig = ROLTConfig()):
        super().__init__()
        self.config, self.num_legs, self.num_joints = config, num_legs, num_joints
        self.normalizer = Normalizer(num_joints)
        D = config.width
        frame = 3 * num_joints + 12  # numbers that one leg sees in one step
        self.leg_embedding = nn.Sequential(nn.Linear(HISTORY * frame, D), nn.GELU(), nn.Linear(D, D))
        if config.leg_pe:
            self.leg_position = nn.Parameter(0.02 * torch.randn(num_legs, D))  # 0.02: ViT's scale
        else:
            self.action_embedding = nn.Linear(num_legs * num_joints, D)
        self.patch_embedding = nn.Linear(PATCH**2, D)
        self.patch_position = nn.Parameter(0.02 * torch.randn(NUM_PATCHES, D))  # p_e
        if config.pe_dropout > 0:
            self.dropped_position = nn.Parameter(0.02 * torch.randn(D))  # stands in for every dropped p_e
        self.encoder = nn.ModuleList(EncoderLayer(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(D)
        self.decoder = nn.Linear(D, num_joints)
        nn.init.normal_(self.decoder.weight, std=0.01)  # start from the default pose
        # shared by the legs, as the weights are; independent of the state, as in legged_gym
        self.log_sigma = nn.Parameter(torch.full((num_joints,), config.initial_sigma).log())

    @property
    def num_proprioceptive(self) -> int:
        """Tokens before the patches: the legs, and the action token unless `leg_pe`."""
        return self.num_legs + (not self.config.leg_pe)

    def sigma(self) -> Tensor:
        """(L*J,) standard deviation of every action, within bounds that no healthy run meets."""
        return self.log_sigma.clamp(*LOG_SIGMA_BOUNDS).exp().repeat(self.num_legs)

    def sample_masks(self, n: int, generator: torch.Generator) -> Masks:
        """Dropout masks for n samples: (n, P) patches that keep their p_e, (n, tokens, D) features that are kept."""

        config, masks = self.config, {}
        if config.pe_dropout > 0:
            masks["patch_position"] = draw_mask((n, NUM_PATCHES), config.pe_dropout, generator)
        if config.feature_dropout > 0:
            for i in range(len(self.encoder)):
                shape = (n, self._queries(i), config.width)
                masks[f"attention_{i}"] = draw_mask(shape, config.feature_dropout, generator)
                masks[f"feedforward_{i}"] = draw_mask(shape, config.feature_dropout, generator)
        return masks

    def forward(self, observation: Observation, masks: Masks | None = None) -> Tensor:
        """(B, L*J) mean action: J joint targets from each leg's token. masks: of `sample_masks`, None = test."""
        return self._encode(observation, masks)[0]

    def attention(self, observation: Observation) -> Tensor:
        """(B, layers, heads, L, T) weights that the leg tokens give to [legs, action, patches], without dropout."""
        return torch.stack([weights[:, :, : self.num_legs] for weights in self._encode(observation, None)[1]], dim=1)

    def tokens(self, observation: Observation, masks: Masks | None) -> Tensor:
        """E_0 = [e^prop, e^h], (B, T, D)."""
        observation, masks = self.normalizer(observation), masks or {}
        legs = self.leg_embedding(observation.legs.flatten(2))  # (B, L, H*frame) -> (B, L, D), eq. 1
        if self.config.leg_pe:
            proprioception = legs + self.leg_position
        else:
            action = self.action_embedding(observation.action)  # (B, D), eq. 2
            proprioception = torch.cat([legs, action[:, None]], dim=1)  # (B, L+1, D), eq. 3

        B, (rows, columns), s = len(legs), SCAN_SHAPE, PATCH
        patches = observation.heights.reshape(B, rows // s, s, columns // s, s).transpose(2, 3)  # (B, 4, 3, s, s)
        patches = self.patch_embedding(patches.reshape(B, NUM_PATCHES, s * s))  # (B, P, D)
        position = self.patch_position
        if "patch_position" in masks:
            keep = masks["patch_position"].bool()[:, :, None]
            position = torch.where(keep, position, self.dropped_position)  # (B, P, D)
        return torch.cat([proprioception, patches + position], dim=1)

    def _queries(self, layer: int) -> int:
        """How many tokens a layer updates: all that the next one reads; after the last only the legs are read."""
        last = layer == self.config.layers - 1
        return self.num_legs if last else self.num_proprioceptive + NUM_PATCHES

    def _encode(self, observation: Observation, masks: Masks | None) -> tuple[Tensor, list[Tensor]]:
        x, masks, attention = self.tokens(observation, masks), masks or {}, []
        for i, layer in enumerate(self.encoder):
            x, weights = layer(x, self._queries(i), masks.get(f"attention_{i}"), masks.get(f"feedforward_{i}"))
            attention.append(weights)
        return self.decoder(self.norm(x)).flatten(1), attention  # (B, L, J) -> (B, L*J)
