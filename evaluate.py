"""The paper's experiments. Each is one function below, named as on the command line.

    python evaluate.py stiffness                          # every shipped checkpoint; about a minute a method
    python evaluate.py stiffness --checkpoints runs/a1-stiffness-rolt-seed0/policy.pt
    python evaluate.py stiffness --methods rolt --episodes 8 --seconds 10 --out /tmp/quick

Each prints a table and writes EXPERIMENT.csv (one row an episode) and EXPERIMENT.png to --out (default: results).
Policies act by their mean, without dropout. The same seed and the same number of threads give the same numbers.
"""

import csv
from pathlib import Path

import numpy as np
import torch

from baselines import METHODS
from checkpoint import CheckpointError, load_policy
from cli import Parser, count, fail, num_cores, positive, seed, writable_folder
from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import TASKS, Fault, healthy
from plots import bar_charts
from ppo import to_tensors

COLUMNS = ("method", "checkpoint", "seed", "case", "episode", "distance_m", "fall_time_s", "episode_return")


@torch.no_grad()
def run_episodes(
    policy, robot: str, faults: list[Fault], speed: float, seconds: float, seed: int = 0, threads: int = 0
) -> dict[str, np.ndarray]:
    """One episode on each of len(faults) robots, robot i with faults[i], told to walk straight on at `speed`.

    Starts vary as in training (pose, velocity, friction); nobody is pushed. A fall is what ends an episode in
    training: the trunk touches the ground or tilts by more than 60 degrees.

    Returns (N,) each: distance_m, net displacement along the commanded heading up to the first fall or the end;
    fall_time_s, of the first fall, `seconds` if there is none; episode_return, the reward up to then.
    """
    config = EnvConfig(
        episode_seconds=seconds + 1.0,  # nobody times out before we stop
        forward_speed=(speed, speed), lateral_speed=(0.0, 0.0), heading=(0.0, 0.0), push_speed=0.0,
    )  # fmt: skip
    env = LocomotionEnv(robot, len(faults), seed, threads, config=config, extras=policy.extras)
    env.pin_faults(faults)
    observation = env.reset()
    start, steps = env.position[:, 0].copy(), round(seconds / CONTROL_DT)
    distance, returns = np.zeros(len(faults)), np.zeros(len(faults))
    fall_time, upright = np.full(len(faults), seconds), np.ones(len(faults), dtype=bool)
    for step in range(1, steps + 1):
        action = policy(to_tensors(observation, "cpu")).numpy()
        observation, reward, terminated, _, info = env.step(action)
        valid = upright & ~info["diverged"]  # a diverged simulation's position means nothing: keep the last one
        distance[valid] = info["position"][valid, 0] - start[valid]
        returns += upright * reward
        fall_time[upright & terminated] = step * CONTROL_DT
        upright &= ~terminated
        if not upright.any():
            break
    return {"distance_m": distance, "fall_time_s": fall_time, "episode_return": returns}


def stiffness(args) -> None:
    """Section IV-A (i), figure "Stiffness test results": one calf locked at a time, 0.75 m/s for 20 s.

    Seen in training: healthy and FR locked. Unseen: FL, RR and RL locked.
    """
    task = TASKS["stiffness"]
    seen = [fault for _, fault in task.training]
    cases = {"healthy" if f == healthy() else f.locked[0].split("_")[0]: f for f in (*seen, *task.unseen)}
    rows = run_cases(args, cases, speed=0.75)
    marked = [f"{case}{'' if case == 'healthy' else ' locked'} ({'seen' if f in seen else 'unseen'})" for case, f in cases.items()]
    report(args, rows, list(cases), marked, "stiffness", f"Stiffness test: {args.robot}, 0.75 m/s, {args.seconds:g} s")


EXPERIMENTS = {"stiffness": stiffness}


