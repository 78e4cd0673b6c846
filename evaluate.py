"""The paper's experiments. Each is one function below, named as on the command line.

    python evaluate.py stiffness                          # every shipped checkpoint; about a minute a method
    python evaluate.py stiffness --checkpoints runs/a1-stiffness-rolt-seed0/policy.pt
    python evaluate.py dropout_ratio                      # why the dropout masks are stored
    python evaluate.py stiffness --methods rolt --episodes 8 --seconds 10 --out /tmp/quick

Each prints a table and writes EXPERIMENT.csv (one row an episode) and EXPERIMENT.png to --out (default: results).
Policies act by their mean, without dropout. The same seed and the same number of threads give the same numbers.
"""

import csv
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from baselines import METHODS
from checkpoint import CheckpointError, load_policy
from cli import Parser, count, fail, num_cores, positive, seed, writable_folder
from env import CONTROL_DT, EnvConfig, LocomotionEnv
from faults import TASKS, Fault, healthy
from paper import DAMAGE
from plots import bar_charts, ratio_bands
from ppo import Critic, PPOConfig, RolloutBuffer, collect, gaussian, to_tensors
from rolt import ROLT

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
    marked = [
        f"{case}{'' if case == 'healthy' else ' locked'} ({'seen' if fault in seen else 'unseen'})"
        for case, fault in cases.items()
    ]
    report(args, rows, list(cases), marked, "stiffness", f"Stiffness test: {args.robot}, 0.75 m/s, {args.seconds:g} s")


def damage(args) -> None:
    """Section IV-A (ii), table "Damage test results": one motor of the hexapod dead, 0.75 m/s for 20 s.

    Cases are named as in the paper: FLC is the calf of the front left leg, T a thigh. Healthy, FRT, MRT and MLC were
    trained (controls, not in the paper's table), nine others were not.
    """
    task = TASKS["damage"]
    faults = [fault for _, fault in task.training] + list(task.unseen)
    cases = {"healthy" if f == healthy() else short_name(f.strength[0][0]): f for f in faults}
    marked = [f"{case}{' (seen)' if i < len(task.training) else ''}" for i, case in enumerate(cases)]
    rows = run_cases(args, cases, speed=0.75)
    title = f"Damage test: {args.robot}, 0.75 m/s, {args.seconds:g} s"
    report(args, rows, list(cases), marked, "damage", title, paper=DAMAGE)


def short_name(joint: str) -> str:
    """FL_calf -> FLC"""
    leg, link = joint.split("_")
    return leg + link[0].upper()


@torch.no_grad()
def dropout_ratio(args) -> None:
    """Not in the paper, but its case for consistency (section III-C) in one picture: PPO's ratio before any weight has
    moved, where it should be 1.

    The shipped ROLT collects a rollout with feature dropout at each rate (PE dropout off). Then the update's probability
    of the same actions is computed with the stored masks (consistent dropout), with fresh masks (ordinary dropout) and
    without masks (what Roll-Drop does).
    """
    (path, (policy, _)), rows = next(iter(args.policies.items())), []
    print(f"{path}\n{'masks':10}{'rate':>8}{'5 %':>10}{'median':>10}{'95 %':>10}{'clipped':>10}")
    for rate in (1e-4, 1e-3, 1e-2, 0.05, 0.1, 0.2):
        model = ROLT(policy.num_legs, policy.num_joints, replace(policy.config, feature_dropout=rate, pe_dropout=0.0))
        model.load_state_dict(policy.state_dict(), strict=False)  # all but the vector of dropped positions
        for scheme, ratio in ratios(model, args).items():
            low, median, high = ratio.quantile(torch.tensor([0.05, 0.5, 0.95])).tolist()
            clipped = ((ratio - 1).abs() > PPOConfig.clip).float().mean().item()
            rows.append({"masks": scheme, "rate": rate, "low": low, "median": median, "high": high, "clipped": clipped})
            print(f"{scheme:10}{rate:8g}{low:10.4f}{median:10.4f}{high:10.4f}{clipped:10.1%}")
    write_csv(args.out / "dropout_ratio.csv", rows)
    ratio_bands(rows, args.out / "dropout_ratio.png", "PPO's ratio before any weight has moved (5 % to 95 % of samples)")
    print(f"\nwritten: {args.out / 'dropout_ratio.csv'}, {args.out / 'dropout_ratio.png'}")


