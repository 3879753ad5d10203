"""What a camera's view should have shown: pure Python, for the plant."""

from __future__ import annotations

import math
from collections.abc import Sequence

from core.inventory.track import Track, point
from core.wire.fruit import View

MARGIN_RATIO = 0.9
"""Near its edge a picture cuts fruit off: only the inner part counts as seen."""

Vector = tuple[float, float, float]


def in_view(view: View, p: Vector) -> bool:
    """Whether a point (plant frame) lies within the view's pyramid and its range."""
    look = _unit((view.look.x, view.look.y, view.look.z))
    right = _unit(_cross(look, (view.up.x, view.up.y, view.up.z)))
    up = _cross(right, look)
    ray = _minus(p, point(view))
    ahead = _dot(ray, look)
    if not (ahead > 0.0 and view.range_m_min <= math.hypot(*ray) <= view.range_m_max):
        return False
    across = math.tan(0.5 * view.fov_x_rad) * MARGIN_RATIO
    along = math.tan(0.5 * view.fov_y_rad) * MARGIN_RATIO
    return abs(_dot(ray, right)) <= ahead * across and abs(_dot(ray, up)) <= ahead * along


def blocked(view: View, fruit: Track, others: Sequence[Track]) -> bool:
    """Whether another known fruit hangs before this one's centre."""
    eye, ray = point(view), _minus(fruit.p, point(view))
    distance = math.hypot(*ray)
    if distance < 1e-6:
        return False
    to = _scaled(ray, 1.0 / distance)
    for other in others:
        if other.fruit.fruit_id == fruit.fruit.fruit_id:
            continue
        way = _minus(other.p, eye)
        ahead = _dot(way, to)
        if 0.0 < ahead < distance - fruit.fruit.radius_m and math.dist(way, _scaled(to, ahead)) < other.fruit.radius_m:
            return True
    return False


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _scaled(a: Vector, by: float) -> Vector:
    return a[0] * by, a[1] * by, a[2] * by


def _unit(a: Vector) -> Vector:
    length = math.hypot(*a)
    return _scaled(a, 1.0 / length) if length > 1e-9 else (0.0, 0.0, 0.0)
