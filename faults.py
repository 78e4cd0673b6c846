"""Faults as data: what is wrong with one robot, and how it gets onto one simulation of many.

A fault is words, the same in code, options, tables and checkpoints, which add up with "+":
    lock:FR_calf      held at the default angle, motor off (stiffness: "we simply lock the calf")
    disable:FR_thigh  no torque but dry friction (damage: "we simply set the torque output to zero")
    weaken:RL:0.5     half of the torque is left (real world; a part is a joint or a whole leg)
    half-lock:RR_calf:-1.5    cannot turn up past -1.5 rad, as if tied with a string (real world:
                      "the calf joint angle can't be larger"; the hexapod's left legs turn down)
    tow:RR            the foot is tied to a box ("pull a box with one single hind right leg")
    skate:FL          the foot is a wheel that grips sideways ("roller skates are tied")
    healthy           nothing

`faulty_model` does to a MuJoCo model what the words say; `FaultWriter` copies what has changed
onto chosen robots. So a new fault is an entry in KINDS and some plain MuJoCo in `faulty_model`.
"""

import copy
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch

from robots import TETHER, Robot
from terrain import TRAINING_MAP, Terrain

# kind: does a number follow the part?
KINDS = {"lock": 0, "disable": 0, "weaken": 1, "half-lock": 1, "tow": 0, "skate": 0}
MOTORS = ("lock", "disable", "weaken")
HEALTHY = "healthy"


class Harm(NamedTuple):
    """One of a fault's words."""

    kind: str  # of KINDS
    part: str  # a joint or a leg
    size: float  # as said above; of a lock and a dead motor, too, the share of torque left


def harms_of(fault: str) -> list[Harm]:
    """What the words say. ValueError with what would be right."""
    harms = []
    for word in fault.split("+"):
        kind, *rest = word.split(":")
        try:
            if word != HEALTHY:
                part, size = rest if KINDS[kind] else (*rest, 0)
                harms.append(Harm(kind, part, float(size)))
                if kind == "weaken" and not 0 <= float(size) <= 1:
                    raise ValueError("a strength is from 0 to 1")
        except (KeyError, ValueError) as error:  # no such kind, too few or too many, bad number
            right = f"write healthy or {', '.join(KINDS)}, as in lock:FR_calf+weaken:RL:0.5"
            raise ValueError(f"cannot read the fault {word!r} ({error}); {right}") from None
    return harms


def props(faults: list[str]) -> dict[str, list[str]]:
    """What `build_model` must add for robots with these faults."""
    harms = {harm for fault in faults for harm in harms_of(fault)}
    towing = sorted(harm.part for harm in harms if harm.kind == "tow")
    return {"towing": towing, "skating": sorted(h.part for h in harms if h.kind == "skate")}


