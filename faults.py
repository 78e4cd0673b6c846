"""Faults as data: what is wrong with one robot, from when on, and how one robot of many gets it.

A fault is words, the same in code, options, tables and checkpoints, which add up with "+":
    healthy           nothing
    lock:FR_calf      held at the default angle, motor off (stiffness: "we simply lock the calf")
    disable:FR_thigh  no torque but dry friction (damage: "we simply set the torque output to zero")
    weaken:RL:0.5     half of the torque is left (real world; a part: a joint, a leg, or all)
    half-lock:RR_calf:-1.5    cannot turn up past -1.5 rad, as if tied with a string (real world:
                      "the calf joint angle can't be larger"; the hexapod's left legs turn down)
    tow:RR            the foot is tied to a box ("pull a box with one single hind right leg")
    skate:FL          the foot is a wheel that grips sideways ("roller skates are tied")
and, beyond the paper, what is ours:
    late:FR:0.02      motors answer 0.02 s later, at most 0.04 (in steps of the simulation, 5 ms)
    payload:trunk:2   2 kg more, in the middle of the trunk (or of a link)
    blow:trunk:5@3:   a push of 5 N s to the left, -5 to the right, within the step at 3 s
    freeze:FR_calf    angle and velocity read as they were when it began
    bias:FR:0.2       the angles read 0.2 rad more
    mute:FR           angle and velocity read as of one at rest in the default pose
    imu:trunk:0.1     gravity and turning are sensed by an IMU that sits 0.1 rad nose down
    odometry:trunk:0.5    half of the velocity is sensed; 0 = none
The last five change what policies see, neither the physics nor the rewards. A word may say when, in
seconds of the episode:
    lock:FR_calf@5:12    from 5 s to 12 s; lock:FR_calf@5: (with the colon) from 5 s to the end. A
                         lock that strikes in mid-episode holds where it is.
    lock:FR_calf@0.3/2   for 0.3 s of every 2 s, at a moment drawn anew each time

`faulty_model` does to a MuJoCo model what the words say; `FaultWriter` copies what has changed
onto chosen robots. So a new fault is an entry in KINDS and some plain MuJoCo in `faulty_model`.
"""

import copy
import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch

from robots import CONTROL_DT, MAX_DELAY, TETHER, Robot
from terrain import TRAINING_MAP, Terrain

# kind: between what must the number lie that follows the part? None: no number
KINDS = {
    "lock": None, "disable": None, "weaken": (0, 1), "half-lock": (-7, 7), "tow": None,
    "skate": None, "late": (0, MAX_DELAY), "payload": (0, 50), "blow": (-100, 100), "freeze": None,
    "bias": (-7, 7), "mute": None, "imu": (-1.5, 1.5), "odometry": (0, 2),
}  # fmt: skip
MOTORS = ("lock", "disable", "weaken")  # a critic reads these off the simulation
HEALTHY = "healthy"


class Harm(NamedTuple):
    """One of a fault's words. Steps are control steps of the episode."""

    kind: str  # of KINDS
    part: str  # a joint, a leg, a body
    size: float  # the word's number; 0 if it has none, so locks and dead motors scale torque by 0
    word: str  # all of it but for the time
    start: int = 0  # step
    end: float = math.inf  # step at which it is over
    period: int = 0  # steps; if any, it strikes once in each, at a moment that is drawn,
    length: int = 0  # and lasts so many

    def is_on(self, step: int, luck: tuple[int, ...]) -> bool:
        """luck: what moments are drawn from."""
        if not self.period:
            return self.start <= step < self.end
        turn, step = divmod(step, self.period)
        start = np.random.default_rng((*luck, turn)).integers(self.period - self.length + 1)
        return start <= step < start + self.length


@cache
def harms_of(fault: str) -> tuple[Harm, ...]:
    """What the words say. ValueError with what would be right."""
    harms = []
    for text in fault.split("+"):
        word, at, when = text.partition("@")
        kind, *rest = word.split(":")
        try:
            if text == HEALTHY:
                continue
            bounds = KINDS[kind]
            part, size = rest if bounds else (*rest, 0)
            if bounds and not bounds[0] <= float(size) <= bounds[1]:
                raise ValueError(f"the number of {kind} is from {bounds[0]} to {bounds[1]}")
            harms.append(Harm(kind, part, float(size), word, *_steps(when, kind) if at else ()))
        except (KeyError, ValueError, OverflowError) as error:  # no such kind, a bad number
            kinds = ", ".join(KINDS)
            right = f"write healthy or {kinds}, as in lock:FR_calf+weaken:RL:0.5@5:12"
            raise ValueError(f"cannot read the fault {text!r} ({error}); {right}") from None
    return tuple(harms)


