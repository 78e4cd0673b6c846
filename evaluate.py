"""The paper's experiments. Each is one function below, named as on the command line.

    python evaluate.py stiffness                          # every shipped checkpoint
    python evaluate.py stiffness --checkpoints runs/a1-stiffness-rolt-seed0/policy.pt
    python evaluate.py stairs                             # the paper's terrain, seeing and blind
    python evaluate.py low_frequency                      # and high_frequency, attention: scandots that lie
    python evaluate.py real_world                         # a Go1 with a weak leg, a box in tow, skates
    python evaluate.py gaits                              # which foot is on the ground when
    python evaluate.py mechanisms                         # is what the claims rest on alive?
    python evaluate.py dropout_ratio                      # why the dropout masks are stored
    python evaluate.py stiffness --methods rolt --episodes 8 --seconds 10 --out /tmp/quick

Each prints a table and writes EXPERIMENT.csv and EXPERIMENT.png to --out; one row an episode where
robots walk. Several seeds of a method (NAME.pt, NAME-seed1.pt, ... in checkpoints/) are put
together: a cell is the mean over seeds, and over the episodes of each. Policies act by their mean,
without dropout (ROAM draws which of its behaviours acts). The same seed gives the same numbers.
"""

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import plots
from baselines import METHODS
from checkpoint import CheckpointError, load_policy
from env import CONTROL_DT, LocomotionEnv, Observation
from faults import REAL_WORLD, TASKS, Fault, first_task, healthy
from noise import HEIGHT_SCALE, NUM_PATCHES, ScanNoise, as_patches, missing_points
from ppo import Critic, PPOConfig, RolloutBuffer, collect, gaussian, to_tensors
from rolt import ROLT
from terrain import Terrain, rise
from walk import gait, report, straight_ahead, take_a_walk, walk_cases, write_csv

STAIRS_LEVEL = 0  # of the noise tests, ours: steps of 5 cm, the easiest of legged_gym
NOISE_SCALES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4)  # m, ours
GATE = 0.1  # standard deviations of an action, ours: less is no mechanism


DISTANCE = {"distance_m": "distance walked [m]"}


def fault_test(args, policies, name: str, task: str, case_name) -> None:
    """What was seen in training and what was not, one fault at a time, 0.75 m/s."""
    seen = [fault for _, fault in TASKS[task].training]
    cases = {case_name(fault): fault for fault in (*seen, *TASKS[task].unseen)}
    marks = {case: " (seen)" for case, fault in cases.items() if fault in seen}
    rows = walk_cases(args, policies, cases, speed=0.75)
    title = f"{name}: {args.robot}, 0.75 m/s, {args.seconds:g} s"
    panels = report(args, rows, args.experiment, title, DISTANCE | {"fall_time_s": "time of the first fall [s]"}, marks)
    plots.bar_charts(panels, [case + marks.get(case, "") for case in cases], args.out / f"{args.experiment}.png", title)


def stiffness(args, policies) -> None:
    """Section IV-A (i), figure "Stiffness test results": one calf locked at a time, 0.75 m/s for 20
    s.

    Seen in training: healthy and FR locked. Unseen: FL, RR and RL locked. In leg frames FL is the
    mirror image of FR, and a policy that is its own mirror image has as good as seen it; the hind
    legs are the test.
    """
    fault_test(args, policies, "Stiffness test", "stiffness", lambda fault: "".join(j[:2] for j in fault.locked) or "healthy")


def damage(args, policies) -> None:
    """Section IV-A (ii), table "Damage test results": one motor of the hexapod dead, 0.75 m/s for
    20 s.

    Cases are named as in the paper: FLC is the calf of the front left leg, T a thigh.
    """

    def case_name(fault: Fault) -> str:
        return "".join(j[:2] + j[3].upper() for j, _ in fault.strength) or "healthy"

    fault_test(args, policies, "Damage test", "damage", case_name)


