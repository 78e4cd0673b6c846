"""Faults as data: what is wrong with one robot, and the function that writes it onto a simulation.

A `Fault` is a few numbers. `write_fault` puts them on chosen robots of a batch, starting from the
healthy model each time; so the next fault that is written (at every reset) undoes the last one.
What the numbers act on is prepared in robots.py. Sections IV-A and IV-C of the paper:

    limping   "we simply lock the calf joint"             lock("FR_calf")       stiffness test, A1
    damage    "we simply set the torque output to zero"   disable("FR_thigh")   damage test, hexapod
    weaken    a share of the motors' torque is left       weaken("RL", 0.5)     real-world test, Go1
    half-lock "the calf joint angle can't be larger"      half_lock("RR_calf", -1.5)  likewise
    tow       "pull a box with one single hind right leg" tow("RR")             likewise
    skate     "roller skates are tied to [the] feet"      skate("FR")           likewise

The last two need what a robot alone does not have: the env builds it for the faults that it is made
with.
Faults add up: lock("FR_calf") + weaken("RL", 0.5). A new fault is a field of `Fault`, a line in
`write_fault`, a function that makes it, and a word for it in `Fault.__str__` and `parse`: its name
in tables, options and checkpoints.

    python faults.py            # lists the faults and the training tasks
"""

from dataclasses import dataclass, fields

import mujoco
import numpy as np
from mujoco.batch import Batch

from robots import BOX_FRICTION, ROBOTS, Robot, tether_length
from terrain import TRAINING_MAP, Terrain


@dataclass(frozen=True)
class Fault:
    """What differs from a healthy robot; the default is healthy."""

    locked: tuple[str, ...] = ()  # joints held at their default angle, their motors off
    strength: tuple[tuple[str, float], ...] = ()  # (joint or whole leg, share of its motors' torque that is left)
    half_locked: tuple[tuple[str, float], ...] = ()  # (joint, angle [rad] that it cannot pass upwards)
    towing: tuple[str, ...] = ()  # legs tied to the box behind the robot
    skating: tuple[str, ...] = ()  # legs whose foot is a wheel

    def __add__(self, other: "Fault") -> "Fault":
        return Fault(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(Fault)))

    def __str__(self) -> str:
        """The name that `parse` reads back, e.g. 'lock:FR_calf+weaken:RL:0.5'."""
        words = [f"lock:{joint}" for joint in self.locked]
        words += [f"weaken:{part}:{share}" if share else f"disable:{part}" for part, share in self.strength]
        words += [f"half-lock:{joint}:{angle}" for joint, angle in self.half_locked]
        words += [f"tow:{leg}" for leg in self.towing] + [f"skate:{leg}" for leg in self.skating]
        return "+".join(words) or "healthy"


def healthy() -> Fault:
    """Nothing is wrong."""
    return Fault()


def lock(joint: str) -> Fault:
    """The joint stays at its default angle, e.g. lock("FR_calf"): the paper's limping leg.

    The motor is off: one that pushed against a seized joint would be charged for torque that does
    nothing.
    """
    return Fault(locked=(joint,))


def disable(joint: str) -> Fault:
    """The joint's motor gives no torque; the joint swings freely (but for its dry friction)."""
    return Fault(strength=((joint, 0.0),))


def weaken(part: str, strength: float) -> Fault:
    """The motors of a joint or of a whole leg give `strength` (0 to 1) times the torque of healthy
    ones."""
    if not 0 <= strength <= 1:
        raise ValueError(f"a motor's strength is between 0 and 1, not {strength}")
    return Fault(strength=((part, float(strength)),))


def half_lock(joint: str, angle: float) -> Fault:
    """The joint cannot turn past `angle` [rad] upwards, and turns freely below: for a calf of the
    A1 or the Go1, a string that keeps it from opening (real-world test). Left legs of the hexapod
    turn the other way."""
    if not np.isfinite(angle):
        raise ValueError(f"an angle is a finite number, not {angle}")
    return Fault(half_locked=((joint, float(angle)),))


def tow(leg: str) -> Fault:
    """The leg's foot is tied to a box that stands behind the robot (its numbers are in
    robots.py)."""
    return Fault(towing=(leg,))


def skate(leg: str) -> Fault:
    """The leg's foot is a wheel: it rolls forward and back without loss, and grips sideways."""
    return Fault(skating=(leg,))


def props(faults: list[Fault]) -> dict[str, tuple[str, ...]]:
    """What `build_model` must add for robots with these faults."""
    return {name: tuple(sorted({leg for f in faults for leg in getattr(f, name)})) for name in ("towing", "skating")}


def parse(text: str) -> Fault:
    """Reads 'healthy', 'lock:JOINT', 'disable:JOINT', 'weaken:LEG:SHARE', 'half-lock:JOINT:ANGLE',
    'tow:LEG', 'skate:LEG', or several joined with '+'.

    Raises ValueError with what would be right.
    """
    fault = healthy()
    for word in text.split("+"):
        try:
            match word.split(":"):
                case ["healthy"]:
                    pass
                case ["lock", joint]:
                    fault += lock(joint)
                case ["disable", joint]:
                    fault += disable(joint)
                case ["weaken", part, share]:
                    fault += weaken(part, float(share))
                case ["half-lock", joint, angle]:
                    fault += half_lock(joint, float(angle))
                case ["tow", leg]:
                    fault += tow(leg)
                case ["skate", leg]:
                    fault += skate(leg)
                case _:
                    raise ValueError("no such kind of fault")
        except ValueError as error:
            raise ValueError(
                f"cannot read the fault {word!r} ({error}); write healthy, lock:FR_calf, disable:FR_thigh, weaken:RL:0.5, "
                "half-lock:RR_calf:-1.5, tow:RR or skate:FR"
            ) from None
    return fault