def run_cases(args, cases: dict[str, Fault], speed: float) -> list[dict]:
    """Every checkpoint on every case, `args.episodes` robots each: the rows of the CSV file."""
    faults = [fault for fault in cases.values() for _ in range(args.episodes)]
    labels = [(case, episode) for case in cases for episode in range(args.episodes)]
    rows = []
    for path, (policy, card) in args.policies.items():
        print(f"{card['policy']}: {path} ({card['steps'] / 1e6:.1f}M steps, seed {card['seed']})", flush=True)
        outcome = run_episodes(policy, args.robot, faults, speed, args.seconds, args.seed, args.threads)
        for i, (case, episode) in enumerate(labels):
            measured = {name: f"{values[i]:.4f}" for name, values in outcome.items()}
            row = {"method": card["policy"], "checkpoint": str(path), "seed": card["seed"], "case": case}
            rows.append(row | {"episode": episode} | measured)
    return rows


def report(args, rows: list[dict], cases: list[str], labels: list[str], name: str, title: str) -> None:
    """Prints the table (mean +- sd over episodes), writes the CSV file and the bar charts."""
    with open(args.out / f"{name}.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)

    methods = list(dict.fromkeys(row["method"] for row in rows))
    panels = {}
    for column, label in (("distance_m", "distance walked [m]"), ("fall_time_s", "time of the first fall [s]")):
        panels[label], lines = {}, []
        for method in methods:
            values = [
                np.array([float(row[column]) for row in rows if (row["method"], row["case"]) == (method, case)]) for case in cases
            ]
            panels[label][method] = np.array([v.mean() for v in values]), np.array([v.std() for v in values])
            lines.append("".join(f"{f'{v.mean():.2f} +- {v.std():.2f}':>22}" for v in values))
        print(f"\n{label:28}" + "".join(f"{text:>22}" for text in labels))
        for method, line in zip(methods, lines):
            print(f"{method:28}{line}")
    for method in methods:
        mine = [row for row in rows if row["method"] == method]
        falls = [sum(float(r["fall_time_s"]) < args.seconds for r in mine if r["case"] == case) for case in cases]
        print(f"\nfalls of {len(mine) // len(cases)}, {method}: " + ", ".join(f"{label} {n}" for label, n in zip(labels, falls)))
    bar_charts(panels, labels, args.out / f"{name}.png", title)
    print(f"\nwritten: {args.out / f'{name}.csv'}, {args.out / f'{name}.png'}")


def find_policies(args) -> dict[Path, tuple]:
    """{path: (policy, card)}: the files of --checkpoints, or what checkpoints/ holds for this test."""
    if args.checkpoints:
        paths = args.checkpoints
    else:
        wanted = args.methods or list(METHODS)
        shipped = Path(__file__).parent / "checkpoints"
        named = {method: shipped / f"{args.robot}-{args.experiment}-{method}.pt" for method in wanted}
        paths = [path for path in named.values() if path.is_file()]
        for method in (m for m, path in named.items() if not path.is_file()):
            print(f"no checkpoint of {method} yet: python train.py --robot {args.robot} --task {args.experiment} --policy {method}")
        if not paths:
            fail("nothing to evaluate: name files with --checkpoints")
    try:
        return {path: load_policy(path, args.robot) for path in paths}
    except CheckpointError as error:
        fail(error)


def main(argv: list[str] | None = None) -> None:
    parser = Parser(__doc__)
    parser.add_argument("experiment", choices=EXPERIMENTS)
    parser.add_argument("--robot", default=None, help="default: the first one that the test is for")
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="which shipped checkpoints (default: all)")
    parser.add_argument("--checkpoints", nargs="+", type=Path, metavar="FILE", help="policy files, instead of the shipped")
    parser.add_argument("--episodes", type=count, default=32, help="a case (default 32)")
    parser.add_argument("--seconds", type=positive, default=20.0, help="of an episode (default 20, the paper's)")
    parser.add_argument("--seed", type=seed, default=0, help="of the starts")
    parser.add_argument("--threads", type=count, default=num_cores(), help="cores to use (default: all)")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the CSV file and the picture")
    args = parser.parse_args(argv)
    robots = TASKS[args.experiment].robots
    args.robot = args.robot or robots[0]
    if args.robot not in robots:
        fail(f"the test {args.experiment} is for {', '.join(robots)}, not for {args.robot}")
    if args.seconds < CONTROL_DT:
        fail(f"an episode lasts at least {CONTROL_DT} s, not {args.seconds:g}")
    args.policies = find_policies(args)
    writable_folder(args.out)
    torch.set_num_threads(args.threads)
    EXPERIMENTS[args.experiment](args)


if __name__ == "__main__":
    main()
