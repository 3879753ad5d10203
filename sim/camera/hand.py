"""The view of the camera in a robot's hand, as a clean lens would have it."""

from __future__ import annotations

import math

from core.geometry.pinhole import Camera, from_fov
from core.robots.gardener import CAMERA_FOV_Y_DEG, CAMERA_PIXELS
from sim.camera.geoms import Floats, Geoms, Paint
from sim.camera.raster import rasterise
from sim.camera.shade import Lamp, Light, Picture, shade

LAMPS_TOTAL = 0.95
"""What all lamps together give to a surface that faces them."""


def camera(width: int, height: int) -> Camera:
    """The gardener's camera, read out at this size."""
    return from_fov(*CAMERA_PIXELS, math.radians(CAMERA_FOV_Y_DEG)).scaled(width, height)


def light_of(lamps_m: Floats, lamps_rgb: Floats) -> Light:
    """Lamps (L, 3) [m] of colours (L, 3), balanced so that a lit surface is neither dark nor burnt."""
    total = max(float(lamps_rgb.sum(axis=0).max(initial=0.0)), 1e-6)
    lamps = tuple(
        Lamp(pos_m=(p[0], p[1], p[2]), rgb=(c[0], c[1], c[2]))
        for p, c in zip(lamps_m.tolist(), (lamps_rgb * LAMPS_TOTAL / total).tolist(), strict=True)
    )
    return Light(lamps=lamps)


def draw(camera: Camera, T_world_cam: Floats, geoms: Geoms, paint: Paint, light: Light) -> Picture:
    """The picture (H, W, 3) BGR; slow (0.1 s at 640 x 480): offload it."""
    return shade(camera, T_world_cam, rasterise(camera, T_world_cam, geoms), paint, light)
