"""The paper's experiments. Each is one function below, named as on the command line.

    python evaluate.py stiffness    # every shipped checkpoint (or --checkpoints FILE ...)
    python evaluate.py gaits --methods rolt --episodes 8 --seconds 10 --out /tmp/quick
    python evaluate.py watch        # a policy to look at while it walks (watch.py)

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
import watch
from baselines import METHODS
from checkpoint import CheckpointError, load_policy
from env import CONTROL_DT, LocomotionEnv, Observation
from faults import REAL_WORLD, TASKS, first_task, healthy
from noise import HEIGHT_SCALE, NUM_PATCHES, ScanNoise, as_patches, missing_points
from ppo import Critic, PPOConfig, RolloutBuffer, collect, gaussian, to_tensors
from rolt import ROLT
from terrain import Terrain, rise
from walk import gait, origin, report, straight_ahead, take_a_walk, walk_cases, write_csv

STAIRS_LEVEL = 0  # of the noise tests, ours: steps of 5 cm, the easiest of legged_gym
STAIRS = Terrain(("stairs",), (STAIRS_LEVEL,) * 3)
NOISE_SCALES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4)  # m, ours
GATE = 0.1  # standard deviations of an action, ours: less is no mechanism
DISTANCE = {"distance_m": "distance walked [m]"}


def bars(args, rows, name: str, speed: float, columns=DISTANCE, marks={}) -> None:
    """The table, the CSV file and a bar chart of all cases."""
    title = f"{name}: {args.robot}, {speed:g} m/s, {args.seconds:g} s"
    panels = report(args, rows, args.experiment, title, columns, marks)
    cases = [case + marks.get(case, "") for case in dict.fromkeys(row["case"] for row in rows)]
    plots.bar_charts(panels, cases, args.out / f"{args.experiment}.png", title)


def fault_test(args, policies, name: str, case_name) -> None:
    """One fault at a time, seen in training or not, 0.75 m/s. case_name: the parts of its name."""
    task = TASKS[args.task]
    seen = [fault for _, fault in task.training]
    cases = {"".join(case_name(fault)) or "healthy": fault for fault in (*seen, *task.unseen)}
    marks = {case: " (seen)" for case, fault in cases.items() if fault in seen}
    rows = walk_cases(args, policies, cases, speed=0.75)
    columns = DISTANCE | {"fall_time_s": "time of the first fall [s]"}
    bars(args, rows, f"{name} test", 0.75, columns, marks)


def stiffness(args, policies) -> None:
    """Section IV-A (i), figure "Stiffness test results": one calf locked at a time, 0.75 m/s, 20 s.
    Unseen in training: FL, RR, RL. In leg frames FL is the mirror image of FR (which was seen), and
    a policy that is its own mirror image has as good as seen it; the hind legs are the test."""
    fault_test(args, policies, "Stiffness", lambda f: [joint[:2] for joint in f.locked])


def damage(args, policies) -> None:
    """Section IV-A (ii), table "Damage test results": one dead motor, hexapod, 0.75 m/s, 20 s.
    Cases are named as in the paper: FLC is the calf of the front left leg, T a thigh."""
    fault_test(args, policies, "Damage", lambda f: [j[:2] + j[3].upper() for j, _ in f.strength])


def real_world(args, policies) -> None:
    """Section IV-C, table "Real-world Experiments", simulated: the stiffness task's Go1, 10 s. How
    weak, how heavy, how smooth is ours, the paper does not say (faults.py, robots.py). Its
    distances (RMA 0.0, 0.4, 1.2 m; ROLT 2.8, 1.5, 4.8 m) are of a physical Go1 and no target here:
    what can be compared is whether a method walks on or falls, and how methods rank."""
    rows = []
    for case, fault in REAL_WORLD.items():  # one by one: only who needs a box or wheels has them
        rows += walk_cases(args, policies, {case: fault}, speed=0.75)
    bars(args, rows, "Real-world test, simulated", 0.75)


def stairs(args, policies) -> None:
    """Not in the paper: does the policy climb, and with its eyes? Stairs of every level of the
    training at 0.5 m/s, with clean scandots and blind (all of them read zero)."""
    rows, blind = [], ScanNoise(missing_patches=NUM_PATCHES)
    for suffix, noise in (("", ScanNoise()), (" blind", blind)):
        for level in TASKS["terrain"].terrain.levels:
            case, course = f"{100 * rise(level):.1f} cm{suffix}", Terrain(("stairs",), (level,) * 3)
            rows += walk_cases(args, policies, {case: healthy()}, 0.5, terrain=course, noise=noise)
    bars(args, rows, "Stairs", 0.5)


def low_frequency(args, policies) -> None:
    """Section IV-B (i), figure "Low-frequency noise" (its caption stands under the other figure): 4
    of the 12 patches each offset as a whole in a random direction, for the whole episode."""
    noise_test(args, policies, "offset", "Low-frequency noise", "offset of 4 patches of 12 [m]")


def high_frequency(args, policies) -> None:
    """Section IV-B (ii), figure "High-frequency noise": every point moved in x, y, z (Gaussian)."""
    noise_test(args, policies, "sigma", "High-frequency noise", "deviation of every point [m]")


def noise_test(args, policies, kind: str, title: str, axis: str) -> None:
    """Return and distance on stairs of STAIRS_LEVEL at 0.5 m/s against the scale of the noise."""
    rows = []
    for scale in NOISE_SCALES:
        case, noise = f"{scale:g}", ScanNoise(**{kind: scale})
        rows += walk_cases(args, policies, {case: healthy()}, 0.5, terrain=STAIRS, noise=noise)
    cm = 100 * rise(STAIRS_LEVEL)
    title = f"{title}: {args.robot}, steps of {cm:.1f} cm, 0.5 m/s, {args.seconds:g} s"
    columns = {"episode_return": "return of an episode"} | DISTANCE
    panels = report(args, rows, args.experiment, title, columns)
    plots.curves(panels, NOISE_SCALES, args.out / f"{args.experiment}.png", title, axis)


@torch.no_grad()
def attention(args, policies) -> None:
    """Figure "Elevation maps and attention maps": where the legs look when patches read zero.

    All methods are shown what the last of them saw 4 s into a walk over stairs of STAIRS_LEVEL,
    clean and with 4 patches missing. Shown is the attention of the leg tokens on the 12 patches in
    the last layer, mean over legs and heads, made to add up to 1. Printed: the share of it on those
    4 patches, and its entropy relative to an even gaze."""
    *_, (walker, _) = policies.values()
    config, options = straight_ahead(walker, 0.5, 4), {"extras": ("heights",), "terrain": STAIRS}
    env = LocomotionEnv(args.robot, 1, args.seed, 1, config=config, **options)
    observation = env.reset()
    for _ in range(round(4 / CONTROL_DT)):
        observation, _, fallen, *_ = env.step(walker(to_tensors(observation, "cpu")).numpy())
        if fallen.any():
            sys.exit("error: the policy that walks falls within 4 s: try another --seed")
    missing = missing_points(ScanNoise(missing_patches=4), 1, np.random.default_rng(args.seed))
    patches, rows, panels = as_patches(missing[0]).any(axis=1), [], {}
    for title, unread in (("clean", False), ("4 patches missing", missing)):
        heights = np.where(unread, np.float32(0), observation.heights)
        panels[title] = {"heights": heights[0] / HEIGHT_SCALE}
        shown = to_tensors(observation._replace(heights=heights), "cpu")
        for path, (policy, card) in policies.items():
            weights = policy.attention(shown)[0, -1, :, :, -NUM_PATCHES:].mean((0, 1)).numpy()
            weights /= weights.sum()
            share, method = weights[patches].sum(), card["policy"]
            entropy = -(weights * np.log(weights)).sum() / np.log(NUM_PATCHES)
            panels[title][method] = weights
            row = {"method": method, "seed": card["seed"], "scan": title, "checkpoint": str(path)}
            rows.append(row | {"share_of_4_patches": f"{share:.4f}", "entropy": f"{entropy:.4f}"})
            print(f"{method:18}{title:20} on the 4 patches {share:6.1%}, entropy {entropy:.3f}")
    write_csv(args.out / "attention.csv", rows)
    plots.attention_maps(panels, args.out / "attention.png")


def gaits(args, policies) -> None:
    """Figure "Unstructured gaits": which foot is down when, for every fault of the robot's task.
    Drawn: the last second of a case's first episode. Numbers: all of its episodes, from 2 s on."""
    task, rows, panels = TASKS[first_task(args.robot)], [], []
    cases = {str(fault): fault for fault in (*(fault for _, fault in task.training), *task.unseen)}
    faults = [fault for fault in cases.values() for _ in range(args.episodes)]
    for path, (policy, card) in policies.items():
        walk = take_a_walk(policy, args.robot, faults, 0.75, args.seconds, args.seed, args.threads)
        legs = walk.env.robot.legs
        words = "".join(f"{leg:>6}" for leg in legs)
        print(f"\n{card['policy']:24}  feet down  strides/s    duty{words}")
        none = np.full(len(legs), np.nan)
        for first, case in zip(range(0, len(faults), args.episodes), cases):
            found = [one for i in range(args.episodes) if (one := gait(walk, first + i))]
            found = found or [{"duty": none, "stride_hz": none, "feet_down": none}]
            duty, stride, feet = (np.mean([one[key] for one in found], axis=0) for key in found[0])
            words = "".join(f"{share:6.2f}" for share in duty)
            print(f"{case:24}{feet.mean():11.2f}{stride.mean():11.2f}{duty.mean():8.2f}{words}")
            for leg, share, hz in zip(legs, duty, stride):
                row = {"case": case, "leg": leg, "duty": f"{share:.3f}", "stride_hz": f"{hz:.3f}"}
                rows.append(origin(path, card) | row)
            end = walk.steps[first]
            shown = walk.contacts[max(0, end - round(1 / CONTROL_DT)) : end, first]
            panels.append((f"{card['policy']}, {case}", shown))
    write_csv(args.out / f"gaits-{args.robot}.csv", rows)
    title, picture = f"Gaits: {args.robot}, feet on the ground, 1 s", f"gaits-{args.robot}.png"
    plots.gait_diagrams(panels, legs, CONTROL_DT, len(policies), args.out / picture, title)


