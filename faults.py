"""Faults as data: what is wrong with one robot, and the function that writes it onto a simulation.

A `Fault` is a few numbers. `write_fault` puts them on chosen robots of a batch, starting from the
healthy model, so that the next one written (at every reset) undoes the last. What they act on is
prepared in robots.py; boxes and skates only if the env is made with such faults. Faults are those
of the paper's sections IV-A and IV-C, and add up: lock("FR_calf") + weaken("RL", 0.5).

A new fault is a field of `Fault`, a line in `write_fault`, a function that makes it, and its name
(in tables, options and checkpoints) in `Fault.__str__` and `parse`.
"""

from dataclasses import dataclass, fields

import mujoco
import numpy as np
from mujoco.batch import Batch

from robots import BOX_FRICTION, Robot, tether_length
from terrain import TRAINING_MAP, Terrain


@dataclass(frozen=True)
class Fault:
    """What differs from a healthy robot; the default is healthy."""

    locked: tuple[str, ...] = ()  # joints held at their default angle, their motors off
    strength: tuple[tuple[str, float], ...] = ()  # (joint or leg, share of torque that is left)
    half_locked: tuple[tuple[str, float], ...] = ()  # (joint, rad that it cannot pass upwards)
    towing: tuple[str, ...] = ()  # legs tied to the box behind the robot
    skating: tuple[str, ...] = ()  # legs whose foot is a wheel

    def __add__(self, other: "Fault") -> "Fault":
        return Fault(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(Fault)))

    def __str__(self) -> str:
        """The name that `parse` reads back, e.g. 'lock:FR_calf+weaken:RL:0.5'."""
        words = [f"lock:{joint}" for joint in self.locked]
        for part, share in self.strength:
            words.append(f"weaken:{part}:{share}" if share else f"disable:{part}")
        words += [f"half-lock:{joint}:{angle}" for joint, angle in self.half_locked]
        words += [f"tow:{leg}" for leg in self.towing] + [f"skate:{leg}" for leg in self.skating]
        return "+".join(words) or "healthy"


def healthy() -> Fault:
    """Nothing is wrong."""
    return Fault()


def lock(joint: str) -> Fault:
    """The joint stays at its default angle (stiffness test: "we simply lock the calf joint"); its
    motor is off, or it would be charged for torque that does nothing."""
    return Fault(locked=(joint,))


def disable(joint: str) -> Fault:
    """Swings freely, but for dry friction (damage: "we simply set the torque output to zero")."""
    return Fault(strength=((joint, 0.0),))


def weaken(part: str, strength: float) -> Fault:
    """The motors of a joint or a leg give `strength` (0 to 1) times their torque (real world)."""
    if not 0 <= strength <= 1:
        raise ValueError(f"a motor's strength is between 0 and 1, not {strength}")
    return Fault(strength=((part, float(strength)),))


def half_lock(joint: str, angle: float) -> Fault:
    """The joint cannot turn past `angle` [rad] upwards, as if tied with a string (real world: "the
    calf joint angle can't be larger"). The hexapod's left legs turn the other way."""
    if not np.isfinite(angle):
        raise ValueError(f"an angle is a finite number, not {angle}")
    return Fault(half_locked=((joint, float(angle)),))


def tow(leg: str) -> Fault:
    """The foot is tied to a box (real world: "pull a box with one single hind right leg")."""
    return Fault(towing=(leg,))


def skate(leg: str) -> Fault:
    """The foot is a wheel that grips sideways ("roller skates are tied to [the] feet")."""
    return Fault(skating=(leg,))


def parse(text: str) -> Fault:
    """Reads 'healthy', 'lock:JOINT', 'disable:JOINT', 'weaken:LEG:SHARE', 'half-lock:JOINT:ANGLE',
    'tow:LEG', 'skate:LEG', or several joined with '+'. ValueError with what would be right."""
    makers = {"healthy": healthy, "lock": lock, "disable": disable, "weaken": weaken}
    makers |= {"half-lock": half_lock, "tow": tow, "skate": skate}
    fault = healthy()
    for word in text.split("+"):
        try:
            kind, *rest = word.split(":")
            fault += makers[kind](*rest[:1], *map(float, rest[1:]))  # a part, then numbers
        except (KeyError, TypeError, ValueError) as error:  # no such kind, wrong count, bad number
            right = "lock:FR_calf, disable:FR_thigh, weaken:RL:0.5, half-lock:RR_calf:-1.5, tow:RR"
            right = f"write healthy, {right} or skate:FR"
            raise ValueError(f"cannot read the fault {word!r} ({error}); {right}") from None
    return fault


def props(faults: list[Fault]) -> dict[str, tuple[str, ...]]:
    """What `build_model` must add for robots with these faults."""
    total = sum(faults, healthy())
    return {name: tuple(sorted(set(getattr(total, name)))) for name in ("towing", "skating")}


def joint_mask(parts: tuple[str, ...], robot: Robot) -> np.ndarray:
    """(L*J,) bool, the joints that the names of joints or legs mean. ValueError for other names."""
    if unknown := [part for part in parts if part not in (*robot.joints, *robot.legs)]:
        has = f"it has the legs {', '.join(robot.legs)}, with joints such as {robot.joints[0]}"
        raise ValueError(f"the {robot.name} has no joint or leg {unknown[0]!r}; {has}")
    legs = [leg for leg in robot.legs for _ in robot.links]
    return np.array([leg in parts or joint in parts for leg, joint in zip(legs, robot.joints)])


