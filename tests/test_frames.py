"""Leg frames: a mirrored robot in a mirrored state says the same of its legs, left and right
exchanged; and to act so moves it as the mirror image moves."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import QUIET, env_of
from robots import ROBOTS


@pytest.mark.parametrize("leg_frames", [True, False])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_mirrored_robot_says_the_same_in_leg_frames_alone_and_moves_alike(name, leg_frames, rng):
    """Robot 1 is the mirror image of robot 0 in the world's x-z plane."""
    env = env_of(2, name, replace(QUIET, leg_frames=leg_frames))
    mounts, links = env.robot.mounts, env.robot.links
    swap = [mounts.index((x, -y, z)) for x, y, z in mounts]  # the leg on the other side
    signs = np.array([1.0 if link.axis[1] else -1.0 for link in links])  # -1: about x and z
    angles, speeds, action = rng.normal(size=(3, env.num_legs, env.num_joints))
    angles = env._default + 0.1 * angles
    linear, angular = rng.normal(size=(2, 3))
    turn = np.array([1.0, 0.1, -0.2, 0.3]) / np.linalg.norm([1.0, 0.1, -0.2, 0.3])
    env._qpos[:, 2] += 1.0  # in the air: contacts are solved to a tolerance only
    env._qpos[:, 3:7] = turn, turn * [1, -1, 1, -1]
    env._qpos[:, env._angle_at] = angles.ravel(), (angles[swap] * signs).ravel()
    env._qvel[:, :3] = linear, linear * [1, -1, 1]
    env._qvel[:, 3:6] = angular, angular * [-1, 1, -1]
    env._qvel[:, env._velocity_at] = speeds.ravel(), (speeds[swap] * signs).ravel()
    env.command[:] = (0.7, 0.3, 0.2), (0.7, -0.3, -0.2)
    env.action[:] = action, action[swap]
    env.world.forward()
    env._read_state()
    seen, image = env._newest_step()
    assert np.array_equal(image, seen[swap]) == leg_frames
    assert not np.array_equal(seen[0], seen[1])  # a leg's own numbers are there

    for _ in range(5):
        action = rng.normal(size=action.shape)
        env.step(np.stack([action, action[swap] * (1 if leg_frames else signs)]))
    # the A1's trunk is not quite its own mirror image (its centre of mass is 4 mm to the left)
    assert np.allclose(env.joint_error[1], env.joint_error[0, swap] * signs, atol=0.02)
    assert np.abs(env.joint_error).max() > 0.1
