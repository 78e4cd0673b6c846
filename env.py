"""N legged robots in `mujoco.batch.Batch`, each with a fault of its own, like a Gymnasium vector
env: observations, commands, resets, pushes, terminations of the paper's section III and legged_gym.

Legend: N robots, L legs, J joints a leg, H = 10 steps of history. Numpy, float32 out.
What a policy sees (`Observation`); the numbers are those of J = 3 joints a leg:
    symbol     shape            meaning                                                     scale
    legs       (N, L, H, 21)    s^l of eq. 1: what each leg saw in the past 10 steps, oldest first
      0:3                       joint angle beyond the default pose, hip thigh calf [rad]   4
      3:6                       joint velocity [rad/s]                                      0.2
      6:9                       previous action: target angle beyond the default pose       1
      9:12                      command: velocity forward, left [m/s], yaw [rad/s]          2
      12:15                     trunk linear velocity in the trunk's frame [m/s]            2
      15:18                     trunk angular velocity in the trunk's frame [rad/s]         1
      18:21                     direction of gravity in the trunk's frame, less (0, 0, -1)  5
    action     (N, L*J)         a_{t-1} of eq. 2: the previous actions of all legs          1

All of it is in *leg frames*: what a left leg sees and does is mirrored, so that a number means the
same motion and push on every leg, and what one leg learns holds on the other side, too (NOTES 1).
Right legs see the trunk's own numbers. What only some read is empty, (N, 0), unless in `extras`:
    privileged (N, 2*L*J+1+M)   locked joints, motors' strength, friction, M other harms    1
    heights    (N, 16, 12)      s_e: trunk z - 0.3 m - ground z at the scandots, +-1 m      20
    past       (N, L, 50, 21)   as `legs`, 50 steps long                                    as above
    situation  (N, 1)           index of the robot's fault among the env's `faults`         1

What rewards and users may read after a step (attributes). Copy what you keep. Where an episode has
just ended, these are already of the next one; only the contacts are still the old one's.
    command, linear_velocity, angular_velocity, gravity (N, 3)  as above, unscaled
    joint_error, joint_velocity, torque (N, L, J)               rad, rad/s, N m, in URDF frames
    action, last_action (N, L, J)                               in leg frames
    link_contact (N, L*links with a capsule), foot_contact, touchdown (N, L) bool; air_time (N, L) s
    position (N, 3) m, yaw (N,) rad                             the trunk in the world
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from faults import HEALTHY, FaultWriter, fault_now, props
from noise import NoisyScan
from rewards import FALL, total_reward
from robots import CONTROL_DT, ROBOTS, SUBSTEPS, Robot, build_model
from rolt import HISTORY, Observation
from terrain import TILE, Terrain

mujoco.set_mju_user_warning(lambda message: None)  # counted in `_diverged`, not logged
LONG_HISTORY = 50  # steps that RMA's adaptation reads (Kumar et al. 2021)
JOINT_SCALE = np.array([[4.0], [0.2], [1.0]])  # angle, velocity, action; ours (NOTES 2)
TRUNK_SCALE = np.repeat((2.0, 2.0, 1.0, 5.0), 3)  # command, velocities, gravity; ours, likewise
# A mirror in the trunk's x-z plane changes the sign of a velocity's y, and of a turn's x and z.
MIRROR = np.array([1, -1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1])
MAX_ACTION = 10.0  # ours: 2.5 rad (hexapod: 1.5) off the default pose, far more than walking needs
MAX_SPEED = 1000.0  # m/s, rad/s, ours: flailing at the motors' limits reaches 100
MAX_TILT = np.cos(np.deg2rad(60))  # ours: past it none gets up again; legged_gym waits for contact
EXTRAS = ("privileged", "heights", "past", "situation")
SAVED = (
    "action", "last_action", "history", "command", "heading", "air_time", "age", "first_age",
    "command_age", "episode_return", "fault_index", "episode", "_last_contact", "row", "start",
)  # fmt: skip


@dataclass(frozen=True)
class EnvConfig:
    """What training, tests and pictures ask differently of it. Ranges are (low, high), uniform."""

    leg_frames: bool = True  # left legs are mirrored; False = the URDF's frames, our No Leg Frames
    episode_seconds: float = 20.0  # legged_gym, and the paper's tests
    command_seconds: float = 20.0  # through falls, until a reset; ours (NOTES 9; legged_gym: 10)
    forward_speed: tuple[float, float] = (0.3, 1.0)  # m/s, ours (NOTES 5; legged_gym: -1 to 1)
    lateral_speed: tuple[float, float] = (0.0, 0.0)  # m/s, ours: the tests walk forward
    heading: tuple[float, float] = (-0.5, 0.5)  # rad; ours: enough to hold a course
    friction: tuple[float, float] = (0.5, 1.25)  # legged_gym: once per robot; here at resets
    start_pose: tuple[float, float] = (0.5, 1.5)  # times the default joint angles, legged_gym
    start_speed: float = 0.5  # m/s and rad/s, the trunk's velocities within +-, legged_gym
    push_seconds: float = 15.0  # legged_gym: then the trunk's velocity is redrawn
    push_speed: float = 1.0  # m/s, x and y within +-, legged_gym; 0 = no pushes
    start_rows: int = 3  # of the terrain, on which robots begin, ours (legged_gym: 6 of 10)
    climb: bool = True  # from row to row by the curriculum; False = always start on the first rows


class LocomotionEnv:
    """N robots of one kind; robot i's episode ends, and is restarted by `step`, on its own.

    num_threads: of the simulator, 0 = one per core. Results do not depend on it.
    faults: (probability, fault) pairs; each reset draws one. Boxes and skates exist for these only.
    extras: which of `EXTRAS` the observation holds. None of them changes the simulation.
    terrain: None = flat ground. Robot i stays on column i modulo the number of columns.
    noise: on the scandots (noise.py), for tests; has a generator of its own: all else stays.
    """

    def __init__(
        self, robot: str | Robot, num_envs: int, seed: int | tuple[int, ...] = 0,
        num_threads: int = 0, faults: tuple[tuple[float, str], ...] = ((1.0, HEALTHY),),
        config: EnvConfig = EnvConfig(), extras: tuple[str, ...] = (),
        terrain: Terrain | None = None, noise: str = "clean",
    ):  # fmt: skip
        if unknown := set(extras) - set(EXTRAS):
            raise ValueError(f"unknown extras {', '.join(unknown)}; there is {', '.join(EXTRAS)}")
        self.robot = robot = ROBOTS[robot] if isinstance(robot, str) else robot
        self.num_envs, self.config, self.extras = num_envs, config, extras
        self.num_legs, self.num_joints = len(robot.legs), len(robot.links)
        self.num_actions = self.num_legs * self.num_joints
        self.episode_steps = round(config.episode_seconds / CONTROL_DT)
        self.rng = np.random.default_rng(seed)
        self.terrain, self.scan = terrain, NoisyScan(num_envs, terrain, noise, seed)

        self._fault_odds, self.faults = zip(*faults)
        self.model = model = build_model(robot, terrain, **props(self.faults))
        self.world = world = Batch(model, nsim=num_envs, nthread=num_threads, persistent=True)
        # bind: the live (N, ...) array of a field of MjData, read-only if it is no state. expand: a
        # field of MjModel, shared by all robots until now, as (N, ...), a value for each of them.
        self._qpos, self._qvel, self._ctrl = map(world.bind, ("qpos", "qvel", "ctrl"))
        self._torque, self._contacts = map(world.bind, ("actuator_force", "sensordata"))
        self._friction = world.expand("geom_friction")
        self.fault_writer = FaultWriter(robot, world, self.faults)
        self._rotation = world.bind("xmat")[:, model.body("trunk").id]
        self._geoms = model.sensor_objid  # the robot's own: 0 the trunk, then each leg's
        self._foot_sensors = feet = [model.sensor(f"contact_{leg}_foot").id for leg in robot.legs]
        self._link_sensors = [i for i in range(1, model.nsensor) if i not in feet]
        self._joints = joints = np.array([model.joint(name).id for name in robot.joints])  # (L*J,)
        self._angle_at, self._velocity_at = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._default = np.array(robot.default_pose)  # (L, J)

        # Leg frames: y > 0 is left, and mirrored: there a turn about x or z goes the other way.
        left = (np.array([y for _, y, _ in robot.mounts]) > 0) & config.leg_frames  # (L,)
        turned = np.array([link.axis[1] == 0 for link in robot.links])  # (J,)
        self._joint_sign = np.where(left[:, None] & turned, -1.0, 1.0)  # (L, J)
        self._trunk_sign = np.where(left[:, None], MIRROR, 1.0)  # (L, 12)

        self._pinned, self._luck = False, tuple(np.atleast_1d(seed))
        self.fault_index, self.episode = np.zeros((2, num_envs), dtype=int)  # in `faults`; a count
        self.fault_now = [HEALTHY] * num_envs  # without the words whose time it is not
        shape = (num_envs, self.num_legs, self.num_joints)
        memory = LONG_HISTORY if "past" in extras else HISTORY
        self.history = np.zeros((*shape[:2], memory, 3 * self.num_joints + 12), dtype=np.float32)
        self.action, self.last_action = np.zeros(shape), np.zeros(shape)
        self.air_time, self._last_contact = np.zeros(shape[:2]), np.zeros(shape[:2], dtype=bool)
        self.command, self.heading = np.zeros((num_envs, 3)), np.zeros(num_envs)
        # (N,) steps: since the reset, of which not lived (`random_ages`), since the command
        self.age, self.first_age, self.command_age = np.zeros((3, num_envs), dtype=int)
        self.episode_return = np.zeros(num_envs)
        self.row, self.start = np.zeros(num_envs, dtype=int), np.zeros((num_envs, 2))  # m
        self.column = np.arange(num_envs) % (len(terrain.columns) if terrain else 1)

    def pin_faults(self, faults: list[str]) -> None:
        """Robot i has faults[i] in every episode from its next reset on, for tests."""
        self.fault_writer.expect(faults)
        self.faults, self.fault_index, self._pinned = list(faults), np.arange(self.num_envs), True

    def reset(self, random_ages: bool = False) -> Observation:
        """Starts an episode on every robot. `random_ages`: their ends are spread (legged_gym)."""
        everyone = np.arange(self.num_envs)
        self._resample_commands(everyone)
        if self.terrain:
            rows = min(self.config.start_rows, len(self.terrain.levels))
            self.row[:] = self.rng.integers(rows, size=self.num_envs)
        self._reset(everyone)
        if random_ages:
            ages = self.rng.integers(self.episode_steps, size=self.num_envs)
            self.age[:] = self.first_age[:] = self.command_age[:] = ages
        return self.observe()

    def step(self, action: np.ndarray) -> tuple:
        """One control step of 20 ms, to joint targets default pose + action_scale * action. Actions
        are (N, L*J) or (N, L, J), in leg frames, and are clipped to +-10. Returns:
            observation: of a robot whose episode ended, its next one's. reward: (N,) float32.
            terminated: (N,) bool, fallen (trunk on the ground, tilt over 60 degrees) or diverged.
            truncated: (N,) bool, the time was up.
            info: of the state before any reset: "rewards" {term: (N,)} weighted, per second,
                "position" (N, 3) m, "speed" and "commanded_speed" forward (N,) m/s, "diverged" (N,)
                bool; of time-outs "truncated_ids" (n,) and "final_observation" (n rows) to
                bootstrap from; of all ended "episode_returns", "episode_lengths" (n,), in steps.
        """
        if action.shape not in (self._ctrl.shape, self.action.shape):
            raise ValueError(f"actions are {self._ctrl.shape}, not {action.shape}")
        action = action.astype(np.float64).reshape(self.action.shape)
        if not np.isfinite(action).all():
            raise FloatingPointError("an action is not finite: its policy has diverged")
        self.last_action, self.action = self.action, np.clip(action, -MAX_ACTION, MAX_ACTION)
        target = self._default + self.robot.action_scale * self._joint_sign * self.action  # rad
        self._ctrl[:] = target.reshape(self._ctrl.shape)
        self.strike(np.flatnonzero(self.fault_writer.timed[self.fault_index]))
        self.world.step(nstep=SUBSTEPS, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self.age += 1
        self.command_age += 1

        diverged = self._diverged()
        self._read_state()
        self._read_contacts()
        reward, terms = total_reward(self, CONTROL_DT)
        fallen = (self._contacts[:, 0] > 0) | (self.gravity[:, 2] > -MAX_TILT)  # 0: the trunk's
        reward = np.where(diverged, 0.0, reward + FALL * fallen)
        self.episode_return += reward
        terminated = fallen | diverged
        truncated = (self.age >= self.episode_steps) & ~terminated
        self.air_time *= ~self.foot_contact
        info = {"rewards": terms, "position": self.position, "diverged": diverged}
        info |= {"speed": self.linear_velocity[:, 0], "commanded_speed": self.command[:, 0].copy()}

        self._push()
        self._steer()
        self.history[:, :, :-1] = self.history[:, :, 1:]
        self.history[:, :, -1] = self._newest_step()

        ended, late = np.flatnonzero(terminated | truncated), np.flatnonzero(truncated)
        info |= {"truncated_ids": late, "final_observation": self.observe(late)}
        info["episode_returns"] = self.episode_return[ended]
        info["episode_lengths"] = (self.age - self.first_age)[ended]
        if len(ended):
            self._climb(ended[~diverged[ended]])  # a diverged one is nowhere
            self._reset(ended)
        return self.observe(), reward.astype(np.float32), terminated, truncated, info

    def observe(self, ids: np.ndarray | slice = slice(None)) -> Observation:
        """The current observation of all robots or of the n robots `ids` (a copy)."""
        history = self.history[ids]
        action = self.action[ids].reshape(len(history), self.num_actions).astype(np.float32)
        extra = {name: np.zeros((len(history), 0), dtype=np.float32) for name in EXTRAS}
        if "privileged" in self.extras:
            extra["privileged"] = self._privileged()[ids]
        if "heights" in self.extras:
            extra["heights"] = self.scan.read(ids, self.position[ids], self.yaw[ids])
        if "past" in self.extras:
            extra["past"] = history.copy()
        if "situation" in self.extras:
            extra["situation"] = self.fault_index[ids, None].astype(np.float32)
        return Observation(history[:, :, -HISTORY:].copy(), action, **extra)

    def state_dict(self) -> dict:
        """All that the next step depends on but noise on the scan. Tensors: safe for torch.load."""
        arrays = {name: getattr(self, name) for name in SAVED}
        arrays |= {"world": self.world.state, "friction": self._friction}
        writer = self.fault_writer  # where what has struck is held
        arrays |= {"held": writer.senses.held, "eq_data": writer.values["eq_data"]}
        tensors = {name: torch.tensor(array) for name, array in arrays.items()}  # copies
        return tensors | {"random": self.rng.bit_generator.state}

    def load_state_dict(self, state: dict) -> None:
        """The inverse, for an env of the same arguments and the same pinned faults."""
        for name in SAVED:
            getattr(self, name)[...] = state[name]
        self.rng.bit_generator.state = state["random"]
        self.strike(range(self.num_envs), anew=True, ago=1)  # what was so in the last step
        self.fault_writer.senses.held[...] = state["held"]
        self.fault_writer.values["eq_data"][...] = state["eq_data"]
        self._friction[...] = state["friction"]
        self.world.state[...] = state["world"]
        self.world.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        self._read_state()

    def _reset(self, ids: np.ndarray) -> None:
        """New episodes for the robots `ids`: pose, velocity, friction, fault, command."""
        config, n = self.config, len(ids)
        self.world.reset(ids, keyframe=0, stage=mujoco.mjtStage.mjSTAGE_NONE)
        if not self._pinned:
            self.fault_index[ids] = self.rng.choice(len(self.faults), size=n, p=self._fault_odds)
        pose = self._default * self.rng.uniform(*config.start_pose, size=(n, *self._default.shape))
        self._qvel[ids, :6] = self.rng.uniform(-config.start_speed, config.start_speed, size=(n, 6))
        friction = self.rng.uniform(*config.friction, size=(n, 1, 1))
        self._friction[np.ix_(ids, self._geoms, [0])] = friction
        self.episode[ids] += 1
        self.age[ids] = self.first_age[ids] = 0
        self.strike(ids, anew=True)
        locked = self.world.bind("eq_active")[ids] > 0
        limits = self.world.expand("jnt_range")[ids][:, self._joints]
        pose = np.clip(pose.reshape(n, -1), limits[:, :, 0], limits[:, :, 1])
        self._qpos[ids[:, None], self._angle_at] = np.where(locked, self._default.reshape(-1), pose)
        if self.model.nhistory:  # what late motors have been asked until now: the default pose
            samples = self.model.actuator_history[0, 0]
            memory = self.world.bind("history").reshape(self.num_envs, self.num_actions, -1)
            memory[ids, :, -samples:] = self._default.reshape(-1, 1)
        if self.terrain:
            self.start[ids] = TILE * np.stack([self.row[ids], self.column[ids]], axis=1)
            self.start[ids, 1] += self.rng.uniform(-1, 1, size=n)  # m to the side, legged_gym
            self._qpos[ids, :2] = self.start[ids]
        self.scan.draw(ids)
        self.world.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)

        self.action[ids] = self.last_action[ids] = self.air_time[ids] = self._last_contact[ids] = 0
        self.episode_return[ids] = 0
        self._read_state()
        old = self.command_age[ids] >= round(config.command_seconds / CONTROL_DT)
        self._resample_commands(ids[old])
        self._steer()
        self.history[ids] = self._newest_step()[ids, :, None]  # as though it always stood like this

    def strike(self, ids, anew: bool = False, ago: int = 0) -> None:
        """Gives the robots `ids` what is wrong at this step; anew: even if it is what they have;
        ago 1, at a resume: what was so in the last step, so that what begins now strikes."""
        for i in ids:
            luck, age = (*self._luck, i, self.episode[i]), self.age[i] - self.first_age[i]
            now = fault_now(self.faults[self.fault_index[i]], max(0, age - ago), luck)
            if anew or now != self.fault_now[i]:
                self.fault_writer.write(now, i, None if anew else self._qpos[i, self._angle_at])
                self.fault_now[i] = now

    def _climb(self, ids: np.ndarray) -> None:
        """The terrain's curriculum, at the end of an episode."""
        if self.terrain and self.config.climb:
            distance = np.linalg.norm(self.position[ids, :2] - self.start[ids], axis=1)
            commanded = np.linalg.norm(self.command[ids, :2], axis=1) * self.config.episode_seconds
            self.row[ids] = self.terrain.next_row(self.row[ids], distance, commanded, self.rng)

    def _resample_commands(self, ids: np.ndarray) -> None:
        """A forward and a lateral speed, and a heading, for each of the robots `ids`."""
        self.command[ids, 0] = self.rng.uniform(*self.config.forward_speed, size=len(ids))
        self.command[ids, 1] = self.rng.uniform(*self.config.lateral_speed, size=len(ids))
        self.heading[ids] = self.rng.uniform(*self.config.heading, size=len(ids))
        self.command_age[ids] = 0

    def _steer(self) -> None:
        """The yaw command turns the robot towards its heading (legged_gym's heading mode)."""
        error = (self.heading - self.yaw + np.pi) % (2 * np.pi) - np.pi
        self.command[:, 2] = np.clip(0.5 * error, -1.0, 1.0)

    def _push(self) -> None:
        due = self.age % round(self.config.push_seconds / CONTROL_DT) == 0
        speed = self.config.push_speed
        if speed > 0 and due.any():
            self._qvel[due, :2] = self.rng.uniform(-speed, speed, size=(int(due.sum()), 2))

    def _diverged(self) -> np.ndarray:
        """(N,) bool: MuJoCo warns (it resets most such) or it ran away. All states finite after."""
        slow = np.abs(self._qvel).max(axis=1) < MAX_SPEED  # NaN is not <
        wild = ~(slow & np.isfinite(self._qpos).all(axis=1))
        self.world.reset(np.flatnonzero(wild), keyframe=0, stage=mujoco.mjtStage.mjSTAGE_VEL)
        return wild | (self.world.warning[:, :, 1] > 0).any(axis=1)

    def _read_state(self) -> None:
        """The table's terms. qvel is linear in the world's frame and angular in the trunk's."""
        shape = self.action.shape
        rotation = self._rotation.reshape(-1, 3, 3)  # (N, 9) -> (N, 3, 3), trunk -> world
        self.position = self._qpos[:, :3].copy()
        self.yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        self.linear_velocity = np.einsum("nji,nj->ni", rotation, self._qvel[:, :3])
        self.angular_velocity = self._qvel[:, 3:6].copy()
        self.gravity = -rotation[:, 2]
        self.joint_error = self._qpos[:, self._angle_at].reshape(shape) - self._default
        self.joint_velocity = self._qvel[:, self._velocity_at].reshape(shape)
        self.torque = self._torque.reshape(shape)

    def _read_contacts(self) -> None:
        """Feet's are held for a step: one in the air for a step has not stepped (legged_gym)."""
        self.link_contact = self._contacts[:, self._link_sensors] > 0
        contact = self._contacts[:, self._foot_sensors] > 0
        self.foot_contact = contact | self._last_contact
        self._last_contact = contact
        self.touchdown = self.foot_contact & (self.air_time > 0)
        self.air_time += CONTROL_DT

    def _newest_step(self) -> np.ndarray:
        """(N, L, 21), what every leg sees now."""
        seen = self.joint_error, self.joint_velocity, self.linear_velocity, self.angular_velocity
        sensed = self.fault_writer.senses.read(*seen, self.gravity)
        angle, velocity, linear, angular, gravity = sensed
        joints = self._joint_sign * angle, self._joint_sign * velocity, self.action
        joints = JOINT_SCALE * np.stack(joints, axis=2)  # (N, L, 3, J)
        trunk = np.concatenate([self.command, linear, angular, gravity - (0, 0, -1)], axis=1)
        trunk = TRUNK_SCALE * trunk  # (N, 12)
        parts = joints.reshape(*self.action.shape[:2], -1), trunk[:, None] * self._trunk_sign
        return np.concatenate(parts, axis=2, dtype=np.float32)

    def _privileged(self) -> np.ndarray:
        """(N, 2*L*J + 1 + M), what no robot can measure."""
        locked = self.world.bind("eq_active")
        motors = self.world.expand("actuator_forcerange") / self.model.actuator_forcerange
        friction = self._friction[:, self._geoms[:1], 0]
        parts = locked, motors[:, :, 1], friction, self.fault_writer.told
        return np.concatenate(parts, axis=1, dtype=np.float32)
