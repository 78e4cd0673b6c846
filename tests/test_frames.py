"""Leg frames: a mirrored robot in a mirrored state says the same of its legs, left and right
exchanged; and to act so moves it as the mirror image moves."""

import numpy as np
import pytest

from conftest import QUIET, env_of
from env import EnvConfig
from robots import ROBOTS


def mirror_of(robot):
    """The leg on the other side, and the sign that the mirror gives to each joint's angle: -1 for
    turns about x and z."""
    swap = [robot.mounts.index((x, -y, z)) for x, y, z in robot.mounts]
    return swap, np.array([1.0 if link.axis[1] else -1.0 for link in robot.links])


def put_into_mirrored_states(env) -> None:
    """Robot 0 into a random state, robot 1 into its mirror image in the world's x-z plane."""
    swap, signs = mirror_of(env.robot)
    rng, shape = np.random.default_rng(1), (env.num_legs, env.num_joints)
    angles, speeds = env._default + 0.1 * rng.normal(size=shape), rng.normal(size=shape)
    turn = np.array([1.0, 0.1, -0.2, 0.3]) / np.linalg.norm([1.0, 0.1, -0.2, 0.3])
    linear, angular = rng.normal(size=3), rng.normal(size=3)
    for i in (0, 1):
        env._qpos[i, 3:7] = turn * ([1, -1, 1, -1] if i else 1)
        env._qpos[i, env._angle_at] = (angles[swap] * signs if i else angles).ravel()
        env._qvel[i, :3] = linear * ([1, -1, 1] if i else 1)
        env._qvel[i, 3:6] = angular * ([-1, 1, -1] if i else 1)
        env._qvel[i, env._velocity_at] = (speeds[swap] * signs if i else speeds).ravel()
    env.command[:] = (0.7, 0.3, 0.2), (0.7, -0.3, -0.2)
    env.action[0] = rng.normal(size=shape)
    env.action[1] = env.action[0, swap]
    env.world.forward()
    env._read_state()


@pytest.mark.parametrize("leg_frames", [True, False])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_mirrored_robot_says_the_same_in_leg_frames_alone(name, leg_frames):
    env = env_of(2, name, EnvConfig(leg_frames=leg_frames))
    put_into_mirrored_states(env)
    seen, image = env._newest_step()
    assert np.array_equal(image, seen[mirror_of(env.robot)[0]]) == leg_frames
    assert not np.array_equal(seen[0], seen[1])  # a leg's own numbers are there


@pytest.mark.parametrize("name", ROBOTS)
def test_the_same_actions_move_mirrored_robots_as_mirror_images(name):
    env = env_of(2, name, QUIET)
    swap, signs = mirror_of(env.robot)
    put_into_mirrored_states(env)
    env._qpos[:, 2] += 1.0  # in the air: contacts are solved to a tolerance only
    env.world.forward()
    env._read_state()
    for _ in range(5):
        action = np.random.default_rng(2).normal(size=env.action.shape[1:])
        env.step(np.stack([action, action[swap]]))
    # the A1's trunk is not quite its own mirror image (its centre of mass is 4 mm to the left)
    assert np.allclose(env.joint_error[1], env.joint_error[0, swap] * signs, atol=0.02)
    assert np.abs(env.joint_error).max() > 0.1
