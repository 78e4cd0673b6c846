"""The real-world test's half-lock, box and skates: what they do, to whom; resets undo all."""

import mujoco
import numpy as np
import pytest

from env import EnvConfig, LocomotionEnv
from faults import HEALTHY, REAL_WORLD
from robots import A1, BOX_FRICTION, BOX_MASS, GO1, SLACK, TETHER, build_model

QUIET = EnvConfig(push_speed=0.0, start_speed=0.0, start_pose=(1.0, 1.0), friction=(1.0, 1.0))


def make(*faults, robot="go1", config=QUIET):
    """An env of one robot a fault, just reset."""
    env = LocomotionEnv(robot, len(faults), 0, 1, [(1.0, fault) for fault in faults], config)
    env.pin_faults(list(faults))
    env.reset()
    return env


@pytest.mark.parametrize("tied", [True, False])
def test_the_tether_pulls_and_never_pushes(tied):
    """Without weight the tether alone moves the box: set 1 m off, at its length, at the foot."""
    model = build_model(A1, towing=("RR",))
    model.opt.gravity[:] = 0
    tether = model.tendon("RR_tether").id
    model.tendon_range[tether, 1] = TETHER if tied else SLACK
    data, box = mujoco.MjData(model), model.joint("box")
    slack = (0.78, 0.0, False), (0.3, -3.0, False), (0.01, -1.0, False)
    for distance, speed, pulls in ((1.0, 0.0, True), *slack, (1.0, -0.2, True)):
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
        towards_robot, on_robot = data.qfrc_constraint[[box.dofadr[0], 0]]
        assert towards_robot == pytest.approx(force.sum(), abs=1e-6)
        assert on_robot == pytest.approx(-force.sum(), abs=1e-6)  # backwards


def test_the_box_hangs_on_its_own_robot_alone():
    """Both boxes are pulled by 10 N more than their friction; the second robot has none."""
    config = EnvConfig(push_speed=0.0, start_speed=0.0, friction=(1.25, 1.25))
    env = make("tow:RR", HEALTHY, config=config)
    box, geom = env.model.body("box").id, env.model.geom("box").id
    assert env.world.expanded("geom_friction")[:, geom, 0] == pytest.approx(BOX_FRICTION)
    assert env.model.body("box").mass == pytest.approx(BOX_MASS)
    for _ in range(100):
        env.world.bind("xfrc_applied")[:, box, 0] = -(BOX_FRICTION * BOX_MASS * 9.81 + 10)
        assert not env.step(np.zeros((2, 12)))[2].any()
    tether = env.world.bind("ten_length")[:, 0]
    assert tether[0] == pytest.approx(TETHER, abs=0.02) and tether[1] > TETHER + 1


def test_a_half_lock_stops_one_side_only():
    """Asked to open by 0.5 rad the calf stays at the string; it bends like a healthy one."""
    for target, stopped in ((-1.0, True), (-2.0, False)):
        env = make("half-lock:RR_calf:-1.5", HEALTHY)
        action = np.zeros((2, 4, 3))
        action[:, 2, 2] = (target + 1.5) / GO1.action_scale
        for _ in range(40):
            env._qpos[:, :7], env._qvel[:, :6] = [0, 0, 1, 1, 0, 0, 0], 0  # held in the air
            env.step(action.reshape(2, 12))
            assert env.joint_error[0, 2, 2] < 0.05  # a string gives when the leg swings into it
        half_locked, free = env.joint_error[:, 2, 2]
        assert free == pytest.approx(target + 1.5, abs=0.05)
        expected = 0.0 if stopped else free
        assert half_locked == pytest.approx(expected, abs=0.03)  # 1 degree at 10 N m


def test_a_half_locked_leg_starts_on_the_right_side_of_its_string():
    env = make(*["half-lock:RR_calf:-1.5"] * 50, config=EnvConfig())
    assert (env.joint_error[:, 2, 2] <= 1e-9).all() and (env.joint_error[:, 3, 2] > 0.1).any()


def test_a_skate_rolls_forward_grips_sideways_and_acts_on_its_foot_alone():
    """Standing feet are pushed for half a second: only the skate moves, and only forward."""
    for axis, rolls in ((0, True), (1, False)):
        env = make("skate:FR", HEALTHY)
        for _ in range(50):
            env.step(np.zeros((2, 12)))  # settle
        names = [env.model.geom(f"{leg}_foot").id for leg in GO1.legs]
        before = env.world.bind("geom_xpos")[:, names, axis].copy()
        wheel = env.model.body("FR_wheel").id
        for _ in range(25):
            env.world.bind("xfrc_applied")[:, wheel, axis] = 12.0  # N, through the axle
            env.step(np.zeros((2, 12)))
        moved = np.abs(env.world.bind("geom_xpos")[:, names, axis] - before)
        assert (moved[0, 0] > 0.05) == rolls
        assert (moved[1] < 0.02).all() and (moved[0, 1:] < 0.02).all() and moved[0, 0] < 0.3


def test_reset_undoes_every_fault():
    """Healthy again, a robot's model fields are the healthy model's, to the bit."""
    stiff = "lock:FR_calf+disable:FL_thigh+weaken:RR:0.3"
    env = make(stiff, *(REAL_WORLD[name] for name in ("weaken", "box", "skates")))
    changed = {
        "actuator_gainprm": [True, True, False, False],
        "actuator_biasprm": [True, True, False, False],
        "actuator_forcerange": [True, True, False, False],
        "jnt_range": [False, True, False, False],
        "tendon_range": [False, False, True, False],
        "dof_frictionloss": [False, False, False, True],
    }
    healthy_one = {name: np.stack([getattr(env.model, name)] * 4) for name in changed}
    for name, whose in changed.items():
        differs = env.world.expanded(name) != healthy_one[name]
        assert differs.reshape(4, -1).any(axis=1).tolist() == whose, name
    assert env.world.bind("eq_active").any(axis=1).tolist() == [True, False, False, False]
    for _ in range(20):
        env.step(np.random.default_rng(0).normal(size=(4, 12)))
    env.pin_faults([HEALTHY] * 4)
    env.reset()
    assert not env.world.bind("eq_active").any()
    for name, value in healthy_one.items():
        assert np.array_equal(env.world.expanded(name), value)
    box = np.stack([env.model.key_qpos[0, -7:]] * 4)
    assert np.array_equal(env._qpos[:, -7:], box)  # it is back


@pytest.mark.parametrize(
    "fault, says",
    [
        ("half-lock:RR_calf:0.5", "RR_calf turns from -2.818 to -0.888 rad: no stop at 0.5"),
        ("half-lock:MR_calf:-1.5", "no joint or leg 'MR_calf'"),
        ("lock:MR_calf", "no joint or leg 'MR_calf'; it has FR_hip, FR_thigh"),
        ("tow:MR", "no leg MR"),
    ],
)
def test_what_the_robot_does_not_have_is_refused(fault, says):
    with pytest.raises(ValueError, match=says):
        make(fault)


def test_a_box_that_was_not_built_is_refused():
    env = make(HEALTHY)
    env.pin_faults(["tow:RR"])
    with pytest.raises(ValueError, match="no RR, box or wheel for tow:RR: make the env with this"):
        env.reset()
