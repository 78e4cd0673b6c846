"""The env: what it observes, rewards, ends and repeats."""

from types import SimpleNamespace

import numpy as np
import pytest

import rewards
from conftest import QUIET, env_of, flail, go_on_alike, rest
from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import TASKS
from robots import A1


def test_bit_identical_for_a_seed_at_any_number_of_threads_where_locks_come_and_go(rng):
    how = (0, 1), (0, 2), (5, 1)  # seed, threads
    envs = [LocomotionEnv("a1", 8, *one, TASKS["mid-stride"].training) for one in how]
    first, second, other = (env.reset(random_ages=True).legs for env in envs)
    assert np.array_equal(first, second) and not np.array_equal(first, other)
    go_on_alike(*envs[:2], rng, 60)
    assert 0 < envs[0].world.bind("eq_active").sum() < 8


def test_wrong_use_is_refused():
    with pytest.raises(ValueError, match="unknown extras memory; there is privileged"):
        env_of(1, extras=("memory",))
    env = env_of(4)
    for shape in ((12, 4), (48,), (4, 3, 4)):
        with pytest.raises(ValueError, match=r"actions are \(4, 12\), not"):
            env.step(np.zeros(shape))
    env.step(np.zeros((4, 4, 3)))
    with pytest.raises(FloatingPointError, match="not finite"):
        env.step(np.full((4, 12), np.nan))


@pytest.mark.parametrize("robot, faults, terrain", [
    ("a1", TASKS["stiffness"].training, None),
    ("a1", TASKS["terrain"].training, TASKS["terrain"].terrain),
    ("go1", ((0.5, "tow:RR"), (0.5, "skate:FR+half-lock:RL_calf:-1.6")), None),
])  # fmt: skip
def test_goes_on_to_the_bit_after_a_break(robot, faults, terrain, rng):
    config = EnvConfig(episode_seconds=0.5, command_seconds=0.3)
    how = robot, 6, 2, 1, faults, config, (), terrain
    env, twin = LocomotionEnv(*how), LocomotionEnv(*how)
    env.reset(random_ages=True)
    flail(env, rng, 20)
    twin.load_state_dict(env.state_dict())
    assert all(map(np.array_equal, env.observe(), twin.observe()))
    go_on_alike(env, twin, rng, 20)  # resets included: an episode has 25 steps


def test_history_rolls_oldest_first_and_starts_filled(rng):
    env = env_of(3, extras=("past",))
    before = env.observe().legs
    assert np.array_equal(before, np.repeat(before[:, :, :1], 10, axis=2))

    mirrored = np.array([[1, 1, 1], [-1, 1, 1]] * 2)  # hips of left legs
    for _ in range(60):
        action = rng.normal(size=(3, 12))
        after, *_ = env.step(action)
        assert np.array_equal(after.legs[:, :, :-1], before[:, :, 1:])
        own, body = after.legs[:, :, -1, :9], after.legs[:, 2, -1, 9:]
        joints = 4 * mirrored * env.joint_error, 0.2 * mirrored * env.joint_velocity
        assert np.allclose(own, np.dstack([*joints, action.reshape(3, 4, 3)]))  # its own action
        assert np.allclose(after.action, action)
        parts = 2 * env.command, 2 * env.linear_velocity, env.angular_velocity
        assert np.allclose(body[:, :9], np.hstack(parts)) and all(part.any() for part in parts)
        assert np.allclose(body[:, 9:], 5 * (env.gravity + (0, 0, 1)), atol=1e-6)
        before = after.legs

    assert after.past.shape == (3, 4, 50, 21)
    assert np.array_equal(after.legs, after.past[:, :, -10:])


def test_a_trunk_tilted_by_60_degrees_or_on_the_ground_has_fallen_and_the_others_go_on():
    env = env_of(3)
    half = np.radians([50, 70, 0]) / 2
    env._qpos[:, :7] = 0
    env._qpos[:, 2:5] = np.transpose([[2.0, 2.0, 0.05], np.cos(half), np.sin(half)])
    env._qpos[:, 7:] = np.tile([0.0, 2.8, -2.6], 4)  # legs folded beside the trunk
    env._qvel[:] = 0
    _, reward, terminated, truncated, info = rest(env)
    assert terminated.tolist() == [False, True, True] and not truncated.any()
    assert reward[1] == pytest.approx(-1, abs=0.05) and reward[0] >= 0  # a fall costs 1, once
    assert env.age.tolist() == [1, 0, 0] and len(info["episode_returns"]) == 2
    assert env.gravity[1, 2] == pytest.approx(-1)  # upright again


