"""Ceiling markers: from a pose relative to one marker to a pose in the world. Plain floats, no arrays."""

from __future__ import annotations

import math

Pose = tuple[float, float, float]
"""(x [m], y [m], yaw [rad, counter-clockwise])."""


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


def world_pose(fix_xyyaw: Pose, marker_pose: Pose) -> Pose:
    """The sensor in the world: T_world_marker @ T_marker_sensor, yaw within -pi .. pi."""
    return compose(marker_pose, fix_xyyaw)


def marker_view(sensor_pose: Pose, marker_pose: Pose) -> Pose:
    """The inverse: where a sensor at `sensor_pose` stands in the marker's frame."""
    return compose(invert(marker_pose), sensor_pose)
