"""One walk of a policy, what is measured of it, and tables over cases and seeds.

Robots go straight on and unpushed; starts vary as in training. N robots, T steps of 20 ms, L legs.
"""

import csv
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import Fault
from ppo import to_tensors

WARM_UP = 2.0  # s after the start that do not count for a gait; ours: by then the robot walks
SHORTEST = 1.0  # s on its feet after that, or there is no gait to measure; ours: several strides


def straight_ahead(policy, speed: float, seconds: float) -> EnvConfig:
    """Straight on at `speed` m/s from the terrain's first row, no push or time-out in `seconds`."""
    return EnvConfig(
        leg_frames=policy.leg_frames, episode_seconds=seconds + 1.0, forward_speed=(speed, speed),
        heading=(0.0, 0.0), push_speed=0.0, start_rows=1, climb=False,
    )  # fmt: skip


class Walk(NamedTuple):
    """What N robots did. What follows a robot's first fall means nothing."""

    env: LocomotionEnv
    faults: list[Fault]
    poses: np.ndarray  # (T, N, nq), MuJoCo's qpos
    contacts: np.ndarray  # (T, N, L) bool, which feet were on the ground
    steps: np.ndarray  # (N,) up to the first fall
    distance: np.ndarray  # (N,) m, net displacement along the commanded heading up to then
    fall_time: np.ndarray  # (N,) s, of the first fall; the whole time if there was none
    returns: np.ndarray  # (N,) reward up to then

    @property
    def fell(self) -> np.ndarray:  # (N,) bool
        return self.steps < len(self.poses)


@torch.no_grad()
def take_a_walk(policy, robot, faults, speed, seconds, seed=0, threads=0, **env_options) -> Walk:
    """Robot i with faults[i], at speed m/s. env_options: of LocomotionEnv, as terrain and noise. A
    fall is what ends an episode in training: the trunk on the ground or tilted by more than 60
    degrees, or a simulation that diverges (that is said on stderr)."""
    N, situations = len(faults), [(1.0, fault) for fault in faults]
    config, extras = straight_ahead(policy, speed, seconds), policy.extras
    env = LocomotionEnv(robot, N, seed, threads, situations, config, extras, **env_options)
    env.pin_faults(faults)  # one each
    feet = [env.model.sensor(f"contact_{leg}_foot").adr[0] for leg in env.robot.legs]
    observation, poses, contacts = env.reset(), [], []
    start, distance, returns = env.position[:, 0].copy(), np.zeros(N), np.zeros(N)
    upright, steps, divergences = np.ones(N, dtype=bool), np.zeros(N, dtype=int), 0
    for _ in range(round(seconds / CONTROL_DT)):
        poses.append(env.world.bind("qpos").copy())
        contacts.append(env.world.bind("sensordata")[:, feet] > 0)
        action = policy(to_tensors(observation, "cpu")).numpy()
        observation, reward, terminated, _, info = env.step(action)
        divergences += (upright & info["diverged"]).sum()
        valid = upright & ~info["diverged"]  # a diverged position means nothing: keep the last one
        distance[valid] = info["position"][valid, 0] - start[valid]
        returns += upright * reward
        upright &= ~terminated
        steps += upright
        if not upright.any():
            break
    if divergences:
        print(f"simulations that diverged, counted as falls: {divergences}", file=sys.stderr)
    fall_time = np.where(upright, seconds, (steps + 1) * CONTROL_DT)
    poses, contacts = np.array(poses), np.array(contacts)
    return Walk(env, faults, poses, contacts, steps, distance, fall_time, returns)


def without_chatter(contacts: np.ndarray) -> np.ndarray:
    """(T, L): each step takes the majority of itself and its two neighbours, so that a contact or a
    flight of a single step (20 ms, a bounce) is no stride."""
    padded = np.concatenate([contacts[:1], contacts, contacts[-1:]]).astype(int)
    return padded[:-2] + padded[1:-1] + padded[2:] >= 2