def real_world(args, policies) -> None:
    """Section IV-C, table "Real-world Experiments", rebuilt in simulation: a Go1 trained on the
    stiffness task, 10 s.

        weaken   the front left leg's motors at half their strength, the hind right calf tied so that it cannot open
                 beyond its default angle; then each other leg weak in its place
        box      the hind right foot drags a box of 4 kg (20 N) on a tether of 0.8 m
        skates   both front feet are wheels

    These are not the paper's robots, boxes and skates, and how weak, how heavy, how smooth is ours,
    because the paper says none of it (faults.py, robots.py). Its figures (0.0, 0.4, 1.2 m for RMA,
    2.8, 1.5, 4.8 m for ROLT) are of a physical
    Go1 and no target here: what can be compared is whether a method walks on or falls, and how
    methods rank.
    """
    rows = []
    for case, fault in REAL_WORLD.items():  # one by one: only those who need a box or wheels have them
        rows += walk_cases(args, policies, {case: fault}, speed=0.75)
    title = f"Real-world test, simulated: {args.robot}, 0.75 m/s, {args.seconds:g} s"
    panels = report(args, rows, "real_world", title, DISTANCE)
    plots.bar_charts(panels, list(REAL_WORLD), args.out / "real_world.png", title)


def stairs(args, policies) -> None:
    """Not in the paper: does the policy climb, and with its eyes? Stairs of every level of the
    training at 0.5 m/s, with clean scandots and blind (all of them read zero)."""
    rows = []
    for noise, suffix in ((ScanNoise(), ""), (ScanNoise(missing_patches=NUM_PATCHES), " blind")):
        for level in TASKS["terrain"].terrain.levels:
            case, course = f"{100 * rise(level):.1f} cm{suffix}", Terrain(("stairs",), (level,) * 3)
            rows += walk_cases(args, policies, {case: healthy()}, speed=0.5, terrain=course, noise=noise)
    title = f"Stairs: {args.robot}, 0.5 m/s, {args.seconds:g} s"
    panels = report(args, rows, "stairs", title, DISTANCE)
    plots.bar_charts(panels, [*dict.fromkeys(row["case"] for row in rows)], args.out / "stairs.png", title)


def low_frequency(args, policies) -> None:
    """Section IV-B (i), figure "Low-frequency noise": stairs at 0.5 m/s, 4 of the 12 patches of the
    scan each offset as a whole in a random direction, for the whole episode, by a growing distance.
    (The captions of the paper's two figures are exchanged.)"""
    noise_test(args, policies, "offset", "Low-frequency noise", "offset of 4 patches of 12 [m]")


def high_frequency(args, policies) -> None:
    """Section IV-B (ii), figure "High-frequency noise": as above, every point shifted in x, y and z
    by Gaussian noise."""
    noise_test(args, policies, "sigma", "High-frequency noise", "deviation of every point [m]")


def noise_test(args, policies, kind: str, title: str, axis: str) -> None:
    """Return and distance on stairs of STAIRS_LEVEL against the scale of the noise."""
    course, rows = Terrain(("stairs",), (STAIRS_LEVEL,) * 3), []
    for scale in NOISE_SCALES:
        noise = ScanNoise(**{kind: scale})
        rows += walk_cases(args, policies, {f"{scale:g}": healthy()}, speed=0.5, terrain=course, noise=noise)
    title = f"{title}: {args.robot}, steps of {100 * rise(STAIRS_LEVEL):.1f} cm, 0.5 m/s, {args.seconds:g} s"
    panels = report(args, rows, args.experiment, title, {"episode_return": "return of an episode"} | DISTANCE)
    plots.curves(panels, NOISE_SCALES, args.out / f"{args.experiment}.png", title, axis)


# ---------------------------------------------------------------------- looking inside


