"""What the paper's experiments share: episodes of a policy, the rows of a CSV file, tables and charts.

An episode is one robot with one fault, told to walk straight on. Rows of a CSV file are episodes:
method, checkpoint, seed (of the training), case, episode, distance_m, fall_time_s, episode_return.
"""

import csv
import sys
from pathlib import Path

import numpy as np
import torch

from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import TASKS, Fault
from plots import bar_charts, curves
from ppo import to_tensors


def straight_ahead(speed: float, seconds: float) -> EnvConfig:
    """What tests and pictures ask of a robot: to walk straight on at `speed` m/s from the terrain's first row. Starts vary as
    in training (pose, velocity, friction), nobody is pushed, and nobody times out within `seconds`."""
    return EnvConfig(
        episode_seconds=seconds + 1.0, forward_speed=(speed, speed), heading=(0.0, 0.0), push_speed=0.0,
        start_rows=1, climb=False,
    )  # fmt: skip


@torch.no_grad()
def run_episodes(
    policy, robot: str, faults: list[Fault], speed: float, seconds: float, seed: int = 0, threads: int = 0, **env_options
) -> dict[str, np.ndarray]:
    """One episode `straight_ahead` on each of len(faults) robots, robot i with faults[i].

    env_options: of LocomotionEnv, such as terrain and noise. A fall is what ends an episode in training: the trunk touches
    the ground or tilts by more than 60 degrees, or the simulation diverges (that is said on stderr).

    Returns (N,) each: distance_m, net displacement along the commanded heading up to the first fall or the end;
    fall_time_s, of the first fall, `seconds` if there is none; episode_return, the reward up to then.
    """
    situations, config = [(1.0, fault) for fault in faults], straight_ahead(speed, seconds)
    env = LocomotionEnv(robot, len(faults), seed, threads, situations, config, policy.extras, **env_options)
    env.pin_faults(faults)  # one each
    observation = env.reset()
    start, steps = env.position[:, 0].copy(), round(seconds / CONTROL_DT)
    distance, returns = np.zeros(len(faults)), np.zeros(len(faults))
    fall_time, upright, divergences = np.full(len(faults), seconds), np.ones(len(faults), dtype=bool), 0
    for step in range(1, steps + 1):
        action = policy(to_tensors(observation, "cpu")).numpy()
        observation, reward, terminated, _, info = env.step(action)
        divergences += (upright & info["diverged"]).sum()
        valid = upright & ~info["diverged"]  # a diverged simulation's position means nothing: keep the last one
        distance[valid] = info["position"][valid, 0] - start[valid]
        returns += upright * reward
        fall_time[upright & terminated] = step * CONTROL_DT
        upright &= ~terminated
        if not upright.any():
            break
    if divergences:
        print(f"simulations that diverged, counted as falls: {divergences}", file=sys.stderr)
    return {"distance_m": distance, "fall_time_s": fall_time, "episode_return": returns}


def case_name(fault: Fault) -> str:
    """In the paper's words: FL is a locked FL_calf, FLC a dead motor of FL_calf; what it has no word for by its own name."""
    match str(fault).replace("_", ":").split(":"):
        case ["lock", leg, "calf"]:
            return leg
        case ["disable", leg, "thigh" | "calf" as joint]:
            return leg + joint[0].upper()
    return str(fault)


def run_cases(args, cases: dict[str, Fault], speed: float, **env_options) -> list[dict]:
    """Every checkpoint on every case, `args.episodes` robots each: the rows of the CSV file. What --video would show of it is
    noted in `args.scenes`."""
    args.scenes |= {case: (fault, speed, env_options) for case, fault in cases.items()}
    faults = [fault for fault in cases.values() for _ in range(args.episodes)]
    labels = [(case, episode) for case in cases for episode in range(args.episodes)]
    rows = []
    for path, (policy, card) in args.policies.items():
        chooses = card["policy"] == "roam"
        if chooses:
            policy.picked.zero_()
        outcome = run_episodes(policy, args.robot, faults, speed, args.seconds, args.seed, args.threads, **env_options)
        if chooses:
            print_choices(policy.picked, [str(fault) for _, fault in TASKS[card["task"]].training], list(cases))
        for i, (case, episode) in enumerate(labels):
            measured = {name: f"{values[i]:.4f}" for name, values in outcome.items()}
            row = {"method": card["method"], "checkpoint": str(path), "seed": card["seed"], "case": case}
            rows.append(row | {"episode": episode} | measured)
    return rows


