"""ROLT's symmetries and its dropout."""

from dataclasses import replace

import pytest
import torch

from env import Observation
from rolt import ROLT, ROLTConfig, drop


def observation(n=5):
    g = torch.Generator().manual_seed(0)
    shapes = (n, 4, 10, 21), (n, 12), (n, 0), (n, 16, 12), (n, 0), (n, 0)
    return Observation(*(torch.randn(*shape, generator=g) for shape in shapes))


def model(**switches):
    torch.manual_seed(0)
    policy = ROLT(4, 3, replace(ROLTConfig(scan=True), **switches))
    torch.nn.init.normal_(policy.decoder.weight)  # the small initial one would hide differences
    return policy


def test_permuting_the_legs_permutes_the_actions():
    obs, order = observation(), torch.tensor([2, 0, 3, 1])
    permuted = obs._replace(legs=obs.legs[:, order])
    for identity, share in (("action", True), ("none", True), ("embedding", False)):
        policy = model(identity=identity)
        actions, moved = (policy(seen).view(5, 4, 3) for seen in (obs, permuted))
        assert torch.allclose(moved, actions[:, order], atol=1e-5) == share
        assert (actions[:, 0] - actions[:, 1]).abs().max() > 0.1  # but legs do act differently


def test_module_pe_tells_apart_legs_that_see_the_same_and_only_rolt_reads_the_action_token():
    obs = observation()
    same = obs._replace(legs=obs.legs[:, :1].expand(-1, 4, -1, -1))
    other = obs._replace(action=obs.action + 1)
    for identity in ("action", "none", "embedding"):
        policy = model(identity=identity)
        actions = policy(same).view(5, 4, 3)
        apart = (actions[:, 0] - actions[:, 1]).abs().max()
        change = (policy(other) - policy(obs)).abs().max()
        assert apart > 1e-3 if identity == "embedding" else apart < 1e-4
        assert change > 1e-3 if identity == "action" else change == 0


def test_pruned_last_layer_equals_the_full_one():
    policy, obs = model(), observation()
    x = policy.tokens(obs, {})
    for layer in policy.encoder:
        x, _ = layer(x, x.shape[1], None, None)  # all tokens, also those that nobody reads
    full = policy.decoder(policy.norm(x[:, :4])).flatten(1)
    assert torch.allclose(policy(obs), full, atol=1e-5)


def test_masks_have_their_rates_and_drop_scales_what_it_keeps():
    generator = torch.Generator().manual_seed(1)
    masks = model().sample_masks(400, generator)
    shapes = {name: tuple(mask.shape[1:]) for name, mask in masks.items()}
    assert shapes == {
        "patch_position": (12,), "attention_0": (17, 160), "feedforward_0": (17, 160),
        "attention_1": (4, 160), "feedforward_1": (4, 160),
    }  # fmt: skip
    for name, mask in masks.items():
        rate, n = (0.75 if name == "patch_position" else 0.1), mask.numel()
        assert abs((~mask).float().mean() - rate) < 5 * (rate * (1 - rate) / n) ** 0.5
    assert model(feature_dropout=0.0).sample_masks(5, generator).keys() == {"patch_position"}
    assert "patch_position" not in model(pe_dropout=0.0).sample_masks(5, generator)

    x, keep = torch.tensor([9.0, 9.0, 9.0]), torch.tensor([True, False, True])
    assert drop(x, keep, 0.1).tolist() == pytest.approx([10, 0, 10]) and drop(x, None, 0.1) is x


def test_masks_change_the_action_and_repeat_it():
    policy, obs = model(), observation()
    masks = policy.sample_masks(5, torch.Generator().manual_seed(1))
    assert torch.equal(policy(obs, masks), policy(obs, masks))
    for name, mask in masks.items():  # each of them counts
        assert not torch.allclose(policy(obs, masks), policy(obs, masks | {name: ~mask})), name
    kept = {"patch_position": torch.ones(5, 12, dtype=torch.bool)}
    plain = model(feature_dropout=0.0)  # the same weights
    assert torch.allclose(plain(obs, kept), policy(obs), atol=1e-5)


def test_dropped_positions_are_replaced_by_the_one_vector():
    policy, obs = model(), observation()
    keep = torch.zeros(5, 12, dtype=torch.bool)
    keep[:, 3] = True
    tokens, clean = policy.tokens(obs, {"patch_position": keep}), policy.tokens(obs, {})
    change = tokens[:, 5:] - clean[:, 5:]  # tokens: 4 legs, 1 action, 12 patches
    assert torch.allclose(change[:, 3], torch.zeros(5, 160))
    replaced = (policy.dropped_position - policy.patch_position[7]).expand(5, -1)
    assert torch.allclose(change[:, 7], replaced, atol=1e-6)
    policy(obs, {"patch_position": keep}).sum().backward()
    assert policy.dropped_position.grad.abs().sum() > 0
    assert torch.equal(policy.patch_position.grad[7], torch.zeros(160))


def test_patches_are_neighbouring_points():
    """Raising the points of rows 4-7, columns 8-11 changes patch (1, 2), number 5, alone."""
    policy, obs = model(), observation()
    heights = obs.heights.clone()
    heights[:, 4:8, 8:12] += 1
    change = policy.tokens(obs._replace(heights=heights), {}) - policy.tokens(obs, {})
    assert change.abs().sum((0, 2)).nonzero().flatten().tolist() == [5 + 5]


@torch.no_grad()
def test_positions_start_as_large_as_what_they_are_added_to():
    """Root mean squares; inputs of order 1, heights of a walk (NOTES 3). Not 0.02 beside 0.6."""
    policy, embedded, obs = model(), model(identity="embedding"), observation(200)
    obs = obs._replace(heights=0.6 + 0.5 * obs.heights + 0.8 * torch.randn(200, 1, 1))
    patches = policy.tokens(obs, {})[:, 5:] - policy.patch_position
    legs = embedded.tokens(obs, {})[:, :4] - embedded.leg_position
    pairs = [(policy.patch_position, patches), (policy.dropped_position, patches)]
    for position, added_to in [*pairs, (embedded.leg_position, legs)]:
        assert 0.5 < (position.square().mean() / added_to.square().mean()).sqrt() < 2


@torch.no_grad()
def test_bf16_answers_nearly_as_fp32_and_alike_in_every_batch():
    """bf16 has 8 bits: products are off by up to 0.4 %. The mean action stays float32."""
    policy, obs = model(), observation(64)
    exact = policy(obs)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = policy(obs)
        some = policy(Observation(*(field[10:20] for field in obs)))
    assert rounded.dtype == torch.float32 and not torch.equal(rounded, exact)
    assert (rounded - exact).abs().max() < 0.03 * exact.std()
    assert torch.allclose(some, rounded[10:20], atol=1e-3)