def ratios(policy: ROLT, args, num_envs: int = 64) -> dict[str, torch.Tensor]:
    """{scheme: (samples,) PPO's ratio} of a fresh rollout, after a second of warming up."""
    env = LocomotionEnv(args.robot, num_envs, args.seed, args.threads, TASKS["stiffness"].training)
    observation, generator = env.reset(random_ages=True), torch.Generator().manual_seed(args.seed)
    critic = Critic(observation, policy.normalizer)
    buffer = RolloutBuffer(PPOConfig.steps, observation, env.num_actions, policy.sample_masks(num_envs, generator), "cpu")
    for _ in range(2):
        observation, _ = collect(env, policy, critic, buffer, observation, generator)
    batch = buffer.minibatch(torch.arange(len(buffer)))
    schemes = {"stored": batch["masks"], "fresh": policy.sample_masks(len(buffer), generator), "none": None}

    def ratio(masks) -> torch.Tensor:
        mean = policy(batch["observation"], masks)
        return (gaussian(mean, buffer.sigma).log_prob(batch["action"]).sum(-1) - batch["log_prob"]).exp()

    return {scheme: ratio(masks) for scheme, masks in schemes.items()}


# name -> (function, the task whose checkpoints it tests, the methods that it is for)
EXPERIMENTS = {
    "stiffness": (stiffness, "stiffness", tuple(METHODS)),
    "damage": (damage, "damage", tuple(METHODS)),
    "dropout_ratio": (dropout_ratio, "stiffness", ("rolt",)),
}


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


def report(args, rows: list[dict], cases: list[str], labels: list[str], name: str, title: str, paper: dict = {}) -> None:
    """Prints the tables (mean ± sd over episodes; the paper's own, where it has numbers), writes the CSV file and the
    bar charts.

    cases, labels: as in `rows`, and as they are to be shown. paper: {column: {method: {case: (mean, sd)}}}.
    """
    write_csv(args.out / f"{name}.csv", rows)
    methods, panels = list(dict.fromkeys(row["method"] for row in rows)), {}
    for column, quantity in (("distance_m", "distance walked [m]"), ("fall_time_s", "time of the first fall [s]")):
        table = panels[quantity] = {method: mean_and_deviation(rows, method, cases, column) for method in methods}
        width = max(14, *(len(label) + 2 for label in labels))
        print(f"\n{quantity:28}" + "".join(f"{label:>{width}}" for label in labels))
        for method, pairs in table.items():
            print(f"{method:28}" + "".join(f"{f'{mean:.2f} ± {deviation:.2f}':>{width}}" for mean, deviation in zip(*pairs)))
            known = paper.get(column, {}).get(method, {})
            if known:
                words = ["{:.2f} ± {:.2f}".format(*known[case]) if case in known else "-" for case in cases]
                print(f"{'  (paper)':28}" + "".join(f"{word:>{width}}" for word in words))
    print(f"\nepisodes with a fall, of {args.episodes}")
    for method in methods:
        mine = [row for row in rows if row["method"] == method]
        falls = [sum(float(r["fall_time_s"]) < args.seconds for r in mine if r["case"] == case) for case in cases]
        print(f"{method:28}" + "".join(f"{n:>{width}}" for n in falls))
    bar_charts(panels, labels, args.out / f"{name}.png", title)
    print(f"\nwritten: {args.out / f'{name}.csv'}, {args.out / f'{name}.png'}")


def mean_and_deviation(rows: list[dict], method: str, cases: list[str], column: str) -> tuple[np.ndarray, np.ndarray]:
    """Over all episodes (and seeds) of the method, one number a case each."""
    values = [[float(row[column]) for row in rows if (row["method"], row["case"]) == (method, case)] for case in cases]
    return np.array([np.mean(v) for v in values]), np.array([np.std(v) for v in values])


def write_csv(path: Path, rows: list[dict]) -> None:
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def find_policies(args) -> dict[Path, tuple]:
    """{path: (policy, card)}: the files of --checkpoints, or what checkpoints/ holds for this test."""
    if args.checkpoints:
        paths = args.checkpoints
    else:
        _, task, suitable = EXPERIMENTS[args.experiment]
        wanted = args.methods or suitable
        shipped = Path(os.path.relpath(Path(__file__).parent / "checkpoints"))
        named = {method: shipped / f"{args.robot}-{task}-{method}.pt" for method in wanted}
        paths = [path for path in named.values() if path.is_file()]
        missing = [method for method, path in named.items() if not path.is_file()]
        if missing:
            train = f"python train.py --robot {args.robot} --task {task} --policy {missing[0] if len(missing) == 1 else 'all'}"
            print(f"not trained yet: {', '.join(missing)}; {train}, then --checkpoints")
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
    function, task, suitable = EXPERIMENTS[args.experiment]
    robots = TASKS[task].robots
    args.robot = args.robot or robots[0]
    if args.robot not in robots:
        fail(f"the test {args.experiment} is for {', '.join(robots)}, not for {args.robot}")
    if args.seconds < CONTROL_DT:
        fail(f"an episode lasts at least {CONTROL_DT} s, not {args.seconds:g}")
    args.policies = find_policies(args)
    unsuitable = {card["policy"] for _, card in args.policies.values()} - set(suitable)
    if unsuitable:
        fail(f"{args.experiment} is for {', '.join(suitable)}, not for {', '.join(sorted(unsuitable))}")
    writable_folder(args.out)
    torch.set_num_threads(args.threads)
    function(args)


if __name__ == "__main__":
    main()
