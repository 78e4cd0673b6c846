"""The paper's experiments. Each is one function below, named as on the command line.

    python evaluate.py stiffness                          # every shipped checkpoint; about a minute a method
    python evaluate.py stiffness --checkpoints runs/a1-stiffness-rolt-seed0/policy.pt
    python evaluate.py stairs                             # the paper's terrain, seeing and blind
    python evaluate.py low_frequency                      # and high_frequency, attention: scandots that lie
    python evaluate.py real_world                         # a Go1 with a weak leg, a box in tow, skates
    python evaluate.py gaits --robot a1                   # which foot is on the ground when
    python evaluate.py dropout_ratio                      # why the dropout masks are stored
    python evaluate.py stiffness --methods rolt --episodes 8 --seconds 10 --out /tmp/quick --video /tmp/quick/stiffness.gif

    python evaluate.py watch --robot a1 --fault lock:FR_calf     # a viewer; see watch.py, or watch --help

Each prints a table and writes EXPERIMENT.csv and EXPERIMENT.png to --out (default: results); one row an episode, and in
gaits-ROBOT.csv an episode and leg, in attention.csv a policy and scan, in dropout_ratio.csv a rate and scheme. Several seeds
of a method are put together, and shown one by one below.
Policies act by their mean, without dropout (ROAM draws which of its behaviours acts). The same seed and the same number of
threads give the same numbers.
"""

import os
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

import watch  # first: it says how to draw without a display, which mujoco reads when it is imported
from baselines import METHODS
from checkpoint import CheckpointError, load_policy
from cli import Parser, count, fail, num_cores, positive, seed, threads, writable_folder
from env import CONTROL_DT, LocomotionEnv
from faults import REAL_WORLD, TASKS, first_task, healthy
from gaits import gaits
from noise import ScanNoise, missing_points
from paper import DAMAGE
from paper import REAL_WORLD as REAL_WORLD_PAPER
from plots import attention_maps, ratio_bands
from ppo import Critic, PPOConfig, RolloutBuffer, collect, gaussian, to_tensors
from protocol import case_name, report, report_curves, run_cases, straight_ahead, write_csv
from render import film_cases
from rolt import ROLT
from scandots import HEIGHT_SCALE, NUM_PATCHES, as_patches
from terrain import Terrain, rise

STAIRS_LEVEL = 0  # of the noise tests, ours: steps of 5 cm, the easiest of legged_gym
NOISE_SCALES = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)  # m, ours: in the end half of the points read the clip


def stiffness(args) -> None:
    """Section IV-A (i), figure "Stiffness test results": one calf locked at a time, 0.75 m/s for 20 s.

    Seen in training: healthy and FR locked. Unseen: FL, RR and RL locked.
    """
    task = TASKS["stiffness"]
    seen = [fault for _, fault in task.training]
    cases = {case_name(fault): fault for fault in (*seen, *task.unseen)}
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
    cases = {case_name(fault): fault for fault in faults}
    marked = [f"{case}{' (seen)' if i < len(task.training) else ''}" for i, case in enumerate(cases)]
    rows = run_cases(args, cases, speed=0.75)
    title = f"Damage test: {args.robot}, 0.75 m/s, {args.seconds:g} s"
    report(args, rows, list(cases), marked, "damage", title, paper=DAMAGE)


def stairs(args) -> None:
    """Not in the paper: does the policy climb, and with its eyes? Stairs of every level of the training at 0.5 m/s, with clean
    scandots and blind (all of them read zero)."""
    rows, cases = [], {}
    for noise, suffix in ((ScanNoise(), ""), (ScanNoise(missing_patches=NUM_PATCHES), " blind")):
        for level in dict.fromkeys(TASKS["terrain"].terrain.levels):
            case = f"{100 * rise(level):.1f} cm{suffix}"
            rows += run_cases(args, {case: healthy()}, speed=0.5, terrain=Terrain(("stairs",), (level,) * 3), noise=noise)
            cases[case] = f"{100 * rise(level):.1f} cm{suffix and ' (blind)'}"
    title = f"Stairs: {args.robot}, 0.5 m/s, {args.seconds:g} s"
    report(args, rows, list(cases), list(cases.values()), "stairs", title)