def _steps(when: str, kind: str) -> tuple:
    """Harm's start, end, period and length of "5:12", "5:" or "0.3/2"."""
    short = kind == "blow"  # a blow is over after one step
    if "/" in when:
        length, period = (round(float(x) / CONTROL_DT) for x in when.split("/"))
        if not 1 <= length <= period:
            raise ValueError("after @ a length / a period, not shorter, in s")
        return 0, math.inf, period, 1 if short else length
    first, last = when.split(":")
    start = round(float(first) / CONTROL_DT)
    end = round(float(last) / CONTROL_DT) if last else math.inf
    if not 0 <= start < end:
        raise ValueError("after @ a start and a later end, in s, as in @5:12 or @5:")
    return start, start + 1 if short else end


def fault_now(fault: str, step: int, luck: tuple[int, ...]) -> str:
    """The words that hold in a control step of the episode, without their times."""
    return "+".join(h.word for h in harms_of(fault) if h.is_on(step, luck)) or HEALTHY


def props(faults: list[str]) -> dict[str, list[str] | bool]:
    """What `build_model` must add for robots with these faults."""
    harms = {harm for fault in faults for harm in harms_of(fault)}
    legs = {kind: sorted({h.part for h in harms if h.kind == kind}) for kind in ("tow", "skate")}
    late = any(harm.kind == "late" for harm in harms)
    return {"towing": legs["tow"], "skating": legs["skate"], "late": late}


def joints_of(robot: Robot, part: str) -> list[int]:
    """The numbers of the joint, of the leg's joints, or of all."""
    joints = [i for i, x in enumerate(robot.joints) if part in (x, x.split("_")[0], "all")]
    if not joints:
        has = f"it has {', '.join(robot.joints)}"
        raise ValueError(f"the {robot.name} has no joint or leg {part!r}; {has}")
    return joints


