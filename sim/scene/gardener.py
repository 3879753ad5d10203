"""The gardener as MuJoCo bodies: a round base on two sprung wheels and two casters, a 4-DOF arm, a basket.

Every name begins with the robot's id. The base body's origin is the base frame's (on the floor, between the wheels).
"""

from __future__ import annotations

import math
from typing import Any

import mujoco

from core.robots import gardener as g
from core.scenario import Robot
from sim.scene.collide import A_SHELL, AN_ARM, FOR_FRUIT, HULL_GROUP, NOTHING, SITE_GROUP, VISUAL_GROUP
from sim.scene.hang import GRIP_FRICTION, GRIP_SOLIMP, GRIP_SOLREF
from sim.scene.traits import Traits

BOX, CAPSULE, CYLINDER, SPHERE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_SPHERE,
)
HINGE, SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE

SLAB = "floor-slab"

# Masses add up to gardener.MASS_KG; the arm's weight is carried by the base, so that wheel loads do not depend on its pose.
SHELL_KG = 3.55
TOWER_KG = 2.20
MAST_KG = 0.30
WHEEL_KG = 0.15
CASTER_KG = 0.05
ARM_KG = 0.30

WHEEL_LOAD_N = 20.0
"""Preload of each wheel's spring; the casters carry the rest of the weight, some 12 N each."""
SPRING_NPM = 1500.0
SPRING_DAMPING = 60.0
WHEEL_TRAVEL_M = 0.016
TYRE_PRESS_M = 0.0006
"""Half of what a loaded tyre gives way: added to its radius, so that it rolls on the nominal one."""
WHEEL_KV = 2.0
"""Of the motor's speed loop [N m s/rad]: tight, as the Create's own is."""
WHEEL_TORQUE_NM_MAX = 0.5

FRONT_CASTER_X_M = 0.135
FRONT_CASTER_RADIUS_M = 0.016
REAR_CASTER_X_M = -0.150
REAR_CASTER_RADIUS_M = 0.025

FINGER_N_MAX = 12.0
SHELL_FRICTION = [0.2, 0.005, 0.0001]
"""Fingers are rubber inside and smooth outside: they slide between fruit, and past them."""
JOINT_KP = {"pan": 60.0, "shoulder": 80.0, "elbow": 60.0, "wrist": 20.0, "roll": 20.0}
JOINT_KV = {"pan": 3.0, "shoulder": 4.0, "elbow": 2.5, "wrist": 0.6, "roll": 0.6}

WHITE, GREY, DARK = (0.86, 0.87, 0.88, 1.0), (0.55, 0.57, 0.60, 1.0), (0.13, 0.13, 0.15, 1.0)
BLUE, TANK_BLUE = (0.20, 0.35, 0.62, 1.0), (0.45, 0.68, 0.86, 1.0)


def add_gardener(spec: Any, robot: Robot, traits: Traits) -> None:
    """Adds the robot's bodies, joints, actuators and floor contacts to the spec."""
    half_yaw = math.radians(robot.yaw_deg) / 2
    base = spec.worldbody.add_body(
        name=robot.id, pos=[robot.x_m, robot.y_m, 0.0], quat=[math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw)]
    )
    base.add_freejoint(name=f"{robot.id}/free")
    _hull(base, robot.id)
    _wheels(spec, base, robot, traits)
    _casters(spec, base, robot.id)
    _arm(spec, base, robot.id, robot.wrist == "roll")