@torch.no_grad()
def attention(args, policies) -> None:
    """Figure "Elevation maps and attention maps": where the legs look when patches of the scan are
    missing (read zero).

    All methods are shown what the last of them saw 4 s into a walk over stairs of STAIRS_LEVEL,
    clean and with 4 patches missing. Shown is the attention of the leg tokens on the 12 patches in
    the last layer, mean over legs and heads, made to add up to 1. Printed: the share of it on those
    4 patches, and its entropy relative to an even gaze.
    """
    course, (*_, (walker, _)) = Terrain(("stairs",), (STAIRS_LEVEL,) * 3), policies.values()
    env = LocomotionEnv(args.robot, 1, args.seed, 1, config=straight_ahead(walker, 0.5, 4), extras=("heights",), terrain=course)
    observation = env.reset()
    for _ in range(round(4 / CONTROL_DT)):
        observation, _, fallen, *_ = env.step(walker(to_tensors(observation, "cpu")).numpy())
        if fallen.any():
            sys.exit("error: the policy that walks falls within 4 s: another --seed starts it differently")
    missing = missing_points(ScanNoise(missing_patches=4), 1, np.random.default_rng(args.seed))
    patches, panels, rows = as_patches(missing[0]).any(axis=1), {}, []
    for title, heights in (("clean", observation.heights), ("4 patches missing", np.where(missing, 0, observation.heights))):
        panels[title] = {"heights": heights[0] / HEIGHT_SCALE}
        for path, (policy, card) in policies.items():
            weights = policy.attention(to_tensors(observation._replace(heights=heights.astype(np.float32)), "cpu"))
            weights = weights[0, -1, :, :, -NUM_PATCHES:].mean((0, 1)).numpy()
            weights /= weights.sum()
            entropy = -(weights * np.log(weights)).sum() / np.log(NUM_PATCHES)
            share, panels[title][card["policy"]] = weights[patches].sum(), weights
            rows.append({"method": card["policy"], "seed": card["seed"], "scan": title, "checkpoint": str(path)})
            rows[-1] |= {"share_of_4_patches": f"{share:.4f}", "entropy": f"{entropy:.4f}"}
            print(f"{card['policy']:18}{title:20} on the 4 patches {share:6.1%}, entropy {entropy:.3f}")
    write_csv(args.out / "attention.csv", rows)
    plots.attention_maps(panels, args.out / "attention.png")
    print(f"\nwritten: {args.out / 'attention.csv'} and .png")


def gaits(args, policies) -> None:
    """Figure "Unstructured gaits": which foot is on the ground when, for every fault of the robot's
    task. The picture shows the last second of each case's first episode; the numbers are of all
    episodes from 2 s on."""
    task = TASKS[first_task(args.robot)]
    cases = {str(fault): fault for fault in (*(fault for _, fault in task.training), *task.unseen)}
    faults, rows, panels = [fault for fault in cases.values() for _ in range(args.episodes)], [], []
    for path, (policy, card) in policies.items():
        walk = take_a_walk(policy, args.robot, faults, 0.75, args.seconds, args.seed, args.threads)
        legs = walk.env.robot.legs
        print(f"\n{card['policy']:24}{'feet down':>11}{'strides/s':>11}{'duty':>8}" + "".join(f"{leg:>6}" for leg in legs))
        for k, case in enumerate(cases):
            found = [gait(walk, k * args.episodes + i) for i in range(args.episodes)]
            found = [one for one in found if one is not None]
            found = found or [dict.fromkeys(("duty", "stride_hz", "feet_down"), np.full(len(legs), np.nan))]
            duty, stride, feet = (np.mean([one[name] for one in found], axis=0) for name in found[0])
            words = "".join(f"{share:6.2f}" for share in duty)
            print(f"{case:24}{feet.mean():11.2f}{stride.mean():11.2f}{duty.mean():8.2f}{words}")
            for leg, share, hz in zip(legs, duty, stride):
                row = {"method": card["policy"], "seed": card["seed"], "checkpoint": str(path), "case": case}
                rows.append(row | {"leg": leg, "duty": f"{share:.3f}", "stride_hz": f"{hz:.3f}"})
            end = walk.steps[k * args.episodes]
            shown = walk.contacts[max(0, end - round(1 / CONTROL_DT)) : end, k * args.episodes]
            panels.append((f"{card['policy']}, {case}", shown))
    write_csv(args.out / f"gaits-{args.robot}.csv", rows)
    picture = args.out / f"gaits-{args.robot}.png"
    plots.gait_diagrams(panels, legs, CONTROL_DT, len(policies), picture, f"Gaits: {args.robot}, feet on the ground, 1 s")
    print(f"\nwritten: {args.out / f'gaits-{args.robot}.csv'} and .png")


