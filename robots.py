"""Robots as data, and the one function that turns a robot into a MuJoCo model.

A robot is a trunk and L equal legs of J joints, of which the front right one is written down: left
legs are its mirror image in y, rear legs in x where `Link.rear_mirrors_x` says so. Legs are called
FR, FL, RR, RL (front or rear; the hexapod's front, middle, hind), their joints hip, thigh, calf.

What a fault (faults.py) changes on one robot is prepared here:

    joint lock      an inactive equality constraint          eq_active
    motor strength  the gains of its position actuator       actuator_gainprm, _biasprm, _forcerange
    half-lock       a joint's stops                          jnt_range
    box to tow      a box on a tether, slack without end     tendon_range      only if asked for
    skate           a foot that is a wheel, its brake on     dof_frictionloss  only if asked for
    late motor      a memory of past targets                 actuator_delay    only if asked for
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

PHYSICS_DT = 0.005  # s, legged_gym: 200 Hz physics
SUBSTEPS = 4  # legged_gym: 50 Hz control
CONTROL_DT = SUBSTEPS * PHYSICS_DT  # s
MAX_DELAY = 0.04  # s, of a motor that answers late, ours
# implicitfast takes kd implicitly. Newton needs 2 or 3 iterations; bounded, none stalls others.
WORLD = f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{PHYSICS_DT}" integrator="implicitfast" iterations="10" ls_iterations="20"/>
  <visual>
    <global offwidth="1280" offheight="720"/>
    <headlight ambient="0.4 0.4 0.4" diffuse="0.2 0.2 0.2"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="1 1 1" rgb2="0.7 0.8 0.9" width="128"/>
    <texture name="checker" type="2d" builtin="checker" rgb1="0.88 0.89 0.91" rgb2="0.78 0.81 0.84"
             width="256" height="256"/>
    <material name="ground" texture="checker" texrepeat="2 2" texuniform="true"/>
  </asset>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 0.05" material="ground" conaffinity="0"/>
  </worldbody>
</mujoco>
"""

# The props of the real-world test. The paper gives no numbers: all ours.
BOX_MASS = 4.0  # kg, a third of a Go1
BOX_FRICTION = 0.5  # cardboard on a floor: 20 N to drag it, a sixth of a Go1's weight, on one leg
BOX_SIZE = (0.3, 0.3, 0.2)  # m
BOX_START = (-0.95, 0.0, 0.1)  # m, behind the robot
TETHER = 0.8  # m, of the hindmost legs; further forward, longer by as much: all slack at first
SLACK = 1000.0  # m, the length of a tether that nobody has tied
WHEEL_MASS = 0.1  # kg
BRAKE = 10.0  # N m, dry friction of a braked wheel; at 0.02 m four times a robot's weight

Names = tuple[str, ...]
Vec3 = tuple[float, float, float]
Inertia = tuple[float, float, float, float, float, float]  # Ixx, Iyy, Izz, Ixy, Ixz, Iyz
X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_TOUCH = {"contype": 0, "priority": 1}  # the ground alone


@dataclass(frozen=True)
class Link:
    """One link of the front right leg and the joint that carries it."""

    name: str
    mass: float  # kg
    com: Vec3  # m, centre of mass in the link's frame
    inertia: Inertia  # kg m^2 about the centre of mass, link axes
    offset: Vec3  # m, joint origin in the parent link's frame (the first link's: `Robot.mounts`)
    axis: Vec3  # along x, y or z; a left leg turns the other way about x and z
    limits: tuple[float, float]  # rad, right legs
    effort: float  # N m, torque limit
    capsule: tuple[float, Vec3, Vec3] | None  # collision shape: radius, start, end, m, link frame
    rear_mirrors_x: bool = False  # rear legs mirror this link in x as well


@dataclass(frozen=True)
class Robot:
    """A trunk with L legs of J joints. Per-leg tables follow the order of `legs`."""

    name: str
    trunk_mass: float  # kg
    trunk_com: Vec3  # m
    trunk_inertia: Inertia  # kg m^2
    trunk_box: Vec3  # m, full size of the collision box
    legs: Names
    mounts: tuple[Vec3, ...]  # (L, 3) m, first joints in the trunk frame; y < 0 right, x < 0 rear
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
        if self.mounts[0][1] >= 0:  # without leg tokens, the trunk is observed in this leg's frame
            raise ValueError(f"{self.name}: the first leg must be a right one, its mount at y < 0")

    @property
    def joints(self) -> list[str]:
        """The L*J joint names, leg by leg: FR_hip, FR_thigh, FR_calf, FL_hip, ..."""
        return [f"{leg}_{link.name}" for leg in self.legs for link in self.links]


