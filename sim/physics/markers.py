"""The ceiling-marker camera (StarGazer): sees the nearest marker, a little wrong, and rarely a lot.

Two centimetres and a degree at worst, with rare jumps, as paper 000 (section 3) saw under its bright lamps.
"""

from __future__ import annotations

import math

import numpy as np

from core.robots import gardener as g
from core.wire.geometry import Pose2
from sim.devices.plants import MarkerSight
from sim.physics.pose import Planar, wrap

RANGE_M = 2.0
NOISE_M = 0.007
NOISE_M_MAX = 0.02
NOISE_RAD = math.radians(0.6)
NOISE_RAD_MAX = math.radians(2.0)
JUMP_CHANCE = 0.003
JUMP_M = (0.2, 0.6)


def sight_of(pose: Planar, markers: dict[int, Pose2], ceiling_m: float, rng: np.random.Generator) -> MarkerSight | None:
    """The raw view of the nearest marker within range, or None."""
    nearest = min(markers, key=lambda m: (markers[m].x_m - pose.x_m) ** 2 + (markers[m].y_m - pose.y_m) ** 2)
    marker = markers[nearest]
    if math.hypot(marker.x_m - pose.x_m, marker.y_m - pose.y_m) > RANGE_M or abs(pose.z_m) > 0.1:
        return None
    x_m, y_m = Planar(marker.x_m, marker.y_m, marker.yaw_rad).local(pose.x_m, pose.y_m)
    dx, dy, dyaw = rng.normal(0.0, 1.0, 3)
    x_m += _clip(NOISE_M * dx, NOISE_M_MAX)
    y_m += _clip(NOISE_M * dy, NOISE_M_MAX)
    if rng.random() < JUMP_CHANCE:
        away, direction = rng.uniform(*JUMP_M), rng.uniform(-math.pi, math.pi)
        x_m, y_m = x_m + away * math.cos(direction), y_m + away * math.sin(direction)
    yaw_rad = wrap(pose.yaw_rad - marker.yaw_rad + _clip(NOISE_RAD * dyaw, NOISE_RAD_MAX))
    return MarkerSight(
        marker_id=nearest,
        theta_deg=-math.degrees(yaw_rad),
        x_cm=100.0 * x_m,
        y_cm=100.0 * y_m,
        z_cm=100.0 * (ceiling_m - g.MARKER_SENSOR_HEIGHT_M - pose.z_m),
    )


def _clip(value: float, limit: float) -> float:
    return float(min(limit, max(-limit, value)))
