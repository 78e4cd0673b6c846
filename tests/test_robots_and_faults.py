"""The model against its data sheet, and faults on simulated robots."""

from dataclasses import fields, replace

import mujoco
import numpy as np
import pytest

from env import EnvConfig, LocomotionEnv
from faults import REAL_WORLD, TASKS, Fault
from faults import disable, half_lock, healthy, lock, motor_strength, parse, skate, tow, weaken
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
        limits = [-x for x in link.limits[::-1]] if turned else link.limits
        assert model.joint(name).range == pytest.approx(limits)
        assert model.actuator(i).forcerange == pytest.approx([-link.effort, link.effort])


@pytest.mark.parametrize(
    "name, total, leg",
    [
        ("a1", 12.453, (0.696, 1.013, 0.226)),
        ("go1", 12.743448, (0.68, 1.009, 0.195862)),
        ("hexapod", 30.508951, (1.20924, 0.925235, 0.281487 + 0.0190129)),  # foot and calf are one
    ],
)
def test_weighs_what_its_source_says(name, total, leg):
    """kg; Unitree's and the ElSpider Air's descriptions, of which a leg weighs 2.435."""
    model = build_model(ROBOTS[name])
    assert model.body_mass.sum() == pytest.approx(total, abs=1e-4)
    for i, joint in enumerate(ROBOTS[name].joints):
        assert model.body(joint).mass[0] == pytest.approx(leg[i % 3], abs=1e-6)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_legs_are_mirror_images(robot):
    """In the default pose every leg's foot and centres of mass have a twin on the other side."""
    data = mujoco.MjData(build_model(robot))
    mujoco.mj_resetDataKeyframe(data.model, data, 0)
    mujoco.mj_forward(data.model, data)
    at = dict(zip(robot.mounts, robot.legs))
    for (x, y, z), leg in at.items():
        for link in robot.links:
            place, twin = (data.body(f"{one}_{link.name}").xipos for one in (leg, at[x, -y, z]))
            assert place == pytest.approx(twin * [1, -1, 1], abs=1e-6)
        place, twin = (data.geom(f"{one}_foot").xpos for one in (leg, at[x, -y, z]))
        assert place == pytest.approx(twin * [1, -1, 1], abs=1e-6)


@pytest.mark.parametrize(
    "change, says",
    [
        ({"legs": ("FR", "FL", "RR")}, "every leg has a name of its own, a mount"),
        ({"legs": ("FR", "FL", "RR", "RR")}, "every leg has a name of its own"),
        ({"links": A1.links[:2]}, "every link has a name of its own, and an angle in the pose"),
        ({"default_pose": ((-0.1, 0.8, 1.5),) * 4}, "FR_calf at 1.5 rad is beyond its stops"),
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
    """FR calf locked, 20 kg on its back and the policy flailing: it stays. Healthy, it moves."""
    env = LocomotionEnv("a1", 1, num_threads=1, faults=((1.0, lock("FR_calf")),), config=QUIET)
    env.reset()
    rng = np.random.default_rng(0)
    trunk = env.model.body("trunk").id
    for _ in range(100):
        env.world.bind("xfrc_applied")[:, trunk, 2] = -20 * 9.81  # N; a reset clears it
        env.step(rng.normal(size=(1, 12)))
        assert abs(env.joint_error[0, 0, 2]) < 0.01
    env.pin_faults([healthy()])
    env.reset()
    env.world.bind("xfrc_applied")[:] = 0
    for _ in range(25):
        env.step(np.full((1, 12), 0.8))
    assert abs(env.joint_error[0, 0, 2]) > 0.1


def test_weak_motor_gives_its_share_of_the_torque():
    """Same state, same target: half the strength is half the force, and half the clipping limit."""
    env = LocomotionEnv("a1", 3, num_threads=1, config=QUIET)
    env.pin_faults([weaken("FL", 0.5), healthy(), disable("RL_thigh")])
    env.reset()
    for action in (0.5, 10.0):  # 10: 2.5 rad away, 50 N m asked of 33.5
        env.world.bind("ctrl")[:] = (env._default + 0.25 * action).reshape(-1)
        env.world.forward(stage=mujoco.mjtStage.mjSTAGE_ACC)
        weak, strong, dead = env.torque
        assert weak[1] == pytest.approx(0.5 * strong[1])
        assert weak[0] == pytest.approx(strong[0])
        assert dead[3, 1] == 0.0 != strong[3, 1] and dead[3, 2] == pytest.approx(strong[3, 2])
    assert strong[1].max() == pytest.approx(33.5)


def test_training_faults_are_drawn_with_their_odds():
    env = LocomotionEnv("a1", 400, seed=3, num_threads=1, faults=TASKS["stiffness"].training)
    env.reset()
    locked = env.world.bind("eq_active")[:, 2] > 0
    assert 160 < locked.sum() < 240  # 200 +- 4 sd
    assert np.array_equal(env.world.bind("eq_active").sum(axis=1), locked)  # nothing else is locked


def test_fault_names_read_back():
    """A field that `__str__` or `parse` forgets makes a fault that calls itself healthy in tables
    and checkpoints."""
    tied = half_lock("FR_calf", -1.0)
    one_each = lock("FR_calf"), weaken("FR", 0.5), tied, tow("FR"), skate("FR")
    for field in fields(Fault):
        having = [fault for fault in one_each if getattr(fault, field.name)]
        assert len(having) == 1, f"an example with {field.name} is missing above"
    thirds = weaken("FR", 1 / 3) + half_lock("RR_calf", -4 / 3)  # to the last digit
    all_of_it = lock("FR_calf") + weaken("RL", 0.5) + tow("RR") + skate("FL")
    for fault in (*one_each, healthy(), disable("FL_hip"), *REAL_WORLD.values(), thirds, all_of_it):
        assert parse(str(fault)) == fault and (str(fault) == "healthy") == (fault == Fault())
    assert motor_strength(all_of_it, A1).tolist() == [1, 1, 0] + [1] * 6 + [0.5] * 3


@pytest.mark.parametrize("text", [
    "", "lock", "lock:", "weaken:RL", "weaken:RL:x", "weaken:RL:2", "weaken:RL:nan", "melt:FR",
    "tow", "half-lock:RR_calf", "half-lock:RR_calf:nan", "half-lock:RR_calf:x", "skate:FR:2",
])  # fmt: skip
def test_unreadable_faults_are_refused(text):
    with pytest.raises(ValueError, match="lock:FR_calf|no joint"):
        motor_strength(parse(text), A1)
