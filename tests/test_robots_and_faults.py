"""The model against its data sheet, and faults on simulated robots."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from env import EnvConfig, LocomotionEnv
from faults import HEALTHY, KINDS, TASKS, faulty_model, harms_of, other_harms
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


def test_a_robot_that_does_not_fit_together_is_refused():
    for change in ({"legs": A1.legs[:3]}, {"links": A1.links[:2]}):
        with pytest.raises(ValueError, match="zip"):
            build_model(replace(A1, **change))
    with pytest.raises(ValueError, match="the first leg must be a right one"):
        replace(A1, mounts=A1.mounts[::-1])


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
    faults = ((1.0, "lock:FR_calf"),)
    env = LocomotionEnv("a1", 1, num_threads=1, faults=faults, config=QUIET)
    env.reset()
    rng = np.random.default_rng(0)
    trunk = env.model.body("trunk").id
    for _ in range(100):
        env.world.bind("xfrc_applied")[:, trunk, 2] = -20 * 9.81  # N; a reset clears it
        env.step(rng.normal(size=(1, 12)))
        assert abs(env.joint_error[0, 0, 2]) < 0.01
    env.pin_faults([HEALTHY])
    env.reset()
    env.world.bind("xfrc_applied")[:] = 0
    for _ in range(25):
        env.step(np.full((1, 12), 0.8))
    assert abs(env.joint_error[0, 0, 2]) > 0.1


def test_weak_motor_gives_its_share_of_the_torque():
    """Same state, same target: half the strength is half the force, and half the clipping limit."""
    env = LocomotionEnv("a1", 3, num_threads=1, config=QUIET)
    env.pin_faults(["weaken:FL:0.5", HEALTHY, "disable:RL_thigh"])
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


def test_faults_are_read_from_words():
    assert harms_of(HEALTHY) == () and harms_of("lock:FR_calf")[0][:3] == ("lock", "FR_calf", 0.0)
    for kind, bounds in KINDS.items():
        number = bounds and bounds[1] / 2
        (harm,) = harms_of(f"{kind}:FR" + (f":{number}" if bounds else ""))
        assert harm[:3] == (kind, "FR", number or 0)


def test_faults_add_up():
    healthy, both = build_model(A1), "lock:FR_calf+weaken:RL:0.5+weaken:RL_hip:0.5"
    model = faulty_model(both, A1, healthy)
    share = model.actuator_forcerange[:, 1] / healthy.actuator_forcerange[:, 1]
    assert share.tolist() == [1, 1, 0] + [1] * 6 + [0.25, 0.5, 0.5]
    assert model.eq_active0.nonzero()[0].tolist() == [2] and not healthy.eq_active0.any()


def test_critics_are_told_of_every_harm():
    """Locks, motors and friction read off the simulation, all else by its number."""
    faults = ["healthy", "lock:FR_calf", "weaken:FL:0.5", "half-lock:RR_calf:-1.5", "skate:FR"]
    options = {"faults": [(0.2, fault) for fault in faults], "extras": ("privileged",)}
    env = LocomotionEnv("a1", 5, num_threads=1, config=QUIET, **options)
    env.pin_faults(faults)
    told = env.reset().privileged
    assert told.shape == (5, 2 * 12 + 1 + 2)
    assert told[0].tolist() == [0] * 12 + [1] * 12 + [1] + [0, 0]
    assert (told[1] != told[0]).nonzero()[0].tolist() == [2, 14]  # locked, and its motor off
    assert told[2, 15:18].tolist() == [0.5] * 3 and told[3, -2:].tolist() == [-1.5, 0]
    assert told[4, -2:].tolist() == [0, 1] and other_harms(faults[:3]) == []


@pytest.mark.parametrize("text", [
    "", "lock", "lock:", "weaken:RL", "weaken:RL:x", "weaken:RL:2", "weaken:RL:nan", "melt:FR",
    "tow", "half-lock:RR_calf", "half-lock:RR_calf:nan", "half-lock:RR_calf:x", "skate:FR:2",
])  # fmt: skip
def test_unreadable_faults_are_refused(text):
    with pytest.raises(ValueError, match="lock:FR_calf|no joint|no stop at nan"):
        faulty_model(text, A1, build_model(A1))
