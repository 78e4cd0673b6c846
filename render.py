"""Pictures of a robot that walks: a strip of frames (.png) or a moving picture (.gif).

    python render.py checkpoints/a1-stiffness-rolt.pt --fault lock:FL_calf --out limping.gif
    python render.py checkpoints/a1-stiffness-rolt.pt --fault healthy lock:FR_calf --out strip.png

Works without a display through EGL (set MUJOCO_GL yourself for another way, such as osmesa).
"""

import os
import sys
from functools import partial
from pathlib import Path

if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # read by mujoco when it is imported

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from PIL import Image, ImageDraw  # noqa: E402

from checkpoint import CheckpointError, load_policy  # noqa: E402
from cli import Parser, fail, positive, seed, writable_folder  # noqa: E402
from env import CONTROL_DT, EnvConfig, LocomotionEnv  # noqa: E402
from faults import Fault, joint_mask, parse  # noqa: E402
from ppo import to_tensors  # noqa: E402


def make_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """RuntimeError with the way out where off-screen rendering does not work."""
    try:
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # each backend fails in its own way
        way = os.environ.get("MUJOCO_GL", "not set")
        raise RuntimeError(
            f"cannot render ({error}): MUJOCO_GL is {way}; try MUJOCO_GL=egl (package libegl1) or osmesa (libosmesa6)"
        ) from error


@torch.no_grad()
def film(
    policy, robot: str, fault: Fault, seconds: float, every: int, width: int = 480, height: int = 300,
    speed: float = 0.75, seed: int = 0, warm_up: float = 2.0,
) -> list[np.ndarray]:  # fmt: skip
    """(height, width, 3) uint8 frames of one robot that walks straight on, one each `every` control steps, after
    `warm_up` seconds. Links behind a fault are red. The film ends where the robot falls.
    """
    config = EnvConfig(forward_speed=(speed, speed), heading=(0.0, 0.0), push_speed=0.0, episode_seconds=3600)
    env = LocomotionEnv(robot, 1, seed, 1, ((1.0, fault),), config, policy.extras)
    observation = env.reset()
    model = env.world.get_model(0)  # with what the fault changed on it
    faulty = (*fault.locked, *(part for part, _ in (*fault.strength, *fault.half_locked)))
    bodies = [f"{leg}_wheel" for leg in fault.skating]
    bodies += [name for name, bad in zip(env.robot.joints, joint_mask(faulty, env.robot)) if bad]
    for body in bodies:
        model.geom_rgba[model.geom_bodyid == model.body(body).id] = [0.85, 0.2, 0.15, 1]
    renderer = make_renderer(model, width, height)
    data, camera, frames = mujoco.MjData(model), mujoco.MjvCamera(), []
    camera.distance, camera.azimuth, camera.elevation = 1.3, 125, -18
    start = round(warm_up / CONTROL_DT)
    for step in range(start + round(seconds / CONTROL_DT)):
        if step >= start and (step - start) % every == 0:
            data.qpos[:] = env.world.bind("qpos")[0]
            mujoco.mj_forward(model, data)
            camera.lookat[:] = [data.qpos[0], data.qpos[1], 0.18]
            renderer.update_scene(data, camera)
            frames.append(renderer.render().copy())
        observation, _, terminated, _, _ = env.step(policy(to_tensors(observation, "cpu")).numpy())
        if terminated[0]:
            break
    renderer.close()
    if not frames:
        raise ValueError(f"with {fault} the robot falls within {warm_up:g} s: there is nothing to show")
    return frames


def write_gif(frames: list[np.ndarray], path: Path, seconds_a_frame: float) -> None:
    """One palette for all frames keeps the file small and the colours still."""
    images = [Image.fromarray(frame) for frame in frames]
    palette = images[0].quantize(64)
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
    parser.add_argument("--fault", nargs="+", default=["healthy"], help="a row of the strip each; a GIF shows the first")
    parser.add_argument("--seconds", type=partial(positive, most=120), default=4.0, help="of a GIF (default 4)")
    parser.add_argument("--speed", type=partial(positive, most=10), default=0.75, help="commanded, m/s")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--out", type=Path, default=Path("walk.gif"), help="a .gif or .png file")
    args = parser.parse_args(argv)
    if args.out.suffix not in (".gif", ".png"):
        fail(f"--out is a .gif or a .png file, not {args.out}")
    try:
        policy, card = load_policy(args.checkpoint)
        faults = [parse(text) for text in args.fault]
        writable_folder(args.out.parent)
        options = {"speed": args.speed, "seed": args.seed}
        if args.out.suffix == ".gif":
            frames = film(policy, card["robot"], faults[0], args.seconds, 2, **options)
            write_gif(frames, args.out, 2 * CONTROL_DT)
        else:
            rows = {str(f): film(policy, card["robot"], f, 0.6, 5, 300, 240, **options) for f in faults}
            write_strip(rows, args.out)
    except (CheckpointError, OSError, FloatingPointError, ValueError, RuntimeError) as error:
        fail(error)
    print(f"written: {args.out}")


if __name__ == "__main__":
    main()
