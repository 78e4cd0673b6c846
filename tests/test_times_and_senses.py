"""Faults that come and go, motors that are late, loads, blows, and sensors that fail."""

import mujoco
import numpy as np
import pytest

from conftest import env_of, env_with, flail, go_on_alike, rest
from faults import HEALTHY, fault_now, faulty_model
from robots import A1, build_model

ALL = (
    "lock:FR_calf@0.1:0.2+payload:trunk:2@0.1:0.2+blow:trunk:3@0.14:+late:RL:0.02@0.1:0.2"
    "+bias:FL:0.2@0.1:0.2+freeze:RR@0.1:0.2+weaken:FL:0.5@0.1:0.2+mute:RL@0.1:0.2"
)


def test_a_fault_strikes_and_goes_to_the_step_and_critics_are_told(rng):
    """0.1 s is 5 steps, 0.2 s 10; the next episode begins healthy."""
    fault, bias = "lock:FR_calf@0.1:0.2+payload:trunk:2@0.1:0.2", "bias:FL:0.2"
    env = env_with(fault, bias, extras=("privileged",))
    told = np.array([flail(env, rng)[0].privileged[:, [2, -2, -1]] for _ in range(12)])
    assert told[:, 0].tolist() == [[0, 0, 0]] * 5 + [[1, 0, 2]] * 5 + [[0, 0, 0]] * 2
    assert np.allclose(told[:, 1], [0, 0.2, 0])

    for _ in range(8):
        env.reset()
        assert not env.world.bind("eq_active").any() and env.fault_now == [HEALTHY, bias]
        flail(env, rng, 6)
        assert env.fault_now == ["lock:FR_calf+payload:trunk:2", bias]


def test_a_lock_that_strikes_holds_where_it_is_also_when_another_fault_comes(rng):
    env = env_with("lock:FR_calf@0.1:+weaken:RL:0.5@0.2:")
    flail(env, rng, 5)
    before = env.joint_error[0, 0, 2]
    flail(env, rng)
    seat = env.fault_writer.values["eq_data"][0, 2, 0]
    flail(env, rng, 24)
    assert env.fault_now[0].count("+") == 1 and env.fault_writer.values["eq_data"][0, 2, 0] == seat
    assert abs(before) > 0.03 and env.joint_error[0, 0, 2] == pytest.approx(before, abs=0.01)


def test_an_env_goes_on_to_the_bit_amid_faults_and_when_they_end_nothing_is_left_behind(rng):
    """Given their state then, a robot whose faults never come goes on alike."""
    whole, again = env_with(ALL, HEALTHY), env_with(ALL, HEALTHY)
    flail(whole, rng, 8)
    assert whole.fault_now[0].count("+") == 7  # all of them
    again.load_state_dict(whole.state_dict())
    go_on_alike(whole, again, rng, 3)

    later = ALL.replace("@0.1:0.2", "@8:9").replace("@0.14", "@8")
    other = env_with(later, HEALTHY)
    flail(other, rng)
    other.world.state[:] = whole.world.state
    for env in (whole, other):
        flail(env, np.random.default_rng(1), 20)
    assert np.array_equal(whole.world.bind("qpos"), other.world.bind("qpos"))
    assert np.array_equal(whole._newest_step()[..., :6], other._newest_step()[..., :6])


def test_what_comes_and_goes_repeats_with_the_seed():
    """0.2 s of every second: 10 steps of 50 in a row, at moments that differ."""
    fault = "lock:FR_calf@0.2/1"
    pattern, again, other = (
        np.array([fault_now(fault, t, luck) != HEALTHY for t in range(500)])
        for luck in ((3, 1), (3, 1), (3, 2))
    )
    assert pattern.reshape(10, 50).sum(axis=1).tolist() == [10] * 10
    starts = np.flatnonzero(np.diff(pattern, prepend=False) & pattern) % 50
    assert len(starts) == 10 and len(set(starts.tolist())) > 5
    assert np.array_equal(again, pattern) and not np.array_equal(other, pattern)


