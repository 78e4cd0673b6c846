"""A trained policy to look at while it walks, and to disturb on the way; and films.

    python evaluate.py watch --fault lock:FR_calf --speed 0.5
    python evaluate.py watch --stairs 0 --noise offset:0.2    # steps of 5 cm, scandots that lie
    python evaluate.py watch --fault tow:RR --out tow.gif     # no viewer, a moving picture
    python evaluate.py watch --fault healthy lock:FR_calf --out strip.png    # a row a fault

Where there is a display, a window opens: the keys up and down change the speed, left and right the
fault. Elsewhere MuJoCo's browser viewer is served, with a panel for the same. (It is open to all
who can reach the port; from another machine: `ssh -L 8080:localhost:8080`.) The terminal takes the
same words: a fault (lock:RL_calf, healthy), a speed (0.5), noise (sigma:0.1, clean), "again" to
start over, "quit". A robot that falls starts over by itself.
"""

import argparse
import copy
import os
import queue
import re
import sys
import threading
import time
from pathlib import Path

import mujoco
import numpy as np
import torch
from PIL import Image, ImageDraw

from checkpoint import load_policy
from env import CONTROL_DT, LocomotionEnv
from faults import REAL_WORLD, TASKS, Fault, first_task, joint_mask, parse, props, write_fault
from noise import parse as parse_noise
from ppo import to_tensors
from robots import ROBOTS
from terrain import Terrain
from walk import Walk, straight_ahead, take_a_walk

HELP = "type a fault (lock:RL_calf, healthy), a speed (0.5), noise (sigma:0.1), again or quit"
DISPLAY = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
NO_DISPLAY = sys.platform == "linux" and not DISPLAY


def painted(env: LocomotionEnv, fault: Fault) -> mujoco.MjModel:
    """A copy of the env's model, the links behind the fault in red."""
    model = copy.copy(env.model)
    faulty = (*fault.locked, *(part for part, _ in (*fault.strength, *fault.half_locked)))
    bodies = [f"{leg}_wheel" for leg in fault.skating]
    bodies += [name for name, bad in zip(env.robot.joints, joint_mask(faulty, env.robot)) if bad]
    for body in bodies:
        model.geom_rgba[model.geom_bodyid == model.body(body).id] = [0.85, 0.2, 0.15, 1]
    return model


def draw(walk: Walk, robot: int, steps: range, width=480, height=300) -> list[Image.Image]:
    """Frames of one of the robots at these steps. RuntimeError if nothing can be drawn here."""
    if NO_DISPLAY and "MUJOCO_GL" not in os.environ:  # MuJoCo would look for a window
        from mujoco.egl import GLContext
        from mujoco.rendering.classic import gl_context

        gl_context.GLContext = GLContext
    model = painted(walk.env, walk.faults[robot])
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # each backend fails in its own way
        way_out = "try MUJOCO_GL=egl (libegl1) or osmesa (libosmesa6)"
        raise RuntimeError(f"cannot draw ({error}): {way_out}") from error
    data, camera, frames = mujoco.MjData(model), mujoco.MjvCamera(), []
    camera.distance = 1.3 * max(1.0, walk.env.robot.trunk_box[0] / 0.38)  # m, the whole robot
    camera.elevation = -18
    camera.azimuth = 60 if walk.env.terrain else 125  # from behind, stairs show their steps
    for step in steps:
        data.qpos[:] = walk.poses[step, robot]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mj_tendon(model, data)
        camera.lookat[:] = data.qpos[:3] - [0, 0, 0.08]  # on flat ground 0.2 m up
        renderer.update_scene(data, camera)
        frames.append(Image.fromarray(renderer.render()))
    renderer.close()
    return frames


def write_gif(frames: list[Image.Image], path: Path, seconds_a_frame: float) -> None:
    """One palette for all frames keeps the file small and the colours still."""
    palette = frames[0].quantize(64, Image.Quantize.FASTOCTREE)  # keeps a fault's few pixels red
    first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    options = {"duration": max(20, round(1000 * seconds_a_frame)), "loop": 0, "optimize": True}
    first.save(path, save_all=True, append_images=rest, **options)


def write_strip(rows: dict[str, list[Image.Image]], path: Path) -> None:
    """One row of frames a film, from left to right, its name in the first one."""
    width, height = next(iter(rows.values()))[0].size
    strip = Image.new("RGB", (max(map(len, rows.values())) * width, len(rows) * height), "white")
    for y, (name, frames) in enumerate(rows.items()):
        for x, frame in enumerate(frames):
            strip.paste(frame, (x * width, y * height))
        ImageDraw.Draw(strip).text((8, y * height + 6), name, fill="black", font_size=20)
    strip.save(path)