def low_frequency(args) -> None:
    """Section IV-B (i), figure "Low-frequency noise": stairs at 0.5 m/s, 4 of the 12 patches of the scan each offset as a
    whole in a random direction, for the whole episode, by a growing distance. (The captions of the paper's two figures
    are exchanged.)"""
    noises = {scale: ScanNoise(offset=scale) for scale in NOISE_SCALES}
    noise_test(args, noises, "low_frequency", "Low-frequency noise", "offset of 4 patches of 12 [m]")


def high_frequency(args) -> None:
    """Section IV-B (ii), figure "High-frequency noise": as above, every point shifted in x, y and z by Gaussian noise."""
    noises = {scale: ScanNoise(sigma=scale) for scale in NOISE_SCALES}
    noise_test(args, noises, "high_frequency", "High-frequency noise", "deviation of every point [m]")


def noise_test(args, noises: dict[float, ScanNoise], name: str, title: str, axis: str) -> None:
    """Return and distance on stairs of STAIRS_LEVEL against the scale of the noise."""
    stairs, rows = Terrain(("stairs",), (STAIRS_LEVEL,) * 3), []
    for scale, noise in noises.items():
        rows += run_cases(args, {f"{scale:g}": healthy()}, speed=0.5, terrain=stairs, noise=noise)
    title = f"{title}: {args.robot}, stairs with steps of {100 * rise(STAIRS_LEVEL):.1f} cm, 0.5 m/s, {args.seconds:g} s"
    report_curves(args, rows, tuple(noises), name, title, axis)


@torch.no_grad()
def attention(args) -> None:
    """Figure "Elevation maps and attention maps": where the legs look when patches of the scan are missing (read zero).

    All methods are shown what ROLT (or else the last of them) saw 4 s into a walk over stairs of STAIRS_LEVEL, clean and with 4
    patches missing. Shown is the attention of the leg tokens on the 12 patches in the last layer, mean over legs and
    heads, made to add up to 1. Printed: the share of it on those 4 patches, and its entropy relative to an even gaze.
    """
    course, walker = Terrain(("stairs",), (STAIRS_LEVEL,) * 3), rolt_or_last(args)
    env = LocomotionEnv(args.robot, 1, args.seed, 1, config=straight_ahead(0.5, 4.0), terrain=course)
    args.scenes["clean"] = (healthy(), 0.5, {"terrain": course})
    observation = env.reset()
    for _ in range(round(4 / CONTROL_DT)):
        observation, _, fallen, *_ = env.step(walker(to_tensors(observation, "cpu")).numpy())
        if fallen.any():
            fail("the policy that walks falls within 4 s: another --seed starts it differently")
    missing = missing_points(ScanNoise(missing_patches=4), 1, np.random.default_rng(args.seed))
    patches, panels, rows = as_patches(missing[0]).any(axis=1), {}, []
    for title, heights in (("clean", observation.heights), ("4 patches missing", np.where(missing, 0, observation.heights))):
        panels[title] = {"heights": heights[0] / HEIGHT_SCALE}
        for path, (policy, card) in args.policies.items():
            weights = policy.attention(to_tensors(observation._replace(heights=heights.astype(np.float32)), "cpu"))
            weights = weights[0, -1, :, :, -NUM_PATCHES:].mean((0, 1)).numpy()
            weights /= weights.sum()
            entropy = -(weights * np.log(weights)).sum() / np.log(NUM_PATCHES)
            share, panels[title][card["method"]] = weights[patches].sum(), weights
            rows.append({"method": card["method"], "checkpoint": str(path), "seed": card["seed"], "scan": title})
            rows[-1] |= {"share_of_4_patches": f"{share:.4f}", "entropy": f"{entropy:.4f}"}
            print(f"{card['method']:16}{title:20} on the 4 patches {share:6.1%}, entropy {entropy:.3f}")
    write_csv(args.out / "attention.csv", rows)
    attention_maps(panels, args.out / "attention.png")
    print(f"\nwritten: {args.out / 'attention.csv'}, {args.out / 'attention.png'}")


