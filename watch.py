"""A trained policy to look at while it walks, and to disturb on the way; and films.

    python evaluate.py watch --fault lock:FR_calf --speed 0.5
    python evaluate.py watch --stairs 0 --noise offset:0.2    # steps of 5 cm, scandots that lie
    python evaluate.py watch --fault tow:RR --film tow.gif    # no viewer, a moving picture

Where there is a display, a window opens, with a panel for speed and faults. --public makes it a
page for the browser, which MuJoCo serves to all who can reach the port, with all that the panel
does. The terminal takes words, too. A robot that falls starts over.
"""

import copy
import os
import queue
import sys
import threading
import time
from pathlib import Path

import mujoco
import numpy as np
import torch
from PIL import Image

from env import CONTROL_DT, LocomotionEnv
from faults import REAL_WORLD, TASKS, faulty_model, first_task, harms_of, props
from ppo import to_tensors
from rolt import ROLT
from terrain import Terrain
from walk import show_progress, straight_ahead

HELP = "type a fault (lock:RL_calf, healthy), a speed (0.5), noise (sigma:0.1), again or quit"


def painted(env: LocomotionEnv, fault: str) -> mujoco.MjModel:
    """A copy of the env's model, what is harmed in red."""
    model = copy.copy(env.model)
    parts = [harm.part for harm in harms_of(fault)]  # a joint's link has its name
    for body in map(model.body, range(model.nbody)):
        if any(body.name == part or body.name.startswith(f"{part}_") for part in parts):
            model.geom_rgba[model.geom_bodyid == body.id] = [0.85, 0.2, 0.15, 1]
    return model


class Show:
    """One robot that walks straight on for ever. `model` and `data`, which a viewer shows, are new
    objects after some changes. `said` is the answer to the last word."""

    def __init__(self, policy, robot: str, fault: str, speed: float, seed: int, terrain, noise):
        self.policy, self.robot, self.speed = policy, robot, speed
        self.seed, self.terrain = seed, terrain
        self.words, self.said, self.over, self.fell = queue.Queue(), HELP, False, False
        self.terms, self.attention = {}, {}  # of the last step: rewards, and where legs look
        self.start(fault, noise)

    def start(self, fault: str, noise: str) -> None:
        """A new episode in a new env. ValueError if it cannot be; all stays as it is then."""
        config = straight_ahead(self.policy, self.speed, 3600)
        options = (config, self.policy.extras, self.terrain, noise)
        env = LocomotionEnv(self.robot, 1, self.seed, 1, [(1.0, fault)], *options)
        env.pin_faults([fault])
        observation = env.reset()
        self.env, self.observation, self.fault, self.noise = env, observation, fault, noise
        self.repaint()
        self.data = mujoco.MjData(self.model)

    def repaint(self) -> None:
        self.shown = self.env.fault_now[0]
        self.model = painted(self.env, self.shown)

    def set_fault(self, fault: str) -> None:
        """Without a reset, unless a box or wheels come or go. ValueError: there is no such part."""
        if props([fault]) != props([self.fault]):
            return self.start(fault, self.noise)
        faulty_model(fault, self.env.robot, self.env.model)  # is it one?
        self.env.pin_faults([fault])  # at the next resets, too
        self.env.age[:] = self.env.first_age[:] = 0  # its times count from now on
        self.env.strike([0])
        self.fault = fault
        self.repaint()

    def hear(self, word: str) -> None:
        """A word of those in HELP. What it cannot read changes nothing, and `said` tells why."""
        try:
            if word == "quit":
                self.over = True
            elif word == "again":
                self.start(self.fault, self.noise)
            elif word.replace(".", "", 1).isdecimal():
                self.speed = min(3.0, float(word))  # m/s, ours: three times what training commands
            elif word.startswith(("clean", "offset", "sigma", "missing")):
                self.start(self.fault, word)
            elif word:
                self.set_fault(word)
            self.said = f"{self.fault}, {self.speed:g} m/s, {self.noise}"
        except ValueError as error:
            self.said = str(error)
        print(self.said, flush=True)

    @torch.no_grad()
    def step(self) -> None:
        """Words, and one control step of 20 ms."""
        while not self.words.empty():
            self.hear(self.words.get().strip())
        self.env.command[:, 0] = self.speed
        seen = to_tensors(self.observation, "cpu")
        self.observation, _, fallen, _, info = self.env.step(self.policy(seen).numpy())
        self.terms = {name: x[0] for name, x in info["rewards"].items()}
        if isinstance(self.policy, ROLT):
            weights = self.policy.attention(seen)[0].mean(0)  # over heads: (L, T)
            parts = weights.split([len(weights), *self.policy.others.values()], dim=1)
            shares = [part.sum(1).tolist() for part in parts]
            self.attention = dict(zip(("legs", *self.policy.others), shares))
        self.fell = fallen[0]
        if self.fell:
            print("it fell", flush=True)
        if self.env.fault_now[0] != self.shown:
            self.repaint()
        self.data.qpos[:] = self.env.world.bind("qpos")[0]
        self.data.time += CONTROL_DT