def faulty_model(fault: str, robot: Robot, healthy: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the healthy model with the fault in it. ValueError if that cannot be."""
    model = copy.copy(healthy)
    try:
        for kind, part, size, *_ in harms_of(fault):
            if kind == "tow":
                forward = {leg: mount[0] for leg, mount in zip(robot.legs, robot.mounts)}
                length = TETHER + forward[part] - min(forward.values())
                model.tendon_range[model.tendon(f"{part}_tether").id, 1] = length
            elif kind == "skate":
                model.joint(f"{part}_wheel").frictionloss[0] = 0.0
            elif kind == "payload":
                model.body(part).mass[0] += size
            elif kind in ("blow", "imu", "odometry"):
                model.body(part)  # is there; the model stays as it is (`FaultWriter`)
            else:
                for joint in joints_of(robot, part):
                    _harm_joint(model, robot.joints[joint], kind, size)
    except KeyError:
        why = "boxes and wheels are there for the faults that the env was made with"
        raise ValueError(f"the model has no {part} for {fault}; {why}") from None
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
    elif kind == "late":
        model.actuator_delay[motor] = size


def other_harms(faults: list[str]) -> list[tuple[str, str]]:
    """The M (kind, part) of all that is harmed but for locks and motors."""
    harms = {harm[:2] for fault in faults for harm in harms_of(fault) if harm.kind not in MOTORS}
    return sorted(harms)


class Senses:
    """What the sensors of N robots of K joints say instead of what is so."""

    def __init__(self, N: int, K: int):
        self.gain, self.bias = np.ones((N, 1, K)), np.zeros((N, 2, K))  # of angle and velocity
        self.frozen, self.held = np.zeros((N, 1, K), dtype=bool), np.zeros((N, 2, K))
        self.pitch, self.speed = np.zeros(N), np.ones((N, 1))  # rad, share

    def write(self, fault: str, i: int, robot: Robot, anew: bool) -> None:
        """Robot i's fail so, and else not. What freezes is held from the next `read` on; anew: also
        what was frozen before."""
        was, self.frozen[i] = self.frozen[i] & (not anew), False
        self.gain[i] = self.speed[i] = 1
        self.bias[i] = self.pitch[i] = 0
        for kind, part, size, *_ in harms_of(fault):
            if kind in ("freeze", "bias", "mute"):
                joints = joints_of(robot, part)
                self.frozen[i, 0, joints] |= kind == "freeze"
                self.gain[i, 0, joints] *= kind != "mute"
                self.bias[i, 0, joints] += size
            self.pitch[i] += size * (kind == "imu")
            self.speed[i] *= size if kind == "odometry" else 1
        self.held[i, :, (self.frozen[i] & ~was)[0]] = np.nan

    def read(self, angle, velocity, linear, angular, gravity) -> list[np.ndarray]:
        """What is so -> what is sensed: (N, L, J) twice, (N, 3) three times, as in env.py."""
        joints = np.stack([angle, velocity], axis=1)  # (N, 2, L, J)
        flat = joints.reshape(self.held.shape)
        self.held = np.where(np.isnan(self.held), flat, self.held)
        sensed = self.gain * np.where(self.frozen, self.held, flat) + self.bias
        cos, sin = np.cos(self.pitch), np.sin(self.pitch)
        turned = []
        for x, y, z in (angular.T, gravity.T):
            turned.append(np.stack([cos * x - sin * z, y, sin * x + cos * z], axis=1))
        return [*sensed.reshape(joints.shape).swapaxes(0, 1), self.speed * linear, *turned]


class FaultWriter:
    """Puts faults onto robots of a batch, always from the healthy model: each undoes the last."""

    def __init__(self, robot: Robot, world: Batch, faults: list[str]):
        self.robot, self.world = robot, world
        self.models: dict[str, mujoco.MjModel] = {}  # of each fault that was met
        # {field: (N, ...)}, of all that some fault changes; where locks hold, too
        self.values: dict[str, np.ndarray] = {"eq_data": world.expand("eq_data")}
        self.pushes = world.bind("xfrc_applied")  # (N, bodies, 6) N, N m
        self.senses = Senses(world.nsim, len(robot.joints))
        self.expect(faults)

    def expect(self, faults: list[str]) -> None:
        """Which may come. Those that strike later are tried now, so that a wrong one is an error at
        the start. `told`, (N, M): what critics hear of each of `other_harms`, its size."""
        self.timed = np.array(["@" in fault for fault in faults])
        for fault in faults:
            for harm in harms_of(fault):
                if harm.kind == "blow" and harm.end == math.inf and not harm.period:
                    raise ValueError(f"when is the blow of {fault}? As in blow:trunk:5@3:")
            if "@" in fault:
                self.model("+".join(harm.word for harm in harms_of(fault)))
        self.columns = other_harms(faults)
        self.told = np.zeros((self.world.nsim, len(self.columns)))

    def model(self, fault: str) -> mujoco.MjModel:
        """With this fault; every field that it changes is one of `values` from now on."""
        world, healthy = self.world, self.world.model
        if fault not in self.models:
            self.models[fault] = model = faulty_model(fault, self.robot, healthy)
            for name in MODEL_FIELDS:
                if "." in name or np.array_equal(getattr(model, name), getattr(healthy, name)):
                    continue  # an option of the simulator, or no change
                lock = name == "eq_active0"  # acts at MuJoCo's resets only: write the state instead
                self.values[name] = world.bind("eq_active") if lock else world.expand(name)
        return self.models[fault]

    def write(self, fault: str, i: int, angles: np.ndarray | None = None) -> None:
        """Makes robot i healthy but for `fault`, or raises ValueError, writing nothing. angles:
        (L*J,) rad, where joints are if it strikes in mid-episode: there new locks hold."""
        model, seats = self.model(fault), self.values["eq_data"][i, :, 0].copy()
        held = self.world.bind("eq_active")[i] > 0
        for name, values in self.values.items():
            values[i] = getattr(model, name)
        if angles is not None:
            locked = model.eq_active0 > 0
            self.values["eq_data"][i, locked, 0] = np.where(held, seats, angles)[locked]

        self.pushes[i] = self.told[i] = 0
        for kind, part, size, *_ in harms_of(fault):
            if kind == "blow":
                self.pushes[i, model.body(part).id, 1] += size / CONTROL_DT
            if (kind, part) in self.columns:
                lost = 1 - size if kind == "odometry" else size if KINDS[kind] else 1.0
                self.told[i, self.columns.index((kind, part))] += lost
        self.senses.write(fault, i, self.robot, anew=angles is None)


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


STIFF = tuple(f"lock:{leg}_calf" for leg in ("FR", "FL", "RR", "RL"))
TASKS = {
    # Section IV-A (i): "the other legs limp in the test". Halves ours. Also for the real-world Go1.
    "stiffness": Task(("a1", "go1"), ((0.5, HEALTHY), (0.5, STIFF[0])), unseen=STIFF[1:]),
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
    # Ours (RESULTS.md, `legs`): the stiffness task with other faults to learn from. The last comes
    # and goes, for 2 s of every 4.
    "no-legs": Task(("a1",), ((1.0, HEALTHY),), STIFF),
    "two-legs": Task(("a1",), ((0.5, HEALTHY), (0.25, STIFF[0]), (0.25, STIFF[2])), STIFF[1::2]),
    "four-legs": Task(("a1",), ((0.5, HEALTHY), *((0.125, fault) for fault in STIFF)), ()),
    "mid-stride": Task(("a1",), ((0.5, HEALTHY), (0.5, f"{STIFF[0]}@2/4")), STIFF[1:]),
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
