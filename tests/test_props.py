"""The real-world test's half-lock, box and skates: what they do, to whom, and that a reset undoes
them."""

import csv

import mujoco
import numpy as np
import pytest

from baselines import make_policy
from env import EnvConfig, LocomotionEnv
from faults import REAL_WORLD, half_lock, healthy, lock, parse, skate, tow, weaken
from robots import A1, BOX_FRICTION, BOX_MASS, GO1, ROBOTS, SLACK, TETHER, build_model

QUIET = EnvConfig(push_speed=0.0, start_speed=0.0, start_pose=(1.0, 1.0), friction=(1.0, 1.0))


def make(*faults, robot="go1", config=QUIET):
    """An env of one robot a fault, just reset."""
    env = LocomotionEnv(robot, len(faults), 0, 1, [(1.0, fault) for fault in faults], config)
    env.pin_faults(list(faults))
    env.reset()
    return env


def test_go1_weighs_and_turns_what_its_source_says():
    model = build_model(GO1)
    assert model.body_mass.sum() == pytest.approx(12.743, abs=1e-3)
    for link, low, high, effort in (("hip", -0.863, 0.863, 23.7), ("thigh", -0.686, 4.501, 23.7), ("calf", -2.818, -0.888, 35.55)):
        for leg in GO1.legs:
            assert model.joint(f"{leg}_{link}").range == pytest.approx([low, high])
            assert model.actuator(f"{leg}_{link}").forcerange == pytest.approx([-effort, effort])


@pytest.mark.parametrize("robot", ROBOTS)
def test_without_such_faults_nothing_is_added(robot):
    """A healthy robot among others with props: the same motion, but for the solver's rounding."""
    env, other = make(healthy(), robot=robot), make(healthy(), tow(ROBOTS[robot].legs[2]), robot=robot)
    joints = env.num_actions
    assert (env.model.nq, env.model.nv, env.model.ntendon, env.model.neq) == (joints + 7, joints + 6, 0, joints)
    assert other.model.nq == joints + 14
    env._qvel[:, :6] = other._qvel[0, :6]
    action = np.random.default_rng(0).normal(size=(30, joints))
    for a in action:
        env.step(a[None])
        other.step(np.stack([a, a]))
    assert other._qpos[0, : joints + 7] == pytest.approx(env._qpos[0], abs=1e-5)
    assert not np.allclose(other._qpos[0, :7], env.model.key_qpos[0, :7], atol=0.01)  # it did move


@pytest.mark.parametrize("tied", [True, False])
def test_the_tether_pulls_and_never_pushes(tied):
    """In the air and without weight, the tether alone moves the box: set 1 m off, at its length,
    and at the foot."""
    model = build_model(A1, towing=("RR",))
    model.opt.gravity[:] = 0
    tether = model.tendon("RR_tether").id
    model.tendon_range[tether, 1] = TETHER if tied else SLACK
    data, box = mujoco.MjData(model), model.joint("box")
    for distance, speed, pulls in ((1.0, 0.0, True), (0.78, 0.0, False), (0.3, -3.0, False), (0.01, -1.0, False), (1.0, -0.2, True)):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[2] += 1.0
        mujoco.mj_kinematics(model, data)
        front = data.site("RR_ankle").xpos - [distance, 0, 0]
        data.qpos[box.qposadr[0] : box.qposadr[0] + 3] = front - model.site("box_front").pos
        data.qvel[box.dofadr[0]] = -speed  # backwards, away from the robot, if speed > 0
        mujoco.mj_forward(model, data)
        assert data.ten_length[tether] == pytest.approx(distance, abs=1e-6)
        force = data.efc_force[data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON]
        assert (force >= 0).all() and (force.sum() > 1) == (pulls and tied)
        towards_robot = data.qfrc_constraint[box.dofadr[0]]
        assert towards_robot == pytest.approx(force.sum(), abs=1e-6)
        assert data.qfrc_constraint[0] == pytest.approx(-force.sum(), abs=1e-6)  # and the robot backwards


def test_the_box_hangs_on_its_own_robot_alone():
    """A hand pulls both boxes away with 10 N more than their friction: one robot holds its box, the
    other has none."""
    env = make(tow("RR"), healthy(), config=EnvConfig(push_speed=0.0, start_speed=0.0, friction=(1.25, 1.25)))
    box = env.model.body("box").id
    assert env.world.expanded("geom_friction")[:, env.model.geom("box").id, 0] == pytest.approx(BOX_FRICTION)
    assert env.model.body("box").mass == pytest.approx(BOX_MASS)
    for _ in range(100):
        env.world.bind("xfrc_applied")[:, box, 0] = -(BOX_FRICTION * BOX_MASS * 9.81 + 10)
        assert not env.step(np.zeros((2, 12)))[2].any()
    tether = env.world.bind("ten_length")[:, 0]
    assert tether[0] == pytest.approx(TETHER, abs=0.02) and tether[1] > TETHER + 1


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_tether_is_taut_before_the_robot_walks(robot):
    faults = [tow(leg) for leg in ROBOTS[robot].legs] * 5
    env = make(*faults, robot=robot, config=EnvConfig())
    length, reach = env.world.bind("ten_length"), env.world.expanded("tendon_range")[:, :, 1]
    assert (length < reach).all() and ((reach < SLACK).sum(axis=1) == 1).all()