@torch.no_grad()
def mechanisms(args, policies) -> None:
    """Is what the claims rest on alive? In states of a healthy walk, how much each method's actions
    change, in units of their standard deviation, when a part of it is disturbed (`disturbances`).
    An ablation is worth comparing only if what it takes away changes actions by 0.1 or more. Then
    how well a linear probe names a leg from its history (by chance 1 in L), and each foot's share
    of the time on the ground: a fault on a leg hardly used (below 0.1) tests nothing."""
    rows = []
    for path, (policy, card) in policies.items():
        course = Terrain(("stairs",), (-1,) * 3) if card["task"] == "terrain" else None
        states, duty = walking_states(policy, args, course)
        actions, numbers = policy(states), {}
        for name, other in disturbances(policy, states):
            change = (policy(other) - actions) / actions.std(0)
            numbers[name] = change.square().mean().sqrt().item()
        numbers["leg named by its history"] = leg_probe(states.legs)
        numbers |= {f"duty of {leg}": share for leg, share in duty.items()}
        print(f"\n{card['policy']}, seed {card['seed']}")
        for name, value in numbers.items():
            dead = value < GATE and name != "leg named by its history"
            print(f"  {name:26}{value:8.3f}{'   hardly any' if dead else ''}")
            rows.append(origin(path, card) | {"probe": name, "value": f"{value:.4f}"})
    write_csv(args.out / "mechanisms.csv", rows)
    plots.probe_bars(rows, GATE, args.out / "mechanisms.png")