def real_world(args) -> None:
    """Section IV-C, table "Real-world Experiments", rebuilt in simulation: a Go1 trained on the stiffness task, 10 s.

        healthy  for comparison, not in the paper's table
        weaken   the front left leg's motors at half their strength, the hind right calf tied so that it cannot open
                 beyond its default angle; then each other leg weak in its place
        box      the hind right foot drags a box of 4 kg (20 N) on a tether of 0.8 m
        skates   both front feet are wheels

    These are not the paper's robots, boxes and skates. It measured a physical Go1, with a real motor's delay and heat, a
    floor that is not flat, sensors that err, and a velocity estimated, not known; here all that is ideal, and how weak,
    how heavy, how smooth is ours, because the paper says none of it (faults.py, robots.py give numbers and reasons). Nor
    does it say the command: 0.75 m/s, as in its other tests. So its figures, shown beside, are no target that a
    simulation could confirm: what can be compared is whether a method walks on or falls, and how methods rank.
    """
    rows = []
    for case, fault in REAL_WORLD.items():  # one by one: only those who need a box or wheels have them
        print(f"\n{case}: {fault}")
        rows += run_cases(args, {case: fault}, speed=0.75)
    title = f"Real-world test, simulated: {args.robot}, 0.75 m/s, {args.seconds:g} s"
    report(args, rows, list(REAL_WORLD), list(REAL_WORLD), "real_world", title, paper=REAL_WORLD_PAPER)
    print("(paper): a physical Go1, 10 s")


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
    """{scheme: (samples,) PPO's ratio} of a fresh rollout, the second one, after half a second of walking."""
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


SCANNING = tuple(name for name in METHODS if name not in ("roam", "module-pe"))  # whom the paper tests with noise
# name -> (function, the task whose checkpoints it tests, the methods that it is for)
EXPERIMENTS = {
    "stiffness": (stiffness, "stiffness", tuple(METHODS)),
    "damage": (damage, "damage", tuple(METHODS)),
    "stairs": (stairs, "terrain", tuple(METHODS)),
    "low_frequency": (low_frequency, "terrain", SCANNING),
    "high_frequency": (high_frequency, "terrain", SCANNING),
    "attention": (attention, "terrain", ("no-pe-drop", "rolt")),
    "real_world": (real_world, "stiffness", tuple(METHODS)),
    "gaits": (gaits, None, tuple(METHODS)),  # any task that the robot has
    "dropout_ratio": (dropout_ratio, "stiffness", ("rolt",)),
}
PICTURES = ("attention", "gaits", "dropout_ratio")  # of one policy a method
DEFAULTS = {  # where they are not the task's first robot, the paper's 20 s and all methods
    "real_world": {"robot": "go1", "seconds": 10.0},
    "gaits": {"seconds": 10.0, "methods": ("rolt", "mlp")},
}


def find_policies(args) -> dict[Path, tuple]:
    """{path: (policy, card)}: the files of --checkpoints, or what checkpoints/ holds for this test: a file a method, and where
    the test is a table of numbers the method's other seeds, too (ROBOT-TASK-METHOD-seedN.pt)."""
    if args.checkpoints:
        paths = args.checkpoints
    else:
        task, wanted = args.task, args.methods or EXPERIMENTS[args.experiment][2]
        shipped, others = Path(os.path.relpath(Path(__file__).parent / "checkpoints")), args.experiment not in PICTURES
        named = {method: shipped / f"{args.robot}-{task}-{method}.pt" for method in wanted}
        missing = [method for method, path in named.items() if not path.is_file()]
        found = [path for method, path in named.items() if method not in missing]
        paths = [p for path in found for p in (path, *sorted(shipped.glob(f"{path.stem}-seed*.pt")) * others)]
        if missing:
            train = f"python train.py --robot {args.robot} --task {task} --policy {missing[0]}"
            train += " --init FILE, a policy that walks on flat ground" * bool(TASKS[task].terrain)
            print(f"not trained yet: {', '.join(missing)} ({train}; then --checkpoints)")
        if not paths:
            fail("nothing to evaluate: name files with --checkpoints")
    try:
        policies = {path: load_policy(path, args.robot) for path in paths}
    except CheckpointError as error:
        fail(error)
    alike = Counter((card["policy"], card["seed"]) for _, card in policies.values())
    lengths = Counter(policy for policy, _ in {(card["policy"], card["steps"]) for _, card in policies.values()})
    for path, (_, card) in policies.items():  # seeds of equal length are put together in the tables, other variants are not
        variant = path.parent.name if path.name == "policy.pt" else path.stem
        apart = alike[card["policy"], card["seed"]] > 1 or lengths[card["policy"]] > 1
        card["method"] = card["policy"] + f" ({variant})" * apart
        other = f", trained on the task {card['task']}: seen and unseen are others" * (card["task"] != args.task)
        print(f"{card['policy']}: {path} ({card['steps'] / 1e6:.1f}M steps, seed {card['seed']}{other})", flush=True)
    return policies