def test_a_half_lock_stops_one_side_only():
    """The calf asked to open by 0.5 rad stays at the string; asked to bend by 0.5 rad it goes like
    a healthy one."""
    for target, stopped in ((-1.0, True), (-2.0, False)):
        env = make(half_lock("RR_calf", -1.5), healthy())
        action = np.zeros((2, 4, 3))
        action[:, 2, 2] = (target + 1.5) / GO1.action_scale
        for _ in range(40):
            env._qpos[:, :7], env._qvel[:, :6] = [0, 0, 1, 1, 0, 0, 0], 0  # held in the air
            env.step(action.reshape(2, 12))
            assert env.joint_error[0, 2, 2] < 0.05  # a string gives a little when the leg swings into it
        half_locked, free = env.joint_error[:, 2, 2]
        assert free == pytest.approx(target + 1.5, abs=0.05)
        assert half_locked == pytest.approx(0.0 if stopped else free, abs=0.03)  # 1 degree at 10 N m


def test_a_half_locked_leg_starts_on_the_right_side_of_its_string():
    env = make(*[half_lock("RR_calf", -1.5)] * 50, config=EnvConfig())
    assert (env.joint_error[:, 2, 2] <= 1e-9).all() and (env.joint_error[:, 3, 2] > 0.1).any()


def test_a_skate_rolls_forward_grips_sideways_and_acts_on_its_foot_alone():
    """A standing robot's feet, pushed for half a second, forward or sideways: only the skate's
    moves, only forward."""
    for axis, rolls in ((0, True), (1, False)):
        env = make(skate("FR"), healthy())
        for _ in range(50):
            env.step(np.zeros((2, 12)))  # settle
        names = [env.model.geom(f"{leg}_foot").id for leg in GO1.legs]
        before, wheel = env.world.bind("geom_xpos")[:, names, axis].copy(), env.model.body("FR_wheel").id
        for _ in range(25):
            env.world.bind("xfrc_applied")[:, wheel, axis] = 12.0  # N, through the axle
            env.step(np.zeros((2, 12)))
        moved = np.abs(env.world.bind("geom_xpos")[:, names, axis] - before)
        assert (moved[0, 0] > 0.05) == rolls
        assert (moved[1] < 0.02).all() and (moved[0, 1:] < 0.02).all() and moved[0, 0] < 0.3


def test_reset_undoes_half_lock_box_and_skates():
    env = make(*(REAL_WORLD[name] for name in ("weaken", "box", "skates")))
    assert (env.world.expanded("jnt_range") != env.model.jnt_range).any(axis=(1, 2)).tolist() == [True, False, False]
    assert (env.world.expanded("tendon_range") != env.model.tendon_range).any(axis=(1, 2)).tolist() == [False, True, False]
    assert (env.world.expanded("dof_frictionloss") != env.model.dof_frictionloss).any(axis=1).tolist() == [False, False, True]
    for _ in range(20):
        env.step(np.random.default_rng(0).normal(size=(3, 12)))
    env.pin_faults([healthy()] * 3)
    env.reset()
    for field in ("jnt_range", "tendon_range", "dof_frictionloss"):
        assert np.array_equal(env.world.expanded(field), np.stack([getattr(env.model, field)] * 3))
    assert np.array_equal(env._qpos[:, -7:], np.stack([env.model.key_qpos[0, -7:]] * 3))  # the box is back


def test_it_goes_on_to_the_bit_with_a_box_and_skates():
    faults = [(0.5, tow("RR")), (0.5, skate("FR") + half_lock("RL_calf", -1.6))]
    env, twin = (LocomotionEnv("go1", 4, 1, 1, faults) for _ in range(2))
    env.reset()
    actions = np.random.default_rng(0).normal(size=(30, 4, 12))
    for action in actions[:15]:
        env.step(action)
    twin.load_state_dict(env.state_dict())
    for action in actions[15:]:
        assert np.array_equal(env.step(action)[0].legs, twin.step(action)[0].legs)


def test_their_names_read_back():
    thirds = weaken("FR", 1 / 3) + half_lock("RR_calf", -4 / 3)  # to the last digit
    for fault in (*REAL_WORLD.values(), thirds, lock("FR_calf") + weaken("RL", 0.5) + tow("RR") + skate("FL")):
        assert parse(str(fault)) == fault
    assert str(REAL_WORLD["weaken"]) == "weaken:FL:0.5+half-lock:RR_calf:-1.5"


@pytest.mark.parametrize("text", ["half-lock:RR_calf", "half-lock:RR_calf:nan", "half-lock:RR_calf:x", "tow", "skate:FR:2"])
def test_unreadable_ones_are_refused(text):
    with pytest.raises(ValueError, match="half-lock:RR_calf:-1.5"):
        parse(text)


@pytest.mark.parametrize(
    "fault, says",
    [
        (half_lock("RR_calf", 0.5), "RR_calf turns from -2.818 to -0.888 rad: no stop at 0.5"),
        (half_lock("MR_calf", -1.5), "no joint or leg 'MR_calf'"),
        (tow("MR"), "no leg MR"),
        (skate("FR_calf"), "no leg FR_calf"),
    ],
)
def test_what_the_robot_does_not_have_is_refused(fault, says):
    with pytest.raises(ValueError, match=says):
        make(fault)


def test_a_box_that_was_not_built_is_refused():
    env = make(healthy())
    env.pin_faults([tow("RR")])
    with pytest.raises(ValueError, match="no box or wheel for tow:RR: make the env with this fault"):
        env.reset()
