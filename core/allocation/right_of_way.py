"""Who goes first when robots meet, and how near they may come. Pure geometry on what neighbours last told of themselves.

Rules. (1) Nobody drives towards a place nearer than `KEEP_M` to where another may be by now. (2) Lower rank goes first,
ties by id: the later one plans round the earlier one's disc and the next metres of its route, and leaves that route when
it stands in it. (3) Whoever goes first plans as if the others will give way, except round those who stand still and cost
only a small detour.
Source: prioritised planning (Erdmann and Lozano-Perez, On Multiple Moving Objects).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from core.geometry.planar import Point, Pose
from core.robots import gardener

KEEP_M = 2 * gardener.BODY_RADIUS_M + 0.10
START_MPS = 0.15
"""How fast a robot that stood still when last heard may have left since, on average."""
GROWTH_M_MAX = 0.30
SILENT_S = 5.0
ROUTE_M = 1.5
BRAKE_S = 0.6
CLEAR_M = 0.06
"""Beyond KEEP_M, what somebody who gives way leaves free."""
RANK_BUSY, RANK_DRIVING, RANK_IDLE = 0, 1, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Other:
    """A neighbour as last heard of."""

    robot_id: str
    x_m: float
    y_m: float
    v_mps: float = 0.0
    moving: bool = False
    docked: bool = False
    rank: int = RANK_IDLE
    route: tuple[Point, ...] = ()
    age_s: float = 0.0

    @property
    def silent(self) -> bool:
        return self.age_s > SILENT_S


def goes_first(me: tuple[int, str], other: Other) -> bool:
    """True when `me` (rank, id) has the right of way; a silent or docked neighbour never gives way."""
    return not other.silent and not other.docked and me < (other.rank, other.robot_id)


def growth_m(other: Other) -> float:
    """How far it may have come since it was heard [m]."""
    if other.docked and not other.moving:
        return 0.0
    speed_mps = max(other.v_mps, gardener.CRUISE_MPS) if other.moving else START_MPS
    return min(GROWTH_M_MAX, speed_mps * other.age_s)


def keep_m(other: Other) -> float:
    """No centre may come nearer to its last known centre than this [m]."""
    return KEEP_M + growth_m(other)


def speed_limit_mps(pose: Pose, forward: bool, others: Iterable[Other]) -> tuple[float, str]:
    """The most a robot at `pose` may drive along its heading (or backwards), and the id of whoever limits it most."""
    yaw = pose[2] if forward else pose[2] + math.pi
    limit_mps, by = math.inf, ""
    for other in others:
        dx, dy = other.x_m - pose[0], other.y_m - pose[1]
        gap_m = math.hypot(dx, dy)
        towards = (math.cos(yaw) * dx + math.sin(yaw) * dy) / max(gap_m, 1e-9)
        if towards <= 0.0:
            continue
        allowed = max(0.0, gap_m - keep_m(other)) / BRAKE_S / towards
        aside_m = gap_m * math.sqrt(max(0.0, 1.0 - towards * towards))
        if aside_m >= keep_m(other):
            continue
        if allowed < limit_mps:
            limit_mps, by = allowed, other.robot_id
    return limit_mps, by


def route_gap_m(point: Point | Pose, route: Sequence[Point]) -> float:
    """Distance from a point to a polyline [m]; infinite for an empty one."""
    if len(route) == 1:
        return math.hypot(point[0] - route[0][0], point[1] - route[0][1])
    gaps = (_segment_gap_m(point, a, b) for a, b in pairwise(route))
    return min(gaps, default=math.inf)


def _segment_gap_m(p: Point | Pose, a: Point, b: Point) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    squared = dx * dx + dy * dy
    share = 0.0 if squared == 0.0 else max(0.0, min(1.0, ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / squared))
    return math.hypot(p[0] - a[0] - share * dx, p[1] - a[1] - share * dy)


def in_the_way_of(me: tuple[int, str], pose: Pose, others: Iterable[Other]) -> Other | None:
    """The neighbour with the right of way on whose route we stand, if any."""
    for other in others:
        blocked = not other.silent and not goes_first(me, other) and not _settled(other)
        if blocked and route_gap_m(pose, other.route) < KEEP_M:
            return other
    return None


def _settled(other: Other) -> bool:
    return other.docked and not other.route


def along(route: Sequence[Point], every_m: float = 0.1) -> list[Point]:
    """Points along a polyline, no further apart than `every_m`."""
    points: list[Point] = list(route[:1])
    for (ax, ay), (bx, by) in pairwise(route):
        count = max(1, math.ceil(math.hypot(bx - ax, by - ay) / every_m))
        points += [(ax + (bx - ax) * i / count, ay + (by - ay) * i / count) for i in range(1, count + 1)]
    return points