def _hull(base: Any, name: str) -> None:
    half_z = (g.BODY_HEIGHT_M - 0.012) / 2
    shell = {"type": CYLINDER, "size": [g.BODY_RADIUS_M, half_z, 0], "pos": [0, 0, 0.012 + half_z]}
    base.add_geom(name=f"{name}/shell", mass=SHELL_KG, rgba=WHITE, group=VISUAL_GROUP, friction=[0.25, 0.005, 0.0001],
                  **A_SHELL, **shell)  # fmt: skip
    top = g.BODY_HEIGHT_M
    (x, y, z), (bx, by, bz) = g.BASKET_M, (g.BASKET_HALF_M[0], g.BASKET_HALF_M[1], 0.04)
    parts = [
        ("deck", CYLINDER, [0.168, 0.004, 0], [0, 0, top + 0.004], DARK, 0.0),
        ("tank", BOX, [0.055, 0.085, 0.06], [-0.095, 0, top + 0.07], TANK_BLUE, TOWER_KG),
        ("notebook", BOX, [0.035, 0.11, 0.012], [0.0, 0, top + 0.025], GREY, 0.0),
        ("mast", CYLINDER, [0.022, (g.SHOULDER_Z_M - top) / 2, 0],
         [g.SHOULDER_X_M, 0, (g.SHOULDER_Z_M + top) / 2], GREY, MAST_KG),
        ("basket-floor", BOX, [bx, by, 0.006], [x, y, z - bz - 0.006], BLUE, 0.0),
        ("basket-left", BOX, [bx, 0.003, bz], [x, y + by + 0.003, z], BLUE, 0.0),
        ("basket-right", BOX, [bx, 0.003, bz], [x, y - by - 0.003, z], BLUE, 0.0),
        ("basket-front", BOX, [0.003, by, bz], [x + bx + 0.003, y, z], BLUE, 0.0),
        ("basket-back", BOX, [0.003, by, bz], [x - bx - 0.003, y, z], BLUE, 0.0),
        ("bumper", BOX, [0.004, 0.10, 0.015], [0.166, 0, 0.055], DARK, 0.0),
        ("nose", BOX, [0.03, 0.008, 0.003], [0.13, 0, top + 0.01], (0.2, 0.75, 0.3, 1.0), 0.0),
    ]  # fmt: skip
    for part, kind, size, pos, rgba, mass in parts:
        base.add_geom(name=f"{name}/{part}", type=kind, size=size, pos=pos, rgba=rgba, mass=mass, group=VISUAL_GROUP,
                      **FOR_FRUIT)  # fmt: skip