def film(show: Show, out: Path, seconds: float) -> None:
    """From 2 s on, every second step up to the first fall."""
    model = show.model
    try:
        if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:  # without asking a display
            from mujoco import egl

            mujoco.rendering.classic.gl_context.GLContext = egl.GLContext
        renderer = mujoco.Renderer(model, height=300, width=480)
    except Exception as error:  # each backend fails in its own way
        way_out = "install libegl1, or try MUJOCO_GL=glfw (a display) or osmesa (libosmesa6)"
        raise OSError(f"cannot draw ({error}): {way_out}") from error

    camera, frames = mujoco.MjvCamera(), []
    camera.distance = 1.3 * max(1.0, show.env.robot.trunk_box[0] / 0.38)  # m, the whole robot
    camera.elevation = -18
    camera.azimuth = 60 if show.terrain else 125  # from behind, stairs show their steps
    began, steps = time.monotonic(), round((2 + seconds) / CONTROL_DT)
    for step in range(steps):
        show.step()
        show_progress("film", step + 1, steps, began)
        if show.fell:
            break
        if step * CONTROL_DT >= 2 and step % 2 == 0:
            model.geom_rgba[:] = show.model.geom_rgba  # a fault may have come or gone
            mujoco.mj_fwdPosition(model, show.data)
            camera.lookat[:] = show.data.qpos[:3] - [0, 0, 0.08]  # on flat ground 0.2 m up
            renderer.update_scene(show.data, camera)
            frames.append(Image.fromarray(renderer.render()))
    if not frames:
        raise ValueError(f"with {show.fault} the robot falls within 2 s: nothing to show")
    # one palette for all frames keeps the file small and the colours still, a fault's red too
    some = Image.fromarray(np.vstack([np.array(frame) for frame in frames[::10]]))
    palette = some.quantize(64, Image.Quantize.FASTOCTREE)
    first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    pace = {"duration": round(2000 * CONTROL_DT), "loop": 0}  # ms a frame
    first.save(out, save_all=True, append_images=rest, optimize=True, **pace)
    print(f"written: {out}")


def listen(show: Show) -> None:
    """Words from the terminal."""
    for line in sys.stdin:
        show.words.put(line)


def view(show: Show, public: bool, port: int) -> None:
    """MuJoCo's viewer, a window or a web page, with a panel of our own; until it is closed."""
    from mujoco.studio import launch_passive, messages, plugin, viewer_protocol
    from mujoco.studio.dear_imgui import dear_imgui as imgui

    task = TASKS[first_task(show.robot)]
    others = REAL_WORLD.values() if "go1" in task.robots else ()
    menu = list(dict.fromkeys([*task.seen, *task.unseen, *others]))

    class Panel(plugin.ViewerPlugin):
        """Runs in the viewer's thread, so it only reads the show and puts words in its queue."""

        text, size = show.fault, imgui.Vec2(-1, 0)  # as wide as the panel

        @messages.handler
        def aim(self, _: messages.PostModelEvent) -> None:
            camera = self.viewer.camera
            camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1  # the trunk
            camera.distance, camera.azimuth, camera.elevation = 1.8, 125, -18

        @messages.handler
        def draw(self, _: messages.BuildGuiEvent) -> None:
            imgui.SetNextWindowPos(imgui.Vec2(20, 20), imgui.Cond.FirstUseEver)
            imgui.SetNextWindowSize(imgui.Vec2(380, 200), imgui.Cond.FirstUseEver)
            if imgui.Begin("Walk")[0]:
                imgui.TextWrapped(show.said)
                moved, speed = imgui.SliderFloat("m/s", show.speed, 0.0, 1.0, "%.2f")
                if moved:
                    show.words.put(f"{speed:.2f}")
                here = menu.index(show.fault) if show.fault in menu else -1
                chosen, index = imgui.Combo("fault", here, menu)
                if chosen:
                    show.words.put(menu[index])
                _, self.text = imgui.InputText("or write one", self.text)
                if imgui.Button("set it"):
                    show.words.put(self.text)
                imgui.SameLine()
                if imgui.Button("again"):
                    show.words.put("again")
                if imgui.CollapsingHeader("rewards a second"):
                    for name, value in show.terms.items():  # 2 is all that tracking can earn
                        imgui.ProgressBar(abs(value) / 2, self.size, f"{name} {value:+.2f}")
                if show.attention and imgui.CollapsingHeader("attention"):
                    for part, shares in show.attention.items():
                        for leg, share in zip(show.env.robot.legs, shares):
                            imgui.ProgressBar(share, self.size, f"{leg} on {part} {share:.0%}")
            imgui.End()

    gfx = "web" if public else ""
    config = viewer_protocol.ViewerConfig(title=f"ROLT: {show.robot}", gfx=gfx, http_port=port)
    with launch_passive.launch(config, plugins=[Panel()]) as handle:
        while handle.is_running() and not show.over:
            due = time.monotonic() + CONTROL_DT
            show.step()
            handle.sync(show.model, show.data)
            time.sleep(max(0.0, due - time.monotonic()))


def watch(args, policies) -> None:
    """The first of the policies, until the viewer is closed; or a film."""
    display = sys.platform != "linux" or os.getenv("DISPLAY") or os.getenv("WAYLAND_DISPLAY")
    if args.film and args.film.suffix != ".gif":
        raise ValueError(f"--film is a .gif file, not {args.film}")
    if not (display or args.film or args.public):
        page = "--public a page that all can open who reach this machine"
        raise ValueError(f"there is no display: --film walk.gif writes a film, {page}")
    torch.set_num_threads(1)
    (policy, _), *_ = policies.values()
    terrain = None if args.stairs is None else Terrain(("stairs",), (args.stairs,) * 9)
    show = Show(policy, args.robot, args.fault, args.speed, args.seed, terrain, args.noise)
    if args.film:
        return film(show, args.film, args.seconds)
    print(HELP)
    threading.Thread(target=listen, args=(show,), daemon=True).start()
    try:
        view(show, args.public, args.port)
    except (RuntimeError, ImportError) as error:
        raise OSError(f"no viewer ({error}): --film writes a film") from error
