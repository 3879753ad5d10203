"""The ceiling's infrared markers: a document that the installer measured, which the world and the robots both read."""

from __future__ import annotations

import math

from core.scenario import Arena
from core.wire.geometry import Pose2

MARKER_ID_FIRST = 400
MARKER_ID_STEP = 2


def ceiling_markers(arena: Arena) -> dict[int, Pose2]:
    """Marker id -> its pose below the ceiling, in the world frame (x right and y forward of the marker are its axes).

    A centred grid, `marker_spacing_m` apart at most, so that no place on the arena is further than 0.71 of the spacing
    from one. Ids are even, like those of the sensor's dot pattern; rows run along x, from -y to +y.
    """
    xs = _spread(arena.length_m, arena.marker_spacing_m)
    ys = _spread(arena.width_m, arena.marker_spacing_m)
    places = [(x_m, y_m) for y_m in ys for x_m in xs]
    return {
        MARKER_ID_FIRST + MARKER_ID_STEP * index: Pose2(x_m=x_m, y_m=y_m, yaw_rad=0.0)
        for index, (x_m, y_m) in enumerate(places)
    }


def _spread(length_m: float, spacing_m: float) -> list[float]:
    """Centres of the fewest equal cells along `length_m` that are no wider than `spacing_m`."""
    count = max(1, math.ceil(length_m / spacing_m - 1e-9))
    cell_m = length_m / count
    return [(index + 0.5) * cell_m - length_m / 2 for index in range(count)]