@torch.no_grad()
def mechanisms(args, policies) -> None:
    """Is what the claims rest on alive? In states of a healthy walk, how much each method's actions
    change, in units of their standard deviation, when a part of it is disturbed (`disturbances`).
    An ablation is worth comparing only if what it takes away changes actions by 0.1 or more.

    Then how well a linear probe names a leg from its history (by chance 1 in L), and the share of
    the time that each foot
    is on the ground: a fault on a leg that a healthy gait hardly uses (below 0.1) tests nothing.
    """
    rows = []
    for path, (policy, card) in policies.items():
        course = Terrain(("stairs",), (-1,) * 3) if card["task"] == "terrain" else None
        states, duty = walking_states(policy, args, course)
        actions = policy(states)
        changes = {name: policy(other) - actions for name, other in disturbances(policy, states)}
        numbers = {name: (change / actions.std(0)).square().mean().sqrt().item() for name, change in changes.items()}
        numbers["leg named by its history"] = leg_probe(states.legs)
        numbers |= {f"duty of {leg}": share for leg, share in duty.items()}
        print(f"\n{card['policy']}, seed {card['seed']}")
        for name, value in numbers.items():
            dead = value < GATE and name != "leg named by its history"
            print(f"  {name:26}{value:8.3f}{'   hardly any' if dead else ''}")
            row = {"method": card["policy"], "seed": card["seed"], "checkpoint": str(path), "probe": name}
            rows.append(row | {"value": f"{value:.4f}"})
    write_csv(args.out / "mechanisms.csv", rows)
    plots.probe_bars(rows, GATE, args.out / "mechanisms.png")
    print(f"\nwritten: {args.out / 'mechanisms.csv'} and .png")


def walking_states(policy, args, terrain: Terrain | None) -> tuple[Observation, dict[str, float]]:
    """What 32 healthy robots see in 4 s of walking, every tenth step of those that stay up; and the
    duty factor of each leg."""
    seen, act = [], policy.forward
    policy.forward = lambda observation, masks=None: (seen.append(observation), act(observation, masks))[1]
    try:
        options = {"terrain": terrain} if terrain else {}
        walk = take_a_walk(policy, args.robot, [healthy()] * 32, 0.5 if terrain else 0.75, 6.0, args.seed, 1, **options)
    finally:
        del policy.forward
    up = torch.from_numpy(~walk.fell) if (~walk.fell).any() else torch.ones(32, dtype=torch.bool)
    states = Observation(*(torch.cat([field[up] for field in fields]) for fields in zip(*seen[100::10])))
    found = [duty["duty"] for i in range(32) if (duty := gait(walk, i))]
    shares = np.mean(found, axis=0) if found else np.full(len(walk.env.robot.legs), np.nan)
    return states, dict(zip(walk.env.robot.legs, shares.tolist()))


