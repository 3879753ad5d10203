"""Frames of the gardener's hand camera in simulated gardens, with what is in them: reproducible, as many as one likes.

`python -m lab.vision.rendered --out DIR --n N --seed S` writes `images/` and `labels.json` (form: `lab.vision.dataset`).
Beside the usual keys a box carries `fruit_id`, `ripeness`, `visible_ratio` (pixels of the fruit over those of its whole
disc) and `u`, `v`, `radius` of its circle [px]; a frame carries its `group` (its garden) and the camera's intrinsics.
Gardens are worlds of their own: plants of other heights, fruit of all ages, other lamps and light. From each come the six
poses of a scan and looks from a servo's distance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import mujoco
import numpy as np
import typer
from rich.console import Console

from core.errors import Refused
from core.geometry.pinhole import Camera, sphere_outline
from core.manipulation.arm import Joints, Point3, inverse
from core.manipulation.swing import obstruction
from core.robots.gardener import ARM_JOINTS, CAMERA_IN_HAND_M, DOCK_TO_STEM_M, SHOULDER_X_M, SOIL_HEIGHT_M
from core.scenario import Scenario, find
from lab.vision import dataset
from sim.camera import hand
from sim.camera.geoms import Floats, Geoms, Paint, paint_of, seen_by_hand
from sim.camera.raster import Raster, rasterise
from sim.camera.shade import Light, Picture
from sim.scene.tomato import colour_of, rgba_of
from sim.world import World

SIZES = ((320, 240), (640, 480))
FRAMES_A_GARDEN = 12
SCAN_SHARE = 0.5
"""The rest of a garden's frames are looks of the servo."""
RADIUS_SHARE_MIN = 0.012
"""Of the picture's width. Smaller fruit, far behind, are `difficult`: what they are cannot be told."""
VISIBLE_RATIO_MIN = 0.02
"""Less than this is not labelled at all."""
SAME_PLACE_M = 2e-3
LAMP_SHARES = (0.4, 0.2, 0.25, 0.15)
"""How often the lamps are white, warm, like daylight, purple."""
_TRIES = 200
Rgb = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """A picture, what it shows, and from where."""

    picture: Picture
    labels: dict[str, Any]
    """One entry of `labels.json`, without its file name."""
    T_world_cam: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Fruit:
    """One fruit of the world and the geom that shows it."""

    plant_id: str
    fruit_id: str
    geom: int
    centre_m: Floats
    radius_m: float
    ripeness: float


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """All that a frame is made of."""

    camera: Camera
    T_world_cam: Floats
    geoms: Geoms
    paint: Paint
    light: Light
    sensor: hand.Sensor


def frames(count: int, seed: int) -> Iterator[Frame]:
    """`count` frames of as many gardens as they need; the same count and seed give the same frames."""
    for index in range(math.ceil(count / FRAMES_A_GARDEN)):
        yield from garden_frames(f"{seed}-{index}", min(FRAMES_A_GARDEN, count - index * FRAMES_A_GARDEN), [seed, index])


def garden_frames(group: str, count: int, seed: list[int]) -> Iterator[Frame]:
    """Frames of one garden, drawn by `seed`."""
    rng = np.random.default_rng(seed)
    world = World(_scenario(rng), int(rng.integers(2**31)))
    fruit = _fruit_of(world, rng)
    for _ in range(count):
        size = SIZES[int(rng.integers(len(SIZES)))]
        view = _view(world, fruit, size, rng)
        raster = rasterise(view.camera, view.T_world_cam, view.geoms)
        picture = hand.draw_raster(
            view.camera, view.T_world_cam, raster, view.geoms, view.paint, view.light, view.sensor, int(rng.integers(2**31))
        )
        entry = {"width": size[0], "height": size[1], "group": group, "camera": _intrinsics(view.camera)}
        yield Frame(picture=picture, labels=entry | {"boxes": _boxes(view, raster, fruit)}, T_world_cam=view.T_world_cam)


def views(count: int, seed: int, size: tuple[int, int]) -> Iterator[tuple[World, View]]:
    """`count` views of one size in one garden, and the world as it stands for each."""
    rng = np.random.default_rng([seed])
    world = World(_scenario(rng), int(rng.integers(2**31)))
    fruit = _fruit_of(world, rng)
    for _ in range(count):
        yield world, _view(world, fruit, size, rng)


def _scenario(rng: np.random.Generator) -> Scenario:
    """The paper's garden with other plants; its first robot will be docked."""
    scenario = find("garden")
    plants = tuple(
        plant.model_copy(
            update={"height_m": float(rng.uniform(0.6, 1.0)), "fruit": int(rng.integers(6, 31)), "moisture_ratio": 0.3}
        )
        for plant in scenario.plants
    )
    return scenario.model_copy(update={"plants": plants})


