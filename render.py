"""Pictures of a robot that walks: a strip of frames (.png) or a moving picture (.gif).

    python render.py checkpoints/a1-stiffness-rolt.pt --fault lock:FL_calf --out limping.gif
    python render.py checkpoints/a1-stiffness-rolt.pt --fault healthy lock:FR_calf --out strip.png

Works without a display through EGL (set MUJOCO_GL yourself for another way, such as osmesa).
"""

import copy
import math
import os
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

BROKEN = None  # why there can be no pictures, if it is known from the start
if sys.platform == "linux" and not os.environ.get("DISPLAY") and "MUJOCO_GL" not in os.environ:
    if "mujoco" in sys.modules:  # which reads the variable when it is imported
        BROKEN = "import render before anything that imports mujoco, or set MUJOCO_GL=egl"  # drawing would end the process
    os.environ["MUJOCO_GL"] = "egl"
LIBRARIES = "try MUJOCO_GL=egl (package libegl1) or osmesa (libosmesa6)"
try:
    import mujoco
except Exception as error:  # the library of MUJOCO_GL is missing, each fails in its own way; all but pictures works without
    BROKEN = f"MUJOCO_GL is {os.environ.get('MUJOCO_GL', 'not set')}, which does not load ({error}); {LIBRARIES}"
    os.environ["MUJOCO_GL"] = "disable"
    import mujoco
import numpy as np  # noqa: E402
import torch  # noqa: E402
from PIL import Image, ImageDraw  # noqa: E402

from checkpoint import CheckpointError, load_policy  # noqa: E402
from cli import Parser, fail, positive, seed, writable_folder  # noqa: E402
from env import CONTROL_DT, LocomotionEnv  # noqa: E402
from faults import Fault, joint_mask, parse  # noqa: E402
from ppo import to_tensors  # noqa: E402
from protocol import straight_ahead  # noqa: E402
from terrain import Terrain  # noqa: E402


def make_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """RuntimeError with the way out where off-screen rendering does not work."""
    if BROKEN:
        raise RuntimeError(f"cannot render: {BROKEN}")
    try:
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # each backend fails in its own way
        way = os.environ.get("MUJOCO_GL", "not set")
        raise RuntimeError(f"cannot render ({error}): MUJOCO_GL is {way}; {LIBRARIES}") from error


def problem() -> str | None:
    """Why nothing can be drawn here, or None."""
    try:
        make_renderer(mujoco.MjSpec().compile(), 16, 16).close()
    except RuntimeError as error:
        return str(error)
    return None


class Walk(NamedTuple):
    """What N robots did, step by step: T steps, L legs. What follows a robot's first fall means nothing."""

    env: LocomotionEnv
    faults: list[Fault]
    poses: np.ndarray  # (T, N, nq), MuJoCo's qpos
    contacts: np.ndarray  # (T, N, L) bool, which feet were on the ground
    steps: np.ndarray  # (N,) up to the first fall


@torch.no_grad()
def record(
    policy, robot: str, faults: list[Fault], seconds: float, speed: float = 0.75, seed: int = 0, threads: int = 1, **env_options
) -> Walk:
    """One robot a fault walks straight on at `speed` until all have fallen or the time is up. Nobody is pushed.

    env_options: of LocomotionEnv, such as terrain and noise.
    """
    situations, config = [(1.0, fault) for fault in faults], straight_ahead(speed, seconds)
    env = LocomotionEnv(robot, len(faults), seed, threads, situations, config, policy.extras, **env_options)
    env.pin_faults(faults)  # one each
    observation, poses, contacts = env.reset(), [], []
    feet = [env.model.sensor(f"contact_{leg}_foot").adr[0] for leg in env.robot.legs]
    upright, steps = np.ones(len(faults), dtype=bool), np.zeros(len(faults), dtype=int)
    for _ in range(round(seconds / CONTROL_DT)):
        poses.append(env.world.bind("qpos").copy())
        contacts.append(env.world.bind("sensordata")[:, feet] > 0)
        steps += upright
        observation, _, terminated, _, _ = env.step(policy(to_tensors(observation, "cpu")).numpy())
        upright &= ~terminated
        if not upright.any():
            break
    return Walk(env, list(faults), np.array(poses), np.array(contacts), steps)


def painted(env: LocomotionEnv, fault: Fault) -> mujoco.MjModel:
    """A copy of the env's model, the links behind the fault in red."""
    model = copy.copy(env.model)
    faulty = (*fault.locked, *(part for part, _ in (*fault.strength, *fault.half_locked)))
    bodies = [f"{leg}_wheel" for leg in fault.skating]
    bodies += [name for name, bad in zip(env.robot.joints, joint_mask(faulty, env.robot)) if bad]
    for body in bodies:
        model.geom_rgba[model.geom_bodyid == model.body(body).id] = [0.85, 0.2, 0.15, 1]
    return model


def draw(walk: Walk, robot: int, steps: range, width: int = 480, height: int = 300) -> list[np.ndarray]:
    """(height, width, 3) uint8 frames of one of the robots at these steps."""
    model = painted(walk.env, walk.faults[robot])
    renderer = make_renderer(model, width, height)
    data, camera, frames = mujoco.MjData(model), mujoco.MjvCamera(), []
    camera.distance = 1.3 * max(1.0, walk.env.robot.trunk_box[0] / 0.38)  # m, the whole robot
    camera.azimuth, camera.elevation = 60 if walk.env.terrain else 125, -18  # from behind, stairs show their steps
    for step in steps:
        data.qpos[:] = walk.poses[step, robot]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mj_tendon(model, data)
        camera.lookat[:] = data.qpos[:3] - [0, 0, 0.08]  # on flat ground 0.2 m up
        renderer.update_scene(data, camera)
        frames.append(renderer.render().copy())
    renderer.close()
    return frames


