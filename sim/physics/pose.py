"""Planar poses of bodies, by plain floats: read at every control tick."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Planar:
    """A pose on the floor plane, world frame, with the body's height and tilt beside it."""

    x_m: float
    y_m: float
    yaw_rad: float
    z_m: float = 0.0

    def point(self, x_m: float, y_m: float) -> tuple[float, float]:
        """A point of the body's frame in the world."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return self.x_m + cos * x_m - sin * y_m, self.y_m + sin * x_m + cos * y_m

    def local(self, x_m: float, y_m: float) -> tuple[float, float]:
        """A world point in the body's frame."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        dx, dy = x_m - self.x_m, y_m - self.y_m
        return cos * dx + sin * dy, cos * dy - sin * dx


def yaw_of(w: float, x: float, y: float, z: float) -> float:
    """Yaw [rad] of a quaternion q_world_body."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def wrap(angle_rad: float) -> float:
    return math.remainder(angle_rad, math.tau)
