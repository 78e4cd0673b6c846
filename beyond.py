"""What the paper does not ask: how a policy grew, and what else it survives. Run by evaluate.py.

    python evaluate.py sudden             # a fault that strikes in mid-stride, and goes
    python evaluate.py matrix [--pairs]   # every joint, five ways
    python evaluate.py senses             # sensors that fail, motors that are late
    python evaluate.py legs --checkpoints FILE ...    # how many legs must training harm?
    python evaluate.py growth --checkpoints runs/*/policy-*M.pt
    python evaluate.py curves             # learning curves

All on flat ground, told to walk at 0.75 m/s. Policies were trained on none of it, but for the
faults of their task.
"""

from itertools import combinations

import numpy as np

import plots
from env import CONTROL_DT
from faults import HEALTHY, TASKS
from report import USED, by_seed, mean_and_interval, report, scores
from robots import ROBOTS
from walk import Walk, read_csv, walk_cases, write_csv

SPEED = 0.75  # m/s, the paper's
STRIKE, END, LENGTH = 5.0, 12.0, 20.0  # s
BACK = 0.8  # of the speed before
DEAD = "lock", "disable"  # what makes a joint of no use
HARMS = {harm: f"{harm}:{{}}" for harm in DEAD}
HARMS |= {f"weaken to {x}": f"weaken:{{}}:{x}" for x in (0.75, 0.5, 0.25)}
KEY = ("checkpoint", "case", "episode")  # of a row
# What is late or sensed wrongly, five severities each. The last two: of how many quarters of legs.
SEVERITIES = {
    "late": (0, 0.01, 0.02, 0.03, 0.04),  # s, all motors
    "bias": (0, 0.05, 0.1, 0.2, 0.4),  # rad, all angles
    "imu": (0, 0.05, 0.1, 0.2, 0.4),  # rad
    "odometry": (1, 0.75, 0.5, 0.25, 0),  # share of the velocity that is sensed
    "freeze": (0, 1, 2, 3, 4), "mute": (0, 1, 2, 3, 4),
}  # fmt: skip


def curves(args, policies) -> None:
    """How each method learned, in training: mean over the seeds, and their range."""
    methods = {}
    for _, card in policies.values():
        if len(card["curve"]):
            methods.setdefault(card["policy"], []).append(card["curve"].numpy())
    if not methods:
        raise ValueError("none of these files has a learning curve: they are of an older version")
    plots.learning_curves(methods, args.out / "curves.png", f"{args.robot}, {args.task}")


def growth(args, policies) -> None:
    """Success on what was never seen, against the steps of training. What growth.csv holds of other
    runs stays in it: snapshots are too many to keep."""
    rows = walk_cases(args, policies, {fault: fault for fault in TASKS[args.task].unseen}, SPEED)
    steps = {str(path): card["steps"] for path, (_, card) in policies.items()}
    for row in rows:
        row |= {"fault": row["case"], "method": row["method"].split()[0], "seed": str(row["seed"])}
        row["case"] = f"{steps[row['checkpoint']] / 1e6:.1f}"
    if (path := args.out / "growth.csv").exists():
        new = {(row["method"], row["seed"]) for row in rows}
        kept = [row for row in read_csv(path) if row["fault"] in TASKS[args.task].unseen]
        rows = [row for row in kept if (row["method"], row["seed"]) not in new] + rows
    rows.sort(key=lambda row: float(row["case"]))
    columns = {"success": "success on unseen faults", "share": "share of the distance"}
    report(args, rows, columns, f"Growth: {args.robot}", x="env steps [million]")


def legs(args, policies) -> None:
    """How many legs must training harm, and does it help if locks come and go? Policies of several
    tasks (faults.py), with each calf locked, and each dead, which none of them has seen."""
    faults = [f"{harm}:{leg}_calf" for harm in DEAD for leg in ROBOTS[args.robot].legs]
    rows = walk_cases(args, policies, {fault: fault for fault in (HEALTHY, *faults)}, SPEED)
    columns = {"success": "success", "distance_m": "distance walked [m]"}
    report(args, rows, columns, f"Legs harmed in training: {args.robot}", seen=[HEALTHY])


