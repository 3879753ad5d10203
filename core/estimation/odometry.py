"""Differential-drive odometry: from two wheel travels to a pose."""

from __future__ import annotations

import math

from core.geometry.planar import Pose, wrap


def arc(pose: Pose, travel_m: float, turn_rad: float) -> Pose:
    """Go along a circular arc of length `travel_m` that turns by `turn_rad`; exact, straight and spin included."""
    x, y, yaw = pose
    half = turn_rad / 2
    chord_m = travel_m * (1.0 - half * half / 6.0 if abs(half) < 1e-4 else math.sin(half) / half)
    return x + chord_m * math.cos(yaw + half), y + chord_m * math.sin(yaw + half), wrap(yaw + turn_rad)


def advance(pose: Pose, d_left_m: float, d_right_m: float, wheelbase_m: float) -> Pose:
    """Dead reckoning: `pose` after the wheels rolled this far [m]."""
    return arc(pose, (d_left_m + d_right_m) / 2, (d_right_m - d_left_m) / wheelbase_m)