def joint_mask(parts: tuple[str, ...], robot: Robot) -> np.ndarray:
    """(L*J,) bool, the joints that the names of joints or whole legs mean. ValueError for a name
    that means none."""
    for part in parts:
        if part not in robot.joints and part not in robot.legs:
            raise ValueError(
                f"the {robot.name} has no joint or leg {part!r}; it has the legs {', '.join(robot.legs)} "
                f"with the joints {', '.join(link.name for link in robot.links)}, as in {robot.joints[0]}"
            )
    return np.array([leg in parts or f"{leg}_{link.name}" in parts for leg in robot.legs for link in robot.links])


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
            joint = model.joint(name).id
            if not limits[joint, 0] < angle < limits[joint, 1]:
                low, high = limits[joint]
                raise ValueError(f"the {robot.name}'s {name} turns from {low:g} to {high:g} rad: no stop at {angle:g}")
            limits[joint, 1] = angle
    return limits


def write_fault(fault: Fault, robot: Robot, world: Batch, ids: np.ndarray) -> None:
    """Makes the robots `ids` of `world` healthy but for `fault`. ValueError if the robot has no
    such part.

    A motor is force = gain . ctrl + bias . (1, q, dq), clipped to its range: scaling all three
    scales the torque. Friction is the env's to draw anew before each call, but for the box's.
    """
    model = world.model
    locked, share = joint_mask(fault.locked, robot), motor_strength(fault, robot)[:, None]  # (L*J,), (L*J, 1)
    limits, loss, reach = joint_limits(fault, robot, model), model.dof_frictionloss.copy(), model.tendon_range.copy()
    try:
        for leg in fault.skating:
            loss[model.joint(f"{leg}_wheel").dofadr] = 0.0
        for leg in fault.towing:
            reach[model.tendon(f"{leg}_tether").id, 1] = tether_length(robot, leg)
    except KeyError:
        raise ValueError(f"there is no box or wheel for {fault}: make the env with this fault among its faults") from None
    # nothing is written until all of it is known to be possible
    world.bind("eq_active")[ids] = locked
    world.expand("actuator_gainprm")[ids] = model.actuator_gainprm * share
    world.expand("actuator_biasprm")[ids] = model.actuator_biasprm * share
    world.expand("actuator_forcerange")[ids] = model.actuator_forcerange * share
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
            raise ValueError(f"the probabilities of a task's training faults are above 0 and add up to 1, not {shares}")


TASKS = {
    # Section IV-A (i): healthy and FR limping in training, "the other legs limp in the test".
    # Halves: ours. The Go1 of the real-world test was trained on the same.
    "stiffness": Task(
        robots=("a1", "go1"),
        training=((0.5, healthy()), (0.5, lock("FR_calf"))),
        unseen=(lock("FL_calf"), lock("RR_calf"), lock("RL_calf")),
    ),
    # Section IV-A (ii): FRT, MRT, MLC in training, one of them at a time (T thigh, C calf), and the
    # paper's nine in the test. Quarters: ours.
    "damage": Task(
        robots=("hexapod",),
        training=(
            (0.25, healthy()), (0.25, disable("FR_thigh")), (0.25, disable("MR_thigh")), (0.25, disable("ML_calf")),
        ),
        unseen=tuple(
            disable(joint)
            for joint in (
                "FL_calf", "FL_thigh", "FR_calf", "MR_calf", "ML_thigh", "HL_thigh", "HL_calf", "HR_thigh", "HR_calf",
            )
        ),
    ),
    # Section IV-B: healthy, "on multiple terrains, including stairs, slopes and platforms"; the
    # test is noise (noise.py).
    "terrain": Task(robots=("a1",), training=((1.0, healthy()),), unseen=(), terrain=TRAINING_MAP),
}


def first_task(robot: str) -> str:
    """The name of the first task that is for this robot: what it is trained and shown on unless
    told otherwise."""
    for name, task in TASKS.items():
        if robot in task.robots:
            return name
    raise ValueError(f"no task in faults.py is for the robot {robot}: name it in one of TASKS")


# Section IV-C: "we weaken the motor strength of one leg and lock the hind back leg with a string",
# "pull a box with one single hind right leg", "two roller skates are tied to the robot's front
# feet". The paper gives no numbers. Ours: half the strength; of the front leg that training never
# harmed, and of the hind leg that tows, so that both are new; the string at the default angle,
# where training locks. Which leg is weak decides who falls, so the other three are tested as well.
REAL_WORLD = {
    "healthy": healthy(),  # ours: what the others are to be compared with
    "weaken": weaken("FL", 0.5) + half_lock("RR_calf", -1.5),
    "weaken FR": weaken("FR", 0.5) + half_lock("RR_calf", -1.5),
    "weaken RR": weaken("RR", 0.5) + half_lock("RL_calf", -1.5),
    "weaken RL": weaken("RL", 0.5) + half_lock("RR_calf", -1.5),
    "box": tow("RR"),
    "skates": skate("FR") + skate("FL"),
}


if __name__ == "__main__":
    print(*__doc__.split("\n\n")[2:4], sep="\n\n")
    for name, task in TASKS.items():
        print(f"\ntask {name} (robots: {', '.join(task.robots)})")
        print("  training:", ", ".join(f"{share:.0%} {fault}" for share, fault in task.training))
        print("  unseen:  ", ", ".join(str(fault) for fault in task.unseen) or "noise on the scandots (noise.py)")
        print("  ground:  ", ", ".join(dict.fromkeys(task.terrain.columns)) if task.terrain else "flat")
    for robot in ROBOTS.values():
        print(f"\njoints of the {robot.name}: {', '.join(robot.joints)}")