def _wheels(spec: Any, base: Any, robot: Robot, traits: Traits) -> None:
    """Each wheel hangs on a sprung slide; a sphere touches the floor in one point, a cylinder is what one sees."""
    radius_m = g.WHEEL_DIAMETER_M[robot.create] / 2
    half_track_m = g.WHEELBASE_M[robot.create] * traits.track / 2
    for side, sign, scale in (("left", 1.0, traits.wheel_left), ("right", -1.0, traits.wheel_right)):
        name, r_m = f"{robot.id}/{side}", radius_m * scale
        wheel = base.add_body(name=name, pos=[0, sign * half_track_m, r_m])
        wheel.add_joint(
            name=f"{name}-spring", type=SLIDE, axis=[0, 0, -1], range=[-0.010, WHEEL_TRAVEL_M], limited=True,
            stiffness=SPRING_NPM, springref=WHEEL_LOAD_N / SPRING_NPM, damping=SPRING_DAMPING,
        )  # fmt: skip
        # The limit stands at the joint: a motor that is cut off itself is integrated explicitly, and its loop then flips a
        # standing wheel to and fro at every step for ever, so that the world never rests.
        wheel.add_joint(
            name=f"{name}-wheel", type=HINGE, axis=[0, 1, 0], damping=0.002, armature=0.002,
            actfrclimited=True, actfrcrange=[-WHEEL_TORQUE_NM_MAX, WHEEL_TORQUE_NM_MAX],
        )  # fmt: skip
        wheel.add_geom(
            name=f"{name}-tread", type=SPHERE, size=[r_m + TYRE_PRESS_M, 0, 0], mass=WHEEL_KG, group=HULL_GROUP, **NOTHING
        )
        wheel.add_geom(name=f"{name}-rim", type=CYLINDER, size=[r_m, 0.011, 0], quat=[math.sqrt(0.5), math.sqrt(0.5), 0, 0],
                       rgba=DARK, mass=0.0, group=VISUAL_GROUP, **NOTHING)  # fmt: skip
        motor = spec.add_actuator(name=f"{name}-motor", target=f"{name}-wheel", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_velocity(WHEEL_KV)


def _casters(spec: Any, base: Any, name: str) -> None:
    radius_m = FRONT_CASTER_RADIUS_M
    base.add_geom(name=f"{name}/front-caster", type=SPHERE, size=[radius_m, 0, 0], pos=[FRONT_CASTER_X_M, 0, radius_m],
                  mass=0.0, rgba=DARK, group=VISUAL_GROUP, **NOTHING)  # fmt: skip
    radius_m = REAR_CASTER_RADIUS_M
    rear = base.add_body(name=f"{name}/rear", pos=[REAR_CASTER_X_M, 0, radius_m])
    rear.add_joint(name=f"{name}/rear-wheel", type=HINGE, axis=[0, 1, 0], frictionloss=0.004, damping=0.0005,
                   armature=0.0005)  # fmt: skip
    rear.add_geom(name=f"{name}/rear-caster", type=SPHERE, size=[radius_m, 0, 0], mass=CASTER_KG, rgba=DARK,
                  group=VISUAL_GROUP, **NOTHING)  # fmt: skip


def _arm(spec: Any, base: Any, name: str, rolls: bool) -> None:
    pan = base.add_body(name=f"{name}/pan", pos=[g.SHOULDER_X_M, 0, g.SHOULDER_Z_M], gravcomp=1)
    _joint(spec, pan, name, "pan", [0, 0, 1])
    _limb(pan, f"{name}/pan-hub", [0, 0, -0.02], [0, 0, 0.02], 0.024)
    upper = pan.add_body(name=f"{name}/upper", gravcomp=1)
    _joint(spec, upper, name, "shoulder", [0, -1, 0])
    _limb(upper, f"{name}/upper-arm", [0, 0, 0], [g.UPPER_ARM_M, 0, 0], 0.014)
    fore = upper.add_body(name=f"{name}/fore", pos=[g.UPPER_ARM_M, 0, 0], gravcomp=1)
    _joint(spec, fore, name, "elbow", [0, -1, 0])
    _limb(fore, f"{name}/forearm", [0, 0, 0], [g.FOREARM_M, 0, 0], 0.012)
    hand = fore.add_body(name=f"{name}/hand", pos=[g.FOREARM_M, 0, 0], gravcomp=1)
    _joint(spec, hand, name, "wrist", [0, -1, 0])
    _limb(hand, f"{name}/palm", [0, 0, 0], [0.055, 0, 0], 0.011)
    _hand(spec, hand, _rolling(spec, hand, name) if rolls else hand, name)


def _joint(spec: Any, body: Any, name: str, joint: str, axis: list[float], servo: g.Servo | None = None) -> None:
    """A hobby servo holds its joint like a stiff spring with a worm's friction; its speed is limited by what drives it."""
    servo = servo or g.SERVOS[joint]
    body.add_joint(name=f"{name}/{joint}", type=HINGE, axis=axis, range=[servo.min_rad, servo.max_rad], limited=True,
                   armature=0.02, damping=0.3)  # fmt: skip
    motor = spec.add_actuator(name=f"{name}/{joint}", target=f"{name}/{joint}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_position(JOINT_KP[joint], JOINT_KV[joint])


def _limb(body: Any, name: str, a: list[float], b: list[float], radius_m: float) -> None:
    body.add_geom(name=name, type=CAPSULE, size=[radius_m, 0, 0], fromto=[*a, *b], mass=ARM_KG / 6, rgba=GREY,
                  group=VISUAL_GROUP, friction=[0.3, 0.005, 0.0001], **AN_ARM)  # fmt: skip


def _rolling(spec: Any, hand: Any, name: str) -> Any:
    """The part of a rolling wrist that carries the fingers."""
    cuff = hand.add_body(name=f"{name}/cuff", gravcomp=1)
    cuff.add_geom(name=f"{name}/cuff", type=CAPSULE, size=[0.012, 0, 0], fromto=[0.045, 0, 0, 0.055, 0, 0], mass=0.01,
                  rgba=DARK, group=VISUAL_GROUP, **NOTHING)  # fmt: skip
    _joint(spec, cuff, name, "roll", [1, 0, 0], g.ROLL_SERVO)
    return cuff


def _hand(spec: Any, hand: Any, wrist: Any, name: str) -> None:
    """Two coupled fingers on `wrist`, the eye and the nozzle on the hand."""
    for side, sign in (("left", 1.0), ("right", -1.0)):
        finger = wrist.add_body(name=f"{name}/finger-{side}", pos=[0.05, 0, 0], gravcomp=1)
        finger.add_joint(name=f"{name}/finger-{side}", type=SLIDE, axis=[0, sign, 0], range=[0.0, g.GRIPPER_OPEN_M / 2],
                         limited=True, armature=0.01, damping=2.0)  # fmt: skip
        finger.add_geom(name=f"{name}/rail-{side}", type=BOX, size=[0.034, 0.0015, 0.006], pos=[0.034, sign * 0.0035, 0],
                        mass=0.015, rgba=DARK, group=VISUAL_GROUP, friction=SHELL_FRICTION, priority=2,
                        **AN_ARM)  # fmt: skip
        finger.add_geom(name=f"{name}/shell-{side}", type=BOX, size=[0.0145, 0.001, 0.0105], pos=[0.0805, sign * 0.004, 0],
                        mass=0.002, rgba=DARK, group=VISUAL_GROUP, friction=SHELL_FRICTION, priority=2,
                        **AN_ARM)  # fmt: skip
        finger.add_geom(name=f"{name}/pad-{side}", type=BOX, size=[0.0135, 0.0015, 0.010], pos=[0.08, sign * 0.0015, 0],
                        mass=0.008, rgba=DARK, group=VISUAL_GROUP, condim=4, friction=GRIP_FRICTION, solref=GRIP_SOLREF,
                        solimp=GRIP_SOLIMP, priority=2, **AN_ARM)  # fmt: skip
        finger.add_site(name=f"{name}/pad-{side}", type=BOX, size=[0.016, 0.003, 0.013], pos=[0.08, 0, 0],
                        group=SITE_GROUP)  # fmt: skip
        sensor = spec.add_sensor(name=f"{name}/touch-{side}", type=mujoco.mjtSensor.mjSENS_TOUCH,
                                 objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"{name}/pad-{side}")  # fmt: skip
        sensor.cutoff = g.FORCE_SENSOR_N_MAX
    couple = spec.add_equality(name=f"{name}/fingers", type=mujoco.mjtEq.mjEQ_JOINT,
                               objtype=mujoco.mjtObj.mjOBJ_JOINT)  # fmt: skip
    couple.name1, couple.name2 = f"{name}/finger-left", f"{name}/finger-right"
    couple.data[:5] = [0, 1, 0, 0, 0]
    couple.solref = [0.005, 1.0]
    motor = spec.add_actuator(name=f"{name}/gripper", target=f"{name}/finger-left", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_position(2000.0, 20.0)
    motor.forcelimited, motor.forcerange = True, [-FINGER_N_MAX, FINGER_N_MAX]
    hand.add_site(name=f"{name}/tool", pos=[g.HAND_M, 0, 0], group=SITE_GROUP)
    hand.add_site(name=f"{name}/nozzle", pos=list(g.NOZZLE_IN_HAND_M), group=SITE_GROUP)
    _limb(hand, f"{name}/hose", [0.02, 0, -0.018], list(g.NOZZLE_IN_HAND_M), 0.004)
    hand.add_camera(name=f"{name}/eye", pos=list(g.CAMERA_IN_HAND_M), quat=[0.5, 0.5, -0.5, -0.5], fovy=g.CAMERA_FOV_Y_DEG)
    hand.add_geom(name=f"{name}/bracket", type=BOX, size=[0.006, 0.012, 0.016], pos=[0.012, 0, 0.024], rgba=DARK, mass=0.0,
                  group=VISUAL_GROUP, **NOTHING)  # fmt: skip
    hand.add_geom(name=f"{name}/camera", type=BOX, size=[0.012, 0.018, 0.014], rgba=DARK, mass=0.0, group=VISUAL_GROUP,
                  pos=[g.CAMERA_IN_HAND_M[0] - 0.014, g.CAMERA_IN_HAND_M[1], g.CAMERA_IN_HAND_M[2]],
                  **NOTHING)  # fmt: skip
