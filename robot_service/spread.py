"""Where an idle robot waits: now and then it looks whether the robots around it and it could be nearer to the docks."""

from __future__ import annotations

from dataclasses import dataclass

from core.allocation.bidding import BATTERY_ENOUGH_RATIO, Travel, ride_s
from core.allocation.coverage import Ways, better_place
from core.allocation.right_of_way import KEEP_M, RANK_IDLE, SILENT_S
from core.geometry.planar import Point, distance_m
from core.robots.garden_map import KnownDock
from core.wire.robot import Position
from robot_service import neighbours
from robot_service.robot import Robot, launch_of

EVERY_S = 60.0
"""One decision so often at most."""
FAILED_S = 600.0
"""After a dock that could not be reached."""
BUSY_LOOKS_MAX = 5
"""Whoever drives is not judged by where it is just now; but in a large garden somebody always drives."""
DOCKS_MAX = 24
"""The nearest ones: no robot looks after a whole estate."""
ROW_COST_S = 0.002


@dataclass(frozen=True, slots=True)
class _Spot:
    """Where a robot stands; `dock` is empty between docks."""

    dock: str
    at: Point

    @property
    def coarse(self) -> tuple[str, float, float]:
        return self.dock, round(2 * self.at[0]), round(2 * self.at[1])


@dataclass(slots=True)
class Spread:
    """One robot's choice of a waiting place."""

    robot: Robot
    travel: Travel
    _next_s: float | None = None
    _busy_looks: int = 0
    _stayed: object = None
    """What it knew when it last chose to stay: while that is so there is nothing to decide."""

    def later(self, seconds: float | None = None) -> None:
        """Look no sooner; None: no sooner than it has been idle for a while again."""
        self._next_s = None if seconds is None else self.robot.clock.now() + seconds

    async def place(self) -> str:
        """The dock to wait at from now on; empty to stay. Cheap, and mostly nothing, however often it is asked."""
        after_s, now_s = self.robot.settings.spread_after_s, self.robot.clock.now()
        if self._next_s is None:
            self._next_s = now_s + after_s
        if not after_s or now_s < self._next_s:
            return ""
        self._next_s = now_s + EVERY_S * (1.0 + 0.4 * self.robot.rng.random())
        if not self._may_leave() or self._seen() == self._stayed:
            return ""
        await self.robot.neighbours.poll()
        said = self._said()
        if any(one.rank == RANK_IDLE and one.moving for one in said):
            return ""  # one at a time, so that no two go to the same dock
        self._busy_looks += 1
        if any(one.moving for one in said) and self._busy_looks < BUSY_LOOKS_MAX:
            return ""
        self._busy_looks, seen = 0, self._seen()
        chosen = await self._choose(said)
        self._stayed = None if chosen else seen
        return chosen

    def _may_leave(self) -> bool:
        """Knows where it is, and has more than it needs."""
        state = self.robot.body.state
        return state is not None and state.battery_ratio >= BATTERY_ENOUGH_RATIO and self.robot.where.pose is not None

    def _said(self) -> list[Position]:
        """The neighbours' newest words. Who has not answered for long serves nobody."""
        since_s = self.robot.clock.now() - neighbours.IDLE_EVERY_S - SILENT_S
        return [heard.position for heard in self.robot.neighbours.heard.values() if heard.at_s >= since_s]

    def _here(self) -> _Spot:
        x_m, y_m, _ = self.robot.pose()
        return _Spot(self.robot.where.docked_at, (x_m, y_m))

    def _seen(self) -> object:
        return self.robot.ground.version, self._here().coarse, sorted(_spot(said).coarse for said in self._said())

    async def _choose(self, said: list[Position]) -> str:
        here = self._here()
        docks = sorted(self.robot.settings.map.docks, key=lambda dock: distance_m(here.at, _at(dock)))[:DOCKS_MAX]
        pots = {pot.plant_id for pot in self.robot.settings.map.pots}
        asking = [dock.name for dock in docks if dock.name in pots]
        free = [dock.name for dock in docks if self._is_free(dock, said)]
        if not asking or not free:
            return ""
        mine, *theirs = [await self._ways(spot, asking) for spot in (here, *map(_spot, said))]
        places = {name: await self._ways(_Spot(name, here.at), asking) for name in free}
        return better_place(mine, theirs, places) or ""

    async def _ways(self, spot: _Spot, docks: list[str]) -> Ways:
        """Away from the loop: the first time it takes milliseconds a dock."""
        return await self.robot.clock.offload(lambda: {dock: self._way_s(spot, dock) for dock in docks}, ROW_COST_S)

    def _way_s(self, spot: _Spot, dock: str) -> float | None:
        if self.robot.settings.map.dock(spot.dock) is not None:
            return self.travel(spot.dock, dock)
        x_m, y_m, _ = launch_of(self.robot.dock(dock))
        length_m = self.robot.ground.length_m(spot.at, (x_m, y_m))
        return None if length_m is None else ride_s(length_m)

    def _is_free(self, dock: KnownDock, said: list[Position]) -> bool:
        """Its owner is here, it is no tap, and nobody stands there or is about to."""
        if dock.tap or self.robot.peers.find(dock.owner) is None:
            return False
        return not any(one.docked_at == dock.name or _comes_near(one, dock) for one in said)


def _spot(said: Position) -> _Spot:
    return _Spot(said.docked_at, (said.pose.x_m, said.pose.y_m))


def _at(dock: KnownDock) -> Point:
    return dock.pose.x_m, dock.pose.y_m


def _comes_near(said: Position, dock: KnownDock) -> bool:
    x_m, y_m, _ = launch_of(dock)
    ahead = [(said.pose.x_m, said.pose.y_m), *((point.x_m, point.y_m) for point in said.route)]
    return any(distance_m(point, place) < KEEP_M for point in ahead for place in ((x_m, y_m), _at(dock)))
