"""What the paper does not ask; experiments of evaluate.py like its own (their list is there).

All on flat ground, told to walk at 0.75 m/s (mechanisms: a policy trained on stairs on stairs).
"""

import sys
from dataclasses import replace
from itertools import combinations

import numpy as np
import torch

import plots
from env import CONTROL_DT, LocomotionEnv
from faults import HEALTHY, TASKS
from ppo import Critic, PPOConfig, RolloutBuffer, collect
from report import USED, by_seed, mean_and_interval, report, scores
from robots import ROBOTS
from rolt import ROLT, Observation
from terrain import Terrain
from walk import Walk, duty, origin, read_csv, take_a_walk, walk_cases, write_csv

SPEED = 0.75  # m/s, the paper's
STRIKE, END, LENGTH = 5.0, 12.0, 20.0  # s
BACK = 0.8  # of the speed before
GATE = 0.1  # standard deviations of an action, ours: less is no mechanism
DEAD = "lock", "disable"  # what makes a joint of no use
HARMS = {harm: f"{harm}:{{}}" for harm in DEAD}
HARMS |= {f"weaken to {x}": f"weaken:{{}}:{x}" for x in (0.75, 0.5, 0.25)}
KEY = ("checkpoint", "case", "episode")  # of a row
GROWN = ("method", "seed", "case")  # of a snapshot; the case is its steps
# What is late or sensed wrongly, five severities each. The last two: of how many quarters of legs.
SEVERITIES = {
    "late": (0, 0.01, 0.02, 0.03, 0.04),  # s, all motors
    "bias": (0, 0.05, 0.1, 0.2, 0.4),  # rad, all angles
    "imu": (0, 0.05, 0.1, 0.2, 0.4),  # rad
    "odometry": (1, 0.75, 0.5, 0.25, 0),  # share of the velocity that is sensed
    "freeze": (0, 1, 2, 3, 4), "mute": (0, 1, 2, 3, 4),
}  # fmt: skip


def mechanisms(args, policies) -> None:
    """Is what the claims rest on alive? How much a method's actions change in a healthy walk, in
    their standard deviations, when a part of it is disturbed: an ablation is worth comparing if it
    takes away 0.1 or more. Then how well a linear probe names a leg from its history (by chance 1
    in L), and each foot's share of the time down: a fault on a leg below 0.1 tests nothing."""
    rows = []
    for path, (policy, card) in policies.items():
        course = Terrain(("stairs",), (-1,) * 3) if card["task"] == "terrain" else None
        how = {"seconds": 6.0, "seed": args.seed, "threads": args.threads, "terrain": course}
        speed, seen = 0.5 if course else SPEED, []
        walk = take_a_walk(policy, args.robot, [HEALTHY] * 32, speed, observations=seen, **how)
        up = ~walk.fell | walk.fell.all()  # all, if none stays up
        fields = zip(*(seen[100::10] or seen))  # every tenth step from 2 s on
        states = Observation(*(torch.tensor(np.array(x)[:, up]).flatten(0, 1) for x in fields))
        shares = zip(walk.env.robot.legs, duty(walk, range(32)))
        numbers = {f"duty of {leg}": share for leg, share in shares}
        actions = policy(states)
        for name, other in disturbances(policy, states):
            change = (policy(other) - actions) / actions.std(0)
            numbers[name] = change.square().mean().sqrt().item()
        numbers["leg named by its history"] = leg_probe(states.legs)
        row = origin(path, card)
        rows += [row | {"case": name, "value": f"{x:.4f}"} for name, x in numbers.items()]
    columns = {"value": "change of the actions [their deviation]; share"}
    report(args, rows, columns, f"Mechanisms: {args.robot}")
    dead = [row for row in rows if float(row["value"]) < GATE]
    dead = [f"{row['method']} {row['seed']}, {row['case']}" for row in dead]
    print(f"\nbelow the gate of {GATE}:", "; ".join(dead) or "nothing")


