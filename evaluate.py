"""The paper's experiments, each a function named as on the command line; ours are in beyond.py.

    python evaluate.py stiffness    # every shipped checkpoint (or --checkpoints FILE ...)
    python evaluate.py gaits --methods rolt --episodes 8 --seconds 10 --out /tmp/quick
    python evaluate.py claims       # verdicts on the paper's claims, from the CSV files (report.py)
    python evaluate.py watch        # one walks on a screen, in a page or a film (watch.py)

Most print a table and write EXPERIMENT.csv (a row per episode) and EXPERIMENT.png to --out.
A cell is the mean over the seeds of a method (checkpoints/NAME.pt, NAME-seed1.pt, ...) and over the
episodes of each. Policies act by their mean, without dropout; ROAM draws a behaviour. attention,
mechanisms and dropout_ratio ignore --episodes and --seconds. The same --seed, the same numbers.
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np
import torch

import beyond
import plots
import watch
from baselines import METHODS
from checkpoint import load_policy
from env import CONTROL_DT
from faults import HEALTHY, REAL_WORLD, TASKS, first_task
from noise import HEIGHT_SCALE, NoisyScan
from ppo import to_tensors
from report import claims, compare, report
from robots import ROBOTS
from rolt import GRID, NUM_PATCHES, PATCH
from terrain import Terrain, rise
from walk import duty, origin, take_a_walk, walk_cases, write_csv

STAIRS_LEVEL = 0  # of the noise tests, ours: steps of 5 cm, the easiest of legged_gym
NOISE_SCALES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4)  # m, ours
WALKED = {"distance_m": "distance walked [m]", "fell": "share of falls", "success": "success"}


def fault_test(args, policies, name: str, case_name) -> None:
    """One fault at a time, seen in training or not, 0.75 m/s. case_name: of a joint's."""
    task = TASKS[args.task]
    faults = *task.seen, *task.unseen
    cases = {}
    for fault in faults:
        parts = fault.split(":")
        one_joint = len(parts) == 2 and "_" in fault  # and no number: the paper has a name for it
        case = case_name(parts[1]) if one_joint else fault
        cases[fault if case in cases else case] = fault
    seen = [case for case, fault in cases.items() if fault in task.seen]
    rows = walk_cases(args, policies, cases, speed=0.75)
    title = f"{name} test: {args.robot}, 0.75 m/s, {args.seconds:g} s"
    report(args, rows, WALKED, title, seen)
    robot, unseen = ROBOTS[args.robot], [case for case in cases if case not in seen]
    behind = {leg for leg, mount in zip(robot.legs, robot.mounts) if mount[0] < 0}
    hind = [case for case in unseen if cases[case].split(":")[1][:2] in behind]
    compare(rows, {"all unseen": unseen, "unseen hind legs": hind})


def stiffness(args, policies) -> None:
    """Section IV-A (i), figure "Stiffness test results": one calf locked at a time, 0.75 m/s, 20 s.
    In leg frames the unseen FL is the mirror image of FR, which was seen (RESULTS.md)."""
    fault_test(args, policies, "Stiffness", lambda joint: joint[:2])


def damage(args, policies) -> None:
    """Section IV-A (ii), table "Damage test results": one dead motor, hexapod, 0.75 m/s, 20 s.
    Cases are named as in the paper: FLC is the calf of the front left leg, T a thigh."""
    fault_test(args, policies, "Damage", lambda joint: joint[:2] + joint[3].upper())


def real_world(args, policies) -> None:
    """Section IV-C, table "Real-world Experiments", simulated: the stiffness task's Go1, 10 s. How
    weak, heavy and smooth is ours (faults.py, robots.py). The paper's distances (RMA 0.0, 0.4, 1.2
    m; ROLT 2.8, 1.5, 4.8 m) are of a physical Go1: compare only who falls, and how methods rank."""
    rows = []
    for case, fault in REAL_WORLD.items():  # one by one: only who needs a box or wheels has them
        rows += walk_cases(args, policies, {case: fault}, speed=0.75)
    title = f"Real-world test, simulated: {args.robot}, 0.75 m/s, {args.seconds:g} s"
    report(args, rows, WALKED, title, seen=["healthy"])


