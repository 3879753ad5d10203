"""A detector that is told the truth and errs at stated rates: judges tell by it what bookkeeping does with a good eye.

No algorithm of the garden reads the truth. This stands in for the detector alone (`ROBOT_DETECTOR=lab.stand_in:detect`),
when what comes after it is under test.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from core.geometry.pinhole import sphere_outline
from core.perception.detection import COLOURS, Detection, Image
from lab.garden import Garden
from lab.orchard import lens
from sim.camera.geoms import geoms_of
from sim.camera.raster import rasterise

NAME = "lab.stand_in:detect"
SHOWN_RATIO_MIN = 0.35
"""A fruit that shows less of its disc is not found."""
NEAR_M, FAR_M = 0.09, 0.8
OFF_RATIO = 0.05
"""Of the radius: deviation of the circle's centre and of its radius."""
RECALL, PRECISION = 0.92, 0.98
COLOUR_ERROR = 0.03
"""So often the colour is that of the neighbouring stage."""
CONFIDENCE = 0.9
FALSE_RADIUS_PX = 20.0

_looked_at: list[tuple[Garden, str]] = []


@contextmanager
def looking_at(garden: Garden, robot_id: str) -> Iterator[None]:
    """While in it, `detect` tells what the robot's camera in this garden sees."""
    _looked_at.append((garden, robot_id))
    try:
        yield
    finally:
        _looked_at.pop()


def detect(image: Image) -> list[Detection]:
    """The fruit before the camera, some of them missed, some of the wrong colour, some that are none."""
    garden, robot_id = _looked_at[-1]
    world, camera = garden.world, lens()
    eye = world.model.camera(f"{robot_id}/eye").id
    R = world.data.cam_xmat[eye].reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
    at = world.data.cam_xpos[eye]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, at
    geoms = geoms_of(world.model, world.data)
    shown = geoms.visible.copy()
    shown[world.model.geom(f"{robot_id}/camera").id] = False
    ids = rasterise(camera, T, replace(geoms, visible=shown), normals=False).ids
    rng, balls = np.random.default_rng((garden.seed, round(world.time_s * 1000))), world.orchard.balls()
    found: list[Detection] = []
    for fruit in (fruit for plant in garden.truth().plants for fruit in plant.fruit):
        p = R.T @ (np.array([fruit.position_world.x_m, fruit.position_world.y_m, fruit.position_world.z_m]) - at)
        if p[2] < NEAR_M or np.linalg.norm(p) > FAR_M:
            continue
        u, v, r = sphere_outline(camera, p, fruit.radius_m)
        if float((ids == balls[fruit.id]).sum()) < SHOWN_RATIO_MIN * math.pi * r * r or rng.random() > RECALL:
            continue
        found.append(_erring(rng, u, v, r, COLOURS.index(fruit.colour)))
    false = rng.poisson((1.0 / PRECISION - 1.0) * len(found))
    height, width = image.shape[:2]
    return found + [
        _erring(rng, rng.uniform(0, width), rng.uniform(0, height), 20.0, int(rng.integers(3))) for _ in range(false)
    ]


def _erring(rng: np.random.Generator, u: float, v: float, r: float, colour: int) -> Detection:
    du, dv, dr = rng.normal(0.0, OFF_RATIO * r, 3)
    if rng.random() < COLOUR_ERROR:
        colour = min(2, max(0, colour + int(rng.choice((-1, 1)))))
    return Detection(u_px=u + du, v_px=v + dv, radius_px=max(2.0, r + dr), colour=COLOURS[colour], confidence=CONFIDENCE)