def disturbances(policy, states: Observation):
    """(what, the observation or the policy so disturbed), of those that the policy has."""
    other = torch.arange(len(states.legs)).roll(len(states.legs) // 2)  # another robot's
    if states.heights.numel():
        yield "scan turned round", states._replace(heights=states.heights.flip(1))
        yield "another's scan", states._replace(heights=states.heights[other])
    if "action" in getattr(policy, "others", ()):
        yield "another's action token", states._replace(action=states.action[other])
    yield "another's legs", states._replace(legs=states.legs[other])
    for part in ("patch", "leg"):
        if (position := getattr(policy, f"{part}_position", None)) is not None:
            kept = position.clone()
            position.copy_(position.mean(0).expand_as(position))
            yield f"{part} positions equal", states
            position.copy_(kept)


def leg_probe(legs: torch.Tensor) -> float:
    """Share of (B, L, H, frame) histories whose leg a linear fit to their first half can name."""
    B, L = legs.shape[:2]
    x = torch.cat([legs.flatten(2), torch.ones(B, L, 1)], dim=2).double()
    a, b = x[: B // 2].flatten(0, 1), torch.eye(L).double().repeat(B // 2, 1)
    weights = torch.linalg.solve(a.T @ a + 1e-2 * len(a) * torch.eye(a.shape[1]).double(), a.T @ b)
    named = (x[B // 2 :] @ weights).argmax(2)
    return (named == torch.arange(L)).double().mean().item()


def dropout_ratio(args, policies) -> None:
    """Not in the paper, but its case for consistency (section III-C) in one picture: PPO's ratio
    before any weight has moved, where it should be 1. The first policy collects a rollout at every
    rate; the update has its masks (consistent dropout), fresh (ordinary) or none (Roll-Drop)."""
    (policy, card), *_ = policies.values()
    if not isinstance(policy, ROLT):
        sys.exit(f"error: {card['policy']} is no ROLT and has no feature dropout")
    rows, faults, extras = [], TASKS["stiffness"].training, (*policy.extras, "privileged")
    for rate in (1e-4, 1e-3, 1e-2, 0.05, 0.1, 0.2):
        config = replace(policy.config, feature_dropout=rate)
        model = ROLT(policy.num_legs, policy.num_joints, config)
        model.load_state_dict(policy.state_dict())
        env = LocomotionEnv(args.robot, 64, args.seed, 1, faults, extras=extras)
        observation = env.reset(random_ages=True)
        generator = torch.Generator().manual_seed(args.seed)
        critic, masks = Critic(observation), model.sample_masks(64, generator)
        buffer = RolloutBuffer(PPOConfig.steps, observation, env.num_actions, masks, "cpu")
        for _ in range(2):  # what counts is the second, after half a second of walking
            observation, _ = collect(env, model, critic, buffer, observation, generator)
        batch = buffer.minibatch(torch.arange(len(buffer)))
        fresh = model.sample_masks(len(buffer), generator)
        schemes = {"stored masks": batch["masks"], "fresh masks": fresh, "no masks": None}
        for scheme, masks in schemes.items():
            actions = torch.distributions.Normal(model(batch["observation"], masks), buffer.std)
            ratio = (actions.log_prob(batch["action"]).sum(-1) - batch["log_prob"]).exp()
            clipped = ((ratio - 1).abs() > PPOConfig.clip).float().mean().item()
            off = ratio.log().abs().median().exp().item()
            row = {"method": scheme, "seed": card["seed"], "case": f"{rate:g}"}
            rows.append(row | {"clipped": f"{clipped:.4f}", "off_by": f"{off:.4f}"})
    columns = {"off_by": "factor by which the ratio is off (median)", "clipped": "share clipped"}
    report(args, rows, columns, "PPO's ratio before any weight has moved", x="feature dropout rate")


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
    """Success on each unseen fault, against the steps of training, of --checkpoints
    runs/*/policy-*M.pt. Others stay in growth.csv: snapshots are too many to ship."""
    faults = TASKS[args.task].unseen
    rows = walk_cases(args, policies, {fault: fault for fault in faults}, SPEED)
    steps = {str(path): card["steps"] for path, (_, card) in policies.items()}
    for row in rows:
        row |= {"fault": row["case"], "method": row["method"].split()[0], "seed": str(row["seed"])}
        row["case"] = f"{steps[row['checkpoint']] / 1e6:.1f}"
    if (path := args.out / "growth.csv").exists():
        new = {tuple(row[key] for key in GROWN) for row in rows}
        kept = [row for row in read_csv(path) if row["fault"] in faults]
        rows = [row for row in kept if tuple(row[key] for key in GROWN) not in new] + rows
    rows.sort(key=lambda row: float(row["case"]))
    for row in rows:
        row |= {fault: row["success"] if fault == row["fault"] else "" for fault in faults}
    columns = {fault: f"success, {fault}" for fault in faults}
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