def stride_frequency(contacts: np.ndarray, dt: float) -> np.ndarray:
    """(L,) Hz: strides from a foot's first touchdown to its last over their time; 0 if none."""
    frequency = np.zeros(contacts.shape[1])
    for leg, foot in enumerate(contacts.T):
        touchdowns = np.flatnonzero(foot[1:] & ~foot[:-1])
        if len(touchdowns) > 1:
            frequency[leg] = (len(touchdowns) - 1) / ((touchdowns[-1] - touchdowns[0]) * dt)
    return frequency


def gait(walk: Walk, i: int) -> dict[str, np.ndarray] | None:
    """Of robot i, from WARM_UP to its first fall (None if too soon): (L,) share of the time on the
    ground (above 0.5 in a walk, below in a run), (L,) strides a second, () feet on the ground."""
    steady = without_chatter(walk.contacts[: walk.steps[i], i])[round(WARM_UP / CONTROL_DT) :]
    if len(steady) * CONTROL_DT < SHORTEST:
        return None
    strides, feet_down = stride_frequency(steady, CONTROL_DT), np.array(steady.sum(axis=1).mean())
    return {"duty": steady.mean(axis=0), "stride_hz": strides, "feet_down": feet_down}


def origin(path: Path, card: dict) -> dict:
    """Which policy a row of a CSV file is about."""
    return {"method": card["policy"], "seed": card["seed"], "checkpoint": str(path)}


def walk_cases(args, policies, cases: dict[str, Fault], speed: float, **env_options) -> list[dict]:
    """Every policy on every case, `args.episodes` robots each: rows of the CSV file. Distance is as
    walked; `share` is of the commanded distance, at most 1 (to run ahead is no success)."""
    labels = [(case, episode) for case in cases for episode in range(args.episodes)]
    faults = [cases[case] for case, _ in labels]
    how, rows = (speed, args.seconds, args.seed, args.threads), []
    for path, (policy, card) in policies.items():
        walk = take_a_walk(policy, args.robot, faults, *how, **env_options)
        for i, (case, episode) in enumerate(labels):
            share, fell = min(1.0, walk.distance[i] / (speed * args.seconds)), walk.fell[i]
            rows.append(origin(path, card) | {
                "case": case, "episode": episode, "fell": int(fell),
                "success": int(share >= 0.5 and not fell), "distance_m": f"{walk.distance[i]:.4f}",
                "share": f"{share:.4f}", "fall_time_s": f"{walk.fall_time[i]:.4f}",
                "episode_return": f"{walk.returns[i]:.4f}",
            })  # fmt: skip
        print(f"  {card['policy']}, seed {card['seed']}: done", flush=True)
    return rows


def cell(rows: list[dict], method: str, case: str, column: str) -> tuple[float, float]:
    """Mean over seeds of the mean over episodes; deviation over seeds (over episodes if one)."""
    mine = [row for row in rows if row["method"] == method and row["case"] == case]
    seeds = [[float(r[column]) for r in mine if r["seed"] == s] for s in {r["seed"] for r in mine}]
    means = [np.mean(values) for values in seeds]
    return float(np.mean(means)), float(np.std(means) if len(means) > 1 else np.std(seeds[0]))


def report(args, rows, name: str, title: str, columns: dict[str, str], marks={}) -> dict:
    """Writes the CSV file, prints a table of each of the columns {column: what} and of the falls.
    marks: {case: a remark}. Returns {what: {method: (means, deviations)}} for a chart."""
    write_csv(args.out / f"{name}.csv", rows)
    methods, cases = ([*dict.fromkeys(row[key] for row in rows)] for key in ("method", "case"))
    panels = {}
    print(f"\n{title}")
    for column, what in (columns | {"fell": "episodes with a fall"}).items():
        print(f"\n{what:22}" + "".join(f"{case + marks.get(case, ''):>15}" for case in cases))
        panels[what] = {}
        for method in methods:
            pairs = [cell(rows, method, case, column) for case in cases]
            panels[what][method] = [*zip(*pairs)]
            words = [f"{m:.0%}" if column == "fell" else f"{m:.2f} ± {d:.2f}" for m, d in pairs]
            print(f"{method:22}" + "".join(f"{word:>15}" for word in words))
    return {what: panels[what] for what in columns.values()}


def write_csv(path: Path, rows: list[dict]) -> None:
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