def build_model(
    robot: Robot, terrain=None,
    towing: Names = (), skating: Names = (), late: bool = False,
) -> mujoco.MjModel:  # fmt: skip
    """Keyframe 0 is the default pose; bodies and actuators are in the order of `robot.joints`. The
    sensors `contact_<geom>` count contacts, which are with the ground alone: the trunk's, then leg
    by leg those of each link with a capsule and of the foot. terrain: a terrain.Terrain or None.

    towing, skating: legs whose foot gets a tether to one box, or becomes a wheel; slack or braked
    until faults.py changes it. Both add bodies and joints: find a robot's own by name. late: motors
    remember their targets, so that they can be late.
    """
    if unknown := {*towing, *skating} - set(robot.legs):
        raise ValueError(f"no leg {', '.join(sorted(unknown))}: the {robot.name} has {robot.legs}")
    if terrain is not None and towing:
        raise ValueError("the box wants flat ground: no terrain for robots that tow")

    spec = mujoco.MjSpec.from_string(WORLD)
    spec.modelname = robot.name
    if terrain is not None:
        terrain.build(spec)
    trunk = spec.worldbody.add_body(name="trunk", pos=[0, 0, robot.start_height])
    trunk.add_freejoint(name="root")
    spot, track = mujoco.mjtLightType.mjLIGHT_SPOT, mujoco.mjtCamLight.mjCAMLIGHT_TRACK
    light = {"pos": [-0.6, -0.8, 2.5], "dir": [0.24, 0.32, -1], "diffuse": [0.6, 0.6, 0.6]}
    trunk.add_light(type=spot, mode=track, cutoff=60, exponent=1, **light)
    _set_inertia(trunk, robot.trunk_mass, robot.trunk_com, robot.trunk_inertia)
    _add_geom(spec, trunk, "trunk", mujoco.mjtGeom.mjGEOM_BOX, np.array(robot.trunk_box) / 2)

    qpos = [0, 0, robot.start_height, 1, 0, 0, 0]
    for leg, mount, pose in zip(robot.legs, robot.mounts, robot.default_pose, strict=True):
        body, left, rear = trunk, mount[1] > 0, mount[0] < 0
        qpos += pose
        for link, angle in zip(robot.links, pose, strict=True):
            mirror = np.array([-1 if rear and link.rear_mirrors_x else 1, -1 if left else 1, 1])
            name = f"{leg}_{link.name}"
            body = body.add_body(name=name, pos=mount if body is trunk else mirror * link.offset)
            _set_inertia(body, link.mass, link.com, link.inertia, mirror)
            turned = left and not link.axis[1]  # about x or z: the other way round
            stops = np.negative(link.limits[::-1]) if turned else link.limits
            joint = body.add_joint(name=name, axis=link.axis, range=stops)
            joint.armature, joint.frictionloss = robot.armature, robot.friction_loss
            if link.capsule is not None:
                radius, start, end = link.capsule
                size, ends = [radius, 0, 0], np.concatenate([mirror * start, mirror * end])
                _add_geom(spec, body, name, mujoco.mjtGeom.mjGEOM_CAPSULE, size, fromto=ends)

            motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_position(kp=robot.stiffness, kv=robot.damping)
            motor.forcerange = [-link.effort, link.effort]
            if late:
                motor.nsample = 1 + round(MAX_DELAY / PHYSICS_DT)
            lock = spec.add_equality(name=name, name1=name, type=mujoco.mjtEq.mjEQ_JOINT)
            lock.objtype, lock.active = mujoco.mjtObj.mjOBJ_JOINT, False
            lock.data[0] = angle  # the joint angle that the lock holds
            lock.solref = [2 * PHYSICS_DT, 1]  # as stiff as the time step allows: within 0.01 rad
            lock.solimp = [0.99, 0.9999, 0.001, 0.5, 2]

        foot = mirror * robot.foot_position
        ball = {"size": [robot.foot_radius, 0, 0], "mass": WHEEL_MASS}  # calves have given ones
        if leg in towing:
            body.add_site(name=f"{leg}_ankle", pos=foot)
        if leg in skating:
            body, foot = _add_wheel(body, leg, foot), np.zeros(3)
            qpos.append(0.0)
        _add_geom(spec, body, f"{leg}_foot", mujoco.mjtGeom.mjGEOM_SPHERE, **ball, pos=foot)

    if towing:
        _add_box(spec, towing)
        qpos += [*BOX_START, 1, 0, 0, 0]
    spec.add_key(name="default", qpos=qpos, ctrl=np.ravel(robot.default_pose))
    return spec.compile()