def _fruit_of(world: World, rng: np.random.Generator) -> list[Fruit]:
    """The world's fruit, each plant younger or older by a draw."""
    fruit = []
    balls = [g for g in range(world.model.ngeom) if world.model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
    for plant in world.truth().plants:
        older = float(rng.normal(0.15, 0.25))
        for berry in plant.fruit:
            at = berry.position_world
            centre_m = np.array([at.x_m, at.y_m, at.z_m])
            geom = min(balls, key=lambda g: float(np.linalg.norm(world.data.geom_xpos[g] - centre_m)))
            assert np.linalg.norm(world.data.geom_xpos[geom] - centre_m) < SAME_PLACE_M, berry.id
            ripeness = float(np.clip(berry.ripeness + older + rng.normal(0.0, 0.04), 0.03, 0.99))
            fruit.append(
                Fruit(
                    plant_id=plant.id,
                    fruit_id=berry.id,
                    geom=geom,
                    centre_m=centre_m,
                    radius_m=berry.radius_m,
                    ripeness=ripeness,
                )
            )
    return fruit


def _view(world: World, fruit: list[Fruit], size: tuple[int, int], rng: np.random.Generator) -> View:
    name = next(iter(world.robots))
    plant = world.scenario.plants[int(rng.integers(len(world.scenario.plants)))]
    docked, turn = plant.dock, float(rng.normal(0.0, math.radians(2.0)))
    world.teleport(name, docked.x_m + float(rng.normal(0.0, 0.01)), docked.y_m + float(rng.normal(0.0, 0.01)),
                   docked.yaw_rad + turn)  # fmt: skip
    q = _scan_look(rng) if rng.random() < SCAN_SHARE else _servo_look(world, name, plant.id, fruit, rng)
    for joint, angle in zip(ARM_JOINTS, q, strict=True):
        world.data.joint(f"{name}/{joint}").qpos[0] = angle
    for side in ("left", "right"):
        world.data.joint(f"{name}/finger-{side}").qpos[0] = float(rng.uniform(0.0, 0.022))
    mujoco.mj_kinematics(world.model, world.data)
    mujoco.mj_camlight(world.model, world.data)
    paint = _painted(paint_of(world.model), fruit)
    geoms, T_world_cam = seen_by_hand(world.model, world.data, name, paint)
    return View(
        camera=hand.camera(*size),
        T_world_cam=T_world_cam,
        geoms=geoms,
        paint=paint,
        light=_light(world, T_world_cam, rng),
        sensor=_sensor(rng),
    )


def _painted(paint: Paint, fruit: list[Fruit]) -> Paint:
    rgba = paint.rgba.copy()
    for one in fruit:
        rgba[one.geom] = rgba_of(one.ripeness)
    return replace(paint, rgba=rgba)


def _light(world: World, T_world_cam: Floats, rng: np.random.Generator) -> Light:
    """Lamps of any colour, moved about a little, stronger or weaker than what the walls send back."""
    lamps_m = np.array(world.data.light_xpos) + rng.normal(0.0, 0.3, (world.model.nlight, 3))
    names = list(hand.LAMP_RGB)
    tint = np.array(hand.LAMP_RGB[names[int(rng.choice(len(names), p=LAMP_SHARES))]]) * rng.uniform(0.9, 1.1, 3)
    light = hand.light_of(lamps_m, (tint[0], tint[1], tint[2]), hand.nearest_lamp(lamps_m, T_world_cam))
    walls, around = rng.uniform(0.25, 1.15), rng.uniform(0.6, 1.5)
    return replace(light, sky_rgb=_times(walls, light.sky_rgb), ambient_rgb=_times(around, light.ambient_rgb))


def _times(factor: float, rgb: Rgb) -> Rgb:
    return (factor * rgb[0], factor * rgb[1], factor * rgb[2])


def _sensor(rng: np.random.Generator) -> hand.Sensor:
    """As good cameras differ: exposure, noise, sharpness and white balance."""
    return hand.Sensor(
        exposure=float(np.exp(rng.normal(0.0, 0.22))),
        white_balance=float(rng.uniform(0.45, 1.0)),
        blur_px=float(rng.uniform(0.4, 1.0)),
        vignette=float(rng.uniform(0.1, 0.35)),
        read_noise=float(rng.uniform(0.003, 0.015)),
        shot_noise=float(rng.uniform(0.008, 0.035)),
    )


def _scan_look(rng: np.random.Generator) -> Joints:
    """The camera before the stem at any height, looking at it."""
    away_m = DOCK_TO_STEM_M - SHOULDER_X_M

    def draw() -> Joints:
        r_m, z_m = away_m - rng.uniform(0.26, 0.42), rng.uniform(0.34, 0.78)
        pan = rng.uniform(-1.0, 1.0) * math.radians(24.0)
        aim_z_m = z_m + rng.uniform(-0.06, 0.06)
        point = (SHOULDER_X_M + r_m * math.cos(pan), r_m * math.sin(pan), z_m)
        return inverse(point, math.atan2(aim_z_m - z_m, away_m - r_m), CAMERA_IN_HAND_M)

    return _first_clear(draw)


def _servo_look(world: World, robot: str, plant: str, fruit: list[Fruit], rng: np.random.Generator) -> Joints:
    """The camera 0.13 to 0.3 m before one of the plant's fruit, looking more or less at it."""
    base = world.robots[robot].pose
    cos, sin = math.cos(base.yaw_rad), math.sin(base.yaw_rad)
    mine = [one for one in fruit if one.plant_id == plant]
    if not mine:
        return _scan_look(rng)

    def draw() -> Joints:
        x, y, z = mine[int(rng.integers(len(mine)))].centre_m - np.array([base.x_m, base.y_m, 0.0])
        x, y = cos * x + sin * y, -sin * x + cos * y
        pan, pitch = math.atan2(y, x - SHOULDER_X_M), math.radians(rng.uniform(-45.0, 35.0))
        reach = math.hypot(x - SHOULDER_X_M, y) - math.cos(pitch) * (near_m := rng.uniform(0.13, 0.30))
        point: Point3 = (
            SHOULDER_X_M + reach * math.cos(pan) + rng.normal(0.0, 0.02) * -math.sin(pan),
            reach * math.sin(pan) + rng.normal(0.0, 0.02) * math.cos(pan),
            float(z) - math.sin(pitch) * near_m + rng.normal(0.0, 0.02),
        )
        return inverse(point, pitch, CAMERA_IN_HAND_M)

    return _first_clear(draw)


def _first_clear(draw: Any) -> Joints:
    for _ in range(_TRIES):
        try:
            q: Joints = draw()
        except Refused:
            continue
        if not obstruction(q, SOIL_HEIGHT_M):
            return q
    raise Refused("no pose of the arm is clear", hint="another plant")


def _intrinsics(camera: Camera) -> dict[str, Any]:
    lens = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return {name: round(value, 4) for name, value in lens.items()} | {"distortion": list(camera.distortion)}


def _boxes(view: View, raster: Raster, fruit: list[Fruit]) -> list[dict[str, Any]]:
    pixels = np.bincount(raster.ids[raster.ids >= 0], minlength=len(view.geoms.kind))
    R, eye = view.T_world_cam[:3, :3], view.T_world_cam[:3, 3]
    seen = ((one, (one.centre_m - eye) @ R) for one in fruit if pixels[one.geom] > 0)
    boxes = [_box(view.camera, one, p_cam, int(pixels[one.geom])) for one, p_cam in seen if p_cam[2] > 2 * one.radius_m]
    return [box for box in boxes if box["visible_ratio"] >= VISIBLE_RATIO_MIN and min(box["w"], box["h"]) > 0]


def _box(camera: Camera, fruit: Fruit, p_cam: Floats, pixels: int) -> dict[str, Any]:
    u, v, radius = sphere_outline(camera, p_cam, fruit.radius_m)
    x0, x1 = max(0.0, u - radius), min(float(camera.width), u + radius)
    y0, y1 = max(0.0, v - radius), min(float(camera.height), v + radius)
    ratio = min(1.0, pixels / (math.pi * radius * radius))
    box = {
        "x": round(x0, 2),
        "y": round(y0, 2),
        "w": round(x1 - x0, 2),
        "h": round(y1 - y0, 2),
        "label": colour_of(fruit.ripeness),
        "fruit_id": fruit.fruit_id,
        "ripeness": round(fruit.ripeness, 3),
        "visible_ratio": round(ratio, 3),
        "u": round(u, 2),
        "v": round(v, 2),
        "radius": round(radius, 2),
    }
    hard = ratio < dataset.VISIBLE_RATIO_MIN or radius < RADIUS_SHARE_MIN * camera.width
    return box | ({"difficult": 1} if hard else {})


def write(folder: Path, count: int, seed: int) -> int:
    """Frames into `folder`; returns how many fruit are labelled and not difficult."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    entries = []
    for index, frame in enumerate(frames(count, seed)):
        name = f"images/r{seed}-{index:05d}.png"
        cv2.imwrite(str(folder / name), frame.picture)
        entries.append({"file": name, **frame.labels})
    dataset.write(folder, entries)
    return sum("difficult" not in box for entry in entries for box in entry["boxes"])


def render_command(
    out: Annotated[Path, typer.Option("--out", help="Folder for images/ and labels.json")],
    n: Annotated[int, typer.Option("--n", min=1, help="How many frames")] = 120,
    seed: Annotated[int, typer.Option("--seed", min=0)] = 7,
) -> None:
    """Render labelled frames of the hand camera in simulated gardens."""
    began_s = time.monotonic()
    fruit = write(out, n, seed)
    Console(stderr=True).print(f"{n} frames, {fruit} fruit in {time.monotonic() - began_s:.0f} s: {out}", highlight=False)


if __name__ == "__main__":
    typer.run(render_command)
