"""What stands still: the slab, pots with their shrubs, docks, the tap, ceiling markers and lamps.

Names: `floor-slab`, `PLANT/pot`, `PLANT/soil`, `DOCK/dock` (DOCK as in `Scenario.docks`).
"""

from __future__ import annotations

import math
from typing import Any

import mujoco

from core.robots import gardener as g
from core.robots.markers import ceiling_markers
from core.scenario import Arena, Plant, Scenario, StationDock
from core.wire.geometry import Pose2
from sim.scene.collide import FOR_FRUIT, FURNITURE, GROUND, NOTHING, VISUAL_GROUP
from sim.scene.gardener import SLAB
from sim.scene.hang import add_trusses
from sim.scene.tomato import STEM_RGBA, Shrub

BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE,
)

SLAB_HALF_Z_M = 0.03
ROOM_FLOOR_M = -0.75
"""The field stands on trestles: what drives over its edge falls this far."""
DOCK_HALF_WIDTH_M = 0.085
DOCK_HEIGHT_M = 0.085
STOP_GAP_M = 0.003
"""The dock's plates are springs: they touch this much before the body meets the dock's face."""
TURF_RGBA = (0.22, 0.48, 0.20, 1.0)
POT_RGBA = (0.62, 0.36, 0.24, 1.0)
SOIL_RGBA = (0.22, 0.15, 0.10, 1.0)
DOCK_RGBA = (0.25, 0.26, 0.30, 1.0)
METAL_RGBA = (0.75, 0.76, 0.78, 1.0)


def add_arena(spec: Any, arena: Arena) -> None:
    half = [arena.length_m / 2, arena.width_m / 2, SLAB_HALF_Z_M]
    world = spec.worldbody
    world.add_geom(name=SLAB, type=BOX, size=half, pos=[0, 0, -SLAB_HALF_Z_M], rgba=TURF_RGBA, material="turf",
                   friction=[0.6, 0.005, 0.0001], **GROUND)  # fmt: skip
    world.add_geom(name="room-floor", type=PLANE, size=[half[0] + 4, half[1] + 4, 0.1], pos=[0, 0, ROOM_FLOOR_M],
                   rgba=(0.50, 0.50, 0.52, 1.0), friction=[0.8, 0.005, 0.0001], **GROUND)  # fmt: skip
    for index, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        height = -ROOM_FLOOR_M - 2 * SLAB_HALF_Z_M
        world.add_geom(name=f"trestle-{index}", type=BOX, size=[0.04, 0.04, height / 2], rgba=METAL_RGBA,
                       pos=[sx * (half[0] - 0.1), sy * (half[1] - 0.1), ROOM_FLOOR_M + height / 2],
                       group=VISUAL_GROUP, **NOTHING)  # fmt: skip
    _ceiling(world, arena)


def _ceiling(world: Any, arena: Arena) -> None:
    for marker_id, pose in ceiling_markers(arena).items():
        world.add_geom(name=f"marker/{marker_id}", type=BOX, size=[0.06, 0.06, 0.001], rgba=(0.9, 0.9, 0.95, 1.0),
                       pos=[pose.x_m, pose.y_m, arena.ceiling_m], group=VISUAL_GROUP, **NOTHING)  # fmt: skip
    for index, side in enumerate((-1, 1)):
        pos = [0.0, side * arena.width_m / 4, arena.ceiling_m - 0.25]
        world.add_geom(name=f"lamp-{index}", type=BOX, size=[0.5, 0.06, 0.03], pos=pos, rgba=(1.0, 0.97, 0.88, 1.0),
                       group=VISUAL_GROUP, **NOTHING)  # fmt: skip
        world.add_light(name=f"lamp-{index}", pos=pos, dir=[0, 0, -1], diffuse=[0.6, 0.6, 0.58], castshadow=False)


def add_plant(spec: Any, plant: Plant, shrub: Shrub) -> None:
    """Pot, dock and shrub. Stem and leaves are fixed and untouchable: they cost a step almost nothing."""
    half_z = g.SOIL_HEIGHT_M / 2
    pot = spec.worldbody.add_body(
        name=plant.id,
        pos=[plant.x_m, plant.y_m, 0.0],
        quat=_about_z(math.radians(plant.dock_yaw_deg)),
    )
    pot.add_geom(name=f"{plant.id}/pot", type=CYLINDER, size=[g.POT_RADIUS_M, half_z - 0.004, 0], pos=[0, 0, half_z - 0.004],
                 rgba=POT_RGBA, friction=[0.3, 0.005, 0.0001], **FURNITURE)  # fmt: skip
    pot.add_geom(name=f"{plant.id}/soil", type=CYLINDER, size=[g.SOIL_RADIUS_M, 0.01, 0], pos=[0, 0, g.SOIL_HEIGHT_M - 0.01],
                 rgba=SOIL_RGBA, material="soil", group=VISUAL_GROUP, **FOR_FRUIT)  # fmt: skip
    _add_shrub(pot, plant.id, shrub)
    add_trusses(spec, plant, shrub)
    _add_dock(spec, plant.id, plant.dock, depth_m=g.DOCK_TO_STEM_M - g.BODY_RADIUS_M - g.POT_RADIUS_M)