def faulty_model(fault: str, robot: Robot, healthy: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the healthy model with the fault in it. ValueError if that cannot be."""
    model = copy.copy(healthy)
    try:
        for kind, part, size in harms_of(fault):
            if kind == "tow":
                forward = {leg: mount[0] for leg, mount in zip(robot.legs, robot.mounts)}
                length = TETHER + forward[part] - min(forward.values())
                model.tendon_range[model.tendon(f"{part}_tether").id, 1] = length
            elif kind == "skate":
                model.joint(f"{part}_wheel").frictionloss[0] = 0.0
            else:
                joints = [x for x in robot.joints if part in (x, x.split("_")[0])]  # the leg's
                if not joints:
                    has = f"it has {', '.join(robot.joints)}"
                    raise ValueError(f"the {robot.name} has no joint or leg {part!r}; {has}")
                for joint in joints:
                    _harm_joint(model, joint, kind, size)
    except KeyError:
        raise ValueError(f"no {part}, box or wheel for {fault}: make the env with this") from None
    mujoco.mj_setConst(model, mujoco.MjData(model))  # what follows from masses and the like
    return model


def _harm_joint(model: mujoco.MjModel, joint: str, kind: str, size: float) -> None:
    motor, (low, high) = model.actuator(joint).id, model.joint(joint).range
    if kind in MOTORS:  # force = gain . ctrl + bias . (1, q, dq), clipped: all three scale it
        for values in (model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange):
            values[motor] *= size
    if kind == "lock":
        model.eq_active0[model.equality(joint).id] = True
    elif kind == "half-lock" and not low < size < high:
        raise ValueError(f"{joint} turns from {low:g} to {high:g} rad: no stop at {size:g}")
    elif kind == "half-lock":
        model.joint(joint).range[1] = size


class FaultWriter:
    """Puts faults onto robots of a batch, always from the healthy model: each undoes the last."""

    def __init__(self, robot: Robot, world: Batch):
        self.robot, self.world = robot, world
        self.models: dict[str, mujoco.MjModel] = {}  # of each fault that was written
        self.values: dict[str, np.ndarray] = {}  # {field: (N, ...)}, of all that some fault changes

    def write(self, fault: str, ids: np.ndarray | int) -> None:
        """Makes the robots `ids` healthy but for `fault`, or raises ValueError, writing nothing."""
        world, healthy = self.world, self.world.model
        if fault not in self.models:
            self.models[fault] = model = faulty_model(fault, self.robot, healthy)
            for name in MODEL_FIELDS:
                if "." in name or np.array_equal(getattr(model, name), getattr(healthy, name)):
                    continue  # an option of the simulator, or no change
                lock = name == "eq_active0"  # acts at MuJoCo's resets only: write the state instead
                self.values[name] = world.bind("eq_active") if lock else world.expand(name)
        for name, values in self.values.items():
            values[ids] = getattr(self.models[fault], name)


def other_harms(faults: list[str]) -> np.ndarray:
    """(faults, M) for critics: the sizes of all that is harmed but for locks and motors."""
    harms = [{h[:2]: h.size or 1.0 for h in harms_of(f) if h.kind not in MOTORS} for f in faults]
    columns = sorted(set().union(*harms))
    return np.array([[sizes.get(column, 0.0) for column in columns] for sizes in harms])


@dataclass(frozen=True)
class Task:
    """What policies are trained on, and the faults that only the test shows them."""

    robots: tuple[str, ...]
    training: tuple[tuple[float, str], ...]  # (probability, fault), drawn anew at every reset
    unseen: tuple[str, ...]
    terrain: Terrain | None = None  # flat ground

    @property
    def seen(self) -> list[str]:
        return [fault for _, fault in self.training]


TASKS = {
    # Section IV-A (i): "the other legs limp in the test". Halves ours. Also for the real-world Go1.
    "stiffness": Task(
        robots=("a1", "go1"), training=((0.5, HEALTHY), (0.5, "lock:FR_calf")),
        unseen=tuple(f"lock:{leg}_calf" for leg in ("FL", "RR", "RL")),
    ),
    # Section IV-A (ii): FRT, MRT, MLC one at a time, and the paper's nine in the test. Shares ours.
    "damage": Task(
        robots=("hexapod",),
        training=((0.25, HEALTHY), (0.25, "disable:FR_thigh"),
                  (0.25, "disable:MR_thigh"), (0.25, "disable:ML_calf")),
        unseen=tuple(f"disable:{joint}" for joint in (
            "FL_calf FL_thigh FR_calf MR_calf ML_thigh HL_thigh HL_calf HR_thigh HR_calf".split())),
    ),
    # Section IV-B: "multiple terrains, including stairs, slopes and platforms"; tested with noise.
    "terrain": Task(robots=("a1",), training=((1.0, HEALTHY),), unseen=(), terrain=TRAINING_MAP),
}  # fmt: skip


def first_task(robot: str) -> str:
    """The first task for this robot: what it is trained and shown on unless told otherwise."""
    for name, task in TASKS.items():
        if robot in task.robots:
            return name
    raise ValueError(f"no task in faults.py is for the robot {robot}: name it in one of TASKS")


# Section IV-C: "we weaken the motor strength of one leg and lock the hind back leg with a string",
# boxes and skates. Numbers ours: half the strength, of the front leg that training never harmed;
# the string at the default angle, on the hind leg that tows. Who falls depends on the weak leg.
REAL_WORLD = {
    "healthy": HEALTHY,  # ours: what the others are to be compared with
    "weaken": "weaken:FL:0.5+half-lock:RR_calf:-1.5",
    "weaken FR": "weaken:FR:0.5+half-lock:RR_calf:-1.5",
    "weaken RR": "weaken:RR:0.5+half-lock:RL_calf:-1.5",
    "weaken RL": "weaken:RL:0.5+half-lock:RR_calf:-1.5",
    "box": "tow:RR",
    "skates": "skate:FR+skate:FL",
}
