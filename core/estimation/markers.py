"""Ceiling markers: from a pose relative to one marker to a pose in the world. Plain floats, no arrays."""

from __future__ import annotations

from core.geometry.planar import Pose, compose, invert, wrap

__all__ = ["Pose", "compose", "invert", "marker_view", "world_pose", "wrap"]


def world_pose(fix_xyyaw: Pose, marker_pose: Pose) -> Pose:
    """The sensor in the world: T_world_marker @ T_marker_sensor, yaw within -pi .. pi."""
    return compose(marker_pose, fix_xyyaw)


def marker_view(sensor_pose: Pose, marker_pose: Pose) -> Pose:
    """The inverse: where a sensor at `sensor_pose` stands in the marker's frame."""
    return compose(invert(marker_pose), sensor_pose)
