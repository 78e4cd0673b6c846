"""One walk of a policy, and what is measured of it.

Robots go straight on and unpushed; starts vary as in training. N robots, T steps of 20 ms, L legs.
"""

import csv
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import HEALTHY, harms_of
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
    poses: np.ndarray  # (T, N, nq), MuJoCo's qpos
    contacts: np.ndarray  # (T, N, L) bool, which feet were on the ground
    steps: np.ndarray  # (N,) up to the first fall
    distance: np.ndarray  # (N,) m, net displacement along the commanded heading up to then
    fall_time: np.ndarray  # (N,) s, of the first fall; the whole time if there was none
    returns: np.ndarray  # (N,) reward up to then
    fell: np.ndarray  # (N,) bool


def show_progress(label: str, done: int, total: int, start: float) -> None:
    """One line on a terminal, and how long it will take."""
    if sys.stderr.isatty() and done % 10 == 0:
        left = (time.monotonic() - start) * (total - done) / done
        bar = f"\r\033[K{label} [{'#' * (20 * done // total):.<20}] {left:.0f} s left"
        print(bar if done < total else "\r\033[K", end="", file=sys.stderr, flush=True)


@torch.no_grad()
def take_a_walk(
    policy, robot, faults, speed, seconds, seed=0, threads=0, observations=None, label="", **sim
) -> Walk:
    """Robot i with faults[i], at speed m/s. observations: a list to which each step's is added.
    label: of the progress that is shown. sim: options of LocomotionEnv, as terrain and noise. A
    fall: the trunk on the ground or tilted by more than 60 degrees, or a simulation that diverges
    (which is said on stderr)."""
    N, situations = len(faults), [(1.0, fault) for fault in faults]
    config, extras = straight_ahead(policy, speed, seconds), policy.extras
    env = LocomotionEnv(robot, N, seed, threads, situations, config, extras, **sim)
    env.pin_faults(faults)  # one each
    feet = [env.model.sensor(f"contact_{leg}_foot").adr[0] for leg in env.robot.legs]
    observation, poses, contacts = env.reset(), [], []
    start, distance, returns = env.position[:, 0].copy(), np.zeros(N), np.zeros(N)
    upright, steps, divergences = np.ones(N, dtype=bool), np.zeros(N, dtype=int), 0
    began, T = time.monotonic(), round(seconds / CONTROL_DT)
    for t in range(T):
        poses.append(env.world.bind("qpos").copy())
        contacts.append(env.world.bind("sensordata")[:, feet] > 0)
        if observations is not None:
            observations.append(observation)
        action = policy(to_tensors(observation, "cpu")).numpy()
        observation, reward, terminated, _, info = env.step(action)
        divergences += (upright & info["diverged"]).sum()
        valid = upright & ~info["diverged"]  # a diverged position means nothing: keep the last one
        distance[valid] = info["position"][valid, 0] - start[valid]
        returns += upright * reward
        upright &= ~terminated
        steps += upright
        show_progress(label, t + 1, T, began)
        if not upright.any():
            break
    if divergences:
        print(f"simulations that diverged, counted as falls: {divergences}", file=sys.stderr)
    fall_time = np.where(upright, seconds, (steps + 1) * CONTROL_DT)
    poses, contacts = np.array(poses), np.array(contacts)
    return Walk(env, poses, contacts, steps, distance, fall_time, returns, ~upright)


def duty(walk: Walk, robots: list[int]) -> np.ndarray:
    """(L,) share of the time that each foot was down, from WARM_UP to the first fall, mean over
    `robots`; above 0.5 in a walk, below in a run. NaN if that is too short for all of them."""
    steady = [walk.contacts[round(WARM_UP / CONTROL_DT) : walk.steps[i], i] for i in robots]
    shares = [x.mean(axis=0) for x in steady if len(x) * CONTROL_DT >= SHORTEST]
    return np.mean(shares, axis=0) if shares else np.full(walk.contacts.shape[2], np.nan)


def origin(path: Path, card: dict) -> dict:
    """Which policy a row of a CSV file is about."""
    return {"method": card["policy"], "seed": card["seed"], "checkpoint": str(path)}


def walk_cases(
    args, policies, cases: dict[str, str], speed: float, measure=lambda walk, i: {}, **sim
) -> list[dict]:
    """Every policy on every case, `args.episodes` robots each: rows of the CSV file. Distance is as
    walked; `share` is of the commanded distance, at most 1 (to run ahead is no success). `leg_duty`
    is of the harmed leg, the least used if several, in the healthy case (1 without one). measure:
    what else is wanted of robot i."""
    labels = [(case, episode) for case in cases for episode in range(args.episodes)]
    faults = [cases[case] for case, _ in labels]
    how = {"speed": speed, "seconds": args.seconds, "seed": args.seed, "threads": args.threads}
    rows = []
    for path, (policy, card) in policies.items():
        label = f"{card['policy']}, seed {card['seed']}, {', '.join(cases)}"[:60]
        walk = take_a_walk(policy, args.robot, faults, label=label, **how, **sim)
        healthy, sound = [i for i, fault in enumerate(faults) if fault == HEALTHY], walk
        if not healthy:  # it takes a walk of its own to know
            healthy = range(8)
            sound = take_a_walk(policy, args.robot, [HEALTHY] * 8, **how, **sim)
        duties = dict(zip(sound.env.robot.legs, duty(sound, healthy)))
        for i, (case, episode) in enumerate(labels):
            parts = [harm.part.split("_")[0] for harm in harms_of(faults[i])]
            used = [duties.get(leg, 1.0) for leg in parts]
            share, fell = min(1.0, walk.distance[i] / (speed * args.seconds)), walk.fell[i]
            rows.append(origin(path, card) | {
                "case": case, "episode": episode, "fell": int(fell),
                "success": int(share >= 0.5 and not fell), "distance_m": f"{walk.distance[i]:.4f}",
                "share": f"{share:.4f}", "fall_time_s": f"{walk.fall_time[i]:.4f}",
                "leg_duty": f"{min(used, default=1.0):.2f}",
                "episode_return": f"{walk.returns[i]:.4f}",
            } | measure(walk, i))  # fmt: skip
    return rows


def read_csv(path: Path) -> list[dict]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def write_csv(path: Path, rows: list[dict], mode: str = "w") -> None:
    """mode "a": adds rows to those in the file."""
    with open(path, mode, newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        if mode == "w":
            writer.writeheader()
        writer.writerows(rows)
