"""Between a docked robot's base frame and the frame of the plant before it (x towards the dock, z up from the soil)."""

from __future__ import annotations

import math

import numpy as np

from core.geometry.planar import Pose, between
from core.manipulation.kinematics import Array
from core.wire.geometry import Pose2
from core.wire.market import PlantCard


def plant_in_base(pose: Pose, plant: PlantCard) -> Array:
    """T_base_plant (4, 4) [m] of a base at `pose` (world frame)."""
    yaw_rad = plant.dock.yaw_rad + math.pi
    x_m, y_m, turn_rad = between(pose, (plant.stem.x_m, plant.stem.y_m, yaw_rad))
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    T = np.eye(4)
    T[:2, :2] = ((cos, -sin), (sin, cos))
    T[:3, 3] = x_m, y_m, plant.stem.z_m
    return T


def base_in_plant(pose: Pose, plant: PlantCard) -> Pose2:
    """The base's pose relative to the plant."""
    yaw_rad = plant.dock.yaw_rad + math.pi
    x_m, y_m, turn_rad = between((plant.stem.x_m, plant.stem.y_m, yaw_rad), pose)
    return Pose2(x_m=x_m, y_m=y_m, yaw_rad=turn_rad)


def mapped(T_a_b: Array, p_b: tuple[float, float, float]) -> tuple[float, float, float]:
    """One point."""
    p = T_a_b[:3, :3] @ np.array(p_b) + T_a_b[:3, 3]
    return float(p[0]), float(p[1]), float(p[2])