def on_stairs(args, policies, cases: dict, name: str, seen=(), x="") -> None:
    """Healthy, 0.5 m/s, over stairs. cases: {case: (level, noise)}."""
    rows = []
    for case, (level, noise) in cases.items():
        course = {"terrain": Terrain(("stairs",), (level,) * 3), "noise": noise}
        rows += walk_cases(args, policies, {case: HEALTHY}, 0.5, **course)
    columns = {"episode_return": "return of an episode"} | WALKED
    report(args, rows, columns, f"{name}: {args.robot}, 0.5 m/s, {args.seconds:g} s", seen, x)


def stairs(args, policies) -> None:
    """Not in the paper: does the policy climb, and with its eyes? Stairs of every level of the
    training, with clean scandots and blind (all of them read zero)."""
    cases = {}
    for suffix, noise in (("", "clean"), (" blind", f"missing:{NUM_PATCHES}")):
        for level in TASKS["terrain"].terrain.levels:
            cases[f"{100 * rise(level):.1f} cm{suffix}"] = level, noise
    on_stairs(args, policies, cases, "Stairs")


def low_frequency(args, policies) -> None:
    """Section IV-B (i), figure "Low-frequency noise" (its caption stands under the other figure): 4
    of the 12 patches each offset as a whole in a random direction, for the whole episode."""
    noise_test(args, policies, "offset", "Low-frequency noise", "offset of 4 patches of 12 [m]")


def high_frequency(args, policies) -> None:
    """Section IV-B (ii), figure "High-frequency noise": every point moved in x, y, z (Gaussian)."""
    noise_test(args, policies, "sigma", "High-frequency noise", "deviation of every point [m]")


def noise_test(args, policies, kind: str, name: str, x: str) -> None:
    """Against the scale of the noise, on stairs of STAIRS_LEVEL."""
    cases = {f"{scale:g}": (STAIRS_LEVEL, f"{kind}:{scale}") for scale in NOISE_SCALES}
    name += f", steps of {100 * rise(STAIRS_LEVEL):.1f} cm"
    on_stairs(args, policies, cases, name, ["0"], x)


def attention(args, policies) -> None:
    """Figure "Elevation maps and attention maps": where the legs look when patches read zero. All
    policies see what the last of them saw 4 s into a walk over stairs of STAIRS_LEVEL, clean and
    with 4 patches missing. Shown is the attention of the leg tokens on the 12 patches in the last
    layer, mean over legs and heads, made to add up to 1; printed, the share of it on those 4
    patches, and its entropy relative to an even gaze."""
    if not all(hasattr(policy, "patch_position") for policy, _ in policies.values()):
        sys.exit("error: attention on patches is of ROLTs that read the scan: choose --checkpoints")
    *_, (walker, _) = policies.values()
    course, seen = Terrain(("stairs",), (STAIRS_LEVEL,) * 3), []
    how = {"speed": 0.5, "seconds": 4.0, "seed": args.seed, "threads": args.threads}
    walk = take_a_walk(walker, args.robot, [HEALTHY], **how, observations=seen, terrain=course)
    if walk.fell.any():
        sys.exit("error: the policy that walks falls within 4 s: try another --seed")
    blind = NoisyScan(1, None, "missing:4", args.seed)
    blind.draw(np.array([0]))
    patches, rows, panels = blind.missing[0, ::PATCH, ::PATCH].ravel(), [], {}
    for scan, unread in (("clean", False), ("4 patches missing", blind.missing)):
        heights = np.where(unread, np.float32(0), seen[-1].heights)
        panels[scan] = {"scandots [m]": heights[0] / HEIGHT_SCALE}
        shown = to_tensors(seen[-1]._replace(heights=heights), "cpu")
        for path, (policy, card) in policies.items():
            weights = policy.attention(shown)[0, :, :, -NUM_PATCHES:].mean((0, 1)).numpy()
            weights /= weights.sum()
            panels[scan][card["policy"]] = weights.reshape(GRID)
            share = weights[patches].sum()
            entropy = -(weights * np.log(weights)).sum() / np.log(NUM_PATCHES)
            row = {"scan": scan, "share_of_4_patches": f"{share:.4f}", "entropy": f"{entropy:.4f}"}
            print(f"{card['policy']:18}{scan:20} on 4 patches {share:6.1%}, entropy {entropy:.3f}")
            rows.append(origin(path, card) | row)
    write_csv(args.out / "attention.csv", rows)
    plots.attention_maps(panels, args.out / "attention.png")


