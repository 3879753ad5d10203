"""Wavefront planning: the cost to a goal from everywhere, and the way down.

Source: paper 000, section 3 (1 cm cells on the configuration space); the queue is described in `kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.geometry.planar import Point, Pose, distance_m
from core.planning import kernels
from core.planning.grid import CSpace, GridMap
from core.robots import gardener

MARGIN_M = 0.02
"""Planned distance kept between the robot's body and anything."""
COMFORT_M = 0.08
"""Up to this much more, nearness costs extra."""
ESCAPE_M = 0.6
GOAL_SLACK_M = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """A polyline in the world frame."""

    points_m: NDArray[np.float64]
    """(N, 2), from the start to the goal."""
    escape_m: float = 0.0
    """How much of its beginning leads out of a place too near to something."""

    @property
    def length_m(self) -> float:
        return path_length_m(self.points_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Field:
    """The cost to one goal from every cell. Serves any number of starts."""

    space: CSpace
    goal: Point
    dist: NDArray[np.int32]

    def path_from(self, start: Point | Pose) -> Path | None:
        """The cheapest way from `start`, straightened; None when the goal cannot be reached."""
        begin = _entry(self.space, start, ESCAPE_M)
        if begin is None or self.dist[begin] == kernels.FAR:
            return None
        flat = self.space.weight.ravel()
        cells = kernels.descend(self.dist, self.space.width, begin)
        corners = kernels.shortcut(self.dist, flat, self.space.width, cells)
        inner = [self.space.point(int(cell)) for cell in corners]
        escaped = begin != self.space.index(start[0], start[1])
        middle = inner[:-1] if escaped else inner[1:-1]
        points = np.array([(start[0], start[1]), *middle, self.goal], dtype=np.float64)
        return Path(points_m=points, escape_m=distance_m(start, inner[0]) if escaped else 0.0)


def _entry(space: CSpace, point: Point | Pose, within_m: float) -> int | None:
    if space.is_free(point[0], point[1]):
        return space.index(point[0], point[1])
    return space.nearest_free(point[0], point[1], within_m)


def wavefront(space: CSpace, goal: Point | Pose) -> Field | None:
    """The full field from `goal`; None when the robot could not stand there."""
    end = _entry(space, goal, GOAL_SLACK_M)
    if end is None:
        return None
    dist = np.where(space.free, kernels.FAR, np.int32(-1)).ravel()
    if space.weighted:
        kernels.weighted_field(dist, space.weight.ravel(), space.width, end)
    else:
        kernels.plain_field(dist, space.width, end)
    at = (goal[0], goal[1]) if space.is_free(goal[0], goal[1]) else space.point(end)
    return Field(space=space, goal=at, dist=dist)


def plan(
    grid: GridMap,
    start: Point | Pose,
    goal: Point | Pose,
    *,
    radius_m: float = gardener.BODY_RADIUS_M + MARGIN_M,
    comfort_m: float = COMFORT_M,
) -> Path | None:
    """A path of a robot of `radius_m` from start to goal (world frame [m]); None when there is none.

    A start too near to something first leads to the nearest place that is not.
    """
    field = wavefront(grid.inflate(radius_m, comfort_m), goal)
    return field.path_from(start) if field is not None else None


def path_length_m(points_m: NDArray[np.float64]) -> float:
    """Length of a polyline (N, 2) [m]."""
    return float(np.linalg.norm(np.diff(points_m, axis=0), axis=1).sum())


def warm() -> None:
    """Compile every kernel, or load it from numba's cache."""
    grid = GridMap.of_arena(0.6, 0.4)
    grid.add_box(0.0, 0.05, 0.0, 0.05, 0.2)
    for comfort_m in (0.0, 0.05):
        plan(grid, (-0.2, 0.1), (0.2, 0.1), radius_m=0.02, comfort_m=comfort_m)
