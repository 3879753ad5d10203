"""Inventory (paper 000, Algorithm 2): six camera poses before the plant, detect, lift, tell the plant. Done at the dock."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from core.errors import Refused
from core.inventory.sightings import Seen, fuse, upside_down
from core.inventory.sightings import View as ScanView
from core.inventory.track import logit, probability
from core.manipulation.eye import camera_pose, scan_poses
from core.manipulation.kinematics import Array
from core.manipulation.swing import swing
from core.perception.detection import Detection
from core.wire.fruit import FRUITS_MAX, Direction, Scan, Sighting, View
from core.wire.market import PlantCard
from robot_service.robot import Robot, SkillFailed
from robot_service.skills.arm import fold_arm, joints_now, move_arm
from robot_service.skills.plantframe import base_in_plant, mapped, plant_in_base

FUSE_COST_S, TURN_COST_S = 0.25, 0.10
RANGE_M_MAX = 0.9
RANGE_M_MIN = 0.08
PLANT_RADIUS_M, PLANT_M = 0.27, (0.02, 1.3)
"""The room that a plant takes: round its stem, above its soil."""
TRUSS_M, FAR_ODDS_PER_M = 0.15, -115.0
"""Trusses reach so far from the stem; what hangs further out is a fruit with log-odds less by so much (a fit, as in
`core.inventory.sightings`)."""


async def scan(robot: Robot, plant: PlantCard, scan_id: str, task_id: str) -> Scan:
    """Look from six poses and fuse what was seen. Raises SkillFailed when the camera or the arm does not do its part."""
    try:
        poses = scan_poses(mapped(plant_in_base(robot.pose(), plant), (0.0, 0.0, 0.0)))
    except Refused as error:
        raise SkillFailed(f"the arm cannot bring the camera before the plant: {error}") from error
    seen: list[tuple[Array, tuple[Detection, ...]]] = []
    sure_min = 0.0
    # A brain before this one may have left the hand among the fruit.
    await fold_arm(robot)
    for number, q in enumerate(poses):
        await _go(robot, q)
        look = await robot.eye.look(fine=True)
        seen.append((camera_pose(joints_now(robot)), look.detections))
        sure_min = look.sure_min
        robot.activity.waiting = f"view {number + 1} of {len(poses)}: {len(look.sure)} fruit"
    robot.activity.waiting = ""
    # The base has stood still, and knows its place better with every marker.
    T_plant_base = np.linalg.inv(plant_in_base(robot.pose(), plant))
    views = [ScanView(T_plant_cam=T_plant_base @ T_base_cam, detections=circles) for T_base_cam, circles in seen]
    await fold_arm(robot)
    camera = robot.eye.camera
    if await robot.clock.offload(lambda: upside_down(camera, views), TURN_COST_S):
        raise SkillFailed("the pictures agree only when turned: the camera is mounted upside down")
    fruit = await robot.clock.offload(lambda: fuse(camera, views, sure_min=sure_min), FUSE_COST_S)
    return document(robot, plant, scan_id, task_id, views, fruit)


async def _go(robot: Robot, q: tuple[float, float, float, float]) -> None:
    try:
        legs = swing(joints_now(robot), q)
    except Refused as error:
        raise SkillFailed(f"the arm cannot get into its scanning pose: {error}") from error
    await move_arm(robot, legs)


def document(robot: Robot, plant: PlantCard, scan_id: str, task_id: str, views: list[ScanView], seen: list[Seen]) -> Scan:
    """The scan as the plant takes it; the surest fruit if there are more than it takes."""
    camera, pose = robot.eye.camera, base_in_plant(robot.pose(), plant)
    half_x, half_y = math.atan(camera.width / 2 / camera.fx), math.atan(camera.height / 2 / camera.fy)
    best = sorted(map(_weighed, filter(_on_the_plant, seen)), key=lambda fruit: -fruit.confidence)[:FRUITS_MAX]
    return Scan(
        scan_id=scan_id,
        task_id=task_id,
        robot_id=robot.settings.id,
        views=[_view(view.T_plant_cam, 2 * half_x, 2 * half_y) for view in views],
        sightings=[
            Sighting(
                x_m=float(fruit.p[0]),
                y_m=float(fruit.p[1]),
                z_m=float(fruit.p[2]),
                sigma_m=min(1.0, max(0.001, fruit.sigma_m)),
                radius_m=fruit.radius_m,
                colour=fruit.colour,
                confidence=fruit.confidence,
                robot_pose=pose,
                image_x_px=fruit.image_x_px,
                image_y_px=fruit.image_y_px,
                views=list(fruit.views),
            )
            for fruit in best
        ],
        detector=robot.eye.accuracy,
    )


def _on_the_plant(fruit: Seen) -> bool:
    """What hangs anywhere else is another plant's fruit, or no fruit at all."""
    x_m, y_m, z_m = (float(value) for value in fruit.p)
    return math.hypot(x_m, y_m) < PLANT_RADIUS_M and PLANT_M[0] < z_m < PLANT_M[1]


def _weighed(fruit: Seen) -> Seen:
    """With what its distance from the stem says."""
    beyond_m = max(0.0, math.hypot(float(fruit.p[0]), float(fruit.p[1])) - TRUSS_M)
    return replace(fruit, confidence=probability(logit(fruit.confidence) + FAR_ODDS_PER_M * beyond_m))


def _view(T_plant_cam: Array, fov_x_rad: float, fov_y_rad: float) -> View:
    look, up, at = T_plant_cam[:3, 2], -T_plant_cam[:3, 1], T_plant_cam[:3, 3]
    return View(
        x_m=float(at[0]),
        y_m=float(at[1]),
        z_m=float(at[2]),
        look=_direction(look),
        up=_direction(up),
        fov_x_rad=fov_x_rad,
        fov_y_rad=fov_y_rad,
        range_m_min=RANGE_M_MIN,
        range_m_max=RANGE_M_MAX,
    )


def _direction(v: Array) -> Direction:
    x, y, z = (float(np.clip(value, -1.0, 1.0)) for value in v)
    return Direction(x=x, y=y, z=z)
