"""The garden from above, a little tilted, with names and moisture written in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from core.geometry.pinhole import Camera, from_fov, look_at, project
from sim.camera.geoms import Floats, Geoms, Paint
from sim.camera.raster import rasterise
from sim.camera.shade import Lamp, Light, Picture, cast_shadow, shade

WIDTH, HEIGHT = 960, 720
FOV_Y_DEG = 38.0
TILT_DEG = 55.0
"""Of the view, below the horizon."""
SHRUB_TOP_M = 1.0
MARGIN_PX = 36
JPEG_QUALITY = 85
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_INK, _PAPER = (245, 245, 245), (30, 28, 26)
_BAR_PX = (74, 9)
_SHADOW = (-0.42, -0.34, 0.92)
"""Direction to the lamp."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """A name at a point of the world; with `ratio`, a bar below it (moisture, 0-1, full scale `ratio_full`)."""

    p_world: tuple[float, float, float]
    text: str
    ratio: float | None = None
    ratio_full: float = 0.4
    threshold_ratio: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Arena:
    length_m: float
    width_m: float
    ceiling_m: float


def view_of(arena: Arena) -> tuple[Camera, Floats]:
    """Camera and T_world_cam (4, 4) that hold the arena and the shrubs in the frame."""
    camera = from_fov(WIDTH, HEIGHT, math.radians(FOV_Y_DEG))
    near, far = 1.0, 80.0
    for _ in range(30):
        middle = (near + far) / 2
        near, far = (near, middle) if _fits(camera, arena, middle) else (middle, far)
    return camera, _pose(far)


def _pose(distance_m: float) -> Floats:
    tilt = math.radians(TILT_DEG)
    target = np.array([0.0, 0.0, 0.2])
    eye = target + distance_m * np.array([0.0, -math.cos(tilt), math.sin(tilt)])
    return look_at(eye, target, np.array([0.0, 0.0, 1.0]))


def _fits(camera: Camera, arena: Arena, distance_m: float) -> bool:
    x, y = arena.length_m / 2, arena.width_m / 2
    floor = [(sx * x, sy * y, 0.0) for sx in (-1, 1) for sy in (-1, 1)]
    tops = [(sx * x * 0.8, sy * y * 0.7, SHRUB_TOP_M) for sx in (-1, 1) for sy in (-1, 1)]
    p = project(camera, _pose(distance_m), np.array(floor + tops))
    u, v = p[:, 0], p[:, 1]
    inside = (u > MARGIN_PX) & (u < WIDTH - MARGIN_PX) & (v > MARGIN_PX) & (v < HEIGHT - MARGIN_PX)
    return bool((p[:, 2] > 0).all() and inside.all())


def draw(geoms: Geoms, paint: Paint, arena: Arena, labels: Sequence[Label], caption: str) -> Picture:
    """The picture (720, 960, 3) BGR; what hangs from the ceiling is left out. Slow (0.3 s): offload it."""
    geoms = replace(geoms, visible=geoms.visible & (geoms.pos[:, 2] < arena.ceiling_m - 0.4))
    camera, T_world_cam = view_of(arena)
    reach_m = math.hypot(arena.length_m, arena.width_m) / 2 + 0.6
    lamp_m = tuple(6 * reach_m * side for side in _SHADOW)
    lamp = Lamp(pos_m=(lamp_m[0], lamp_m[1], lamp_m[2]), rgb=(0.85, 0.83, 0.78))
    shadow = cast_shadow(lamp, geoms, (0.0, 0.0, 0.3), reach_m)
    picture = shade(camera, T_world_cam, rasterise(camera, T_world_cam, geoms), geoms, paint, Light(lamps=(lamp,)), shadow)
    _write_labels(picture, camera, T_world_cam, labels)
    _text(picture, caption, (12, HEIGHT - 12), 0.5)
    return picture


def _write_labels(picture: Picture, camera: Camera, T_world_cam: Floats, labels: Sequence[Label]) -> None:
    if not labels:
        return
    points = project(camera, T_world_cam, np.array([label.p_world for label in labels]))
    for label, (u, v, _) in zip(labels, points, strict=True):
        _label(picture, label, round(u), round(v))


def _label(picture: Picture, label: Label, u: int, v: int) -> None:
    text = label.text if label.ratio is None else f"{label.text}  {100 * label.ratio:.1f} %"
    width = cv2.getTextSize(text, _FONT, 0.45, 1)[0][0]
    u = min(max(u, width // 2 + 6), WIDTH - width // 2 - 6)
    _text(picture, text, (u - width // 2, v), 0.45)
    if label.ratio is not None:
        _bar(picture, label, u - _BAR_PX[0] // 2, v + 7)


def _bar(picture: Picture, label: Label, u: int, v: int) -> None:
    assert label.ratio is not None
    width, height = _BAR_PX
    colour = (70, 70, 225) if label.ratio < label.threshold_ratio else (225, 150, 60)
    fill = round(width * min(1.0, label.ratio / label.ratio_full))
    cv2.rectangle(picture, (u - 1, v - 1), (u + width + 1, v + height + 1), _PAPER, -1)
    cv2.rectangle(picture, (u, v), (u + fill, v + height), colour, -1)
    mark = u + round(width * min(1.0, label.threshold_ratio / label.ratio_full))
    cv2.line(picture, (mark, v - 2), (mark, v + height + 2), _INK, 1)


def _text(picture: Picture, text: str, at: tuple[int, int], size: float) -> None:
    (width, height), base = cv2.getTextSize(text, _FONT, size, 1)
    u, v = at
    box = picture[max(v - height - 4, 0) : v + base + 2, max(u - 4, 0) : u + width + 4]
    box[:] = (0.45 * box + 0.55 * np.array(_PAPER)).astype(np.uint8)
    cv2.putText(picture, text, at, _FONT, size, _INK, 1, cv2.LINE_AA)


def jpeg(picture: Picture, quality: int = JPEG_QUALITY) -> bytes:
    """The picture as a JPEG file."""
    ok, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError("the picture could not be encoded")
    return bytes(data)
