"""A trained policy to look at while it walks, with its fault, its command and its noise to change on the way.

    python evaluate.py watch                                          # the A1, healthy
    python evaluate.py watch --robot a1 --fault lock:FR_calf --speed 0.5
    python evaluate.py watch --stairs 0 --noise offset:0.2            # steps of 5 cm (level 0), and scandots that lie
    python evaluate.py watch --fault tow:RR --video tow.gif           # no viewer, a moving picture

Where there is a display, a window of MuJoCo's viewer opens: the keys up and down change the speed, left and right the
fault. Elsewhere MuJoCo's browser viewer is served; its panel does the same. (It is open to everybody who can reach the
port; from another machine it wants `ssh -L 8080:localhost:8080`.) Either way the terminal takes the same words: a fault
("lock:RL_calf", "healthy"), a speed ("0.5"), noise ("sigma:0.1", "clean"), "again" to start over, "quit". A robot that
falls starts over by itself.
"""

import os
import queue
import re
import sys
import threading
import time
import warnings
from functools import partial
from pathlib import Path

import render  # first: it says how to draw without a display, which mujoco reads when it is imported
import mujoco
import numpy as np
import torch

from checkpoint import CheckpointError, load_policy
from cli import Parser, fail, port, positive, seed, writable_folder
from env import CONTROL_DT, LocomotionEnv
from faults import REAL_WORLD, TASKS, Fault, first_task, healthy, parse, props, write_fault
from noise import ScanNoise
from noise import parse as parse_noise
from ppo import to_tensors
from protocol import straight_ahead
from robots import ROBOTS
from terrain import Terrain

MAX_COMMAND = 10.0  # m/s, ours: ten times what training commands
HELP = "type a fault (lock:RL_calf, healthy, ...), a speed (0.5), noise (sigma:0.1, clean, ...), again or quit"


class Show:
    """One robot that walks straight on for ever. `model` and `data` are what a viewer shows; they are new objects after some
    changes. `said` is the answer to the last wish."""

    def __init__(
        self, policy, robot: str, fault: Fault = healthy(), speed: float = 0.75, seed: int = 0,
        terrain: Terrain | None = None, noise: ScanNoise = ScanNoise(),
    ):  # fmt: skip
        self.policy, self.robot, self.speed, self.seed = policy, robot, speed, seed
        self.terrain, self.noise = terrain, noise
        task = TASKS[first_task(robot)]
        self.menu = [fault for _, fault in task.training] + list(task.unseen)
        self.menu += [fault for fault in REAL_WORLD.values() if "go1" in task.robots and fault not in self.menu]
        self.wishes, self.said, self.over = queue.Queue(), HELP, False
        self.start(fault)

    def start(self, fault: Fault) -> None:
        """A new episode in a new env. ValueError if the robot has no such part; then all stays as it was."""
        options = {"extras": self.policy.extras, "terrain": self.terrain, "noise": self.noise}
        options["config"] = straight_ahead(self.speed, 3600)
        env = LocomotionEnv(self.robot, 1, self.seed, 1, [(1.0, fault)], **options)
        observation, model = env.reset(), render.painted(env, fault)
        self.env, self.observation, self.fault = env, observation, fault
        self.model, self.data = model, mujoco.MjData(model)

    def set_fault(self, fault: Fault) -> None:
        """Without a fall or a reset, unless a box or wheels come or go. ValueError if the robot has no such part."""
        if props([fault]) == props([self.fault]):
            write_fault(fault, self.env.robot, self.env.world, np.array([0]))
            self.env.pin_faults([fault])  # at the next resets, too
            self.fault, self.model = fault, render.painted(self.env, fault)
        else:
            self.start(fault)

    def obey(self, wish: str) -> None:
        """One of the words that HELP lists. What it cannot read changes nothing, and `said` tells why."""
        try:
            if wish == "quit":
                self.over = True
            elif wish == "again":
                self.start(self.fault)
            elif wish.replace(".", "", 1).isdecimal():
                if float(wish) > MAX_COMMAND:
                    raise ValueError(f"a speed is at most {MAX_COMMAND:g} m/s, not {wish}")
                self.speed = float(wish)
            elif re.split("[:+]", wish)[0] in ("clean", "offset", "sigma", "missing"):
                self.noise = parse_noise(wish)
                self.env.scan.set_noise(self.noise)
            elif wish:
                self.set_fault(parse(wish))
            self.said = f"{self.fault}, {self.speed:g} m/s, scandots {self.noise}"
        except ValueError as error:
            self.said = str(error)
        print(self.said, flush=True)

    @torch.no_grad()
    def step(self) -> None:
        """Wishes, and one control step of 20 ms."""
        while not self.wishes.empty():
            self.obey(self.wishes.get().strip())
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


def listen(show: Show) -> None:
    """Lines typed in the terminal are wishes."""
    threading.Thread(target=lambda: [show.wishes.put(line) for line in sys.stdin], daemon=True).start()


def has_display() -> bool:
    """Can a window be opened? On Linux, where mujoco.viewer would end the program if not, it is tried."""
    if sys.platform != "linux":
        return True
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    import glfw  # mujoco brings it along

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return bool(glfw.init())