def _add_shrub(pot: Any, name: str, shrub: Shrub) -> None:
    def up(point: tuple[float, float, float]) -> list[float]:
        return [point[0], point[1], point[2] + g.SOIL_HEIGHT_M]

    still = {"group": VISUAL_GROUP, **NOTHING}
    for index, rod in enumerate(shrub.rods):
        pot.add_geom(name=f"{name}/stem/{index}", type=CAPSULE, size=[rod.radius_m, 0, 0], fromto=[*up(rod.a), *up(rod.b)],
                     rgba=STEM_RGBA, **still)  # fmt: skip
    for index, leaf in enumerate(shrub.leaves):
        pot.add_geom(name=f"{name}/leaf/{index}", type=ELLIPSOID, size=list(leaf.half_m), pos=up(leaf.centre),
                     quat=list(leaf.q_wxyz), rgba=leaf.rgba, **still)  # fmt: skip


def add_station_dock(spec: Any, name: str, dock: StationDock) -> None:
    """A dock before its wall; the tap's stand carries a spout over the docked robot's tank."""
    _add_dock(spec, name, dock.dock, depth_m=0.10)
    if not dock.tap:
        return
    yaw_rad = math.radians(dock.dock_yaw_deg)
    foot = [dock.x_m - 0.08 * math.cos(yaw_rad), dock.y_m - 0.08 * math.sin(yaw_rad)]
    spout = [dock.dock.x_m, dock.dock.y_m]
    for part, a, b in (("stand", [*foot, 0.0], [*foot, 0.62]), ("spout", [*foot, 0.62], [*spout, 0.60])):
        spec.worldbody.add_geom(name=f"{name}/{part}", type=CAPSULE, size=[0.012, 0, 0], fromto=[*a, *b], rgba=METAL_RGBA,
                                group=VISUAL_GROUP, **NOTHING)  # fmt: skip


def _add_dock(spec: Any, name: str, docked: Pose2, depth_m: float) -> None:
    """A box `depth_m` deep whose face the docked robot's front just meets, with the charging plates before it."""
    cos, sin = math.cos(docked.yaw_rad), math.sin(docked.yaw_rad)
    face_m = g.BODY_RADIUS_M + STOP_GAP_M

    def ahead(distance_m: float, z_m: float) -> list[float]:
        return [docked.x_m + distance_m * cos, docked.y_m + distance_m * sin, z_m]

    half_depth = (depth_m - STOP_GAP_M) / 2
    quat = _about_z(docked.yaw_rad)
    spec.worldbody.add_geom(
        name=f"{name}/dock", type=BOX, size=[half_depth, DOCK_HALF_WIDTH_M, DOCK_HEIGHT_M / 2], quat=quat,
        pos=ahead(face_m + half_depth, DOCK_HEIGHT_M / 2), rgba=DOCK_RGBA, friction=[0.2, 0.005, 0.0001], **FURNITURE,
    )  # fmt: skip
    for side, rgba in ((1, (0.8, 0.1, 0.1, 1.0)), (-1, (0.1, 0.7, 0.2, 1.0))):
        pad = ahead(g.BODY_RADIUS_M - 0.03, 0.004)
        pad[0] -= side * 0.04 * sin
        pad[1] += side * 0.04 * cos
        spec.worldbody.add_geom(name=f"{name}/plate{side:+d}", type=BOX, size=[0.03, 0.012, 0.004], quat=quat, pos=pad,
                                rgba=METAL_RGBA, group=VISUAL_GROUP, **NOTHING)  # fmt: skip
        buoy = ahead(face_m + 0.012, DOCK_HEIGHT_M + 0.006)
        buoy[0] -= side * 0.02 * sin
        buoy[1] += side * 0.02 * cos
        spec.worldbody.add_geom(name=f"{name}/buoy{side:+d}", type=SPHERE, size=[0.008, 0, 0], pos=buoy, rgba=rgba,
                                group=VISUAL_GROUP, **NOTHING)  # fmt: skip


def _about_z(yaw_rad: float) -> list[float]:
    return [math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2)]


def add_all(spec: Any, scenario: Scenario, shrubs: dict[str, Shrub]) -> None:
    add_arena(spec, scenario.arena)
    for plant in scenario.plants:
        add_plant(spec, plant, shrubs[plant.id])
    for dock in scenario.station.docks:
        add_station_dock(spec, f"{scenario.station.id}/{dock.id}", dock)
