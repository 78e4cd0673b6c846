"""The model against its data sheet, and faults on simulated robots."""

from dataclasses import fields, replace

import mujoco
import numpy as np
import pytest

from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import TASKS, Fault, Task, disable, half_lock, healthy, lock, motor_strength, parse, skate, tow, weaken
from robots import A1, ROBOTS, build_model

QUIET = EnvConfig(push_speed=0.0, start_speed=0.0, start_pose=(1.0, 1.0), friction=(1.0, 1.0))


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_model_agrees_with_the_data(robot):
    model = build_model(robot)
    joints = len(robot.legs) * len(robot.links)
    assert (model.nu, model.neq, model.nv) == (joints, joints, joints + 6)
    total = robot.trunk_mass + len(robot.legs) * sum(link.mass for link in robot.links)
    assert model.body_mass.sum() == pytest.approx(total)
    for i, name in enumerate(robot.joints):
        link = robot.links[i % len(robot.links)]
        assert model.actuator(i).name == model.equality(i).name == name
        left = robot.mounts[i // len(robot.links)][1] > 0
        turned = left and link.axis[1] == 0  # about x or z: left is right the other way round
        assert model.joint(name).range == pytest.approx([-x for x in link.limits[::-1]] if turned else link.limits)
        assert model.actuator(i).forcerange == pytest.approx([-link.effort, link.effort])


@pytest.mark.parametrize(
    "name, total, leg",
    [
        ("a1", 12.453, (0.696, 1.013, 0.226)), ("go1", 12.743448, (0.68, 1.009, 0.195862)),
        ("hexapod", 30.508951, (1.20924, 0.925235, 0.281487 + 0.0190129)),  # its foot is part of the calf
    ],
)  # fmt: skip
def test_weighs_what_its_source_says(name, total, leg):
    """kg; Unitree's and the ElSpider Air's descriptions, of which a leg weighs 2.435."""
    model = build_model(ROBOTS[name])
    assert model.body_mass.sum() == pytest.approx(total, abs=1e-4)
    for i, joint in enumerate(ROBOTS[name].joints):
        assert model.body(joint).mass[0] == pytest.approx(leg[i % 3], abs=1e-6)


def test_the_hexapod_stands_still():
    """10 s of zero action: no foot creeps by a centimetre, no joint comes to rest at a stop."""
    env = LocomotionEnv("hexapod", 1, num_threads=1, config=QUIET)
    env.reset()
    world, model = env.world, env.model
    for _ in range(50):
        env.step(np.zeros((1, 18)))
    feet = []
    for seconds in (0, 10):
        for _ in range(round(seconds / CONTROL_DT)):
            env.step(np.zeros((1, 18)))
        data = mujoco.MjData(model)
        data.qpos[:] = world.bind("qpos")[0]
        mujoco.mj_kinematics(model, data)
        feet.append(np.array([data.geom(f"{leg}_foot").xpos[:2] for leg in env.robot.legs]))
    assert np.abs(feet[1] - feet[0]).max() < 0.01
    angles, limits = data.qpos[env._angle_at], model.jnt_range[env._joints]
    assert np.all(angles > limits[:, 0] + 0.05) and np.all(angles < limits[:, 1] - 0.05)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_legs_are_mirror_images(robot):
    """In the default pose every leg's foot and centres of mass have a twin on the other side."""
    model = build_model(robot)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    at = dict(zip(robot.mounts, robot.legs))
    for right, left in ((leg, at[x, -y, z]) for (x, y, z), leg in at.items() if y < 0):
        for link in robot.links:
            twin = data.body(f"{left}_{link.name}").xipos * [1, -1, 1]
            assert data.body(f"{right}_{link.name}").xipos == pytest.approx(twin, abs=1e-6)
        assert data.geom(f"{right}_foot").xpos == pytest.approx(data.geom(f"{left}_foot").xpos * [1, -1, 1], abs=1e-6)


@pytest.mark.parametrize(
    "change, says",
    [
        ({"legs": ("FR", "FL", "RR")}, "every leg has a name of its own, a mount and a default pose"),
        ({"legs": ("FR", "FL", "RR", "RR")}, "every leg has a name of its own"),
        ({"links": A1.links[:2]}, "every link has a name of its own, and an angle in the pose of FR"),
        ({"default_pose": ((-0.1, 0.8, 1.5), *A1.default_pose[1:])}, "FR_calf at 1.5 rad is beyond its stops, -2.69653 and -0.916298"),
    ],
)
def test_a_robot_that_does_not_fit_together_is_refused(change, says):
    with pytest.raises(ValueError, match=says):
        replace(A1, **change)


def test_a_link_that_cannot_be_mirrored_is_refused():
    with pytest.raises(ValueError, match="only axes along x, y or z"):
        replace(A1.links[0], axis=(0.8, 0.6, 0))
    with pytest.raises(ValueError, match="the stops of the thigh would have to be mirrored"):
        replace(A1.links[1], rear_mirrors_x=True)


def test_faults_of_legs_and_joints_with_other_names():
    """A leg may have an underscore in its name; what has no word in the paper is called by its own
    name."""
    robot = replace(A1, legs=("front_right", "front_left", "rear_right", "rear_left"))
    strength = motor_strength(weaken("front_left", 0.5) + disable("rear_right_calf"), robot)
    assert strength.tolist() == [1, 1, 1, 0.5, 0.5, 0.5, 1, 1, 0, 1, 1, 1]


def test_shares_of_a_task_add_up():
    for shares in ((0.5, 0.4), (1.0, 0.0), ()):
        with pytest.raises(ValueError, match="add up to 1"):
            Task(("a1",), tuple((share, healthy()) for share in shares), ())


@pytest.mark.parametrize("robot", ROBOTS)
def test_stands_under_zero_action(robot):
    env = LocomotionEnv(robot, 2, num_threads=1, config=QUIET)
    env.reset()
    for _ in range(150):
        _, _, terminated, _, _ = env.step(np.zeros((2, env.num_actions)))
        assert not terminated.any()
    assert env.foot_contact.all() and not env.link_contact.any()
    assert env.gravity[:, 2] == pytest.approx(-1, abs=0.01)


def test_locked_joint_holds_under_load_and_is_free_after_reset():
    """FR calf locked, 20 kg on its back and the policy flailing: it stays. Healthy again, it
    moves."""
    env = LocomotionEnv("a1", 1, num_threads=1, faults=((1.0, lock("FR_calf")),), config=QUIET)
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(100):
        env.world.bind("xfrc_applied")[:, env.model.body("trunk").id, 2] = -20 * 9.81  # N; a reset after a fall clears it
        env.step(rng.normal(size=(1, 12)))
        assert abs(env.joint_error[0, 0, 2]) < 0.01
    env.pin_faults([healthy()])
    env.reset()
    env.world.bind("xfrc_applied")[:] = 0
    for _ in range(25):
        env.step(np.full((1, 12), 0.8))
    assert abs(env.joint_error[0, 0, 2]) > 0.1


def test_disabled_motor_gives_no_torque_but_its_joint_moves():
    env = LocomotionEnv("a1", 2, num_threads=1, config=QUIET)
    env.pin_faults([disable("RL_thigh"), healthy()])
    env.reset()
    rng, moved = np.random.default_rng(0), 0.0
    for _ in range(50):
        env.step(rng.normal(size=(2, 12)))
        assert env.torque[0, 3, 1] == 0.0
        assert env.torque[1, 3, 1] != 0.0
        moved = max(moved, abs(env.joint_error[0, 3, 1]))
    assert moved > 0.1


def test_weak_motor_gives_its_share_of_the_torque():
    """Same state, same target: half the strength is half the force, and half the clipping limit."""
    env = LocomotionEnv("a1", 2, num_threads=1, config=QUIET)
    env.pin_faults([weaken("FL", 0.5), healthy()])
    env.reset()
    for action in (0.5, 10.0):  # 10: 2.5 rad away, 50 N m asked of 33.5
        env.world.bind("ctrl")[:] = (env._default + 0.25 * action).reshape(-1)
        env.world.forward(stage=mujoco.mjtStage.mjSTAGE_ACC)
        weak, strong = env.torque
        assert weak[1] == pytest.approx(0.5 * strong[1])
        assert weak[0] == pytest.approx(strong[0])
    assert strong[1].max() == pytest.approx(33.5)


def test_reset_undoes_every_fault():
    """After faults of all kinds, a healthy robot's model fields are the healthy model's, to the
    bit."""
    env = LocomotionEnv("a1", 3, num_threads=1)
    env.pin_faults([lock("FR_calf"), disable("FL_thigh"), weaken("RR", 0.3)])
    env.reset()
    env.pin_faults([healthy()] * 3)
    env.reset()
    assert not env.world.bind("eq_active").any()
    for field in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
        assert np.array_equal(env.world.expanded(field), np.stack([getattr(env.model, field)] * 3))


def test_training_faults_are_drawn_with_their_odds():
    env = LocomotionEnv("a1", 400, seed=3, num_threads=1, faults=TASKS["stiffness"].training)
    env.reset()
    locked = env.world.bind("eq_active")[:, 2] > 0
    assert 160 < locked.sum() < 240  # 200 +- 4 sd
    assert np.array_equal(env.world.bind("eq_active").sum(axis=1), locked)  # nothing else is locked


def test_fault_names_read_back():
    for fault in (healthy(), lock("FR_calf"), disable("FL_hip"), weaken("RL", 0.25), lock("FR_calf") + weaken("RL", 0.5)):
        assert parse(str(fault)) == fault
    assert motor_strength(lock("FR_calf") + weaken("RL", 0.5), A1).tolist() == [1, 1, 0] + [1] * 6 + [0.5] * 3
    assert healthy() == Fault()


def test_every_field_of_a_fault_has_a_name_of_its_own():
    """A field that `__str__` or `parse` forgets makes a fault that calls itself healthy in tables
    and checkpoints."""
    one_each = lock("FR_calf"), weaken("FR", 0.5), half_lock("FR_calf", -1.0), tow("FR"), skate("FR")
    for field in fields(Fault):
        assert sum(bool(getattr(fault, field.name)) for fault in one_each) == 1, f"an example with {field.name} is missing above"
    assert len({str(fault) for fault in one_each}) == len(fields(Fault)) and "healthy" not in map(str, one_each)
    assert [parse(str(fault)) for fault in one_each] == list(one_each)


@pytest.mark.parametrize("text", ["", "lock", "lock:", "weaken:RL", "weaken:RL:x", "weaken:RL:2", "weaken:RL:nan", "melt:FR"])
def test_unreadable_faults_are_refused(text):
    with pytest.raises(ValueError, match="lock:FR_calf|no joint"):
        motor_strength(parse(text), A1)


def test_fault_of_a_part_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="no joint or leg 'MR_calf'; it has the legs FR, FL, RR, RL"):
        motor_strength(lock("MR_calf"), A1)