def gaits(args, policies) -> None:
    """Figure "Unstructured gaits": which foot is down when, for every fault of the robot's task.
    Drawn: the last second of a case's first episode. Numbers: all of its episodes, from 2 s on."""
    task, rows, panels, n = TASKS[args.task], [], [], args.episodes
    cases = *task.seen, *task.unseen
    faults = [fault for fault in cases for _ in range(n)]
    for path, (policy, card) in policies.items():
        walk = take_a_walk(policy, args.robot, faults, 0.75, args.seconds, args.seed, args.threads)
        legs = walk.env.robot.legs
        name = f"{card['policy']} {card['seed']}"
        print(f"\n{name:24}", *(f"{leg:>5}" for leg in legs), " of the time down")
        for first, case in zip(range(0, len(faults), n), cases):
            shares = duty(walk, range(first, first + n))
            print(f"{case:24}", *(f"{share:5.2f}" for share in shares))
            row = origin(path, card) | {"case": case}
            rows += [row | {"leg": leg, "duty": f"{x:.3f}"} for leg, x in zip(legs, shares)]
            shown = walk.contacts[: walk.steps[first], first][-round(1 / CONTROL_DT) :]
            panels.append((f"{name}, {case}", shown))
    write_csv(args.out / "gaits.csv", rows)
    title = f"Gaits: {args.robot}, feet on the ground, 1 s"
    plots.gait_diagrams(panels, legs, CONTROL_DT, len(policies), args.out / "gaits.png", title)


# name -> (function, task of its checkpoints (None: the robot's first), default robot and methods)
EXPERIMENTS = {
    "stiffness": (stiffness, "stiffness", "a1", METHODS),
    "damage": (damage, "damage", "hexapod", METHODS),
    "real_world": (real_world, "stiffness", "go1", METHODS),
    "stairs": (stairs, "terrain", "a1", METHODS),
    "low_frequency": (low_frequency, "terrain", "a1", METHODS),
    "high_frequency": (high_frequency, "terrain", "a1", METHODS),
    "attention": (attention, "terrain", "a1", ("rolt", "no-pe-drop", "no-feature-drop")),
    "gaits": (gaits, None, "a1", METHODS),
    "curves": (beyond.curves, None, "a1", METHODS),
    "growth": (beyond.growth, None, "a1", METHODS),
    "legs": (beyond.legs, "stiffness", "a1", METHODS),
    "sudden": (beyond.sudden, None, "a1", METHODS),
    "matrix": (beyond.matrix, None, "a1", METHODS),
    "senses": (beyond.senses, None, "a1", METHODS),
    "mechanisms": (beyond.mechanisms, None, "a1", METHODS),
    "dropout_ratio": (beyond.dropout_ratio, "stiffness", "a1", ("rolt",)),
    "watch": (watch.watch, None, "a1", ("rolt",)),
}