def sudden(args, policies) -> None:
    """A healthy walk; at 5 s a fault strikes, at 12 s it has gone. Training may have shown it, but
    from the start on. How long until the robot goes at 80 % of its former speed again (mean over a
    second; 8 s: not within the test)? Always 20 s, whatever --seconds says."""
    args.seconds = LENGTH
    faults = *TASKS[args.task].seen[1:], *TASKS[args.task].unseen
    cases = {HEALTHY: HEALTHY} | {fault: f"{fault}@{STRIKE:g}:{END:g}" for fault in faults}
    rows = walk_cases(args, policies, cases, SPEED, recovery)
    columns = {"fell": "share of falls", "during": "speed while it lasts / before"}
    columns |= {"recovery_s": "time to recover [s]", "distance_m": "distance walked [m]"}
    title = f"Sudden faults, {STRIKE:g} to {END:g} s: {args.robot}"
    report(args, rows, columns, title, seen=[HEALTHY])


def recovery(walk: Walk, i: int) -> dict[str, str]:
    """Of robot i; who falls does not recover."""
    x, second = walk.poses[: walk.steps[i] + 1, i, 0], round(1 / CONTROL_DT)
    strike, end = round(STRIKE / CONTROL_DT), round(END / CONTROL_DT)
    numbers = {"during": 0.0, "recovery_s": LENGTH - END}
    if walk.steps[i] >= end:
        before = (x[strike] - x[second]) / (strike - second)  # m a step
        numbers["during"] = (x[end] - x[strike]) / (end - strike) / before
        speed = (x[end:] - x[end - second : -second]) / second  # the mean of the second before
        back = np.flatnonzero(speed >= BACK * before)
        if before > 0 and len(back) and not walk.fell[i]:
            numbers["recovery_s"] = back[0] * CONTROL_DT
    return {name: f"{number:.3f}" for name, number in numbers.items()}


def matrix(args, policies) -> None:
    """Every joint locked, dead or weak, one at a time (--pairs: two legs at a time, their calves
    locked or dead, or all weak). Survived: no fall, at least half of the commanded distance; cells
    of a leg that the healthy gait hardly uses do not count."""
    robot = ROBOTS[args.robot]
    parts = [(joint,) for joint in robot.joints]
    if args.pairs:
        parts = list(combinations(robot.legs, 2))
    last = robot.joints[-1].split("_")[1]  # a calf is what is locked or dead of a leg
    cases = {}
    for names in parts:
        for harm, word in HARMS.items():
            whole = [f"{x}_{last}" if args.pairs and ":{}:" not in word else x for x in names]
            cases[f"{'+'.join(names)}, {harm}"] = "+".join(word.format(name) for name in whole)
    rows = walk_cases(args, policies, cases, SPEED)
    args.experiment += "-pairs" * args.pairs
    path = args.out / args.experiment
    write_csv(path.with_suffix(".csv"), rows)
    maps = {}
    print("\n| method | share of the map that is survived |\n|---|---|")
    for method in dict.fromkeys(row["method"] for row in rows):
        used = [row for row in rows if not float(row["leg_duty"]) < USED]  # NaN: not known
        mean, low, high = mean_and_interval(by_seed(used, "success", method=method))
        print(f"| {method} | {mean:.2f} ({low:.2f} to {high:.2f}) |")
        both = (scores(rows, method, [*cases], column).mean(axis=0) for column in ("share", "fell"))
        maps[f"{method}: {mean:.0%} survived"] = [x.reshape(len(parts), -1) for x in both]
    labels = ["+".join(names) for names in parts], [*HARMS]
    title = f"Share of the distance, and falls: {robot.name}"
    plots.heat_maps(maps, *labels, path.with_suffix(".png"), title)


def senses(args, policies) -> None:
    """Success against how badly a sense fails (SEVERITIES, from none to most)."""
    legs, rows = ROBOTS[args.robot].legs, {}
    for kind, sizes in SEVERITIES.items():
        part = "trunk" if kind in ("imu", "odometry") else "all"
        words = [f"{kind}:{part}:{size}" for size in sizes]
        if kind in ("freeze", "mute"):
            broken = [legs[: n * len(legs) // 4] for n in sizes]
            words = ["+".join(f"{kind}:{leg}" for leg in some) or HEALTHY for some in broken]
        for row in walk_cases(args, policies, {str(i): x for i, x in enumerate(words)}, SPEED):
            key = tuple(row[name] for name in KEY)
            first = {name: row[name] for name in ("method", "seed", *KEY)}
            rows.setdefault(key, first)[kind] = row["success"]
    columns = {kind: f"success: {kind}, {sizes}" for kind, sizes in SEVERITIES.items()}
    report(args, [*rows.values()], columns, f"Senses: {args.robot}", x="severity")