def test_body_velocities_and_gravity_are_in_the_trunks_frame():
    """Yawed 90 degrees left and driven along world x, the robot moves to its right. Pitched nose
    down by 0.3 rad, gravity points forward."""
    env = env_of(2)
    env._qpos[:, 3:7] = [[0.5**0.5, 0, 0, 0.5**0.5], [np.cos(0.15), 0, np.sin(0.15), 0]]
    env._qvel[0, :6] = [1, 0, 0, 0, 0, 0.7]
    env.world.forward()
    env._read_state()
    assert env.yaw[0] == pytest.approx(np.pi / 2)
    assert env.linear_velocity[0] == pytest.approx([0, -1, 0])
    assert env.angular_velocity[0] == pytest.approx([0, 0, 0.7])
    assert np.allclose(env.gravity, [[0, 0, -1], [np.sin(0.3), 0, -np.cos(0.3)]])


def test_steering_follows_the_heading():
    env = env_of(4)
    env.yaw, env.heading = np.array([0.0, 0.0, 3.0, 0.0]), np.array([0.5, -3.0, -3.0, np.pi])
    env._steer()
    # half the error; at most 1 rad/s; the short way round: from 3.0 on to 2 pi - 3.0
    assert env.command[:3, 2] == pytest.approx([0.25, -1.0, 0.5 * (2 * np.pi - 6.0)])
    assert abs(env.command[3, 2]) == 1.0


def test_a_command_lasts_through_falls_and_changes_between_episodes_only():
    env = env_of(2, config=EnvConfig(episode_seconds=0.2, command_seconds=0.1, start_speed=0.0))
    first = env.command[:, 0].copy()
    rest(env, 3)
    env._qpos[0, 3:7] = [0, 1, 0, 0]  # robot 0 falls before its command is old: it tries again
    assert rest(env)[2][0]
    for _ in range(6):
        assert np.array_equal(env.command[:, 0], first)  # old by then, but not within an episode
        rest(env)
    assert env.command[0, 0] == first[0] and env.command[1, 0] != first[1]  # whose time was up
    env._qpos[0, 3:7] = [0, 1, 0, 0]  # with an old command
    rest(env)
    assert env.command[0, 0] != first[0]


def test_timeout_gives_the_true_last_observation_and_restarts():
    env = env_of(2, config=EnvConfig(episode_seconds=5 * CONTROL_DT, start_speed=0.0))
    for step in range(5):
        before = env.observe().legs
        observation, _, terminated, truncated, info = rest(env)
        assert truncated.all() == (step == 4) and not terminated.any()
    assert info["truncated_ids"].tolist() == [0, 1]
    final, legs = info["final_observation"].legs, observation.legs
    assert np.array_equal(final[:, :, :-1], before[:, :, 1:])  # of the old episode
    assert np.array_equal(legs, np.repeat(legs[:, :, :1], 10, axis=2))  # of the new one
    assert info["episode_lengths"].tolist() == [5, 5] and env.age.tolist() == [0, 0]


def test_a_foot_in_the_air_for_one_step_has_not_stepped():
    env, touchdowns = env_of(1), []
    env._contacts = np.zeros(env._contacts.shape)
    for down in (1, 0, 1, 0, 0, 1):
        env._contacts[0, env._foot_sensors[0]] = down
        env._read_contacts()
        env.air_time *= ~env.foot_contact  # as `step` does after the rewards
        touchdowns.append(bool(env.touchdown[0, 0]))
    assert touchdowns == [False] * 5 + [True]


def test_air_time_of_a_fall_from_one_metre():
    """sqrt(2 m / g) = 0.452 s: all four feet touch down at once, in the 23rd step (0.46 s)."""
    env = env_of(1, config=QUIET)
    env._qpos[0, 2] = 1.0 + 0.2 * np.cos(0.8) + 0.2 * np.cos(0.7) + 0.02  # thigh, calf, foot
    for step in range(1, 25):
        *_, info = rest(env)
        assert env.touchdown.all() == env.touchdown.any() == (step == 23)
        assert env.foot_contact.all() == env.foot_contact.any() == (step >= 23)
        earned = 4 * (0.46 - 0.5) if step == 23 else 0.0
        assert info["rewards"]["foot_air_time"][0] == pytest.approx(earned)


def test_a_knee_on_the_ground_is_one_collision():
    """The trunk one thigh above it: the front right calf lies on it, other legs are folded up."""
    env = env_of(1, config=QUIET)
    angles = np.array([(0.0, 0.0, -np.pi / 2)] + 3 * [(0.0, 2.6, -2.69)])
    env._qpos[0, 2], env._qpos[0, 7:] = 0.2, angles.ravel()
    *_, info = env.step((angles - A1.default_pose).reshape(1, 12) / A1.action_scale)
    assert env.link_contact.tolist() == [[False, True] + 6 * [False]]  # thigh, calf of FR, FL, ...
    assert info["rewards"]["collision"][0] == -1.0


def test_a_push_redraws_the_horizontal_velocity_when_it_is_due():
    pushed, calm = (env_of(64, config=EnvConfig(push_seconds=0.1, push_speed=x)) for x in (1, 0))
    for _ in range(5):
        assert np.array_equal(pushed._qvel, calm._qvel)  # until now, the same
        rest(pushed)
        rest(calm)
    assert np.array_equal(pushed._qvel[:, 2:], calm._qvel[:, 2:])
    velocity = pushed._qvel[:, :2]
    assert np.abs(velocity).max() <= 1 and np.abs(velocity.mean()) < 0.2
    assert velocity.std() == pytest.approx(3**-0.5, rel=0.15)


