"""ROLT, the robust locomotion transformer: the paper's section III in one file; needs torch only.

Where each equation is:
    eq. 1  e^l = MLP(s^l)             `leg_embedding`, one network for all legs
    eq. 2  e^a = W a_{t-1} + b        `action_embedding`, by it a leg finds out which one it is
    eq. 3  e^prop = [e^l..., e^a]     `tokens`; where the policy reads the scan, 12 patches follow,
                                      e^h = linear(s^h) + p_e
    III-B  two encoder layers, linear decoder on the leg tokens     `EncoderLayer`, `forward`
    III-C  feature dropout, position embedding (PE) dropout         `sample_masks`, `drop`, `tokens`

Why no position embedding on the legs: with one, each leg learns a controller of its own, and what
the front right leg has learned about limping stays there. Without one the legs share everything; a
leg finds out where it is by comparing its own previous action with the action token.

Why the masks are data: the rollout's are stored with the transition and passed to `forward` again
when PPO updates the policy, which else would differ from the one that acted (ppo.py).

Legend: B samples, L legs, J joints a leg, H = 10 steps of history, P = 12 patches, D = 160 width,
T tokens: L, the action token, and P where the policy reads the scan.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

HISTORY = 10  # H, steps (paper, section III-A)
SCAN_SHAPE = (16, 12)  # points forward, left
PATCH = 4  # points a side, ours
GRID = (SCAN_SHAPE[0] // PATCH, SCAN_SHAPE[1] // PATCH)
NUM_PATCHES = GRID[0] * GRID[1]  # P = 12, paper
LOG_STD_BOUNDS = (math.log(0.05), math.log(2.0))  # ours
Masks = dict[str, Tensor]  # what a policy drew in the rollout: (B, ...) bool, True = keep; or noise


class Observation(NamedTuple):
    """What robots see; the table at the head of env.py says what each number is (M, too)."""

    legs: Tensor  # (B, L, H, 3J + 12)
    action: Tensor  # (B, L*J)
    privileged: Tensor  # (B, 2*L*J + 1 + M), or (B, 0) as all that follows
    heights: Tensor  # (B, 16, 12)
    past: Tensor  # (B, L, 50, 3J + 12)
    situation: Tensor  # (B, 1)


@dataclass(frozen=True)
class ROLTConfig:
    """The model's hyper-parameters, and the switches of its ablations."""

    width: int = 160  # D, paper
    layers: int = 2  # paper
    heads: int = 4  # ours: the paper names no number; 4 heads of 40
    feedforward: int = 320  # ours: twice the width keeps it light
    scan: bool = False  # reads heights? Flat ground's are 192 times one number (NOTES 12)
    initial_std: float = 1.0  # legged_gym; from 0.7 the robots learn to stand first (NOTES 4)
    patch_position_std: float = 0.75  # ours: as large as what it is added to (NOTES 3)
    leg_position_std: float = 0.2  # ours, likewise
    feature_dropout: float = 0.1  # paper; 0 = the ablation No Feature Drop
    pe_dropout: float = 0.75  # paper; 0 = the ablation No PE Drop
    # How a leg knows which one it is: by the "action" token (the paper), a learned "embedding" a
    # leg (its ablation Module PE), or "none" (our control No Identity)
    identity: str = "action"
    leg_frames: bool = True  # sees and acts in leg frames (env.py); False = our No Leg Frames


def draw_mask(shape: tuple[int, ...], p: float, generator: torch.Generator) -> Tensor:
    """Bools, False with probability p to within 2^-16. int16 takes half the time of torch.rand."""
    bits = torch.empty(shape, dtype=torch.int16, device=generator.device)
    return bits.random_(generator=generator) >= round(p * 2**15)  # bits: 0 to 2^15 - 1


def drop(x: Tensor, keep: Tensor | None, p: float) -> Tensor:
    """Consistent dropout: x where the stored mask is True, times 1 / (1 - p); None = identity."""
    return x if keep is None else x * keep * (1 / (1 - p))


class Decoder(nn.Linear):
    """The policy's last layer: in fp32 even where the rest is in bf16, and small, to start near the
    default pose (Andrychowicz et al. 2021; 0.01 is ours)."""

    def __init__(self, width: int, outputs: int):
        super().__init__(width, outputs)
        nn.init.normal_(self.weight, std=0.01)

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