def disturbances(policy, states: Observation):
    """(what, the observation or the policy so disturbed), of those that the policy has."""
    other = torch.arange(len(states.legs)).roll(len(states.legs) // 2)  # another robot's, at another time
    if states.heights.numel():
        yield "scan turned round", states._replace(heights=states.heights.flip(1))
        yield "another's scan", states._replace(heights=states.heights[other])
    yield "another's action token", states._replace(action=states.action[other])
    yield "another's legs", states._replace(legs=states.legs[other])
    for name, what in (("patch_position", "patch positions equal"), ("leg_position", "leg positions equal")):
        if hasattr(policy, name):
            position = getattr(policy, name)
            kept = position.clone()
            position.copy_(position.mean(0).expand_as(position))
            yield what, states
            position.copy_(kept)


def leg_probe(legs: torch.Tensor) -> float:
    """Share of (B, L, H, frame) histories whose leg a linear classifier names, trained on the first
    half."""
    B, L = legs.shape[:2]
    x = torch.cat([legs.flatten(2), torch.ones(B, L, 1)], dim=2)
    target = torch.eye(L).expand(B, L, L)
    half, rest = slice(0, B // 2), slice(B // 2, B)
    a, b = x[half].flatten(0, 1).double(), target[half].flatten(0, 1).double()
    weights = torch.linalg.solve(a.T @ a + 1e-2 * len(a) * torch.eye(a.shape[1]).double(), a.T @ b)
    named = (x[rest].flatten(0, 1).double() @ weights).argmax(1)
    return (named == target[rest].flatten(0, 1).argmax(1)).double().mean().item()


@torch.no_grad()
def dropout_ratio(args, policies) -> None:
    """Not in the paper, but its case for consistency (section III-C) in one picture: PPO's ratio
    before any weight has moved, where it should be 1.

    The first policy collects a rollout with feature dropout at each rate. Then the update's
    probability of the same actions is computed with the stored masks (consistent dropout), with
    fresh masks (ordinary dropout) and without masks (what Roll-Drop does).
    """
    (policy, _), rows = next(iter(policies.values())), []
    print(f"{'masks':10}{'rate':>8}{'5 %':>10}{'median':>10}{'95 %':>10}{'clipped':>10}")
    for rate in (1e-4, 1e-3, 1e-2, 0.05, 0.1, 0.2):
        model = ROLT(policy.num_legs, policy.num_joints, replace(policy.config, feature_dropout=rate))
        model.load_state_dict(policy.state_dict())
        for scheme, ratio in ratios(model, args).items():
            low, median, high = ratio.quantile(torch.tensor([0.05, 0.5, 0.95])).tolist()
            clipped = ((ratio - 1).abs() > PPOConfig.clip).float().mean().item()
            rows.append({"masks": scheme, "rate": rate, "low": low, "median": median, "high": high, "clipped": clipped})
            print(f"{scheme:10}{rate:8g}{low:10.4f}{median:10.4f}{high:10.4f}{clipped:10.1%}")
    write_csv(args.out / "dropout_ratio.csv", rows)
    plots.ratio_bands(rows, args.out / "dropout_ratio.png", "PPO's ratio before any weight has moved (5 % to 95 % of samples)")
    print(f"\nwritten: {args.out / 'dropout_ratio.csv'} and .png")


def ratios(policy: ROLT, args, num_envs: int = 64) -> dict[str, torch.Tensor]:
    """{scheme: (samples,) PPO's ratio} of a fresh rollout, the second one, after half a second of
    walking."""
    extras = (*policy.extras, "privileged")
    env = LocomotionEnv(args.robot, num_envs, args.seed, 1, TASKS["stiffness"].training, extras=extras)
    observation, generator = env.reset(random_ages=True), torch.Generator().manual_seed(args.seed)
    critic, masks = Critic(observation), policy.sample_masks(num_envs, generator)
    buffer = RolloutBuffer(PPOConfig.steps, observation, env.num_actions, masks, "cpu")
    for _ in range(2):
        observation, _ = collect(env, policy, critic, buffer, observation, generator)
    batch = buffer.minibatch(torch.arange(len(buffer)))
    schemes = {"stored": batch["masks"], "fresh": policy.sample_masks(len(buffer), generator), "none": None}

    def ratio(masks) -> torch.Tensor:
        mean = policy(batch["observation"], masks)
        return (gaussian(mean, buffer.std).log_prob(batch["action"]).sum(-1) - batch["log_prob"]).exp()

    return {scheme: ratio(masks) for scheme, masks in schemes.items()}


# ---------------------------------------------------------------------- command line

# name -> (function, the task whose checkpoints it tests, default robot, default seconds)
EXPERIMENTS = {
    "stiffness": (stiffness, "stiffness", "a1", 20.0),
    "damage": (damage, "damage", "hexapod", 20.0),
    "real_world": (real_world, "stiffness", "go1", 10.0),
    "stairs": (stairs, "terrain", "a1", 20.0),
    "low_frequency": (low_frequency, "terrain", "a1", 20.0),
    "high_frequency": (high_frequency, "terrain", "a1", 20.0),
    "attention": (attention, "terrain", "a1", 4.0),
    "gaits": (gaits, None, "a1", 10.0),  # of the robot's first task
    "mechanisms": (mechanisms, None, "a1", 6.0),
    "dropout_ratio": (dropout_ratio, "stiffness", "a1", 1.0),
}
ONE_SEED = ("attention", "gaits", "dropout_ratio")
SUITABLE = {"attention": ("rolt", "no-pe-drop", "no-feature-drop"), "dropout_ratio": ("rolt",)}  # the others: all


def find_policies(args) -> dict[Path, tuple]:
    """{path: (policy, card)}: the files of --checkpoints, or what checkpoints/ holds for this
    test."""
    paths = args.checkpoints
    if not paths:
        folder, stem = Path(__file__).parent / "checkpoints", f"{args.robot}-{args.task}"
        wanted = args.methods or SUITABLE.get(args.experiment, METHODS)
        seeds = "" if args.experiment in ONE_SEED else "*"
        paths = [p for m in wanted for p in sorted(folder.glob(f"{stem}-{m}.pt")) + sorted(folder.glob(f"{stem}-{m}-seed{seeds}.pt"))]
        if not paths:
            sys.exit(f"error: checkpoints/ holds no {stem}-METHOD.pt of these methods: train one, name it with --checkpoints")
    return {Path(os.path.relpath(path)): load_policy(path, args.robot) for path in paths}


def main(argv: list[str] | None = None) -> None:
    words = sys.argv[1:] if argv is None else argv
    if words[:1] == ["watch"]:
        import watch

        return watch.main(words[1:])
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, usage=argparse.SUPPRESS
    )
    parser.add_argument("experiment", choices=EXPERIMENTS)
    parser.add_argument("--robot", help="default: the one that the test is for")
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="which shipped checkpoints (default: all)")
    parser.add_argument("--checkpoints", nargs="+", type=Path, metavar="FILE", help="policy files, instead of the shipped")
    parser.add_argument("--episodes", type=int, default=32, help="a case (default 32)")
    parser.add_argument("--seconds", type=float, help="of an episode (default: the paper's 20; real_world, gaits 10)")
    parser.add_argument("--seed", type=int, default=0, help="of the starts")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="cores to use (default: all)")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the CSV file and the picture")
    args = parser.parse_args(argv)
    function, task, robot, seconds = EXPERIMENTS[args.experiment]
    args.robot, args.seconds = args.robot or robot, args.seconds or seconds
    if args.methods and args.checkpoints:
        parser.error("--methods chooses among the shipped checkpoints, --checkpoints names files: leave one of them away")
    if args.episodes < 1 or args.threads < 1 or not CONTROL_DT <= args.seconds < 1e5:
        parser.error("there is at least one episode of 0.02 s, and one thread")
    try:
        args.task = task or first_task(args.robot)
        if args.robot not in TASKS[args.task].robots:
            parser.error(f"{args.experiment} is for {', '.join(TASKS[args.task].robots)}, not for {args.robot}")
        policies = find_policies(args)
        args.out.mkdir(parents=True, exist_ok=True)
        torch.set_num_threads(args.threads)
        function(args, policies)
    except (CheckpointError, ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