def film(
    policy, robot: str, fault: Fault, seconds: float, every: int, width: int = 480, height: int = 300,
    speed: float = 0.75, seed: int = 0, warm_up: float = 2.0, **env_options,
) -> list[np.ndarray]:  # fmt: skip
    """Frames of one robot that walks straight on, one each `every` control steps, after `warm_up` seconds. The film ends
    where the robot falls. ValueError if nothing is left of it."""
    if seconds < CONTROL_DT:
        raise ValueError(f"a film lasts at least {CONTROL_DT} s, not {seconds:g}")
    walk = record(policy, robot, [fault], warm_up + seconds, speed, seed, **env_options)
    steps = range(round(warm_up / CONTROL_DT), walk.steps[0], every)
    if not steps:
        raise ValueError(f"with {fault} the robot falls within {warm_up:g} s: there is nothing to show")
    return draw(walk, 0, steps, width, height)


def film_cases(
    policy, robot: str, cases: dict[str, tuple[Fault, float, dict]], seconds: float, path: Path, seed: int = 0
) -> None:
    """A GIF of one robot a case, side by side from the start; who falls stays as it fell.

    cases: {name: (fault, commanded speed, options of LocomotionEnv)}
    """
    width, height, every, films = 240, 160, 4, {}
    for name, (fault, speed, env_options) in cases.items():
        walk = record(policy, robot, [fault], seconds, speed, seed, **env_options)
        films[name] = draw(walk, 0, range(0, walk.steps[0], every), width, height)
    columns, frames = math.ceil(math.sqrt(len(films))), []
    for i in range(max(len(film) for film in films.values())):
        sheet = Image.new("RGB", (columns * width, math.ceil(len(films) / columns) * height), "white")
        for place, (name, film) in enumerate(films.items()):
            x, y = place % columns * width, place // columns * height
            sheet.paste(Image.fromarray(film[min(i, len(film) - 1)]), (x, y))
            ImageDraw.Draw(sheet).text((x + 6, y + 4), name, fill="black", font_size=14)
        frames.append(np.asarray(sheet))
    write_gif(frames, path, every * CONTROL_DT)


def write_gif(frames: list[np.ndarray], path: Path, seconds_a_frame: float) -> None:
    """One palette for all frames keeps the file small and the colours still."""
    images = [Image.fromarray(frame) for frame in frames]
    palette = images[0].quantize(64, Image.Quantize.FASTOCTREE)  # keeps the few red pixels of a fault red
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = max(20, round(1000 * seconds_a_frame))
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=True)


def write_strip(rows: dict[str, list[np.ndarray]], path: Path) -> None:
    """One row of frames a film, from left to right, its name in the first one."""
    height, width = next(iter(rows.values()))[0].shape[:2]
    columns = max(len(frames) for frames in rows.values())
    strip = Image.new("RGB", (columns * width, len(rows) * height), "white")
    for y, (name, frames) in enumerate(rows.items()):
        for x, frame in enumerate(frames):
            strip.paste(Image.fromarray(frame), (x * width, y * height))
        ImageDraw.Draw(strip).text((8, y * height + 6), name, fill="black", font_size=20)
    strip.save(path)


def main(argv: list[str] | None = None) -> None:
    parser = Parser(__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--fault", nargs="+", default=["healthy"], help="a row of the strip each; a GIF shows one")
    parser.add_argument("--seconds", type=partial(positive, most=120), help="default: 4 in a GIF, 0.6 in a strip")
    parser.add_argument("--speed", type=partial(positive, most=10), default=0.75, help="commanded, m/s")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--stairs", type=int, choices=range(-2, 11), metavar="LEVEL", help="-2 to 10, instead of flat ground")
    parser.add_argument("--out", type=Path, default=Path("walk.gif"), help="a .gif or .png file")
    args = parser.parse_args(argv)
    if args.out.suffix not in (".gif", ".png"):
        fail(f"--out is a .gif or a .png file, not {args.out}")
    if args.out.suffix == ".gif" and len(args.fault) > 1:
        fail("a .gif shows one fault; name a .png to see several in rows")
    try:
        policy, card = load_policy(args.checkpoint)
        faults = [parse(text) for text in args.fault]
        writable_folder(args.out.parent)
        terrain = None if args.stairs is None else Terrain(("stairs",), (args.stairs,) * 9)
        options = {"speed": args.speed, "seed": args.seed, "terrain": terrain}
        if args.out.suffix == ".gif":
            frames = film(policy, card["robot"], faults[0], args.seconds or 4.0, 2, **options)
            write_gif(frames, args.out, 2 * CONTROL_DT)
        else:
            seconds = args.seconds or 0.6
            every = max(1, round(seconds / CONTROL_DT / 6))  # six frames
            rows = {str(f): film(policy, card["robot"], f, seconds, every, 300, 240, **options) for f in faults}
            write_strip(rows, args.out)
    except (CheckpointError, OSError, FloatingPointError, ValueError, RuntimeError) as error:
        fail(error)
    print(f"written: {args.out}")


if __name__ == "__main__":
    main()
