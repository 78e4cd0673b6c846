"""Running statistics against numpy's, and that they do not tell the legs apart."""

import numpy as np
import torch

from env import LocomotionEnv, Observation
from normalizer import CLIP, Normalizer


def observation(seed, n=6):
    g = torch.Generator().manual_seed(seed)
    shapes = (n, 4, 10, 21), (n, 12), (n, 16, 12), (n, 25), (n, 4, 50, 21), (n, 0)
    return Observation(*(3.0 + 2.0 * torch.randn(*shape, generator=g) for shape in shapes))


def alone(tensor):
    return tensor


def test_mean_and_deviation_of_all_that_was_seen():
    """Batches of different sizes count by their samples; of the history, the newest step."""
    normalizer, batches = Normalizer(3, num_privileged=25), [observation(0, 6), observation(1, 30)]
    for batch in batches:
        normalizer.update(batch, alone)
    newest = np.concatenate([batch.legs[:, :, -1].reshape(-1, 21).numpy() for batch in batches])
    heights = np.concatenate([batch.heights.flatten().numpy() for batch in batches])
    seen, x = normalizer(batches[0]), batches[0]
    expected = (x.legs.numpy() - newest.mean(0)) / newest.std(0)
    assert np.allclose(seen.legs, expected.clip(-CLIP, CLIP), atol=1e-4)
    target = (x.action.numpy().reshape(6, 4, 3) - newest.mean(0)[6:9]) / newest.std(0)[6:9]
    assert np.allclose(seen.action, target.reshape(6, 12).clip(-CLIP, CLIP), atol=1e-4)
    assert np.allclose(seen.heights, (x.heights.numpy() - heights.mean()) / heights.std(), atol=1e-4)
    assert abs(seen.privileged.mean()) < 0.5 and abs(seen.past.mean()) < 0.5


def test_what_is_to_be_forgotten_is_replaced():
    normalizer, alone_seen, x, y = Normalizer(3), Normalizer(3), observation(0), observation(1)
    normalizer.update(x, alone)
    normalizer.update(y, alone, forget=("heights",))
    alone_seen.update(y, alone)
    assert torch.equal(normalizer(x).heights, alone_seen(x).heights) and not torch.equal(normalizer(x).legs, alone_seen(x).legs)
    assert normalizer.count == 2 * 24


def test_a_loaded_normalizer_answers_as_the_saved_one():
    saved, loaded, x = Normalizer(3), Normalizer(3), observation(0)
    saved.update(x, alone)
    loaded.load_state_dict(saved.state_dict())
    assert torch.equal(loaded(x).legs, saved(x).legs) and not torch.equal(Normalizer(3)(x).legs, saved(x).legs)


def test_two_processes_see_what_one_would():
    whole, half = Normalizer(3), Normalizer(3)
    left, right = observation(0), observation(1)
    whole.update(Observation(*(torch.cat(pair) for pair in zip(left, right))), alone)
    # the sum over two processes, of which the other one holds `right`
    other, sums = Normalizer(3), []
    other.update(right, lambda tensor: sums.append(tensor.clone()) or tensor * 1.0)
    means = other.legs_mean, other.legs_square, other.heights_mean, other.heights_square
    theirs = iter([sums[0], *(mean * sums[0] for mean in means)])
    half.update(left, lambda tensor: tensor + next(theirs))
    for key, value in whole.state_dict().items():
        assert torch.allclose(half.state_dict()[key], value), key


def test_what_never_changes_is_not_blown_up_and_outliers_are_clipped():
    normalizer, x = Normalizer(3), observation(0)
    x.legs[..., 10] = 0.0  # the lateral command
    normalizer.update(x, alone)
    assert (normalizer(x).legs[..., 10] == 0).all()
    x.legs[0, 0, 0, 0] = 1e6
    assert normalizer(x).legs[0, 0, 0, 0] == CLIP


def test_left_and_right_hips_stay_apart():
    """Statistics are shared by the legs: the difference of their default poses survives."""
    env = LocomotionEnv("a1", 64, 0, 1)
    env.reset()
    for _ in range(20):
        last, *_ = env.step(np.random.default_rng(0).normal(size=(64, 12)))
    seen = Observation(*(torch.from_numpy(field) for field in last))
    normalizer = Normalizer(3)
    normalizer.update(seen, alone)
    right, left = normalizer(seen).legs[:, :2, -1, 0].mean(0)
    assert left - right > 0.3