def desktop(show: Show) -> None:
    """A window of mujoco.viewer, opened anew when a box or wheels come or go. Closing it ends the show."""
    import mujoco.viewer

    def key(code: int) -> None:  # GLFW's codes
        if code in (265, 264):  # up, down
            show.wishes.put(f"{max(0.0, show.speed + (0.1 if code == 265 else -0.1)):.2f}")
        if code in (262, 263):  # right, left
            here = show.menu.index(show.fault) if show.fault in show.menu else 0
            show.wishes.put(str(show.menu[(here + (1 if code == 262 else -1)) % len(show.menu)]))

    clock, closed = Clock(), False
    while not (show.over or closed):
        model, data = show.model, show.data
        with mujoco.viewer.launch_passive(model, data, key_callback=key, show_left_ui=False, show_right_ui=False) as viewer:
            viewer.sync()  # a camera that is set before the first one is set back
            with viewer.lock():
                track(viewer.cam)
            while show.data is data and not (show.over or closed):
                with viewer.lock():
                    show.step()
                    model.geom_rgba[:] = show.model.geom_rgba if show.data is data else model.geom_rgba
                    mujoco.mj_forward(model, data)
                viewer.sync()
                clock.wait()
                closed = not viewer.is_running()


def browser(show: Show, http_port: int = 0) -> None:
    """MuJoCo's viewer as a web page, with a panel of our own. `http_port` 0: the first free one from 8080 on."""
    from mujoco.studio import launch_web, messages, plugin, viewer_protocol
    from mujoco.studio.dear_imgui import dear_imgui as imgui

    names = [str(fault) for fault in show.menu]

    class Panel(plugin.ViewerPlugin):
        """Runs in the viewer's thread, so it only reads the show and puts wishes in its queue."""

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
                    show.wishes.put(f"{speed:.2f}")
                chosen, index = imgui.Combo("fault", names.index(str(show.fault)) if str(show.fault) in names else -1, names)
                if chosen:
                    show.wishes.put(names[index])
                _, self.text = imgui.InputText("or write one", self.text)
                if imgui.Button("set it"):
                    show.wishes.put(self.text)
                imgui.SameLine()
                if imgui.Button("again"):
                    show.wishes.put("again")
            imgui.End()

    config, clock = viewer_protocol.ViewerConfig(title=f"ROLT: {show.robot}", gfx="web", http_port=http_port), Clock()
    with launch_web.launch(config, plugins=[Panel()]) as handle:
        while handle.is_running() and not show.over:
            show.step()
            handle.sync(show.model, show.data)
            clock.wait()


def track(camera) -> None:
    camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1  # the trunk
    camera.distance, camera.azimuth, camera.elevation = 1.8, 125, -18


def main(argv: list[str] | None = None) -> None:
    parser = Parser(__doc__)
    parser.add_argument("--robot", default="a1", choices=ROBOTS)
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="default: the shipped ROLT of the robot")
    parser.add_argument("--fault", default="healthy", help="e.g. lock:FR_calf+weaken:RL:0.5 (default healthy)")
    parser.add_argument("--speed", type=partial(positive, most=MAX_COMMAND), default=0.75, help="commanded, m/s (default 0.75)")
    parser.add_argument("--stairs", type=int, choices=range(-2, 11), metavar="LEVEL", help="-2 to 10, instead of flat ground")
    parser.add_argument("--noise", default="clean", help="on the scandots, e.g. offset:0.2, sigma:0.1, missing:4")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--viewer", choices=("desktop", "browser"), help="default: desktop where there is a display")
    parser.add_argument("--port", type=port, default=0, help="of the browser viewer (default: the first free from 8080 on)")
    parser.add_argument("--video", type=Path, metavar="FILE.gif", help="write a moving picture instead")
    parser.add_argument("--seconds", type=partial(positive, most=120), default=4.0, help="of the moving picture (default 4)")
    args = parser.parse_args(argv)
    if args.video and args.video.suffix != ".gif":
        fail(f"--video is a .gif file, not {args.video}")
    torch.set_num_threads(1)
    try:
        task = first_task(args.robot) if args.stairs is None else "terrain"
        shipped = Path(os.path.relpath(Path(__file__).parent / "checkpoints")) / f"{args.robot}-{task}-rolt.pt"
        policy, _ = load_policy(args.checkpoint or shipped, args.robot)
        fault, noise = parse(args.fault), parse_noise(args.noise)
        terrain = None if args.stairs is None else Terrain(("stairs",), (args.stairs,) * 9)
        if args.video:
            writable_folder(args.video.parent, "--video")
            options = {"speed": args.speed, "seed": args.seed, "terrain": terrain, "noise": noise}
            frames = render.film(policy, args.robot, fault, args.seconds, 2, **options)
            render.write_gif(frames, args.video, 2 * CONTROL_DT)
            print(f"written: {args.video}")
            return
        kind = args.viewer or ("desktop" if has_display() else "browser")
        if kind == "desktop" and not has_display():
            fail("no window can be opened: set DISPLAY to a screen that is there, or use --viewer browser")
        show = Show(policy, args.robot, fault, args.speed, args.seed, terrain, noise)
        print(HELP)
        listen(show)
        desktop(show) if kind == "desktop" else browser(show, args.port)
    except KeyboardInterrupt:
        pass
    except (CheckpointError, ValueError, RuntimeError, ImportError, OSError, FloatingPointError) as error:
        fail(error)


if __name__ == "__main__":
    main()