def walking_states(policy, args, terrain: Terrain | None) -> tuple[Observation, dict[str, float]]:
    """What 32 healthy robots see in 4 s of walking, every tenth step of those that stay up (of all
    if none does); and the duty factor of each leg."""
    seen, faults, speed = [], [healthy()] * 32, 0.5 if terrain else 0.75
    hook = policy.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    walk = take_a_walk(policy, args.robot, faults, speed, 6.0, args.seed, 1, terrain=terrain)
    hook.remove()
    up = torch.from_numpy(~walk.fell if not walk.fell.all() else walk.fell)
    states = Observation(*(torch.cat([x[up] for x in field]) for field in zip(*seen[100::10])))
    legs, found = walk.env.robot.legs, [one["duty"] for i in range(32) if (one := gait(walk, i))]
    shares = np.mean(found, axis=0) if found else np.full(len(legs), np.nan)
    return states, dict(zip(legs, shares.tolist()))


def disturbances(policy, states: Observation):
    """(what, the observation or the policy so disturbed), of those that the policy has."""
    batch = len(states.legs)
    other = torch.arange(batch).roll(batch // 2)  # another robot's, at another time
    if states.heights.numel():
        yield "scan turned round", states._replace(heights=states.heights.flip(1))
        yield "another's scan", states._replace(heights=states.heights[other])
    yield "another's action token", states._replace(action=states.action[other])
    yield "another's legs", states._replace(legs=states.legs[other])
    for part in ("patch", "leg"):
        position = getattr(policy, f"{part}_position", None)
        if position is not None:
            kept = position.clone()
            position.copy_(position.mean(0).expand_as(position))
            yield f"{part} positions equal", states
            position.copy_(kept)


def leg_probe(legs: torch.Tensor) -> float:
    """Share of (B, L, H, frame) histories whose leg a linear fit to their first half can name."""
    B, L = legs.shape[:2]
    x = torch.cat([legs.flatten(2), torch.ones(B, L, 1)], dim=2).double()
    target = torch.eye(L).expand(B, L, L).double()
    a, b = x[: B // 2].flatten(0, 1), target[: B // 2].flatten(0, 1)
    weights = torch.linalg.solve(a.T @ a + 1e-2 * len(a) * torch.eye(a.shape[1]).double(), a.T @ b)
    named = (x[B // 2 :] @ weights).argmax(2)
    return (named == torch.arange(L)).double().mean().item()


@torch.no_grad()
def dropout_ratio(args, policies) -> None:
    """Not in the paper, but its case for consistency (section III-C) in one picture: PPO's ratio
    before any weight has moved, where it should be 1. The first policy collects a rollout at each
    rate of feature dropout. The update's probability of the same actions is computed with the
    stored masks (consistent dropout), fresh ones (ordinary dropout) and none (Roll-Drop)."""
    (policy, _), *_ = policies.values()
    rows, quantiles = [], torch.tensor([0.05, 0.5, 0.95])
    print(f"{'masks':10}{'rate':>8}{'5 %':>10}{'median':>10}{'95 %':>10}{'clipped':>10}")
    for rate in (1e-4, 1e-3, 1e-2, 0.05, 0.1, 0.2):
        config = replace(policy.config, feature_dropout=rate)
        model = ROLT(policy.num_legs, policy.num_joints, config)
        model.load_state_dict(policy.state_dict())
        for scheme, ratio in ratios(model, args).items():
            low, median, high = ratio.quantile(quantiles).tolist()
            clipped = ((ratio - 1).abs() > PPOConfig.clip).float().mean().item()
            row = {"masks": scheme, "rate": rate, "low": low, "median": median, "high": high}
            rows.append(row | {"clipped": clipped})
            print(f"{scheme:10}{rate:8g}{low:10.4f}{median:10.4f}{high:10.4f}{clipped:10.1%}")
    write_csv(args.out / "dropout_ratio.csv", rows)
    title = "PPO's ratio before any weight has moved (5 % to 95 % of samples)"
    plots.ratio_bands(rows, args.out / "dropout_ratio.png", title)


def ratios(policy: ROLT, args, num_envs: int = 64) -> dict[str, torch.Tensor]:
    """{scheme: (samples,) PPO's ratio} of a rollout, the second: after half a second of walking."""
    task, extras = TASKS["stiffness"].training, (*policy.extras, "privileged")
    env = LocomotionEnv(args.robot, num_envs, args.seed, 1, task, extras=extras)
    observation, generator = env.reset(random_ages=True), torch.Generator().manual_seed(args.seed)
    critic, masks = Critic(observation), policy.sample_masks(num_envs, generator)
    buffer = RolloutBuffer(PPOConfig.steps, observation, env.num_actions, masks, "cpu")
    for _ in range(2):
        observation, _ = collect(env, policy, critic, buffer, observation, generator)
    batch = buffer.minibatch(torch.arange(len(buffer)))
    fresh, ratio = policy.sample_masks(len(buffer), generator), {}
    for scheme, masks in (("stored", batch["masks"]), ("fresh", fresh), ("none", None)):
        actions = gaussian(policy(batch["observation"], masks), buffer.std)
        ratio[scheme] = (actions.log_prob(batch["action"]).sum(-1) - batch["log_prob"]).exp()
    return ratio


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
# the methods that have what is looked at; elsewhere all
SUITABLE = {"attention": ("rolt", "no-pe-drop", "no-feature-drop"), "dropout_ratio": ("rolt",)}


def find_policies(args) -> dict[Path, tuple]:
    """{path: (policy, card)} of --checkpoints, or of what checkpoints/ holds for this test."""
    paths, stem = args.checkpoints or [], f"{args.robot}-{args.task}"
    if not paths:
        folder = Path(__file__).parent / "checkpoints"
        for method in args.methods or SUITABLE.get(args.experiment, METHODS):
            paths += sorted(folder.glob(f"{stem}-{method}.pt"))
            if args.experiment not in ONE_SEED:
                paths += sorted(folder.glob(f"{stem}-{method}-seed*.pt"))
    if not paths:
        sys.exit(f"error: no such checkpoints/{stem}-METHOD.pt: train one or name --checkpoints")
    return {Path(os.path.relpath(path)): load_policy(path, args.robot) for path in paths}


def main(argv: list[str] | None = None) -> None:
    words = sys.argv[1:] if argv is None else argv
    if words[:1] == ["watch"]:
        return watch.main(words[1:])
    plain = {"usage": argparse.SUPPRESS, "formatter_class": argparse.RawDescriptionHelpFormatter}
    parser = argparse.ArgumentParser(description=__doc__, **plain)
    add = parser.add_argument
    add("experiment", choices=EXPERIMENTS)
    add("--robot", help="default: the one that the test is for")
    add("--methods", nargs="+", choices=METHODS, help="of the shipped checkpoints (default: all)")
    add("--checkpoints", nargs="+", type=Path, metavar="FILE", help="instead of the shipped ones")
    add("--episodes", type=int, default=32, help="a case (default 32)")
    add("--seconds", type=float, help="an episode (default: the paper's 20; real_world, gaits 10)")
    add("--seed", type=int, default=0, help="of the starts")
    add("--threads", type=int, default=os.cpu_count(), help="cores to use (default: all)")
    add("--out", type=Path, default=Path("results"), help="folder of the CSV file and the picture")
    args = parser.parse_args(argv)
    function, task, robot, seconds = EXPERIMENTS[args.experiment]
    args.robot, args.seconds = args.robot or robot, args.seconds or seconds
    if args.methods and args.checkpoints:
        parser.error("--methods and --checkpoints both choose policies: leave one of them away")
    if args.episodes < 1 or args.threads < 1 or not CONTROL_DT <= args.seconds < 1e5:
        parser.error("there is at least one episode of 0.02 s, and one thread")
    try:
        args.task = task or first_task(args.robot)
        robots = TASKS[args.task].robots
        if args.robot not in robots:
            parser.error(f"{args.experiment} is for {', '.join(robots)}, not for {args.robot}")
        policies = find_policies(args)
        args.out.mkdir(parents=True, exist_ok=True)
        torch.set_num_threads(args.threads)
        function(args, policies)
        name = f"gaits-{args.robot}" if function is gaits else args.experiment
        print(f"\nwritten: {args.out / name}.csv and .png")
    except (CheckpointError, ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
