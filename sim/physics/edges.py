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
WHEEL_DROP_M = 0.008
"""A wheel that hangs further out than this has nothing under it."""


@dataclass(frozen=True, slots=True)
class Edges:
    """What lies below: four cliff sensors (left .. right) and the front caster."""

    cliffs: tuple[bool, bool, bool, bool]
    caster: bool


def edges(pose: Planar, arena: Arena) -> Edges:
    """True where there is no floor within the sensors' reach."""
    sunk = abs(pose.z_m) > 0.04

    def beyond(x_m: float, y_m: float) -> bool:
        wx, wy = pose.point(x_m, y_m)
        return sunk or abs(wx) > arena.length_m / 2 or abs(wy) > arena.width_m / 2

    left, front_left, front_right, right = (
        beyond(SENSOR_RADIUS_M * math.cos(a), SENSOR_RADIUS_M * math.sin(a)) for a in SENSOR_RAD
    )
    return Edges((left, front_left, front_right, right), beyond(FRONT_CASTER_X_M, 0.0))
