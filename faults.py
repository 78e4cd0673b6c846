"""Faults as data: what is wrong with one robot, and the function that writes it onto a simulation.

A `Fault` is a few numbers. `write_fault` puts them on chosen robots of a batch, starting from the healthy model each
time; so the next fault that is written (at every reset) undoes the last one. What the numbers act on is prepared in
robots.py. Section IV-A of the paper:

    limping   "we simply lock the calf joint"             lock("FR_calf")       stiffness test, A1
    damage    "we simply set the torque output to zero"   disable("FR_thigh")   damage test, hexapod
    weaken    a share of the motors' torque is left       weaken("RL", 0.5)     real-world test, Go1

Faults add up: lock("FR_calf") + weaken("RL", 0.5). A new fault is a field of `Fault`, a line in `write_fault` and a
function that makes it.

    python faults.py            # lists the faults and the training tasks
"""

from dataclasses import dataclass

import numpy as np
from mujoco.batch import Batch

from robots import ROBOTS, Robot
from terrain import TRAINING_MAP, Terrain


@dataclass(frozen=True)
class Fault:
    """What differs from a healthy robot; the default is healthy."""

    locked: tuple[str, ...] = ()  # joints held at their default angle, their motors off
    strength: tuple[tuple[str, float], ...] = ()  # (joint or whole leg, share of its motors' torque that is left)

    def __add__(self, other: "Fault") -> "Fault":
        return Fault(self.locked + other.locked, self.strength + other.strength)

    def __str__(self) -> str:
        """The name that `parse` reads back, e.g. 'lock:FR_calf+weaken:RL:0.5'."""
        words = [f"lock:{joint}" for joint in self.locked]
        words += [f"weaken:{part}:{share:g}" if share else f"disable:{part}" for part, share in self.strength]
        return "+".join(words) or "healthy"


def healthy() -> Fault:
    """Nothing is wrong."""
    return Fault()


def lock(joint: str) -> Fault:
    """The joint stays at its default angle, e.g. lock("FR_calf"): the paper's limping leg.

    The motor is off: one that pushed against a seized joint would be charged for torque that does nothing.
    """
    return Fault(locked=(joint,))


def disable(joint: str) -> Fault:
    """The joint's motor gives no torque; the joint swings freely (but for its dry friction)."""
    return Fault(strength=((joint, 0.0),))


def weaken(part: str, strength: float) -> Fault:
    """The motors of a joint or of a whole leg give `strength` (0 to 1) times the torque of healthy ones."""
    if not 0 <= strength <= 1:
        raise ValueError(f"a motor's strength is between 0 and 1, not {strength}")
    return Fault(strength=((part, float(strength)),))


def parse(text: str) -> Fault:
    """Reads 'healthy', 'lock:JOINT', 'disable:JOINT', 'weaken:LEG:SHARE', or several joined with '+'.

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
                case _:
                    raise ValueError("no such kind of fault")
        except ValueError as error:
            raise ValueError(
                f"cannot read the fault {word!r} ({error}); write healthy, lock:FR_calf, disable:FR_thigh or weaken:RL:0.5"
            ) from None
    return fault


def joint_mask(parts: tuple[str, ...], robot: Robot) -> np.ndarray:
    """(L*J,) bool, the joints that the names of joints or whole legs mean. ValueError for a name that means none."""
    for part in parts:
        if part not in robot.joints and part not in robot.legs:
            raise ValueError(
                f"the {robot.name} has no joint or leg {part!r}; it has the legs {', '.join(robot.legs)} "
                f"with the joints {', '.join(link.name for link in robot.links)}, as in {robot.joints[0]}"
            )
    return np.array([joint in parts or joint.split("_")[0] in parts for joint in robot.joints])


def motor_strength(fault: Fault, robot: Robot) -> np.ndarray:
    """(L*J,) share of its torque that each motor has left; 0 where the joint is locked."""
    strength = np.where(joint_mask(fault.locked, robot), 0.0, 1.0)
    for part, share in fault.strength:
        strength[joint_mask((part,), robot)] *= share
    return strength


def write_fault(fault: Fault, robot: Robot, world: Batch, ids: np.ndarray) -> None:
    """Makes the robots `ids` of `world` healthy but for `fault`. ValueError if the robot has no such part.

    A motor is force = gain . ctrl + bias . (1, q, dq), clipped to its range: scaling all three scales the torque.
    """
    model, share = world.model, motor_strength(fault, robot)[:, None]  # (L*J, 1)
    world.bind("eq_active")[ids] = joint_mask(fault.locked, robot)
    world.expand("actuator_gainprm")[ids] = model.actuator_gainprm * share
    world.expand("actuator_biasprm")[ids] = model.actuator_biasprm * share
    world.expand("actuator_forcerange")[ids] = model.actuator_forcerange * share


@dataclass(frozen=True)
class Task:
    """What policies are trained on, and the faults that only the test shows them."""

    robots: tuple[str, ...]
    training: tuple[tuple[float, Fault], ...]  # (probability, fault), drawn anew at every reset
    unseen: tuple[Fault, ...]
    terrain: Terrain | None = None  # flat ground


TASKS = {
    # Section IV-A (i): healthy and FR limping in training, "the other legs limp in the test". Halves: ours. The Go1 of the
    # real-world test was trained on the same.
    "stiffness": Task(
        robots=("a1", "go1"),
        training=((0.5, healthy()), (0.5, lock("FR_calf"))),
        unseen=(lock("FL_calf"), lock("RR_calf"), lock("RL_calf")),
    ),
    # Section IV-A (ii): FRT, MRT, MLC in training, one of them at a time (T thigh, C calf), and the paper's nine in the
    # test. Quarters: ours.
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
    # Section IV-B: healthy, "on multiple terrains, including stairs, slopes and platforms"; the test is noise (noise.py).
    "terrain": Task(robots=("a1",), training=((1.0, healthy()),), unseen=(), terrain=TRAINING_MAP),
}


if __name__ == "__main__":
    print(__doc__.split("\n\n")[2])
    for name, task in TASKS.items():
        print(f"\ntask {name} (robots: {', '.join(task.robots)})")
        print("  training:", ", ".join(f"{share:.0%} {fault}" for share, fault in task.training))
        print("  unseen:  ", ", ".join(str(fault) for fault in task.unseen) or "noise on the scandots (noise.py)")
        print("  ground:  ", ", ".join(dict.fromkeys(task.terrain.columns)) if task.terrain else "flat")
    for robot in ROBOTS.values():
        print(f"\njoints of the {robot.name}: {', '.join(robot.joints)}")
