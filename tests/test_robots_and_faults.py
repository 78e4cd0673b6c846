"""The model against its data sheet, and faults on simulated robots: what they do, and to whom."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from conftest import QUIET, env_of, env_with, flail, rest
from env import EnvConfig
from faults import HEALTHY, REAL_WORLD, TASKS, faulty_model
from robots import A1, BOX_FRICTION, BOX_MASS, GO1, ROBOTS, SLACK, TETHER, build_model


@pytest.mark.parametrize("name, total, leg", [
    ("a1", 12.453, (0.696, 1.013, 0.226)),
    ("go1", 12.743448, (0.68, 1.009, 0.195862)),
    ("hexapod", 30.508951, (1.20924, 0.925235, 0.281487 + 0.0190129)),  # foot and calf are one
])  # fmt: skip
def test_model_agrees_with_the_data_and_weighs_what_its_source_says(name, total, leg):
    """kg; Unitree's and the ElSpider Air's descriptions, of which a leg weighs 2.435."""
    robot, model = ROBOTS[name], build_model(ROBOTS[name])
    joints = len(robot.joints)
    assert (model.nu, model.neq, model.nv) == (joints, joints, joints + 6)
    assert model.body_mass.sum() == pytest.approx(total, abs=1e-4)
    for i, joint in enumerate(robot.joints):
        link, left = robot.links[i % 3], robot.mounts[i // 3][1] > 0
        turned = left and link.axis[1] == 0  # about x or z: left is right the other way round
        limits = [-x for x in link.limits[::-1]] if turned else link.limits
        assert model.actuator(i).name == model.equality(i).name == joint
        assert model.joint(joint).range == pytest.approx(limits)
        assert model.actuator(i).forcerange == pytest.approx([-link.effort, link.effort])
        assert model.body(joint).mass[0] == pytest.approx(leg[i % 3], abs=1e-6)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_legs_are_mirror_images(robot):
    data = mujoco.MjData(build_model(robot))
    mujoco.mj_resetDataKeyframe(data.model, data, 0)
    mujoco.mj_forward(data.model, data)
    centres = np.array([data.body(joint).xipos for joint in robot.joints])
    feet = np.array([data.geom(f"{leg}_foot").xpos for leg in robot.legs])
    swap = [robot.mounts.index((x, -y, z)) for x, y, z in robot.mounts]
    for places in (feet, centres.reshape(len(swap), -1, 3)):
        assert places[swap] == pytest.approx(places * [1, -1, 1], abs=1e-6)


def test_a_robot_that_does_not_fit_together_is_refused_and_a_box_that_was_not_built():
    for change in ({"legs": A1.legs[:3]}, {"links": A1.links[:2]}):
        with pytest.raises(ValueError, match="zip"):
            build_model(replace(A1, **change))
    with pytest.raises(ValueError, match="the first leg must be a right one"):
        replace(A1, mounts=A1.mounts[::-1])
    env = env_with(HEALTHY)
    env.pin_faults(["tow:RR"])
    with pytest.raises(ValueError, match="no RR for tow:RR; boxes and wheels"):
        env.reset()


@pytest.mark.parametrize("robot", ROBOTS)
def test_stands_under_zero_action(robot):
    env = env_of(2, robot, QUIET)
    for _ in range(150):
        assert not rest(env)[2].any()
    assert env.foot_contact.all() and not env.link_contact.any()
    assert env.gravity[:, 2] == pytest.approx(-1, abs=0.01)


def test_a_locked_joint_holds_under_20_kg_while_the_policy_flails(rng):
    env = env_with("lock:FR_calf")
    trunk = env.model.body("trunk").id
    for _ in range(100):
        env.world.bind("xfrc_applied")[:, trunk, 2] = -20 * 9.81  # N; a reset clears it
        flail(env, rng)
        assert abs(env.joint_error[0, 0, 2]) < 0.01


def test_weak_motor_gives_its_share_of_the_torque():
    """Same state, same target: half the strength is half the force, and half the clipping limit."""
    env = env_with("weaken:FL:0.5", HEALTHY, "disable:RL_thigh")
    for action in (0.5, 10.0):  # 10: 2.5 rad away, 50 N m asked of 33.5
        env.world.bind("ctrl")[:] = (env._default + 0.25 * action).reshape(-1)
        env.world.forward(stage=mujoco.mjtStage.mjSTAGE_ACC)
        weak, strong, dead = env.torque
        assert weak[1] == pytest.approx(0.5 * strong[1])
        assert weak[0] == pytest.approx(strong[0])
        assert dead[3, 1] == 0.0 != strong[3, 1] and dead[3, 2] == pytest.approx(strong[3, 2])
    assert strong[1].max() == pytest.approx(33.5)


def test_training_faults_are_drawn_with_their_odds():
    locked = env_of(400, faults=TASKS["stiffness"].training).world.bind("eq_active") > 0
    assert 160 < locked[:, 2].sum() < 240  # 200 +- 4 sd
    assert locked.sum() == locked[:, 2].sum()  # nothing else is locked


def test_faults_add_up():
    healthy, both = build_model(A1), "lock:FR_calf+weaken:RL:0.5+weaken:RL_hip:0.5"
    model = faulty_model(both, A1, healthy)
    share = model.actuator_forcerange[:, 1] / healthy.actuator_forcerange[:, 1]
    assert share.tolist() == [1, 1, 0] + [1] * 6 + [0.25, 0.5, 0.5]
    assert model.eq_active0.nonzero()[0].tolist() == [2] and not healthy.eq_active0.any()


def test_critics_are_told_of_every_harm():
    """Locks, motors and friction read off the simulation, else by number; ROAM of which it is."""
    faults = ["healthy", "lock:FR_calf", "weaken:FL:0.5", "half-lock:RR_calf:-1.5", "skate:FR"]
    env = env_with(*faults, config=EnvConfig(), extras=("privileged", "situation"))
    observation = env.observe()
    assert observation.situation.tolist() == [[0], [1], [2], [3], [4]]
    locked, motors, friction, others = np.split(observation.privileged, [12, 24, 25], axis=1)
    assert np.argwhere(locked).tolist() == [[1, 2]]
    assert np.argwhere(motors != 1).tolist() == [[1, 2], [2, 3], [2, 4], [2, 5]]
    assert motors[1, 2] == 0 and motors[2, 3:6].tolist() == [0.5] * 3
    assert friction[:, 0].tolist() == env._friction[:, 1, 0].astype(np.float32).tolist()
    assert others.tolist() == [[0, 0], [0, 0], [0, 0], [-1.5, 0], [0, 1]]


@pytest.mark.parametrize("text, says", [
    *((text, "as in lock:FR_calf") for text in (
        "", "lock", "weaken:RL", "weaken:RL:x", "weaken:RL:nan", "melt:FR", "tow",
        "half-lock:RR_calf", "half-lock:RR_calf:nan", "half-lock:RR_calf:x", "skate:FR:2",
        "lock:FR_calf@5", "lock:FR_calf@nan:", "lock:FR_calf@5:inf")),
    ("weaken:RL:2", "from 0 to 1"), ("late:FR:-0.01", "from 0 to 0.04"),
    ("late:FR:0.05", "from 0 to 0.04"), ("bias:FR:nan", "from -7 to 7"),
    ("blow:trunk:inf", "from -100 to 100"), ("blow:trunk:5", "when is the blow"),
    ("lock:FR_calf@12:5", "a later end"), ("lock:FR_calf@-1:5", "a later end"),
    ("lock:FR_calf@2/1", "not shorter"), ("lock:", "no joint or leg"),
    ("bias:XX:0.1", "no joint or leg"), ("half-lock:MR_calf:-1.5", "no joint or leg 'MR_calf'"),
    ("lock:MR_calf", "no joint or leg 'MR_calf'; it has FR_hip, FR_thigh"),
    ("tow:MR", "no leg MR"), ("payload:roof:1", "no roof"),
    ("half-lock:RR_calf:0.5", "RR_calf turns from -2.818 to -0.888 rad: no stop at 0.5"),
])  # fmt: skip
def test_faults_that_cannot_be_are_refused_at_once(text, says):
    """Also if their time comes later."""
    with pytest.raises(ValueError, match=says):
        env_with(text, robot="go1")
    if "@" not in text and says != "when is the blow":
        with pytest.raises(ValueError, match=says):
            env_with(text + "@5:", robot="go1")


@pytest.mark.parametrize("tied", [True, False])
def test_the_tether_pulls_and_never_pushes(tied):
    """Without weight the tether alone moves the box: set 1 m off, at its length, at the foot."""
    model = build_model(A1, towing=("RR",))
    model.opt.gravity[:] = 0
    tether = model.tendon("RR_tether").id
    model.tendon_range[tether, 1] = TETHER if tied else SLACK
    data, box = mujoco.MjData(model), model.joint("box")
    for distance, speed in ((1.0, 0.0), (0.78, 0.0), (0.3, -3.0), (0.01, -1.0), (1.0, -0.2)):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[2] += 1.0
        mujoco.mj_kinematics(model, data)
        front = data.site("RR_ankle").xpos - [distance, 0, 0]
        data.qpos[box.qposadr[0] : box.qposadr[0] + 3] = front - model.site("box_front").pos
        data.qvel[box.dofadr[0]] = -speed  # backwards, away from the robot, if speed > 0
        mujoco.mj_forward(model, data)
        assert data.ten_length[tether] == pytest.approx(distance, abs=1e-6)
        force = data.efc_force[data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON]
        assert (force >= 0).all() and (force.sum() > 1) == (tied and distance == 1.0)
        towards_robot, on_robot = data.qfrc_constraint[[box.dofadr[0], 0]]
        assert towards_robot == pytest.approx(force.sum(), abs=1e-6)
        assert on_robot == pytest.approx(-force.sum(), abs=1e-6)  # backwards


def test_the_box_hangs_on_its_own_robot_alone():
    """Both boxes are pulled by 10 N more than their friction; the second robot has none."""
    env = env_with("tow:RR", HEALTHY, robot="go1", config=replace(QUIET, friction=(1.25, 1.25)))
    box, geom = env.model.body("box").id, env.model.geom("box").id
    assert env.world.expanded("geom_friction")[:, geom, 0] == pytest.approx(BOX_FRICTION)
    assert env.model.body("box").mass == pytest.approx(BOX_MASS)
    for _ in range(100):
        env.world.bind("xfrc_applied")[:, box, 0] = -(BOX_FRICTION * BOX_MASS * 9.81 + 10)
        assert not rest(env)[2].any()
    tether = env.world.bind("ten_length")[:, 0]
    assert tether[0] == pytest.approx(TETHER, abs=0.02) and tether[1] > TETHER + 1


def test_a_half_lock_stops_one_side_only_and_legs_start_on_the_other():
    """Asked to open by 0.5 rad the calf stays at the string; it bends like a healthy one."""
    for asked in (0.5, -0.5):
        env, action = env_with("half-lock:RR_calf:-1.5", HEALTHY, robot="go1"), np.zeros((2, 4, 3))
        action[:, 2, 2] = asked / GO1.action_scale
        for _ in range(40):
            env._qpos[:, :7], env._qvel[:, :6] = [0, 0, 1, 1, 0, 0, 0], 0  # held in the air
            env.step(action)
            assert env.joint_error[0, 2, 2] < 0.05  # a string gives when the leg swings into it
        half_locked, free = env.joint_error[:, 2, 2]
        assert free == pytest.approx(asked, abs=0.05)
        assert half_locked == pytest.approx(min(0.0, free), abs=0.03)  # 1 degree at 10 N m

    env = env_with(*["half-lock:RR_calf:-1.5"] * 50, robot="go1", config=EnvConfig())
    assert (env.joint_error[:, 2, 2] <= 1e-9).all() and (env.joint_error[:, 3, 2] > 0.1).any()


def test_a_skate_rolls_forward_grips_sideways_and_acts_on_its_foot_alone():
    for axis, rolls in ((0, True), (1, False)):
        env = env_with("skate:FR", HEALTHY, robot="go1")
        rest(env, 50)  # settle
        names = [env.model.geom(f"{leg}_foot").id for leg in GO1.legs]
        before = env.world.bind("geom_xpos")[:, names, axis].copy()
        wheel = env.model.body("FR_wheel").id
        for _ in range(25):
            env.world.bind("xfrc_applied")[:, wheel, axis] = 12.0  # N, through the axle
            rest(env)
        moved = np.abs(env.world.bind("geom_xpos")[:, names, axis] - before)
        assert (moved[0, 0] > 0.05) == rolls
        assert (moved[1] < 0.02).all() and (moved[0, 1:] < 0.02).all() and moved[0, 0] < 0.3


def test_a_reset_undoes_every_fault_to_the_bit(rng):
    stiff = "lock:FR_calf+disable:FL_thigh+weaken:RR:0.3"
    faults = stiff, *(REAL_WORLD[name] for name in ("weaken", "box", "skates"))
    env = env_with(*faults, robot="go1")
    whose = {f"actuator_{name}": [0, 1] for name in ("gainprm", "biasprm", "forcerange")}
    whose |= {"jnt_range": [1], "tendon_range": [2], "dof_frictionloss": [3]}
    healthy_one = {name: np.stack([getattr(env.model, name)] * 4) for name in whose}
    for name, robots in whose.items():
        differs = (env.world.expanded(name) != healthy_one[name]).reshape(4, -1)
        assert differs.any(axis=1).nonzero()[0].tolist() == robots, name
    assert env.world.bind("eq_active").any(axis=1).tolist() == [True, False, False, False]

    flail(env, rng, 20)
    env.pin_faults([HEALTHY] * 4)
    env.reset()
    assert not env.world.bind("eq_active").any()
    for name, value in healthy_one.items():
        assert np.array_equal(env.world.expanded(name), value)
    assert (env._qpos[:, -7:] == env.model.key_qpos[0, -7:]).all()  # the box is back