def film(args, policy, faults: list[Fault], options: dict) -> None:
    """Writes --out: from 2 s on, up to the first fall."""
    gif, start = args.out.suffix == ".gif", round(2 / CONTROL_DT)
    seconds = args.seconds or (4.0 if gif else 0.6)
    walk = take_a_walk(policy, args.robot, faults, args.speed, 2 + seconds, args.seed, **options)
    every = 2 if gif else max(1, round(seconds / CONTROL_DT / 6))  # six frames in a strip
    shown = {str(fault): range(start, walk.steps[i], every) for i, fault in enumerate(faults)}
    if fallen := [name for name, steps in shown.items() if not steps]:
        raise RuntimeError(f"with {fallen[0]} the robot falls within 2 s: nothing to show")
    if gif:
        write_gif(draw(walk, 0, shown[str(faults[0])]), args.out, every * CONTROL_DT)
    else:
        films = [draw(walk, i, steps, 300, 240) for i, steps in enumerate(shown.values())]
        write_strip(dict(zip(shown, films)), args.out)
    print(f"written: {args.out}")


class Show:
    """One robot that walks straight on for ever. `model` and `data`, which a viewer shows, are new
    objects after some changes. `said` is the answer to the last word."""

    def __init__(self, policy, robot: str, fault: Fault, speed: float, seed: int, terrain, noise):
        self.policy, self.robot, self.speed, self.seed = policy, robot, speed, seed
        self.terrain, self.noise = terrain, noise
        task = TASKS[first_task(robot)]
        self.menu = [*(fault for _, fault in task.training), *task.unseen]
        if "go1" in task.robots:
            self.menu += [fault for fault in REAL_WORLD.values() if fault not in self.menu]
        self.words, self.said, self.over = queue.Queue(), HELP, False
        self.start(fault)

    def start(self, fault: Fault) -> None:
        """A new episode in a new env. ValueError if the robot has no such part; all stays then."""
        config = straight_ahead(self.policy, self.speed, 3600)
        options = (config, self.policy.extras, self.terrain, self.noise)
        env = LocomotionEnv(self.robot, 1, self.seed, 1, [(1.0, fault)], *options)
        observation, model = env.reset(), painted(env, fault)
        self.env, self.observation, self.fault = env, observation, fault
        self.model, self.data = model, mujoco.MjData(model)

    def set_fault(self, fault: Fault) -> None:
        """Without a reset, unless a box or wheels come or go. ValueError: there is no such part."""
        if props([fault]) != props([self.fault]):
            return self.start(fault)
        write_fault(fault, self.env.robot, self.env.world, np.array([0]))
        self.env.pin_faults([fault])  # at the next resets, too
        self.fault, self.model = fault, painted(self.env, fault)

    def hear(self, word: str) -> None:
        """A word of those in HELP. What it cannot read changes nothing, and `said` tells why."""
        try:
            if word == "quit":
                self.over = True
            elif word == "again":
                self.start(self.fault)
            elif word.replace(".", "", 1).isdecimal():
                self.speed = min(3.0, float(word))  # m/s, ours: three times what training commands
            elif re.split("[:+]", word)[0] in ("clean", "offset", "sigma", "missing"):
                self.noise = parse_noise(word)
                self.env.scan.set_noise(self.noise)
            elif word:
                self.set_fault(parse(word))
            self.said = f"{self.fault}, {self.speed:g} m/s, scandots {self.noise}"
        except ValueError as error:
            self.said = str(error)
        print(self.said, flush=True)

    @torch.no_grad()
    def step(self) -> None:
        """Words, and one control step of 20 ms."""
        while not self.words.empty():
            self.hear(self.words.get().strip())
        self.env.command[:, 0] = self.speed
        action = self.policy(to_tensors(self.observation, "cpu")).numpy()
        self.observation, _, fallen, _, _ = self.env.step(action)
        if fallen[0]:
            print("it fell and starts over", flush=True)
        self.data.qpos[:] = self.env.world.bind("qpos")[0]
        self.data.time += CONTROL_DT


class Clock:
    """Holds the loop at real time; a loop that is too slow is not made up for."""

    def __init__(self):
        self.due = time.monotonic()

    def wait(self) -> None:
        now = time.monotonic()
        self.due = max(self.due + CONTROL_DT, now - CONTROL_DT)
        time.sleep(max(0.0, self.due - now))


def desktop(show: Show) -> None:
    """A window of mujoco.viewer, anew when a box or wheels come or go. Closing it ends the show."""
    import mujoco.viewer

    def key(code: int) -> None:  # GLFW's codes
        if code in (265, 264):  # up, down
            show.words.put(f"{max(0.0, show.speed + (0.1 if code == 265 else -0.1)):.2f}")
        if code in (262, 263):  # right, left
            here = show.menu.index(show.fault) if show.fault in show.menu else 0
            show.words.put(str(show.menu[(here + (1 if code == 262 else -1)) % len(show.menu)]))

    clock, closed, panels = Clock(), False, {"show_left_ui": False, "show_right_ui": False}
    while not (show.over or closed):
        model, data = show.model, show.data
        with mujoco.viewer.launch_passive(model, data, key_callback=key, **panels) as viewer:
            viewer.sync()  # a camera that is set before the first one is set back
            with viewer.lock():
                track(viewer.cam)
            while show.data is data and not (show.over or closed):
                with viewer.lock():
                    show.step()
                    if show.data is data:
                        model.geom_rgba[:] = show.model.geom_rgba
                    mujoco.mj_forward(model, data)
                viewer.sync()
                clock.wait()
                closed = not viewer.is_running()


