"""What experiments on fruit share: a garden of one plant and one docked robot, and the judge's questions about fruit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from core.errors import Refused
from core.geometry.pinhole import Camera, from_fov, sphere_outline
from core.manipulation.approach import ROLLS_RAD, Obstacle, approaches
from core.manipulation.eye import camera_pose, scan_poses
from core.manipulation.kinematics import Array
from core.robots import gardener
from core.scenario import Plant, Scenario, find
from core.wire.geometry import Pose2
from lab.garden import Garden
from sim.camera.geoms import geoms_of
from sim.camera.raster import rasterise
from sim.truth import FruitTruth
from sim.world import World

PLANT, ROBOT = "plant-1", "robot-1"
FRUIT = 18
VISIBLE_RATIO_MIN = 0.4
"""A fruit that shows less of its disc does not count as visible (DESIGN, section 8)."""
SAME_FRUIT_M = 0.03
COUNTED_CONFIDENCE = 0.5
"""A fruit that the plant believes in less is not counted."""
MOIST_RATIO = 0.35
START = {"x_m": -1.60, "y_m": 0.42, "yaw_deg": 90.0}


def one_plant(fruit: int = FRUIT, **robot: Any) -> Scenario:
    """The default garden with one moist plant that bears `fruit`, and one robot near its dock."""
    garden = find("garden")

    def potted(plant: Plant) -> Plant:
        return plant.model_copy(update={"moisture_ratio": MOIST_RATIO, "fruit": fruit})

    plants = tuple(potted(plant) for plant in garden.plants if plant.id == PLANT)
    return garden.model_copy(update={"plants": plants, "robots": (garden.robots[0].model_copy(update=START | robot),)})


def lens() -> Camera:
    """The gardener's camera as it is described."""
    return from_fov(*gardener.CAMERA_PIXELS, math.radians(gardener.CAMERA_FOV_Y_DEG))


def _pose_matrix(pose: Pose2) -> Array:
    """(4, 4) [m] of a base that stands on the floor."""
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    T = np.eye(4)
    T[:2, :2] = ((cos, -sin), (sin, cos))
    T[:2, 3] = pose.x_m, pose.y_m
    return T


def in_base(pose: Pose2, fruit: FruitTruth) -> tuple[float, float, float]:
    """A fruit's centre in the base frame of a robot at `pose` [m]."""
    p = np.array([fruit.position_world.x_m, fruit.position_world.y_m, fruit.position_world.z_m, 1.0])
    q = np.linalg.inv(_pose_matrix(pose)) @ p
    return float(q[0]), float(q[1]), float(q[2])


def reachable(pose: Pose2, fruit: FruitTruth, others: Sequence[FruitTruth] = ()) -> bool:
    """Whether joints exist that bring the hand straight to the fruit's true place, clear of pot, dock, body and `others`."""
    obstacles = [Obstacle(centre=in_base(pose, other), radius_m=other.radius_m) for other in others if other.id != fruit.id]
    try:
        ways = approaches(in_base(pose, fruit), fruit.radius_m, obstacles, ROLLS_RAD)
    except Refused:
        return False
    return max(way.room_m for way in ways) >= 0.0


def visible(world: World, pose: Pose2, hanging: list[FruitTruth]) -> set[str]:
    """Fruit that show `VISIBLE_RATIO_MIN` of their disc in at least one of the six pictures of a scan from `pose`."""
    camera, geoms, balls = lens(), geoms_of(world.model, world.data), world.orchard.balls()
    body = world.model.geom_bodyid
    own = np.array([world.model.body(int(b)).rootid[0] for b in body])
    robot = int(world.model.body(ROBOT).id)
    geoms = replace(geoms, visible=geoms.visible & (own != robot))
    T_base = _pose_matrix(pose)
    x_m, y_m = min((pot.place for pot in world.pots.values()), key=lambda at: math.dist(at, (pose.x_m, pose.y_m)))
    stem = np.linalg.inv(T_base) @ (x_m, y_m, 0.0, 1.0)
    seen: set[str] = set()
    for q in scan_poses((float(stem[0]), float(stem[1]), 0.0)):
        T = T_base @ camera_pose(q)
        ids = rasterise(camera, T, geoms, normals=False).ids
        for fruit in hanging:
            p = np.array([fruit.position_world.x_m, fruit.position_world.y_m, fruit.position_world.z_m])
            ahead = T[:3, :3].T @ (p - T[:3, 3])
            if ahead[2] < 0.08:
                continue
            u, v, r = sphere_outline(camera, ahead, fruit.radius_m)
            if not (r < u < camera.width - r and r < v < camera.height - r):
                continue
            if float((ids == balls[fruit.id]).sum()) >= VISIBLE_RATIO_MIN * math.pi * r * r:
                seen.add(fruit.id)
    return seen


@dataclass(frozen=True, slots=True, kw_only=True)
class Matched:
    """An inventory beside the truth: pairs (index in the inventory, fruit's id, distance [m])."""

    pairs: tuple[tuple[int, str, float], ...]
    entries: int

    @property
    def ids(self) -> set[str]:
        return {fruit_id for _, fruit_id, _ in self.pairs}

    @property
    def precision(self) -> float:
        return len(self.pairs) / self.entries if self.entries else math.nan


def matched(known: list[dict[str, Any]], truth: list[FruitTruth]) -> Matched:
    """Each inventory entry with the fruit it stands for: nearest pairs first, each used once, within `SAME_FRUIT_M`."""
    gaps = [
        (
            math.dist((k["x_m"], k["y_m"], k["z_m"]), (f.position_plant.x_m, f.position_plant.y_m, f.position_plant.z_m)),
            i,
            f.id,
        )
        for i, k in enumerate(known)
        for f in truth
    ]
    pairs: list[tuple[int, str, float]] = []
    used: set[int | str] = set()
    for gap_m, index, fruit_id in sorted(gaps):
        if gap_m > SAME_FRUIT_M:
            break
        if index not in used and fruit_id not in used:
            used |= {index, fruit_id}
            pairs.append((index, fruit_id, gap_m))
    return Matched(pairs=tuple(pairs), entries=len(known))


def hanging(garden: Garden) -> list[FruitTruth]:
    """The plant's fruit that still hang."""
    return [fruit for fruit in garden.truth().plant(PLANT).fruit if fruit.where == "plant"]