def find_policies(args, methods) -> dict[Path, tuple]:
    """{path: (policy, card)} of --checkpoints, or of what checkpoints/ holds for this test."""
    paths, stem = args.checkpoints or [], f"{args.robot}-{args.task}"
    if not paths:
        folder = Path(__file__).parent / "checkpoints"
        for method in args.methods or methods:
            paths += sorted(folder.glob(f"{stem}-{method}.pt"))
            paths += sorted(folder.glob(f"{stem}-{method}-seed*.pt"))
    if not paths:
        sys.exit(f"error: no such checkpoints/{stem}-METHOD.pt: train one or name --checkpoints")
    found = {Path(os.path.relpath(path)): load_policy(path, args.robot) for path in paths}
    cards = [card for _, card in found.values()]
    several_tasks = len({card["task"] for card in cards}) > 1
    grown = len({(card["policy"], card["task"], card["seed"]) for card in cards}) < len(cards)
    for card in cards:
        if several_tasks:
            card["policy"] += f" {card['task']}"
        if grown:  # snapshots of a training
            card["policy"] += f" {card['steps'] / 1e6:.1f}M"
    if len({(card["policy"], card["seed"]) for card in cards}) < len(cards):
        sys.exit("error: two of the checkpoints are of the same method, seed and steps")
    return found


def main(argv: list[str] | None = None) -> None:
    plain = {"usage": argparse.SUPPRESS, "formatter_class": argparse.RawDescriptionHelpFormatter}
    parser = argparse.ArgumentParser(description=__doc__, **plain)
    add = parser.add_argument
    add("experiment", choices=[*EXPERIMENTS, "claims"])
    add("--robot", choices=ROBOTS, help="default: the one that the test is for")
    which = parser.add_mutually_exclusive_group().add_argument
    which("--methods", nargs="+", choices=METHODS, help="of the shipped policies (default: all)")
    which("--checkpoints", nargs="+", type=Path, metavar="FILE", help="instead of the shipped ones")
    add("--episodes", type=int, default=32, help="per case (default 32)")
    add("--seconds", type=float, help="an episode (default 20; real_world, gaits 10; films 4)")
    add("--seed", type=int, default=0, help="of the starts")
    add("--threads", type=int, default=os.cpu_count(), help="cores to use (default: all)")
    add("--pairs", action="store_true", help="matrix: of pairs of legs, not of single joints")
    add("--out", type=Path, help="folder of CSV and picture (default: runs; claims: results)")
    add = parser.add_argument_group("watch").add_argument
    add("--fault", default=HEALTHY, help="for example lock:FR_calf+weaken:RL:0.5 (faults.py)")
    add("--speed", type=float, default=0.75, help="commanded, m/s (default 0.75)")
    add("--stairs", type=int, choices=range(-2, 11), help="level of the steps (default: flat)")
    add("--noise", default="clean", help="on the scandots: offset:0.2, sigma:0.1, missing:4")
    add("--film", type=Path, metavar="FILE.gif", help="instead of a viewer")
    add("--public", action="store_true", help="a page, for all who can reach this machine's port")
    add("--port", type=int, default=0, help="of the page (default: the first free from 8080)")
    args = parser.parse_args(argv)
    try:
        if args.experiment == "claims":
            return claims(args.out or Path(__file__).parent / "results")
        args.out = args.out or Path("runs")
        function, task, robot, methods = EXPERIMENTS[args.experiment]
        seconds = {"real_world": 10.0, "gaits": 10.0, "watch": 4.0}.get(args.experiment, 20.0)
        args.robot, args.seconds = args.robot or robot, args.seconds or seconds
        if args.episodes < 1 or args.threads < 1 or args.seconds < CONTROL_DT:
            parser.error(f"there is at least one episode of {CONTROL_DT} s, and one thread")
        for option in ("fault", "speed", "stairs", "noise", "film", "public", "port"):
            if args.experiment != "watch" and getattr(args, option) != parser.get_default(option):
                parser.error(f"--{option} is an option of watch")
        args.task = task or first_task(args.robot)
        if args.stairs is not None:
            args.task = "terrain"
        policies = find_policies(args, methods)
        torch.set_num_threads(args.threads)
        if args.experiment == "watch":
            return function(args, policies)
        args.out.mkdir(parents=True, exist_ok=True)
        with torch.no_grad():
            function(args, policies)
        print(f"\nwritten: {args.out / args.experiment}.*")
    except KeyboardInterrupt:
        sys.exit("\nstopped; nothing was written")
    except (ValueError, OSError, ArithmeticError, MemoryError) as error:
        if sys.flags.dev_mode:  # python -X dev evaluate.py ...: where was it?
            raise
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