def _add_geom(spec: mujoco.MjSpec, body, name: str, kind, size, **where) -> None:
    """With a sensor that counts its contacts."""
    geom = body.add_geom(name=name, type=kind, size=size, **_TOUCH, **where)
    foot = kind == mujoco.mjtGeom.mjGEOM_SPHERE
    geom.rgba = [0.15, 0.15, 0.17, 1] if foot else [0.35, 0.45, 0.60, 1]
    contact = {"type": mujoco.mjtSensor.mjSENS_CONTACT, "objtype": mujoco.mjtObj.mjOBJ_GEOM}
    intprm = [1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value, 0, 1]  # fields, reduction, slots
    spec.add_sensor(name=f"contact_{name}", objname=name, intprm=intprm, **contact)


def _add_wheel(body, leg: str, foot):
    """A wheel in the foot's place, its axle across the leg: it rolls as the foot points and grips
    sideways. Two numbers of friction would not do: MuJoCo's axes do not turn with the foot."""
    wheel = body.add_body(name=f"{leg}_wheel", pos=foot)
    joint = wheel.add_joint(name=f"{leg}_wheel", axis=Y, frictionloss=BRAKE)
    joint.armature = 1e-4  # a rim of 0.25 kg: a lighter wheel runs away when a robot flails
    joint.solref_friction = [2 * PHYSICS_DT, 1]  # this and the next, or else the brake creeps
    joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2]
    return wheel


def _add_box(spec: mujoco.MjSpec, legs: Names) -> None:
    """A box, and a tether to it from each leg's foot: a limit on a distance, nothing before it."""
    box = spec.worldbody.add_body(name="box", pos=BOX_START)
    box.add_freejoint(name="box")
    geom = box.add_geom(name="box", size=np.array(BOX_SIZE) / 2, mass=BOX_MASS, **_TOUCH)
    geom.type, geom.rgba = mujoco.mjtGeom.mjGEOM_BOX, [0.76, 0.60, 0.42, 1]
    geom.friction[0] = BOX_FRICTION
    box.add_site(name="box_front", pos=[BOX_SIZE[0] / 2, 0, 0])
    for leg in legs:
        tether = spec.add_tendon(name=f"{leg}_tether", limited=True, range=[-1, SLACK])
        tether.width, tether.rgba = 0.004, [0.2, 0.2, 0.2, 1]
        tether.wrap_site(f"{leg}_ankle")
        tether.wrap_site("box_front")


def _set_inertia(body, mass: float, com, inertia, mirror=(1, 1, 1)) -> None:
    """Products of inertia change sign with the axes they join; moments do not."""
    x, y, z = mirror
    body.mass, body.ipos, body.explicitinertial = mass, np.multiply(mirror, com), True
    body.fullinertia = np.array(inertia) * [1, 1, 1, x * y, x * z, y * z]


# Unitree A1, 12.45 kg. Sources: mujoco_menagerie unitree_a1/a1.xml (masses, inertias, limits,
# armature, friction), a1.urdf (trunk box), legged_gym a1_config.py (pose, gains, action scale,
# start height). Boxes are capsules: as exact on steps, quicker. Hips, in the trunk, do not collide.
A1 = Robot(
    name="a1", legs=("FR", "FL", "RR", "RL"),
    trunk_mass=4.713, trunk_com=(0, 0.0041, -0.0005), trunk_box=(0.267, 0.194, 0.114),
    trunk_inertia=(0.0158533, 0.0377999, 0.0456542, -3.66e-5, -6.11e-5, -2.75e-5),
    mounts=((0.183, -0.047, 0), (0.183, 0.047, 0), (-0.183, -0.047, 0), (-0.183, 0.047, 0)),
    links=(
        Link("hip", 0.696, com=(-0.003311, -0.000635, 3.1e-5), offset=(0, 0, 0),
             inertia=(0.000469246, 0.00080749, 0.000552929, 9.4e-6, -3.4e-7, 4.7e-7), effort=33.5,
             axis=X, limits=(-0.802851, 0.802851), capsule=None, rear_mirrors_x=True),
        Link("thigh", 1.013, com=(-0.003237, 0.022327, -0.027326), offset=(0, -0.08505, 0),
             inertia=(0.00552906, 0.00513934, 0.00136779, -4.8e-6, 3.44e-4, -2.24e-5), effort=33.5,
             axis=Y, limits=(-1.0472, 4.18879), capsule=(0.015, (0, 0, -0.01), (0, 0, -0.185))),
        Link("calf", 0.226, com=(0.00472659, 0, -0.131975), offset=(0, 0, -0.2),
             inertia=(0.00338556, 0.00340344, 4.385e-5, 0, -1.67e-4, 0), effort=33.5,
             axis=Y, limits=(-2.69653, -0.916298), capsule=(0.01, (0, 0, 0), (0, 0, -0.18))),
    ),
    foot_position=(0, 0, -0.2), foot_radius=0.02, start_height=0.42,
    default_pose=((-0.1, 0.8, -1.5), (0.1, 0.8, -1.5), (-0.1, 1.0, -1.5), (0.1, 1.0, -1.5)),
    stiffness=20.0, damping=0.5, action_scale=0.25, armature=0.01, friction_loss=0.2,
)  # fmt: skip

