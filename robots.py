"""Robots as data, and the one function that turns a robot into a MuJoCo model.

A robot is a trunk and L equal legs of J joints; nothing below knows more than that. A new robot is
a new `Robot(...)` at the end of this file and an entry in `ROBOTS`. Only the front right leg is
written down: left legs are its mirror image in y, rear legs in x where `Link.rear_mirrors_x` says
so.

What a fault (faults.py) will change on one robot is prepared here, so that a fault is only numbers:
    joint lock      an inactive equality constraint a joint        -> eq_active
    motor strength  a position actuator a joint                    -> actuator_gainprm, _biasprm, _forcerange
    friction        the robot's geoms decide it (priority 1)       -> geom_friction
    half-lock       a joint's stops                                -> jnt_range
    box to tow      a box on a tether, slack without end           -> tendon_range       only built when asked for
    skate           a foot that is a wheel, its brake on           -> dof_frictionloss   only built when asked for

Legend: L legs, J joints a leg. Legs are ordered FR, FL, RR, RL (front/rear, right/left), joints
hip, thigh, calf.

    python robots.py            # prints every robot: masses, limits, gains
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from terrain import Terrain

PHYSICS_DT = 0.005  # s, legged_gym: 200 Hz physics, 4 substeps a control step of 50 Hz

# The props of the real-world test. The paper gives no numbers: all ours.
BOX_MASS = 4.0  # kg, a third of a Go1
BOX_FRICTION = 0.5  # cardboard on a floor: 20 N to drag it, a sixth of a Go1's weight, on one leg
BOX_SIZE = (0.3, 0.3, 0.2)  # m
BOX_START = (-0.95, 0.0, 0.1)  # m, behind the robot
TETHER = 0.8  # m, of the hindmost legs: slack at first
SLACK = 1000.0  # m, the length of a tether that nobody has tied
WHEEL_MASS = 0.1  # kg
BRAKE = 10.0  # N m, dry friction of a wheel that does not roll; on a foot of 0.02 m four times a robot's weight

Vec3 = tuple[float, float, float]
Inertia = tuple[float, float, float, float, float, float]  # Ixx, Iyy, Izz, Ixy, Ixz, Iyz


@dataclass(frozen=True)
class Link:
    """One link of the front right leg and the joint that carries it."""

    name: str
    mass: float  # kg
    com: Vec3  # m, centre of mass in the link's frame
    inertia: Inertia  # kg m^2 about the centre of mass, link axes
    offset: Vec3  # m, joint origin in the parent link's frame (the first link's are `Robot.mounts`)
    axis: Vec3  # joint axis, of left legs too: the mirror image of a turn about x or z is then a turn the other way
    limits: tuple[float, float]  # rad, right legs
    effort: float  # N m, torque limit
    capsule: tuple[float, Vec3, Vec3] | None  # collision shape: radius, start, end (m, link frame)
    rear_mirrors_x: bool = False  # rear legs mirror this link in x as well

    def __post_init__(self):
        if sorted(map(abs, self.axis)) != [0, 0, 1]:
            raise ValueError(f"the {self.name} turns about {self.axis}; only axes along x, y or z can be mirrored to the left")
        if self.rear_mirrors_x and not self.axis[0] and self.limits[0] != -self.limits[1]:
            raise ValueError(f"the stops of the {self.name} would have to be mirrored for rear legs, too, which is not built")

    def stops(self, left: bool) -> tuple[float, float]:
        """rad, on a left or a right leg."""
        low, high = self.limits
        return (-high, -low) if left and not self.axis[1] else (low, high)


@dataclass(frozen=True)
class Robot:
    """A trunk with L legs of J joints. Per-leg tables follow the order of `legs`."""

    name: str
    trunk_mass: float  # kg
    trunk_com: Vec3  # m
    trunk_inertia: Inertia  # kg m^2
    trunk_box: Vec3  # m, full size of the collision box
    legs: tuple[str, ...]
    mounts: tuple[Vec3, ...]  # (L, 3) m, first joint of each leg in the trunk frame; y < 0 right, x < 0 rear
    links: tuple[Link, ...]  # J links, from the trunk outwards
    foot_position: Vec3  # m, centre of the foot sphere in the last link's frame
    foot_radius: float  # m
    default_pose: tuple[tuple[float, ...], ...]  # (L, J) rad, the pose of a zero action
    start_height: float  # m, trunk above ground at reset
    stiffness: float  # N m/rad, kp of the joint controller
    damping: float  # N m s/rad, kd
    action_scale: float  # rad of joint target per unit of action
    armature: float  # kg m^2, reflected rotor inertia
    friction_loss: float  # N m, dry friction of a joint

    def __post_init__(self):
        links = [link.name for link in self.links]
        if not len(set(self.legs)) == len(self.legs) == len(self.mounts) == len(self.default_pose):
            raise ValueError(f"{self.name}: every leg has a name of its own, a mount and a default pose")
        for leg, mount, pose in zip(self.legs, self.mounts, self.default_pose):
            if not len(set(links)) == len(links) == len(pose):
                raise ValueError(f"{self.name}: every link has a name of its own, and an angle in the pose of {leg}")
            for link, angle in zip(self.links, pose):
                low, high = link.stops(left=mount[1] > 0)
                if not low < angle < high:
                    raise ValueError(f"{self.name}: {leg}_{link.name} at {angle} rad is beyond its stops, {low} and {high}")

    @property
    def joints(self) -> list[str]:
        """The L*J joint names, leg by leg: FR_hip, FR_thigh, FR_calf, FL_hip, ..."""
        return [f"{leg}_{link.name}" for leg in self.legs for link in self.links]


def build_model(
    robot: Robot, terrain: Terrain | None = None, towing: tuple[str, ...] = (), skating: tuple[str, ...] = ()
) -> mujoco.MjModel:
    """The robot on flat ground or on a terrain. Bodies and actuators in the order of
    `robot.joints`; keyframe 0 is the default pose.

    Contacts are robot-ground only. Sensors `contact_<geom>` count the contacts of the trunk, of
    each link with a capsule, and of each foot.

    towing: legs whose foot gets a tether to one box. skating: legs whose foot becomes a wheel. Both
    add bodies and joints (find a robot's own by name), and change nothing until faults.py ties the
    tether or lets go the brake.
    """
    if unknown := {*towing, *skating} - set(robot.legs):
        raise ValueError(f"the {robot.name} has no leg {', '.join(sorted(unknown))}; it has {', '.join(robot.legs)}")
    if terrain is not None and towing:
        raise ValueError("the box wants flat ground: no terrain for robots that tow")
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.compiler.degree = False
    spec.option.timestep = PHYSICS_DT
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # takes the damping kd implicitly
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.iterations = 10  # Newton converges in 2 or 3; the bound keeps one odd robot from stalling the rest
    spec.option.ls_iterations = 20

    _add_world(spec)
    if terrain is not None:
        terrain.build(spec)
    trunk = spec.worldbody.add_body(name="trunk", pos=[0, 0, robot.start_height])
    trunk.add_freejoint(name="root")
    trunk.add_light(
        type=mujoco.mjtLightType.mjLIGHT_SPOT, mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK, pos=[-0.6, -0.8, 2.5],
        dir=[0.24, 0.32, -1], cutoff=60, exponent=1, diffuse=[0.6, 0.6, 0.6],
    )  # fmt: skip
    _set_inertia(trunk, robot.trunk_mass, robot.trunk_com, robot.trunk_inertia)
    _add_geom(spec, trunk, "trunk", mujoco.mjtGeom.mjGEOM_BOX, np.array(robot.trunk_box) / 2)

    angles = []  # of all joints after the root, in the order of qpos
    for leg, mount, pose in zip(robot.legs, robot.mounts, robot.default_pose):
        parent = trunk
        angles += pose
        for i, (link, angle) in enumerate(zip(robot.links, pose)):
            left, rear = mount[1] > 0, mount[0] < 0
            mirror = np.array([-1 if rear and link.rear_mirrors_x else 1, -1 if left else 1, 1])
            name = f"{leg}_{link.name}"
            body = parent.add_body(name=name, pos=mount if i == 0 else mirror * link.offset)
            _set_inertia(body, link.mass, mirror * link.com, _mirror_inertia(link.inertia, mirror))
            body.add_joint(
                name=name, axis=link.axis, range=link.stops(left), ref=0.0,
                armature=robot.armature, frictionloss=robot.friction_loss,
            )  # fmt: skip
            if link.capsule is not None:
                radius, start, end = link.capsule
                fromto = np.concatenate([mirror * start, mirror * end])
                _add_geom(spec, body, name, mujoco.mjtGeom.mjGEOM_CAPSULE, [radius, 0, 0], fromto=fromto)

            motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_position(kp=robot.stiffness, kv=robot.damping)
            motor.forcerange = [-link.effort, link.effort]
            lock = spec.add_equality(
                name=name, type=mujoco.mjtEq.mjEQ_JOINT, name1=name, objtype=mujoco.mjtObj.mjOBJ_JOINT, active=False
            )
            lock.data[0] = angle  # the joint angle that the lock holds
            lock.solref = [2 * PHYSICS_DT, 1]  # as stiff as the time step allows: within 0.01 rad under load
            lock.solimp = [0.99, 0.9999, 0.001, 0.5, 2]
            parent = body
        foot = mirror * robot.foot_position
        if leg in towing:
            body.add_site(name=f"{leg}_ankle", pos=foot)
        if leg in skating:
            body, foot = _add_wheel(body, leg, foot, robot.foot_radius), np.zeros(3)
            angles.append(0.0)
        _add_geom(spec, body, f"{leg}_foot", mujoco.mjtGeom.mjGEOM_SPHERE, [robot.foot_radius, 0, 0], pos=foot)

    spec.add_key(
        name="default",
        qpos=[0, 0, robot.start_height, 1, 0, 0, 0, *angles, *(_add_box(spec, towing) if towing else ())],
        ctrl=np.ravel(robot.default_pose),
    )
    return spec.compile()


def tether_length(robot: Robot, leg: str) -> float:
    """m; a leg further forward has a tether that is longer by as much, or it would be taut before
    the robot walks."""
    forward = [mount[0] for mount in robot.mounts]
    return TETHER + forward[robot.legs.index(leg)] - min(forward)


def _add_world(spec: mujoco.MjSpec) -> None:
    """Ground, and light, sky and colours for pictures."""
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 720
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4, 0.4, 0.4], [0.2, 0.2, 0.2]
    sky = {"type": texture.mjTEXTURE_SKYBOX, "builtin": builtin.mjBUILTIN_GRADIENT, "rgb1": [1, 1, 1], "rgb2": [0.7, 0.8, 0.9]}
    spec.add_texture(name="sky", width=128, height=128 * 6, **sky)
    checker = {"type": texture.mjTEXTURE_2D, "builtin": builtin.mjBUILTIN_CHECKER}
    checker |= {"rgb1": [0.88, 0.89, 0.91], "rgb2": [0.78, 0.81, 0.84]}
    spec.add_texture(name="checker", width=256, height=256, **checker)
    material = spec.add_material(name="ground", texrepeat=[2, 2], texuniform=True)  # squares of 0.25 m
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checker"
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], material="ground", contype=1, conaffinity=0
    )


def _add_geom(spec: mujoco.MjSpec, body, name: str, kind, size, **where) -> None:
    """A geom that touches the ground alone and decides the friction there, with a sensor that
    counts its contacts."""
    foot = kind == mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_geom(
        name=name, type=kind, size=size, contype=0, conaffinity=1, condim=3, priority=1, friction=[1, 0.005, 0.0001],
        rgba=[0.15, 0.15, 0.17, 1] if foot else [0.35, 0.45, 0.60, 1], **where,
    )  # fmt: skip
    spec.add_sensor(
        name=f"contact_{name}", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_GEOM, objname=name,
        intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value, 0, 1],  # fields, reduction, slots
    )  # fmt: skip


def _add_wheel(body, leg: str, foot, radius: float):
    """A wheel in the foot's place, its axle across the leg: it rolls the way the foot points and
    grips sideways.

    Not two numbers of friction instead: MuJoCo's belong to the contact's frame, which does not turn
    with the foot.
    Not a foot without friction: a skate that could slip sideways would be ice.
    """
    wheel, moment = body.add_body(name=f"{leg}_wheel", pos=foot), 0.4 * WHEEL_MASS * radius**2  # a solid ball
    _set_inertia(wheel, WHEEL_MASS, (0, 0, 0), (moment, moment, moment, 0, 0, 0))
    wheel.add_joint(
        name=f"{leg}_wheel", axis=(0, 1, 0), frictionloss=BRAKE,
        armature=1e-4,  # a rim as heavy as 0.25 kg: a lighter wheel runs away when a robot flails
        solref_friction=[2 * PHYSICS_DT, 1], solimp_friction=[0.9999, 0.9999, 0.001, 0.5, 2],  # or else the brake creeps
    )  # fmt: skip
    return wheel


def _add_box(spec: mujoco.MjSpec, legs: tuple[str, ...]) -> tuple[float, ...]:
    """A box on the ground and a tether to it from the foot of each of the legs. Returns its 7
    numbers of qpos.

    A tether is a limit on a distance: it pulls when that is reached and is nothing before. The box
    touches the ground alone, as all geoms do.
    """
    box = spec.worldbody.add_body(name="box", pos=BOX_START)
    box.add_freejoint(name="box")
    box.add_geom(
        name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=np.array(BOX_SIZE) / 2, mass=BOX_MASS, contype=0, conaffinity=1,
        condim=3, priority=1, friction=[BOX_FRICTION, 0.005, 0.0001], rgba=[0.76, 0.60, 0.42, 1],
    )  # fmt: skip
    box.add_site(name="box_front", pos=[BOX_SIZE[0] / 2, 0, 0])
    for leg in legs:
        tether = spec.add_tendon(name=f"{leg}_tether", limited=True, range=[-1, SLACK], width=0.004, rgba=[0.2, 0.2, 0.2, 1])
        tether.wrap_site(f"{leg}_ankle")
        tether.wrap_site("box_front")
    return (*BOX_START, 1, 0, 0, 0)


def _set_inertia(body, mass: float, com, inertia) -> None:
    body.mass, body.ipos, body.fullinertia, body.explicitinertial = mass, com, inertia, True


def _mirror_inertia(inertia: Inertia, mirror: np.ndarray) -> np.ndarray:
    """Products of inertia change sign with the axes they join; moments do not."""
    x, y, z = mirror
    return np.array(inertia) * [1, 1, 1, x * y, x * z, y * z]


# Unitree A1, 12.45 kg. Source: mujoco_menagerie unitree_a1/a1.xml (masses, inertias, limits,
# armature, friction), Unitree's a1.urdf (trunk box), legged_gym a1_config.py (pose, gains, action
# scale, start height). Thigh and calf boxes are capsules here: as exact on steps and quicker. The
# hips, inside the trunk's outline, do not collide.
_A1_THIGH_Y = -0.08505

A1 = Robot(
    name="a1",
    trunk_mass=4.713,
    trunk_com=(0, 0.0041, -0.0005),
    trunk_inertia=(0.0158533, 0.0377999, 0.0456542, -3.66e-5, -6.11e-5, -2.75e-5),
    trunk_box=(0.267, 0.194, 0.114),
    legs=("FR", "FL", "RR", "RL"),
    mounts=((0.183, -0.047, 0), (0.183, 0.047, 0), (-0.183, -0.047, 0), (-0.183, 0.047, 0)),
    links=(
        Link("hip", 0.696, (-0.003311, -0.000635, 3.1e-5),
             (0.000469246, 0.00080749, 0.000552929, 9.4e-6, -3.4e-7, 4.7e-7),
             offset=(0, 0, 0), axis=(1, 0, 0), limits=(-0.802851, 0.802851), effort=33.5,
             capsule=None, rear_mirrors_x=True),
        Link("thigh", 1.013, (-0.003237, 0.022327, -0.027326),
             (0.00552906, 0.00513934, 0.00136779, -4.8e-6, 3.44e-4, -2.24e-5),
             offset=(0, _A1_THIGH_Y, 0), axis=(0, 1, 0), limits=(-1.0472, 4.18879), effort=33.5,
             capsule=(0.015, (0, 0, -0.01), (0, 0, -0.185))),
        Link("calf", 0.226, (0.00472659, 0, -0.131975),
             (0.00338556, 0.00340344, 4.385e-5, 0, -1.67e-4, 0),
             offset=(0, 0, -0.2), axis=(0, 1, 0), limits=(-2.69653, -0.916298), effort=33.5,
             capsule=(0.01, (0, 0, 0), (0, 0, -0.18))),
    ),
    foot_position=(0, 0, -0.2),
    foot_radius=0.02,
    default_pose=((-0.1, 0.8, -1.5), (0.1, 0.8, -1.5), (-0.1, 1.0, -1.5), (0.1, 1.0, -1.5)),
    start_height=0.42,
    stiffness=20.0,
    damping=0.5,
    action_scale=0.25,
    armature=0.01,
    friction_loss=0.2,
)  # fmt: skip

# Unitree Go1, 12.74 kg. Source: mujoco_menagerie unitree_go1/go1.xml (masses, inertias, limits,
# armature, friction), Unitree's go1.urdf (trunk box), legged_gym's a1_config.py (pose, gains,
# action scale: the same machine in other clothes).
GO1 = Robot(
    name="go1",
    trunk_mass=5.204,
    trunk_com=(0.0223, 0.002, -0.0005),
    trunk_inertia=(0.0168128, 0.0630095, 0.0716547, -2.3e-4, -2.95e-4, -4.2e-5),
    trunk_box=(0.3762, 0.0935, 0.114),
    legs=("FR", "FL", "RR", "RL"),
    mounts=((0.1881, -0.04675, 0), (0.1881, 0.04675, 0), (-0.1881, -0.04675, 0), (-0.1881, 0.04675, 0)),
    links=(
        Link("hip", 0.68, (-0.0049166, 0.00762615, -8.865e-5),
             (0.00039938, 0.00073342, 0.00046842, 1.5e-5, 1e-6, -2e-6),
             offset=(0, 0, 0), axis=(1, 0, 0), limits=(-0.863, 0.863), effort=23.7,
             capsule=None, rear_mirrors_x=True),
        Link("thigh", 1.009, (-0.00304722, 0.019315, -0.0305004),
             (0.0045988, 0.0046892, 0.00081745, -6.1e-5, -2.28e-4, -6.11e-4),
             offset=(0, -0.08, 0), axis=(0, 1, 0), limits=(-0.686, 4.501), effort=23.7,
             capsule=(0.015, (0, 0, -0.01), (0, 0, -0.198))),
        Link("calf", 0.195862, (0.00429862, 0.000976676, -0.146197),
             (0.00148449, 0.00149764, 3.607e-5, 0, -1.8e-5, -4e-6),
             offset=(0, 0, -0.213), axis=(0, 1, 0), limits=(-2.818, -0.888), effort=35.55,
             capsule=(0.01, (0, 0, 0), (0, 0, -0.19))),
    ),
    foot_position=(0, 0, -0.213),
    foot_radius=0.023,
    default_pose=((-0.1, 0.8, -1.5), (0.1, 0.8, -1.5), (-0.1, 1.0, -1.5), (0.1, 1.0, -1.5)),
    start_height=0.45,  # ours: legs may start stretched, and must not start in the ground
    stiffness=20.0,
    damping=0.5,
    action_scale=0.25,
    armature=0.01,
    friction_loss=0.2,
)  # fmt: skip

# ElSpider Air, 30.5 kg: the hexapod of the authors' laboratory (the paper names none). Source:
# extended_legged_gym el_mini.urdf (masses, inertias, geometry, limits) and elspider_air.h (pose,
# gains). The hips turn about the vertical, the thighs point up and the calves down. The foot (0.019
# kg) is part of the calf. Links are capsules as thick as their boxes. Ours, where the sources are
# silent: armature and dry friction (the A1's), the start height. And the signs on the left, where
# the URDF mirrors the axes, too: with its signs all six legs stand at the same angles, and ROLT,
# which has no other way to tell left from right at first, learned to walk within a million steps
# but not to hold a course in 1.76. The action scale is ours, too (the source: 0.2 to 0.5): the
# noise of exploration shakes this heavy robot with its stiff joints about the vertical, by 0.6
# rad/s at 0.25, which hides what steering earns; 0.4 at 0.15. (Both were changed at once.)
HEXAPOD = Robot(
    name="hexapod",
    trunk_mass=15.8991,
    trunk_com=(0, 0, 0.02429),
    trunk_inertia=(0.0926086, 0.47054913, 0.53896766, 0, 0, 0),
    trunk_box=(0.6, 0.28, 0.14),
    legs=("FR", "FL", "MR", "ML", "HR", "HL"),
    mounts=((0.3, -0.08, 0.011), (0.3, 0.08, 0.011), (0, -0.14, 0.011), (0, 0.14, 0.011),
            (-0.3, -0.08, 0.011), (-0.3, 0.08, 0.011)),
    links=(
        Link("hip", 1.20924, (-0.01147, -0.12306, -0.03644),
             (0.00506, 0.00134, 0.00448, -3.8e-4, -1.2e-4, -1.02e-3),
             offset=(0, 0, 0), axis=(0, 0, 1), limits=(-0.785, 0.785), effort=33.5,
             capsule=(0.04, (0.02, -0.06, -0.03), (0.0355, -0.14, -0.04)), rear_mirrors_x=True),
        Link("thigh", 0.925235, (-0.01977, 0.00006, 0.11425),
             (0.00238, 0.00209, 0.00066, 0, 1.2e-4, 0),
             offset=(0.0355, -0.14999, -0.04506), axis=(1, 0, 0), limits=(-0.5233, 3.14), effort=33.5,
             capsule=(0.04, (0, 0, 0), (0, 0, 0.13)), rear_mirrors_x=True),
        Link("calf", 0.3004999, (0.009795, 0, -0.080474),
             (0.003056, 0.0030374, 9.137e-5, 0, 1.952e-4, 0),
             offset=(0, 0, 0.13), axis=(-1, 0, 0), limits=(-0.6978, 3.925), effort=33.5,
             capsule=(0.015, (0, 0, 0), (0.0166, 0, -0.213)), rear_mirrors_x=True),
    ),
    foot_position=(0.018, 0, -0.232),
    foot_radius=0.02,
    default_pose=((0, 0.6, 0.6), (0, -0.6, -0.6)) * 3,
    start_height=0.22,
    stiffness=80.0,
    damping=2.0,
    action_scale=0.15,
    armature=0.01,
    friction_loss=0.2,
)  # fmt: skip

ROBOTS = {"a1": A1, "go1": GO1, "hexapod": HEXAPOD}


if __name__ == "__main__":
    for robot in ROBOTS.values():
        model = build_model(robot)
        print(f"{robot.name}: {model.body_mass.sum():.3f} kg, {len(robot.legs)} legs of {len(robot.links)} joints")
        print(f"  legs {', '.join(robot.legs)}; kp {robot.stiffness} N m/rad, kd {robot.damping} N m s/rad")
        for link in robot.links:
            low, high = link.limits
            print(f"  {link.name:6s} {link.mass:.3f} kg, {low:+.2f} to {high:+.2f} rad, {link.effort} N m")
