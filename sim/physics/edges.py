"""Cliff sensors and hanging casters, against the slab's outline."""

from __future__ import annotations

import math
from dataclasses import dataclass

from core.scenario import Arena
from sim.physics.pose import Planar
from sim.scene.gardener import FRONT_CASTER_X_M

SENSOR_RADIUS_M = 0.160
SENSOR_RAD = tuple(math.radians(a) for a in (60.0, 15.0, -15.0, -60.0))
"""Left, front left, front right, right."""
_SENSORS_M = tuple((SENSOR_RADIUS_M * math.cos(a), SENSOR_RADIUS_M * math.sin(a)) for a in SENSOR_RAD)
_CASTER_M = (FRONT_CASTER_X_M, 0.0)
REACH_M = 0.161
"""No sensor lies further from the middle."""
WHEEL_DROP_M = 0.008
"""A wheel that hangs further out than this has nothing under it."""


@dataclass(frozen=True, slots=True)
class Edges:
    """What lies below: four cliff sensors (left .. right) and the front caster."""

    cliffs: tuple[bool, bool, bool, bool]
    caster: bool


FLOOR = Edges((False, False, False, False), False)


def edges(pose: Planar, arena: Arena) -> Edges:
    """True where there is no floor within the sensors' reach."""
    sunk, half_x_m, half_y_m = abs(pose.z_m) > 0.04, arena.length_m / 2, arena.width_m / 2
    if not sunk and abs(pose.x_m) < half_x_m - REACH_M and abs(pose.y_m) < half_y_m - REACH_M:
        return FLOOR

    def beyond(point: tuple[float, float]) -> bool:
        wx, wy = pose.point(*point)
        return sunk or abs(wx) > half_x_m or abs(wy) > half_y_m

    left, front_left, front_right, right = map(beyond, _SENSORS_M)
    return Edges((left, front_left, front_right, right), beyond(_CASTER_M))