def motor_strength(fault: Fault, robot: Robot) -> np.ndarray:
    """(L*J,) share of its torque that each motor has left; 0 where the joint is locked."""
    strength = np.where(joint_mask(fault.locked, robot), 0.0, 1.0)
    for part, share in fault.strength:
        strength[joint_mask((part,), robot)] *= share
    return strength


def joint_limits(fault: Fault, robot: Robot, model: mujoco.MjModel) -> np.ndarray:
    """(joints of the model, 2) rad, where each joint's stops are."""
    limits = model.jnt_range.copy()
    for part, angle in fault.half_locked:
        for name in np.array(robot.joints)[joint_mask((part,), robot)]:
            low, high = limits[model.joint(name).id]
            if not low < angle < high:
                raise ValueError(f"{name} turns from {low:g} to {high:g} rad: no stop at {angle:g}")
            limits[model.joint(name).id, 1] = angle
    return limits


def write_fault(fault: Fault, robot: Robot, world: Batch, ids: np.ndarray) -> None:
    """Makes the robots `ids` healthy but for `fault`, or raises ValueError and writes nothing.

    A motor is force = gain . ctrl + bias . (1, q, dq), clipped to its range: scaling all three
    scales the torque. The env draws friction before each call, but for the box's.
    """
    model = world.model
    share = motor_strength(fault, robot)[:, None]  # (L*J, 1)
    limits = joint_limits(fault, robot, model)
    loss, reach = model.dof_frictionloss.copy(), model.tendon_range.copy()
    try:
        for leg in fault.skating:
            loss[model.joint(f"{leg}_wheel").dofadr] = 0.0
        for leg in fault.towing:
            reach[model.tendon(f"{leg}_tether").id, 1] = tether_length(robot, leg)
    except KeyError:
        raise ValueError(f"no box or wheel for {fault}: make the env with this fault") from None

    world.bind("eq_active")[ids] = joint_mask(fault.locked, robot)
    for motor in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
        world.expand(motor)[ids] = getattr(model, motor) * share
    world.expand("jnt_range")[ids] = limits
    world.expand("dof_frictionloss")[ids] = loss
    if model.ntendon:
        world.expand("tendon_range")[ids] = reach
        world.expand("geom_friction")[ids, model.geom("box").id, 0] = BOX_FRICTION


@dataclass(frozen=True)
class Task:
    """What policies are trained on, and the faults that only the test shows them."""

    robots: tuple[str, ...]
    training: tuple[tuple[float, Fault], ...]  # (probability, fault), drawn anew at every reset
    unseen: tuple[Fault, ...]
    terrain: Terrain | None = None  # flat ground

    def __post_init__(self):
        shares = [share for share, _ in self.training]
        if not (min(shares, default=0) > 0 and abs(sum(shares) - 1) < 1e-9):
            raise ValueError(f"a task's probabilities are above 0 and add up to 1, not {shares}")


_NINE = ("FL_calf", "FL_thigh", "FR_calf", "MR_calf", "ML_thigh")
_NINE += ("HL_thigh", "HL_calf", "HR_thigh", "HR_calf")
TASKS = {
    # Section IV-A (i): "the other legs limp in the test". Halves ours. Also for the real-world Go1.
    "stiffness": Task(
        robots=("a1", "go1"), training=((0.5, healthy()), (0.5, lock("FR_calf"))),
        unseen=(lock("FL_calf"), lock("RR_calf"), lock("RL_calf")),
    ),
    # Section IV-A (ii): FRT, MRT, MLC one at a time, and the paper's nine in the test. Shares ours.
    "damage": Task(
        robots=("hexapod",), unseen=tuple(disable(joint) for joint in _NINE),
        training=((0.25, healthy()), (0.25, disable("FR_thigh")),
                  (0.25, disable("MR_thigh")), (0.25, disable("ML_calf"))),
    ),
    # Section IV-B: "multiple terrains, including stairs, slopes and platforms"; tested with noise.
    "terrain": Task(robots=("a1",), training=((1.0, healthy()),), unseen=(), terrain=TRAINING_MAP),
}  # fmt: skip


def first_task(robot: str) -> str:
    """The first task for this robot: what it is trained and shown on unless told otherwise."""
    for name, task in TASKS.items():
        if robot in task.robots:
            return name
    raise ValueError(f"no task in faults.py is for the robot {robot}: name it in one of TASKS")


# Section IV-C: "we weaken the motor strength of one leg and lock the hind back leg with a string",
# boxes and skates. The paper gives no numbers. Ours: half the strength; of the front leg that
# training never harmed, and the string on the hind leg that tows, so that both are new, at the
# default angle, where training locks. Which leg is weak decides who falls: all four are tested.
REAL_WORLD = {
    "healthy": healthy(),  # ours: what the others are to be compared with
    "weaken": weaken("FL", 0.5) + half_lock("RR_calf", -1.5),
    "weaken FR": weaken("FR", 0.5) + half_lock("RR_calf", -1.5),
    "weaken RR": weaken("RR", 0.5) + half_lock("RL_calf", -1.5),
    "weaken RL": weaken("RL", 0.5) + half_lock("RR_calf", -1.5),
    "box": tow("RR"),
    "skates": skate("FR") + skate("FL"),
}


if __name__ == "__main__":  # lists the training tasks
    for name, task in TASKS.items():
        print(name, *(f"{p:.0%} {fault}" for p, fault in task.training), "test:", *task.unseen)
