"""The eye in the hand: where the camera is for given joints, where it should be, and the six poses of a scan.

Camera frame: z forward through the picture, x right, y down (OpenCV's). Base frame as in `core.robots.gardener`.
"""

from __future__ import annotations

import math

import numpy as np

from core.errors import Refused
from core.manipulation.arm import Joints, Point3, inverse
from core.manipulation.kinematics import Array, forward
from core.manipulation.swing import obstruction
from core.robots.gardener import CAMERA_IN_HAND_M, DOCK_TO_STEM_M, SHOULDER_X_M

T_HAND_CAM: Array = np.array(
    [
        [0.0, 0.0, 1.0, CAMERA_IN_HAND_M[0]],
        [-1.0, 0.0, 0.0, CAMERA_IN_HAND_M[1]],
        [0.0, -1.0, 0.0, CAMERA_IN_HAND_M[2]],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""The camera looks along the hand; the top of its picture is the hand's upper side."""

SCAN_VIEWS = (
    (math.radians(-12.0), 0.36, 0.46),
    (math.radians(-12.0), 0.42, 0.57),
    (math.radians(12.0), 0.54, 0.64),
    (math.radians(12.0), 0.60, 0.45),
    (math.radians(-12.0), 0.72, 0.67),
    (math.radians(12.0), 0.78, 0.73),
)
"""Bearing beside the stem's; heights above the floor of the camera and of the point on the stem's axis it looks at [m].

Six different heights, because the arm lets the camera rise much further than it can go aside: chosen on 12 plants so that
nearly every fruit is in three pictures, from places far enough apart to tell its distance."""
SCAN_STAND_OFF_M = 0.42
"""From the camera to the stem, seen from above: as far back as the arm can fold."""

ASIDE_M = 0.28
"""From the camera to a fruit that is looked at from aside: fingers and palm stay clear of what hangs about it."""
ASIDE_OFF_RAD = math.radians(32.0)
"""So far from the middle of the picture the fruit is then: 40 degrees are its edge."""
ASIDE_SIGHTS = tuple(
    (math.radians(up), side) for up, side in ((-15, 1), (-15, -1), (-45, 1), (-45, -1), (10, 1), (10, -1), (-30, 0), (25, 0))
)
"""The line of sight's elevation [rad], and whether it comes from the left (1) or the right of the fruit's bearing."""


def camera_pose(q: Joints) -> Array:
    """T_base_cam (4, 4) [m] for these joints."""
    pose: Array = forward(q) @ T_HAND_CAM
    return pose


def looking(camera_base_m: Point3, pitch_rad: float) -> Joints:
    """Joints that put the camera's centre at a point of the base frame [m], looking along this pitch.

    The camera always looks away from the pan axis: a 4-DOF arm has no choice of azimuth. Raises Refused.
    """
    return inverse(camera_base_m, pitch_rad, CAMERA_IN_HAND_M)


def scan_poses(stem_base_m: Point3 = (DOCK_TO_STEM_M, 0.0, 0.0)) -> tuple[Joints, ...]:
    """The six camera poses of an inventory (paper 000, section 5), from the lowest to the highest.

    A height that the arm cannot reach at the wanted stand-off is taken a little further from or nearer to the plant.
    """
    bearing_rad = math.atan2(stem_base_m[1], stem_base_m[0] - SHOULDER_X_M)
    return tuple(_nearest_pose(stem_base_m, bearing_rad + pan_rad, z_m, aim_z_m) for pan_rad, z_m, aim_z_m in SCAN_VIEWS)


def _nearest_pose(stem_base_m: Point3, pan_rad: float, z_m: float, aim_z_m: float) -> Joints:
    away_m = math.hypot(stem_base_m[0] - SHOULDER_X_M, stem_base_m[1])
    first: Refused | None = None
    for shift_m in (0.0, 0.03, -0.03, 0.06, -0.06, 0.10, -0.10, 0.14):
        r_m = away_m - SCAN_STAND_OFF_M + shift_m
        pitch_rad = math.atan2(aim_z_m - z_m, away_m - r_m)
        point = (SHOULDER_X_M + r_m * math.cos(pan_rad), r_m * math.sin(pan_rad), z_m)
        try:
            q = looking(point, pitch_rad)
        except Refused as refusal:
            first = first or refusal
            continue
        if not (why := obstruction(q)):
            return q
        first = first or Refused(why, hint="dock again")
    assert first is not None
    raise first


def beside(fruit: Point3) -> list[Joints]:
    """Poses that look at a point of the base frame [m] from aside, above and below; those that the arm can take.

    The arm's camera looks away from its pan axis, so an eye to the side has the fruit at the picture's other side.
    """
    away_m, bearing = math.hypot(fruit[0] - SHOULDER_X_M, fruit[1]), math.atan2(fruit[1], fruit[0] - SHOULDER_X_M)
    poses = []
    for up_rad, side in ASIDE_SIGHTS:
        off_rad, level_m = side * ASIDE_OFF_RAD, ASIDE_M * math.cos(up_rad)
        pan_off = math.asin(min(1.0, level_m * math.sin(off_rad) / away_m))
        r_m, pan = away_m * math.cos(pan_off) - level_m * math.cos(off_rad), bearing + pan_off
        at = SHOULDER_X_M + r_m * math.cos(pan), r_m * math.sin(pan), fruit[2] - ASIDE_M * math.sin(up_rad)
        try:
            q = looking(at, math.atan(math.tan(up_rad) / math.cos(off_rad)))
        except Refused:
            continue
        if not obstruction(q):
            poses.append(q)
    return poses


def singular(q: Joints, sine_min: float = 0.08) -> str:
    """Why the arm cannot move freely at these joints; empty when it can.

    Singular where the elbow is straight or folded shut, and where the wrist stands over the pan axis.
    """
    if abs(math.sin(q[2])) < sine_min:
        return "the elbow is almost straight: the arm is at the end of its reach"
    hand = forward(q)
    if math.hypot(hand[0, 3] - SHOULDER_X_M, hand[1, 3]) < 0.02:
        return "the wrist stands over the pan axis"
    return ""