class EncoderLayer(nn.Module):
    """Pre-norm transformer layer (ViT's; the paper names none), dropout after attention and MLP."""

    def __init__(self, config: ROLTConfig):
        super().__init__()
        D, hidden = config.width, config.feedforward
        self.heads, self.p = config.heads, config.feature_dropout
        self.norm_attention, self.norm_feedforward = nn.LayerNorm(D), nn.LayerNorm(D)
        self.query, self.key_value = nn.Linear(D, D), nn.Linear(D, 2 * D)
        self.merge = nn.Linear(D, D)
        self.feedforward = nn.Sequential(nn.Linear(D, hidden), nn.ReLU(), nn.Linear(hidden, D))

    def forward(self, x: Tensor, queries: int, keep_attention, keep_feedforward):
        """Updates the first `queries` tokens of x (B, T, D); masks are (B, queries, D) or None.

        The others still serve as keys and values, so these become what they would if all were
        updated: a token depends on the others' keys and values, never on their queries.
        Returns: tokens (B, queries, D), attention weights (B, heads, queries, T)."""
        normed = self.norm_attention(x)
        x = x[:, :queries]
        q = self._split(self.query(normed[:, :queries]))  # (B, heads, queries, d)
        k, v = (self._split(half) for half in self.key_value(normed).chunk(2, dim=-1))  # T long
        scores = q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5
        weights = torch.softmax(scores.float(), dim=-1)  # (B, heads, queries, T)
        mixed = (weights.to(v.dtype) @ v).transpose(1, 2).flatten(2)  # (B, queries, D)

        x = x + drop(self.merge(mixed), keep_attention, self.p)
        x = x + drop(self.feedforward(self.norm_feedforward(x)), keep_feedforward, self.p)
        return x, weights

    def _split(self, x: Tensor) -> Tensor:
        """(B, T, D) -> (B, heads, T, d)"""
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class ROLT(nn.Module):
    """Gaussian policy: each action's mean from the transformer, a learned std per kind of joint."""

    replays_masks = True  # in the update, train.py asks (Roll-Drop does not)

    def __init__(self, num_legs: int, num_joints: int, config: ROLTConfig = ROLTConfig()):
        super().__init__()
        self.config, self.num_legs, self.num_joints = config, num_legs, num_joints
        self.extras = ("heights",) if config.scan else ()  # that it reads, see env.py
        self.leg_frames = config.leg_frames

        others = {"action": config.identity == "action", "patches": NUM_PATCHES * config.scan}
        self.others = {name: n for name, n in others.items() if n}  # tokens beside the legs'

        D = config.width
        inputs = HISTORY * (3 * num_joints + 12)  # numbers that one leg sees
        self.leg_embedding = nn.Sequential(nn.Linear(inputs, D), nn.ReLU(), nn.Linear(D, D))
        if config.identity == "embedding":
            self.leg_position = nn.Parameter(config.leg_position_std * torch.randn(num_legs, D))
        if config.identity == "action":
            self.action_embedding = nn.Linear(num_legs * num_joints, D)
        if config.scan:
            std = config.patch_position_std
            self.patch_embedding = nn.Linear(PATCH**2, D)
            self.patch_position = nn.Parameter(std * torch.randn(NUM_PATCHES, D))  # p_e
            if config.pe_dropout > 0:  # stands in for every dropped p_e
                self.dropped_position = nn.Parameter(std * torch.randn(D))

        self.encoder = nn.ModuleList(EncoderLayer(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(D)
        self.decoder = Decoder(D, num_joints)
        # shared by the legs, as the weights are; independent of the state, as in legged_gym
        self.log_std = nn.Parameter(torch.full((num_joints,), config.initial_std).log())

    def std(self) -> Tensor:
        """(L*J,) standard deviation of every action, within bounds that no healthy run meets."""
        return self.log_std.clamp(*LOG_STD_BOUNDS).exp().repeat(self.num_legs)

    def sample_masks(self, n: int, generator: torch.Generator) -> Masks:
        """For n samples: (n, P) patches that keep their p_e, (n, tokens, D) features that stay."""
        config, masks = self.config, {}
        if config.scan and config.pe_dropout > 0:
            masks["patch_position"] = draw_mask((n, NUM_PATCHES), config.pe_dropout, generator)
        if config.feature_dropout > 0:
            for i in range(config.layers):
                shape = (n, self._queries(i), config.width)
                masks[f"attention_{i}"] = draw_mask(shape, config.feature_dropout, generator)
                masks[f"feedforward_{i}"] = draw_mask(shape, config.feature_dropout, generator)
        return masks

    def forward(self, observation, masks: Masks | None = None) -> Tensor:
        """(B, L*J) mean action, J from each leg's token. masks: of `sample_masks`; None = test."""
        x, _ = self._encode(observation, masks or {})
        return self.decoder(self.norm(x)).flatten(1)  # (B, L, J) -> (B, L*J)

    def attention(self, observation) -> Tensor:
        """(B, heads, L, T), how the last layer's legs attend to legs, action, patches; at test."""
        return self._encode(observation, {})[1]

    def tokens(self, observation, masks: Masks) -> Tensor:
        """E_0 = [e^prop, e^h], (B, T, D)."""
        config = self.config
        legs = self.leg_embedding(observation.legs.flatten(2))  # (B, L, H*21) -> (B, L, D), eq. 1
        tokens = [legs + self.leg_position if config.identity == "embedding" else legs]
        if config.identity == "action":
            tokens.append(self.action_embedding(observation.action)[:, None])  # (B, 1, D), eq. 2

        if config.scan:
            # s = PATCH: (B, 4s, 3s) -> (B, 4, s, 3, s) -> (B, 4, 3, s, s) -> (B, P, s*s)
            squares = observation.heights.unflatten(2, (GRID[1], -1)).unflatten(1, (GRID[0], -1))
            patches = self.patch_embedding(squares.transpose(2, 3).flatten(3).flatten(1, 2))
            position = self.patch_position
            if "patch_position" in masks:
                keep = masks["patch_position"][:, :, None]
                position = torch.where(keep, position, self.dropped_position)  # (B, P, D)
            tokens.append(patches + position)
        return torch.cat([part.float() for part in tokens], dim=1)  # eq. 3, then the patches

    def _queries(self, layer: int) -> int:
        """How many tokens a layer updates: those read afterwards; after the last, only the legs."""
        return self.num_legs + sum(self.others.values()) * (layer < self.config.layers - 1)

    def _encode(self, observation, masks: Masks) -> tuple[Tensor, Tensor]:
        """The leg tokens after the last layer (B, L, D), and its attention (B, heads, L, T)."""
        x = self.tokens(observation, masks)
        for i, layer in enumerate(self.encoder):
            keep = masks.get(f"attention_{i}"), masks.get(f"feedforward_{i}")
            x, attention = layer(x, self._queries(i), *keep)
        return x, attention