def test_a_late_motor_counts_in_steps_of_the_simulation():
    """10 ms are 2 of 5 ms; before the first target it holds the default pose, as all do."""
    env, forces = env_with("late:FR_hip:0.01", HEALTHY), []
    env.world.bind("ctrl")[:, 0] = 0.5  # rad, asked of both
    for _ in range(4):
        env.world.step(nstep=1)
        forces.append(env.world.bind("actuator_force")[:, 0].copy())
    late, prompt = np.array(forces).T
    assert prompt[0] > 8 and (abs(late[:2]) < 0.5).all() and late[2] > 8


def test_a_payload_is_felt():
    """2 kg of 12.453 more in the trunk: the weight, and what it takes to turn what hangs on it."""
    healthy = build_model(A1)
    model = faulty_model("payload:trunk:2", A1, healthy)
    assert model.body_subtreemass[1] == pytest.approx(healthy.body_subtreemass[1] + 2)
    env = env_with("payload:trunk:2", HEALTHY)
    env.world.forward()
    weight = env.world.bind("qfrc_bias")[:, 2]
    assert weight == pytest.approx([14.453 * 9.81, 12.453 * 9.81], abs=0.01)


def test_a_blow_gives_its_impulse_once():
    """In free fall: 5 N s on 12.453 kg to the left, all of it in one control step."""
    env, momentum = env_with("blow:trunk:5@0.04:", HEALTHY), ([], [])
    env.world.bind("qpos")[:, 2] = 5.0
    for _ in range(5):
        rest(env)
        for i in (0, 1):
            robot = env.world.get_data(i)
            mujoco.mj_subtreeVel(env.model, robot)
            momentum[i].append(12.453 * robot.subtree_linvel[1, 1])
    assert momentum[0] == pytest.approx([0, 0, 5, 5, 5], abs=0.02)
    assert momentum[1] == pytest.approx([0] * 5, abs=1e-6)


def test_senses_change_what_is_seen_and_not_what_moves(rng):
    faults = "freeze:FR_calf@0.1:", "bias:FL:0.2", "mute:RR", "imu:trunk:0.1", "odometry:trunk:0.5"
    env = env_with(HEALTHY, *faults)
    for step in range(20):
        observation, *_ = env.step(np.tile(rng.normal(size=(1, 12)), (6, 1)))
        if step == 5:
            held = env.joint_error[0, 0, 2], env.joint_velocity[0, 0, 2]  # the first one it missed
    qpos = env.world.bind("qpos")
    assert (qpos == qpos[0]).all()  # the same motion of all
    healthy, frozen, biased, mute, tilted, slow = observation.legs[:, :, -1]
    assert frozen[0, [2, 5]] == pytest.approx([4 * held[0], 0.2 * held[1]], rel=1e-5)
    assert frozen[0, 2] != healthy[0, 2] and frozen[1:].tolist() == healthy[1:].tolist()
    beyond = biased[1, :3] - healthy[1, :3]  # of a left leg: the hip is mirrored
    assert beyond == pytest.approx([-0.8, 0.8, 0.8], abs=1e-5)
    assert biased[1, 3:].tolist() == healthy[1, 3:].tolist()
    assert mute[2, :6].tolist() == [0] * 6 and mute[2, 6:].tolist() == healthy[2, 6:].tolist()
    assert slow[:, 12:15] == pytest.approx(healthy[:, 12:15] / 2)
    x, y, z = env.gravity[0]
    c, s = np.cos(0.1), np.sin(0.1)
    told = [5 * (c * x - s * z), 5 * y, 5 * (s * x + c * z + 1)]
    assert tilted[0, 18:21] == pytest.approx(told, abs=1e-4)


def test_what_freezes_again_after_a_reset_holds_its_own_reading(rng):
    env = env_of(1, faults=[(1.0, "freeze:FR_calf")])
    readings = []
    for _ in range(2):  # poses at the start vary
        readings.append(env.reset().legs[0, 0, -1, 2])
        assert readings[-1] == pytest.approx(4 * env.joint_error[0, 0, 2])
        for _ in range(5):
            assert flail(env, rng)[0].legs[0, 0, -1, 2] == readings[-1]
    assert readings[0] != readings[1]