# Unitree Go1, 12.74 kg. Sources likewise: unitree_go1/go1.xml, go1.urdf, a1_config.py (a like
# machine). Start height ours: legs that start stretched must not be in the ground.
GO1 = replace(
    A1, name="go1",
    trunk_mass=5.204, trunk_com=(0.0223, 0.002, -0.0005), trunk_box=(0.3762, 0.0935, 0.114),
    trunk_inertia=(0.0168128, 0.0630095, 0.0716547, -2.3e-4, -2.95e-4, -4.2e-5),
    mounts=((0.1881, -0.04675, 0), (0.1881, 0.04675, 0),
            (-0.1881, -0.04675, 0), (-0.1881, 0.04675, 0)),
    links=(
        Link("hip", 0.68, com=(-0.0049166, 0.00762615, -8.865e-5), offset=(0, 0, 0),
             inertia=(0.00039938, 0.00073342, 0.00046842, 1.5e-5, 1e-6, -2e-6), effort=23.7,
             axis=X, limits=(-0.863, 0.863), capsule=None, rear_mirrors_x=True),
        Link("thigh", 1.009, com=(-0.00304722, 0.019315, -0.0305004), offset=(0, -0.08, 0),
             inertia=(0.0045988, 0.0046892, 0.00081745, -6.1e-5, -2.28e-4, -6.11e-4), effort=23.7,
             axis=Y, limits=(-0.686, 4.501), capsule=(0.015, (0, 0, -0.01), (0, 0, -0.198))),
        Link("calf", 0.195862, com=(0.00429862, 0.000976676, -0.146197), offset=(0, 0, -0.213),
             inertia=(0.00148449, 0.00149764, 3.607e-5, 0, -1.8e-5, -4e-6), effort=35.55,
             axis=Y, limits=(-2.818, -0.888), capsule=(0.01, (0, 0, 0), (0, 0, -0.19))),
    ),
    foot_position=(0, 0, -0.213), foot_radius=0.023, start_height=0.45,
)  # fmt: skip

# ElSpider Air, 30.5 kg: the hexapod of the authors' laboratory (the paper names none). Sources:
# extended_legged_gym el_mini.urdf (masses, inertias, geometry, limits; the foot is part of the
# calf), elspider_air.h (pose, gains), the A1 (armature, friction); start height ours, action scale
# ours (NOTES 15). Hips turn about the vertical, thighs point up, calves down; boxes are capsules.
HEXAPOD = Robot(
    name="hexapod", legs=("FR", "FL", "MR", "ML", "HR", "HL"),
    trunk_mass=15.8991, trunk_com=(0, 0, 0.02429), trunk_box=(0.6, 0.28, 0.14),
    trunk_inertia=(0.0926086, 0.47054913, 0.53896766, 0, 0, 0),
    mounts=((0.3, -0.08, 0.011), (0.3, 0.08, 0.011), (0, -0.14, 0.011), (0, 0.14, 0.011),
            (-0.3, -0.08, 0.011), (-0.3, 0.08, 0.011)),
    links=(
        Link("hip", 1.20924, com=(-0.01147, -0.12306, -0.03644), offset=(0, 0, 0),
             inertia=(0.00506, 0.00134, 0.00448, -3.8e-4, -1.2e-4, -1.02e-3), effort=33.5,
             axis=Z, limits=(-0.785, 0.785), rear_mirrors_x=True,
             capsule=(0.04, (0.02, -0.06, -0.03), (0.0355, -0.14, -0.04))),
        Link("thigh", 0.925235, com=(-0.01977, 0.00006, 0.11425), axis=X, limits=(-0.5233, 3.14),
             inertia=(0.00238, 0.00209, 0.00066, 0, 1.2e-4, 0), offset=(0.0355, -0.14999, -0.04506),
             capsule=(0.04, (0, 0, 0), (0, 0, 0.13)), effort=33.5, rear_mirrors_x=True),
        Link("calf", 0.3004999, com=(0.009795, 0, -0.080474), offset=(0, 0, 0.13), axis=(-1, 0, 0),
             inertia=(0.003056, 0.0030374, 9.137e-5, 0, 1.952e-4, 0), limits=(-0.6978, 3.925),
             capsule=(0.015, (0, 0, 0), (0.0166, 0, -0.213)), effort=33.5, rear_mirrors_x=True),
    ),
    foot_position=(0.018, 0, -0.232), foot_radius=0.02, start_height=0.22,
    default_pose=((0, 0.6, 0.6), (0, -0.6, -0.6)) * 3,
    stiffness=80.0, damping=2.0, action_scale=0.15, armature=0.01, friction_loss=0.2,
)  # fmt: skip

ROBOTS = {"a1": A1, "go1": GO1, "hexapod": HEXAPOD}
