"""What makes each baseline what it is."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import checkpoint
from baselines import METHODS, ROLL_DROP_RATE, ROAMLearner, training_stages
from conftest import env_of, fresh_policy, ratio, rollout_of, save_policy
from faults import TASKS
from ppo import proprioception, to_tensors

TASK = TASKS["stiffness"]


def acting(name):
    """A fresh policy, and what it sees after three steps."""
    policy = fresh_policy(name)
    env = env_of(6, faults=TASK.training, extras=policy.extras)
    for step in range(3):
        observation, *_ = env.step(np.full((6, 12), 0.3 * step))
    return policy, to_tensors(observation, "cpu")


@pytest.mark.parametrize("name", METHODS)
@torch.no_grad()
def test_every_policy_acts_and_survives_saving(name, tmp_path):
    policy, observation = acting(name)
    action = policy(observation)
    assert action.shape == (6, 12) and policy.std().shape == (12,)
    halved = {key: x.half() for key, x in policy.state_dict().items()}  # as checkpoint.py ships it
    for weights, tolerance in ((policy.state_dict(), 0.0), (halved, 1e-2)):
        save_policy(tmp_path / "policy.pt", weights, policy=name)
        copy, _ = checkpoint.load_policy(tmp_path / "policy.pt", "a1")
        if tolerance == 0.0 or name != "roam":  # whose choice among behaviours is a draw
            assert torch.allclose(copy(observation), action, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", METHODS)
def test_each_stage_trains_its_weights_alone_and_who_acts_has_the_whole_budget(name):
    """What chooses among policies, or guesses, comes on top."""
    policy, trained = fresh_policy(name), set()
    shares = [stage.share for stage in training_stages(policy, TASK)]
    assert shares == {"rma": [1.0, 0.2], "roam": [1.0, 1.0, 0.2]}.get(name, [1.0])
    for stage in range(len(shares)):
        before = {key: value.clone() for key, value in policy.state_dict().items()}
        run = rollout_of(policy, stage)
        names = {key for key, p in policy.named_parameters() if p.requires_grad}
        run.learner.update(run.buffer, run.generator)
        after = policy.state_dict()
        moved = {key for key in after if not torch.equal(after[key], before[key])}
        assert moved == names
        trained |= names
    assert trained == {key for key, _ in policy.named_parameters()}  # no weight is left out


def test_a_mirrored_mlp_answers_a_mirrored_state_with_the_mirrored_action():
    policy, observation = acting("mirrored-mlp")
    image = observation._replace(legs=observation.legs[:, [1, 0, 3, 2]])  # in leg frames, all of it
    actions, mirrored = policy(observation).view(6, 4, 3), policy(image).view(6, 4, 3)
    assert torch.allclose(mirrored, actions[:, [1, 0, 3, 2]], atol=1e-5)
    assert not torch.allclose(actions[:, 0], actions[:, 1], atol=1e-2)


def test_proprioception_holds_every_number_once():
    legs = torch.arange(2 * 4 * 10 * 21, dtype=torch.float32).view(2, 4, 10, 21)
    legs[:, :, :, 9:] = legs[:, :1, :, 9:]  # as in the env: all legs see the same body
    own, body = legs[1, :, 3, :9].flatten().tolist(), legs[1, 2, 3, 9:].tolist()
    assert proprioception(legs).view(2, 10, 48)[1, 3].tolist() == own + body


def test_roll_drops_ratio_is_off_where_a_neuron_was_dropped(monkeypatch):
    """Of 896: at a rate of 1 % in nearly every sample, at the paper's 0.01 % in one of twelve."""
    for rate in (1e-2, ROLL_DROP_RATE):
        monkeypatch.setattr("baselines.ROLL_DROP_RATE", rate)
        run = rollout_of(fresh_policy("roll-drop"), n=32)
        assert not run.buffer.masks
        off = (ratio(run, run.buffer.minibatch(torch.arange(32 * 24))) - 1).abs() > 1e-3
        assert off.float().mean().item() == pytest.approx(1 - (1 - rate) ** 896, abs=0.04)


def test_rma_reads_nothing_privileged_at_test():
    policy, observation = acting("rma")
    assert observation.privileged.numel() == 0  # the env does not even give it
    poisoned = observation._replace(privileged=torch.full((6, 25), math.nan))
    assert torch.equal(policy(observation), policy(poisoned))
    told = observation._replace(past=torch.zeros(6, 0), privileged=torch.full((6, 25), math.nan))
    assert policy(told).isnan().all()  # in training it does


def test_roams_loss_by_hand():
    """Two behaviours, one state of the first: values 1 and 0, return 3."""
    values = torch.tensor([[1.0, 0.0]], requires_grad=True)
    learner = SimpleNamespace(policy=SimpleNamespace(values=lambda observation: values))
    batch = {"observation": SimpleNamespace(situation=torch.zeros(1, 1))}
    batch["returns"] = torch.tensor([3.0])
    loss, parts = ROAMLearner.loss(learner, batch, None, 0.0)
    bellman, entropy = parts["value_loss"], parts["other_loss"]
    p = math.e / (math.e + 1)  # softmax of (1, 0)
    assert bellman.item() == pytest.approx(4.0)
    assert entropy.item() == pytest.approx(-math.log(p))
    assert loss.item() == pytest.approx(4.0 - math.log(p))
    gradient = torch.autograd.grad(bellman, values, retain_graph=True)[0]
    assert gradient.tolist() == [[-4.0, 0.0]]  # the owner's alone
    gradient = torch.autograd.grad(entropy, values)[0]
    assert torch.allclose(gradient, torch.tensor([[p - 1, 1 - p]]))  # every value's


def test_roam_acts_in_training_by_its_situation_and_at_test_by_its_values():
    policy, observation = acting("roam")
    each = torch.stack([behaviour(observation) for behaviour in policy.behaviours])
    for index in (0, 1):
        told = observation._replace(situation=torch.full((6, 1), float(index)))
        assert torch.equal(policy(told), each[index])
    torch.nn.init.constant_(policy.critics[1][-1].bias, 50.0)  # e^-50: surely the second
    assert torch.equal(policy(observation), each[1])