def report(args, rows: list[dict], cases: list[str], labels: list[str], name: str, title: str, paper: dict = {}) -> None:
    """Prints the tables (mean ± sd over episodes; the paper's own, where it has numbers), writes the CSV file and the
    bar charts.

    cases, labels: as in `rows`, and as they are to be shown. paper: {column: {method: {case: (mean, sd)}}}.
    """
    write_csv(args.out / f"{name}.csv", rows)
    panels = {}
    for column, quantity in (("distance_m", "distance walked [m]"), ("fall_time_s", "time of the first fall [s]")):
        panels[quantity] = print_table(rows, cases, labels, column, quantity, paper.get(column, {}))
    print_falls(args, rows, cases, labels)
    bar_charts(panels, labels, args.out / f"{name}.png", title)
    print(f"\nwritten: {args.out / f'{name}.csv'}, {args.out / f'{name}.png'}")


def report_curves(args, rows: list[dict], scales: tuple[float, ...], name: str, title: str, axis: str) -> None:
    """As `report`, for cases that are the scales of some noise: tables, and a curve a method. The last table is what is left
    of the distance at the largest scale."""
    write_csv(args.out / f"{name}.csv", rows)
    cases, labels, panels = [f"{scale:g}" for scale in scales], [f"{scale:g} m" for scale in scales], {}
    for column, quantity in (("episode_return", "return of an episode"), ("distance_m", "distance walked [m]")):
        panels[quantity] = print_table(rows, cases, labels, column, quantity)
    print_falls(args, rows, cases, labels)
    print(f"\ndistance at {labels[-1]}, of the clean one")
    for method, (mean, _) in panels["distance walked [m]"].items():
        climbs = mean[0] > 2  # m, most of the six steps
        print(f"{method:28}" + (f"{mean[-1] / mean[0]:>14.0%}" if climbs else "  hardly climbs with clean heights either"))
    curves(panels, scales, args.out / f"{name}.png", title, axis)
    print(f"\nwritten: {args.out / f'{name}.csv'}, {args.out / f'{name}.png'}")


def methods_of(rows: list[dict]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def print_table(
    rows: list[dict], cases: list[str], labels: list[str], column: str, quantity: str, paper: dict = {}
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Prints and returns {method: (means, standard deviations)}, one number a case; prints the seeds of a method, too, if there
    are several. paper: {method: {case: (mean, sd)}}."""
    table = {method: mean_and_deviation(rows, method, cases, column) for method in methods_of(rows)}
    width = column_width(labels)

    def show(name: str, means: np.ndarray, deviations: np.ndarray) -> None:
        words = [f"{mean:.2f} ± {deviation:.2f}" for mean, deviation in zip(means, deviations)]
        print(f"{name:28}" + "".join(f"{word:>{width}}" for word in words))

    print(f"\n{quantity:28}" + "".join(f"{label:>{width}}" for label in labels))
    for method, pairs in table.items():
        show(method, *pairs)
        seeds = list(dict.fromkeys(row["seed"] for row in rows if row["method"] == method))
        for seed in seeds if len(seeds) > 1 else ():
            show(f"  seed {seed}", *mean_and_deviation([row for row in rows if row["seed"] == seed], method, cases, column))
        if known := paper.get(method):
            words = ["{:.2f} ± {:.2f}".format(*known[case]) if case in known else "-" for case in cases]
            print(f"{'  (paper)':28}" + "".join(f"{word:>{width}}" for word in words))
    return table


def print_falls(args, rows: list[dict], cases: list[str], labels: list[str]) -> None:
    """How many episodes of each method and case ended in a fall (before their very last step)."""
    print("\nepisodes with a fall")
    for method in methods_of(rows):
        mine = [[float(r["fall_time_s"]) for r in rows if (r["method"], r["case"]) == (method, case)] for case in cases]
        words = [f"{sum(time < args.seconds for time in times)} of {len(times)}" for times in mine]
        print(f"{method:28}" + "".join(f"{word:>{column_width(labels)}}" for word in words))


def print_choices(picked: torch.Tensor, behaviours: list[str], cases: list[str]) -> None:
    """Of ROAM: the share of each behaviour (K of them) in all steps of a case, after falls too.

    picked: (cases * episodes, K) steps.
    """
    shares = picked.unflatten(0, (len(cases), -1)).sum(1)  # (cases, K)
    shares /= shares.sum(1, keepdim=True)
    print(f"\n{'roam chooses':28}" + "".join(f"{case:>{column_width(cases)}}" for case in cases))
    for name, row in zip(behaviours, shares.T.tolist(), strict=True):
        print(f"{name:28}" + "".join(f"{share:>{column_width(cases)}.0%}" for share in row))


def column_width(labels: list[str]) -> int:
    return max(14, *(len(label) + 2 for label in labels))


def mean_and_deviation(rows: list[dict], method: str, cases: list[str], column: str) -> tuple[np.ndarray, np.ndarray]:
    """Over all episodes (and seeds) of the method, one number a case each."""
    values = [[float(row[column]) for row in rows if (row["method"], row["case"]) == (method, case)] for case in cases]
    return np.array([np.mean(v) for v in values]), np.array([np.std(v) for v in values])


def write_csv(path: Path, rows: list[dict]) -> None:
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