def test_friction_is_drawn_at_every_reset_one_number_a_robot():
    env = env_of(256)
    first = env._friction[:, 1:, 0].copy()  # but for the ground
    assert (first == first[:, :1]).all()  # all parts of a robot
    assert 0.5 <= first.min() < 0.52 and 1.23 < first.max() <= 1.25
    assert first[:, 0].mean() == pytest.approx(0.875, abs=0.05)
    env._reset(np.arange(128))
    changed = env._friction[:, 1, 0] != first[:, 0]
    assert changed[:128].all() and not changed[128:].any()


def test_friction_slows_a_sliding_robot():
    """Standing on all fours and slung sideways at 2 m/s, it loses mu * g * t."""
    env, friction = env_of(2, config=QUIET), np.array([0.1, 0.3])
    env._friction[:, :, 0] = friction[:, None]
    rest(env, 40)
    env._qvel[:, 1] = 2.0
    rest(env, 3)
    assert 2.0 - env._qvel[:, 1] == pytest.approx(friction * 9.81 * 3 * CONTROL_DT, rel=0.15)


@pytest.mark.parametrize("before, after", [(np.nan, 0), (0, np.nan), (0, np.inf), (0, 1e4)])
def test_divergence_is_ended_counted_and_harms_nobody(before, after, tmp_path, monkeypatch, capfd):
    """Before the step or in its last substep, of which MuJoCo would warn too late, or never."""
    monkeypatch.chdir(tmp_path)
    env, twin = env_of(3, config=QUIET), env_of(3, config=QUIET)
    step = env.world.step

    def run_away(**how):
        env._qvel[1, 7] += before
        step(**how)
        env._qvel[1, 7] += after

    env.world.step = run_away
    observation, reward, terminated, _, info = rest(env)
    env.world.step = step
    expected, *_ = rest(twin)
    assert info["diverged"].tolist() == [False, True, False] == terminated.tolist()
    fields = *observation, *info["final_observation"], *info["rewards"].values()
    for x in (*fields, reward, info["speed"], info["position"]):
        assert (np.abs(x) < 1000).all()
    assert reward[1] == 0 and info["episode_returns"].tolist() == [0]
    assert np.array_equal(observation.legs[[0, 2]], expected.legs[[0, 2]])

    _, _, terminated, _, info = rest(env)
    assert not info["diverged"].any() and not terminated.any()
    assert not list(tmp_path.iterdir()) and capfd.readouterr().err == ""  # MuJoCo says nothing


def test_reward_terms_by_hand_scaled_by_time_and_floored_and_standing_earns_no_air_time():
    state = SimpleNamespace(
        command=np.array([[0.5, 0.0, 0.2]]),
        linear_velocity=np.array([[0.2, 0.4, 0.3]]),  # error (-0.3, 0.4): squared norm 0.25
        angular_velocity=np.array([[0.1, -0.2, 0.7]]),  # yaw error 0.5: squared 0.25
        link_contact=np.array([[True, False, False, True, False, False, False, True]]),
        torque=np.full((1, 4, 3), 2.0),  # 12 * 4 = 48
        action=np.full((1, 4, 3), 0.5),
        last_action=np.full((1, 4, 3), 0.4),  # 12 * 0.01 = 0.12
        touchdown=np.array([[True, False, True, False]]),
        air_time=np.array([[0.7, 0.9, 0.4, 0.0]]),  # (0.7 - 0.5) + (0.4 - 0.5) = 0.1
        joint_error=np.full((1, 4, 3), -0.1),  # 12 * 0.01 = 0.12
    )
    reward, terms = rewards.total_reward(state, 0.02)
    assert {name: term[0] for name, term in terms.items()} == pytest.approx({
        "xy_velocity_tracking": 1.5 * np.exp(-1),
        "yaw_velocity_tracking": 0.5 * np.exp(-1),
        "z_velocity": -2.0 * 0.09,
        "roll_pitch_velocity": -0.05 * 0.05,
        "collision": -1.0 * 3,
        "joint_torques": -2e-4 * 48,
        "action_rate": -0.01 * 0.12,
        "foot_air_time": 1.0 * 0.1,
        "joint_error": -0.04 * 0.12,
    })  # fmt: skip
    assert reward[0] == 0.0

    state.link_contact[:] = False
    reward, terms = rewards.total_reward(state, 0.02)
    assert reward[0] == pytest.approx(0.02 * sum(t[0] for t in terms.values())) and reward[0] > 0
    state.command = np.array([[0.0, 0.05, 0.9]])
    assert rewards.total_reward(state, 0.02)[1]["foot_air_time"][0] == 0.0
