"""The ground a robot drives on: the known garden, what it bumped into, and where others are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from core.allocation.right_of_way import CLEAR_M, KEEP_M, Other, along, growth_m, route_gap_m
from core.geometry.planar import Point, Pose
from core.planning.grid import CSpace, GridMap
from core.planning.kernels import FAR
from core.planning.wavefront import COMFORT_M, MARGIN_M, Field, Path, wavefront
from core.robots import gardener
from core.robots.garden_map import DOCK_RADIUS_M, GardenMap

RADIUS_M = gardener.BODY_RADIUS_M + MARGIN_M
EDGE_M = 0.03
"""The arena's edge is a drop: planned paths keep this much more from it."""
BUMP_RADIUS_M = 0.08
BUMP_LIFE_S = 30.0
OTHER_RADIUS_M = KEEP_M - RADIUS_M + CLEAR_M
"""A neighbour as an obstacle, so that inflated it keeps KEEP_M and a little."""


@dataclass(slots=True)
class Bumped:
    """Something that was touched where the map shows nothing."""

    x_m: float
    y_m: float
    until_s: float


@dataclass(slots=True)
class Ground:
    """The robot's map. Fields are computed once a goal and version of the map."""

    garden: GardenMap
    cell_m: float = 0.01
    version: int = 0
    bumped: list[Bumped] = field(default_factory=list)
    _fixed: GridMap = field(init=False)
    _spaces: dict[int, CSpace] = field(default_factory=dict)
    _fields: dict[Point, Field | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._fixed = _drawn(self.garden, self.cell_m)

    def mark(self, x_m: float, y_m: float, now_s: float) -> None:
        """Remember a bump for a while, and forget old ones."""
        self.bumped = [b for b in self.bumped if b.until_s > now_s] + [Bumped(x_m, y_m, now_s + BUMP_LIFE_S)]
        self._renew()

    def forget(self, now_s: float) -> None:
        if any(b.until_s <= now_s for b in self.bumped):
            self.bumped = [b for b in self.bumped if b.until_s > now_s]
            self._renew()

    def _renew(self) -> None:
        self.version += 1
        self._fields.clear()
        self._spaces.clear()

    def fixed(self) -> CSpace:
        """Without the others."""
        if 0 not in self._spaces:
            self._spaces[0] = self._grid().inflate(RADIUS_M, COMFORT_M)
        return self._spaces[0]

    def _grid(self) -> GridMap:
        grid = self._fixed.copy()
        for bump in self.bumped:
            grid.add_disc(bump.x_m, bump.y_m, BUMP_RADIUS_M)
        return grid

    def field_to(self, goal: Point) -> Field | None:
        """The wavefront from `goal` on the ground without others; kept until the map changes."""
        if goal not in self._fields:
            if len(self._fields) > 64:
                self._fields.clear()
            self._fields[goal] = wavefront(self.fixed(), goal)
        return self._fields[goal]

    def knows(self, goal: Point) -> bool:
        """The field to `goal` is at hand."""
        return goal in self._fields

    def length_m(self, start: Point | Pose, goal: Point) -> float | None:
        """Length of the way on the ground without others, by a lookup; None when there is no way."""
        reached = self.field_to(goal)
        if reached is None:
            return None
        path = reached.path_from((start[0], start[1]))
        return None if path is None else path.length_m

    def with_others(
        self, discs: Iterable[Other], routes: Iterable[Sequence[Point]], me: Point | Pose, *, tight: bool = False
    ) -> CSpace:
        """Others as discs, grown by what they may have driven since, and routes as corridors. Growth never swallows `me`.

        `tight`: discs where they were last heard, and not a centimetre more than nobody may come nearer.
        """
        grid = self._grid()
        for other in discs:
            more_m = -CLEAR_M if tight else _growth(other, me)
            grid.add_disc(other.x_m, other.y_m, OTHER_RADIUS_M + more_m)
        for route in routes:
            for x_m, y_m in along(route):
                grid.add_disc(x_m, y_m, OTHER_RADIUS_M)
        return grid.inflate(RADIUS_M, COMFORT_M)

    def path(self, space: CSpace, start: Pose, goal: Point) -> Path | None:
        if not space.is_free(*goal):
            return None
        reached = wavefront(space, goal)
        return None if reached is None else reached.path_from(start)

    def refuge(self, discs: Sequence[Other], routes: Sequence[Sequence[Point]], me: Pose) -> Point | None:
        """The place soonest reached from `me`, past everybody, that lies off the routes; None when there is none."""
        space = self.with_others(discs, (), me)
        reached = wavefront(space, _start(space, me))
        if reached is None:
            return None
        quiet = self.with_others(discs, routes, me).free.ravel()
        usable = np.where(quiet & (reached.dist >= 0), reached.dist, FAR)
        best = int(np.argmin(usable))
        return None if usable[best] == FAR else space.point(best)

    def clear(self, x_m: float, y_m: float) -> float:
        """Distance to the nearest fixed thing or edge [m]."""
        return self.fixed().clearance_at_m(x_m, y_m)


def _start(space: CSpace, me: Pose) -> Point:
    if space.is_free(me[0], me[1]):
        return me[0], me[1]
    near = space.nearest_free(me[0], me[1], 0.6)
    return (me[0], me[1]) if near is None else space.point(near)


def _growth(other: Other, me: Point | Pose) -> float:
    gap_m = float(np.hypot(other.x_m - me[0], other.y_m - me[1]))
    return max(0.0, min(growth_m(other), gap_m - KEEP_M - CLEAR_M - 0.03))


def _drawn(garden: GardenMap, cell_m: float) -> GridMap:
    grid = GridMap.of_arena(garden.length_m, garden.width_m, cell_m)
    border = max(1, round(EDGE_M / cell_m))
    grid.occupied[:border, :] = grid.occupied[-border:, :] = True
    grid.occupied[:, :border] = grid.occupied[:, -border:] = True
    for pot in garden.pots:
        grid.add_disc(pot.x_m, pot.y_m, pot.radius_m)
    reach_m = gardener.BODY_RADIUS_M + DOCK_RADIUS_M
    for dock in garden.docks:
        x_m = dock.pose.x_m + reach_m * float(np.cos(dock.pose.yaw_rad))
        y_m = dock.pose.y_m + reach_m * float(np.sin(dock.pose.yaw_rad))
        grid.add_disc(x_m, y_m, DOCK_RADIUS_M)
    return grid


def near_route(point: Point | Pose, route: Sequence[Point]) -> bool:
    return route_gap_m(point, route) < KEEP_M + CLEAR_M