def browser(show: Show, port: int) -> None:
    """MuJoCo's viewer as a web page, with a panel of our own. port 0: the first free from 8080."""
    from mujoco.studio import launch_web, messages, plugin, viewer_protocol
    from mujoco.studio.dear_imgui import dear_imgui as imgui

    names = [str(fault) for fault in show.menu]

    class Panel(plugin.ViewerPlugin):
        """Runs in the viewer's thread, so it only reads the show and puts words in its queue."""

        text = str(show.fault)

        @messages.handler
        def aim(self, _: messages.PostModelEvent) -> None:
            track(self.viewer.camera)

        @messages.handler
        def draw(self, _: messages.BuildGuiEvent) -> None:
            imgui.SetNextWindowPos(imgui.Vec2(20, 20), imgui.Cond.FirstUseEver)
            imgui.SetNextWindowSize(imgui.Vec2(380, 200), imgui.Cond.FirstUseEver)
            if imgui.Begin("Walk")[0]:
                imgui.TextWrapped(show.said)
                moved, speed = imgui.SliderFloat("m/s", show.speed, 0.0, 1.0, "%.2f")
                if moved:
                    show.words.put(f"{speed:.2f}")
                here = names.index(str(show.fault)) if str(show.fault) in names else -1
                chosen, index = imgui.Combo("fault", here, names)
                if chosen:
                    show.words.put(names[index])
                _, self.text = imgui.InputText("or write one", self.text)
                if imgui.Button("set it"):
                    show.words.put(self.text)
                imgui.SameLine()
                if imgui.Button("again"):
                    show.words.put("again")
            imgui.End()

    title, clock = f"ROLT: {show.robot}", Clock()
    config = viewer_protocol.ViewerConfig(title=title, gfx="web", http_port=port)
    with launch_web.launch(config, plugins=[Panel()]) as handle:
        while handle.is_running() and not show.over:
            show.step()
            handle.sync(show.model, show.data)
            clock.wait()


def track(camera) -> None:
    camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1  # the trunk
    camera.distance, camera.azimuth, camera.elevation = 1.8, 125, -18


def main(argv: list[str] | None = None) -> None:
    plain = {"usage": argparse.SUPPRESS, "formatter_class": argparse.RawDescriptionHelpFormatter}
    parser = argparse.ArgumentParser(description=__doc__, **plain)
    add, levels = parser.add_argument, range(-2, 11)
    add("--robot", default="a1", choices=ROBOTS)
    add("--checkpoint", type=Path, metavar="FILE", help="default: the shipped ROLT of the robot")
    add("--fault", nargs="+", default=["healthy"], help="lock:FR_calf+weaken:RL:0.5; .png: several")
    add("--speed", type=float, default=0.75, help="commanded, m/s (default 0.75)")
    add("--stairs", type=int, choices=levels, metavar="LEVEL", help="-2 to 10 (default: flat)")
    add("--noise", default="clean", help="on the scandots: offset:0.2, sigma:0.1, missing:4")
    add("--seed", type=int, default=0)
    add("--viewer", choices=("desktop", "browser"), help="default: desktop if there is a display")
    add("--port", type=int, default=0, help="of the browser viewer (default: the first from 8080)")
    add("--out", type=Path, metavar="FILE", help="write a film (.gif) or a strip of frames (.png)")
    add("--seconds", type=float, help="of the picture (default 4, of a strip 0.6)")
    args = parser.parse_args(argv)
    if args.out and args.out.suffix not in (".gif", ".png"):
        parser.error(f"--out is a .gif or a .png file, not {args.out}")
    if len(args.fault) > 1 and not (args.out and args.out.suffix == ".png"):
        parser.error("one fault at a time; several make the rows of a --out FILE.png")
    torch.set_num_threads(1)
    try:
        task = first_task(args.robot) if args.stairs is None else "terrain"
        shipped = Path(__file__).parent / f"checkpoints/{args.robot}-{task}-rolt.pt"
        policy, _ = load_policy(args.checkpoint or os.path.relpath(shipped), args.robot)
        faults, noise = [parse(text) for text in args.fault], parse_noise(args.noise)
        terrain = None if args.stairs is None else Terrain(("stairs",), (args.stairs,) * 9)
        if args.out:
            return film(args, policy, faults, {"terrain": terrain, "noise": noise})
        show = Show(policy, args.robot, faults[0], args.speed, args.seed, terrain, noise)
        print(HELP)
        threading.Thread(target=lambda: [*map(show.words.put, sys.stdin)], daemon=True).start()
        browser(show, args.port) if args.viewer == "browser" or NO_DISPLAY else desktop(show)
    except KeyboardInterrupt:
        pass
    except (ValueError, RuntimeError, ImportError, OSError, FloatingPointError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
