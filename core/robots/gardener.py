"""The gardener: a Create base with a 4-DOF arm, a water tank and a ceiling-marker localizer, as numbers.

Both the simulated world and the robot's kinematics read these. Base frame: origin on the floor midway between the drive
wheels, x forward, y left, z up (REP-103). Arm joints, in order: pan (about +z), shoulder, elbow and wrist (about -y, so
positive raises the next link; all zero is the arm stretched out forward and level).
Pure Python on purpose: a pot or a console may read it without numpy.
Source: paper 000, section 2; Create figures from hardware/protocols.md, section 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

BODY_RADIUS_M = 0.174
BODY_HEIGHT_M = 0.09
WHEELBASE_M = {"create1": 0.258, "create2": 0.235}
WHEEL_DIAMETER_M = {"create1": 0.066, "create2": 0.072}
V_MPS_MAX = 0.5
"""The Create's own limit; a setpoint beyond it is scaled down, curvature kept."""
CRUISE_MPS = 0.3
OMEGA_RADPS_MAX = 2.0
MASS_KG = 6.5
"""Base, arm, notebook, pack and half a tank: twice a bare Create, which is why its odometry is poor."""

IR_RECEIVER_X_M = 0.13
"""The omni-directional infrared receiver sits near the front edge."""
MARKER_SENSOR_HEIGHT_M = 0.35
"""The StarGazer looks up from above the axle."""

TANK_ML = 1500.0
PUMP_MLPS = 7.5
"""150 ml take the paper's 20 s."""
TANK_SENSOR_V_FULL = 4.5
"""VB reads 0 V empty, this when full, linear."""
FORCE_SENSOR_V_MAX = 4.0
FORCE_SENSOR_N_MAX = 10.0
"""VA reads the gripper's force sensor, linear to 10 N."""

PACK_WH = 130.0
PACK_V = 19.2
IDLE_W = 12.0
DRIVE_W = 18.0
ARM_W = 6.0
PUMP_W = 8.0
CHARGE_W = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Servo:
    """A hobby servo on the SSC-32: joint angle = sign * (pulse - centre) * rad_per_us."""

    channel: int
    centre_us: float
    rad_per_us: float
    sign: int
    min_rad: float
    max_rad: float
    speed_radps_max: float

    def pulse_us(self, angle_rad: float) -> float:
        return self.centre_us + self.sign * angle_rad / self.rad_per_us

    def angle_rad(self, pulse_us: float) -> float:
        return self.sign * (pulse_us - self.centre_us) * self.rad_per_us


_RAD_PER_US = math.radians(90.0) / 1000.0
"""1000 us turn a standard servo by 90 degrees."""


def _servo(channel: int, min_deg: float, max_deg: float, centre_deg: float = 0.0, sign: int = 1) -> Servo:
    return Servo(
        channel=channel,
        centre_us=1500.0 - sign * math.radians(centre_deg) / _RAD_PER_US,
        rad_per_us=_RAD_PER_US,
        sign=sign,
        min_rad=math.radians(min_deg),
        max_rad=math.radians(max_deg),
        speed_radps_max=2.0,
    )


ARM_JOINTS = ("pan", "shoulder", "elbow", "wrist")
SERVOS = {
    "pan": _servo(0, -85, 85),
    "shoulder": _servo(1, -10, 165, centre_deg=77.5),
    "elbow": _servo(2, -155, 5, centre_deg=-75.0, sign=-1),
    "wrist": _servo(3, -88, 88),
    "gripper": _servo(4, 0, 88, centre_deg=44.0),
}
ROLL_SERVO = _servo(5, -90, 90)
"""Turns the fingers about hand x, positive from hand y towards hand z, on a robot whose wrist rolls (`wrist = "roll"`)."""
PUMP_CHANNEL = 8
"""SSC-32 discrete output that switches the pump's relay."""
FORCE_INPUT = 0
TANK_INPUT = 1

SHOULDER_X_M = 0.06
SHOULDER_Z_M = 0.29
"""Pan axis and shoulder axis meet here, on the mast ahead of the axle."""
MAST_RADIUS_M = 0.022
UPPER_ARM_M = 0.24
FOREARM_M = 0.22
HAND_M = 0.13
"""Wrist axis to tool point: between the fingers, and where the nozzle lets go of the water."""
GRIPPER_OPEN_M = 0.044
GRIP_N_MAX = 9.0
"""The fingers close no further at such a squeeze: half as much again as a good grip has, and within the sensor's range."""
CAMERA_IN_HAND_M = (0.03, 0.0, 0.045)
"""Camera centre from the wrist axis along (hand x, y, z); it looks along hand x, its picture's top is hand z."""
CAMERA_PIXELS = (640, 480)
"""Its largest picture, width and height; it can give half of that."""
CAMERA_FOV_Y_DEG = 64.0
"""From the picture's top to its bottom: a wide lens, so that poses a hand's breadth apart see the same fruit, and the eye
still sees what the fingers hold."""
NOZZLE_IN_HAND_M = (0.11, 0.0, -0.02)

ARM_HOME_RAD = (0.0, math.radians(150.0), math.radians(-150.0), math.radians(60.0))
"""Folded over the body: within the footprint while driving."""
BASKET_M, BASKET_HALF_M = (0.0625, 0.11, 0.18), (0.0525, 0.05, 0.045)
"""Middle of what the basket on the left of the deck holds, and half its size, base frame."""
ARM_BASKET_RAD = (math.radians(85.0), math.radians(102.2), math.radians(-143.3), math.radians(-48.9))
"""The hand over the basket pointing straight down, the tool 0.25 m above the floor: fruit falls 0.1 m when it opens."""


def gripper_opening_m(servo_rad: float) -> float:
    """Gripper servo angle -> gap between the fingers: closed at 0, `GRIPPER_OPEN_M` at the servo's end, linear."""
    return GRIPPER_OPEN_M * servo_rad / SERVOS["gripper"].max_rad


def gripper_rad(opening_m: float) -> float:
    """Gap between the fingers -> gripper servo angle; the inverse of `gripper_opening_m`."""
    return SERVOS["gripper"].max_rad * opening_m / GRIPPER_OPEN_M


# How a robot stands at a pot
DOCK_TO_STEM_M = 0.55
"""Axle centre to stem when docked: the plant frame's origin lies this far ahead."""
LAUNCH_M = 0.55
"""The launch point is this far behind the docked pose, facing the dock."""
POT_RADIUS_M = 0.14
SOIL_RADIUS_M = 0.12
SOIL_HEIGHT_M = 0.25
NOZZLE_POINT_M = (0.06, 0.0, 0.06)
"""Where the water should leave, in the plant frame (origin: soil centre; x towards the dock, z up)."""
DOCK_RED_SIDE: Literal["left", "right"] = "left"
"""On which side of a dock's centre line only the red beam is seen, for a robot that faces the dock."""
WATCHDOG_LENGTH_M = 1.5
WATCHDOG_WIDTH_M = 1.0
"""While docking the robot stays in this rectangle before the dock, or goes back to the launch point (paper, 8.2)."""