def rolt_or_last(args) -> torch.nn.Module:
    """The policy to be watched."""
    *_, (last, _) = args.policies.values()
    return next((policy for policy, card in args.policies.values() if card["policy"] == "rolt"), last)


def video(args) -> None:
    if not args.scenes:
        fail("the numbers are written; there is nothing to film, for the test names no args.scenes")
    try:
        film_cases(rolt_or_last(args), args.robot, args.scenes, min(4.0, args.seconds), args.video, args.seed)
    except RuntimeError as error:
        fail(f"the numbers are written, the video is not: {error}")
    print(f"written: {args.video}")


def main(argv: list[str] | None = None) -> None:
    words = sys.argv[1:] if argv is None else argv
    if words[:1] == ["watch"]:
        return watch.main(words[1:])
    parser = Parser(__doc__)
    parser.add_argument("experiment", choices=EXPERIMENTS)
    parser.add_argument("--robot", default=None, help="default: the first one that the test is for")
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="which shipped checkpoints (default: all)")
    parser.add_argument("--checkpoints", nargs="+", type=Path, metavar="FILE", help="policy files, instead of the shipped")
    parser.add_argument("--episodes", type=partial(count, most=10_000), default=32, help="a case (default 32)")
    seconds = partial(positive, most=3600)
    parser.add_argument("--seconds", type=seconds, help="of an episode (default: the paper's 20; real_world, gaits 10)")
    parser.add_argument("--seed", type=seed, default=0, help="of the starts")
    parser.add_argument("--threads", type=threads, default=num_cores(), help="cores to use (default: all)")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the CSV file and the picture")
    parser.add_argument("--video", type=Path, metavar="FILE.gif", help="also film ROLT (or the last method) in every case, 4 s")
    args = parser.parse_args(argv)
    args.scenes = {}  # {case: (fault, speed, options of the env)}, for the film
    if args.video and (args.video.suffix != ".gif" or args.experiment == "dropout_ratio"):
        fail("--video is a .gif file, and for tests in which a robot walks (all but dropout_ratio)")
    if args.methods and args.checkpoints:
        fail("--methods chooses among the shipped checkpoints, --checkpoints names files: leave one of them away")
    function, task, suitable = EXPERIMENTS[args.experiment]
    robots = tuple(dict.fromkeys(robot for name in ([task] if task else TASKS) for robot in TASKS[name].robots))
    defaults = DEFAULTS.get(args.experiment, {})
    args.robot = args.robot or defaults.get("robot", robots[0])
    args.seconds = args.seconds or defaults.get("seconds", 20.0)
    args.methods = args.methods or defaults.get("methods")
    if args.robot not in robots:
        fail(f"the test {args.experiment} is for {', '.join(robots)}, not for {args.robot}")
    args.task = task or first_task(args.robot)
    if args.seconds < CONTROL_DT:
        fail(f"an episode lasts at least {CONTROL_DT} s, not {args.seconds:g}")
    args.policies = find_policies(args)
    unsuitable = {card["policy"] for _, card in args.policies.values()} - set(suitable)
    if unsuitable:
        fail(f"{args.experiment} is for {', '.join(suitable)}, not for {', '.join(sorted(unsuitable))}")
    writable_folder(args.out)
    if args.video:
        writable_folder(args.video.parent, "--video")
    torch.set_num_threads(args.threads)
    try:
        function(args)
        if args.video:
            video(args)
    except (OSError, FloatingPointError) as error:  # a full disk; weights so large that actions are not finite
        fail(error)


if __name__ == "__main__":
    main()
