"""What a gait is, in numbers and in a picture: which foot was on the ground when.

The measures are Hildebrand's (Symmetrical gaits of horses, Science 150, 1965). The paper shows its gaits as a picture only
(section IV-A, figure "Unstructured gaits").

Legend: T steps of `dt` seconds, N robots, L legs. `contacts` (T, L) bool: the foot is on the ground.

    python evaluate.py gaits --robot a1
"""

import render  # first: it says how to draw without a display, which mujoco reads when it is imported
import numpy as np

from env import CONTROL_DT
from faults import TASKS
from plots import gait_diagrams
from protocol import case_name, write_csv
from robots import ROBOTS

WARM_UP = 2.0  # s after the start that do not count; ours: by then the robot walks
SHORTEST = 1.0  # s on its feet after that, or there is no gait to measure; ours: several strides


def without_chatter(contacts: np.ndarray) -> np.ndarray:
    """(T, L): each step takes the majority of itself and its two neighbours, so that a contact or a flight of a single step
    (20 ms, a bounce) is no stride."""
    padded = np.concatenate([contacts[:1], contacts, contacts[-1:]]).astype(int)
    return padded[:-2] + padded[1:-1] + padded[2:] >= 2


def duty_factor(contacts: np.ndarray) -> np.ndarray:
    """(L,) share of the time that each foot is on the ground: above 0.5 in a walk, below in a run."""
    return contacts.mean(axis=0)


def stride_frequency(contacts: np.ndarray, dt: float) -> np.ndarray:
    """(L,) Hz: strides from a foot's first touchdown to its last one over the time they took; 0 for less than one stride."""
    frequency = np.zeros(contacts.shape[1])
    for leg, foot in enumerate(contacts.T):
        touchdowns = np.flatnonzero(foot[1:] & ~foot[:-1])
        if len(touchdowns) > 1:
            frequency[leg] = (len(touchdowns) - 1) / ((touchdowns[-1] - touchdowns[0]) * dt)
    return frequency


def feet_down(contacts: np.ndarray) -> float:
    """How many feet are on the ground, on average: 3 in a hexapod's tripod gait, 2 in a trot."""
    return float(contacts.sum(axis=1).mean())


def measure(contacts: np.ndarray, dt: float) -> dict[str, np.ndarray] | None:
    """The three, (L,), (L,) and (), of an episode from its start to its first fall; None if that came too soon."""
    steady = without_chatter(contacts)[round(WARM_UP / dt) :]
    if len(steady) * dt < SHORTEST:
        return None
    return {
        "duty_factor": duty_factor(steady),
        "stride_hz": stride_frequency(steady, dt),
        "feet_down": np.array(feet_down(steady)),
    }


def gaits(args) -> None:
    """The experiment: every fault of the robot's task, seen in training or not.

    Numbers of all episodes from 2 s on, in gaits-ROBOT.csv one row an episode and leg (empty if it fell before 3 s). The
    picture shows the last second of each case's first episode.
    """
    task, robot = TASKS[args.task], ROBOTS[args.robot]
    cases = {case_name(fault): fault for fault in (*(fault for _, fault in task.training), *task.unseen)}
    labels = [(case, episode) for case in cases for episode in range(args.episodes)]
    args.scenes |= {case: (fault, 0.75, {}) for case, fault in cases.items()}
    rows, panels, problem = [], [], render.problem()
    if problem:
        print(f"no frames, numbers only: {problem}")
    for path, (policy, card) in args.policies.items():
        print(f"\n{card['method']}")
        faults = [cases[case] for case, _ in labels]
        walk = render.record(policy, args.robot, faults, args.seconds, 0.75, args.seed, args.threads)
        measured = [measure(walk.contacts[:end, i], CONTROL_DT) for i, end in enumerate(walk.steps)]
        print_table(list(cases), robot.legs, [measured[i : i + args.episodes] for i in range(0, len(labels), args.episodes)])

        for (case, episode), end, gait in zip(labels, walk.steps, measured):
            row = {"method": card["method"], "checkpoint": str(path), "seed": card["seed"], "case": case, "episode": episode}
            for i, leg in enumerate(robot.legs):
                numbers = {name: "" for name in ("duty_factor", "stride_hz", "feet_down")}
                if gait is not None:
                    numbers = {name: f"{np.broadcast_to(value, len(robot.legs))[i]:.3f}" for name, value in gait.items()}
                rows.append(row | {"seconds": f"{end * CONTROL_DT:.2f}", "leg": leg} | numbers)

        unseen = {case: " (unseen)" if fault in task.unseen else "" for case, fault in cases.items()}
        titles = [f"{card['method']}, {fault}{unseen[case]}" for case, fault in cases.items()]
        panels.append([panel(walk, i * args.episodes, title, framed=not problem) for i, title in enumerate(titles)])
    csv, picture = (args.out / f"gaits-{args.robot}.{suffix}" for suffix in ("csv", "png"))
    write_csv(csv, rows)
    side_by_side = [one for methods in zip(*panels) for one in methods]  # a case's methods stand in one row
    title = f"Gaits: {args.robot}, told 0.75 m/s. Feet on the ground over time [s]"
    gait_diagrams(side_by_side, robot.legs, CONTROL_DT, max(2, len(panels)), picture, title)
    print(f"\nwritten: {csv}, {picture}")


def print_table(cases: list[str], legs: tuple[str, ...], measured: list[list[dict | None]]) -> None:
    """Means over the episodes of each case."""
    names = "".join(f"{leg:>6}" for leg in legs)
    print(f"{'':10}{'feet down':>11}{'strides/s':>11}{'duty factor':>14}{names}  episodes")
    for case, episodes in zip(cases, measured):
        whole = [gait for gait in episodes if gait is not None]
        words = " " * (36 + 6 * len(legs))
        if whole:
            duty, stride, feet = (np.mean([gait[name] for gait in whole], axis=0) for name in whole[0])
            words = f"{feet:11.2f}{stride.mean():11.2f}{duty.mean():14.2f}" + "".join(f"{share:6.2f}" for share in duty)
        print(f"{case:10}{words}  {len(whole)} of {len(episodes)}")


def panel(walk: render.Walk, robot: int, title: str, framed: bool, every: int = 7, num_frames: int = 7) -> dict:
    """What `gait_diagrams` shows of one robot: its last second, and if `framed` a picture each `every` steps (0.14 s; of a stride
    of 0.2 to 0.3 s the next one shows another phase)."""
    end = walk.steps[robot]
    shown = np.arange(max(0, end - every * num_frames), end)
    whole = max(every, len(shown) // every * every)  # a robot that fell early has fewer frames
    return {
        "title": title + ("" if end == len(walk.poses) else f", falls at {end * CONTROL_DT:.1f} s"),
        "time": shown * CONTROL_DT,
        "contacts": without_chatter(walk.contacts[:end, robot])[shown],
        "frames": render.draw(walk, robot, shown[:whole:every], 300, 220) if framed else [],
        "frame_seconds": every * CONTROL_DT,
    }
