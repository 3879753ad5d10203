"""Planar poses as plain tuples: no arrays, so that a pot or a body may use them too."""

from __future__ import annotations

import math

Pose = tuple[float, float, float]
"""(x [m], y [m], yaw [rad, counter-clockwise])."""
Point = tuple[float, float]


def wrap(angle_rad: float) -> float:
    """The same angle within -pi .. pi [rad]."""
    return math.remainder(angle_rad, math.tau)


def compose(T_a_b: Pose, T_b_c: Pose) -> Pose:
    """Planar poses multiplied: T_a_c = T_a_b @ T_b_c."""
    x, y, yaw = T_a_b
    cos, sin = math.cos(yaw), math.sin(yaw)
    return x + cos * T_b_c[0] - sin * T_b_c[1], y + sin * T_b_c[0] + cos * T_b_c[1], wrap(yaw + T_b_c[2])


def invert(T_a_b: Pose) -> Pose:
    """T_b_a."""
    x, y, yaw = T_a_b
    cos, sin = math.cos(yaw), math.sin(yaw)
    return -(cos * x + sin * y), sin * x - cos * y, wrap(-yaw)


def between(T_a_b: Pose, T_a_c: Pose) -> Pose:
    """T_b_c: the second pose as seen from the first."""
    return compose(invert(T_a_b), T_a_c)


def distance_m(a: Pose | Point, b: Pose | Point) -> float:
    """Between two positions [m]; yaw does not count."""
    return math.hypot(a[0] - b[0], a[1] - b[1])
