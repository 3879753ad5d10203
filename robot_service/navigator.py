"""One drive from here to a pose, among others, as a function of time: called 25 times a second, it never waits by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from core.allocation.right_of_way import (
    KEEP_M,
    RANK_DRIVING,
    ROUTE_M,
    Other,
    along,
    goes_first,
    in_the_way_of,
    route_gap_m,
    speed_limit_mps,
)
from core.geometry.planar import Point, Pose, distance_m
from core.planning.follow import PathFollower
from core.planning.wavefront import Path
from robot_service.ground import Ground, near_route

LOOK_S = 0.5
"""The others are looked at anew this often."""
DETOUR_RATIO, DETOUR_M = 1.3, 0.5
"""Going round somebody who stands still may cost this much; beyond it he is expected to give way."""
OFF_PATH_M = 0.15
PATIENCE_S = 8.0
"""Blocked this long by somebody who should give way, plan as if he never will."""
RETREAT_S = 20.0
"""Blocked this long by anybody, retreat to a refuge and try again."""
REFUGE_REST_S = 3.0
STUCK_S = 180.0
NEARER_M = 0.05
WANTED_POINTS = 1 + round(ROUTE_M / 0.25)
CREEP_MPS = 0.02
ZONE_M = 0.75


@dataclass(frozen=True, slots=True, kw_only=True)
class Going:
    """What to do now. `waiting` is the reason for standing still; `failed` ends the drive."""

    v_mps: float = 0.0
    omega_radps: float = 0.0
    waiting: str = ""
    done: bool = False
    failed: str = ""


@dataclass(slots=True)
class Navigator:
    """Plans on the ground with others in it, follows, gives way, replans. Pure but for its own memory."""

    ground: Ground
    me: str
    goal: Pose
    rank: int = RANK_DRIVING
    yaw_matters: bool = True
    may_enter: Callable[[], str] = field(default=lambda: "")
    """Why the neighbourhood of `zone` may not be entered yet; empty when it may."""
    zone: tuple[Point, ...] = ()
    """The way in and out of the dock it drives to; whoever waits for that dock keeps ZONE_M away."""
    v_mps_max: float = 0.3
    _follower: PathFollower | None = None
    _aim: Literal["goal", "refuge"] = "goal"
    _looked_s: float = -1e9
    _moved_s: float | None = None
    _began_s: float | None = None
    _rest_until_s: float = 0.0
    _planned: tuple[object, ...] = ()
    _blocked_by: str = ""
    _why: str = ""
    _held: bool = False
    _wanted: tuple[Point, ...] = ()
    """The way it would go were nobody in it, while there is none: whoever gives way must know what to leave free."""
    _left_m: float = math.inf
    _nearer_s: float = -1e9
    """The least way that was ever left, and when it last became less."""
    replans: int = 0

    def route(self) -> list[Point]:
        """The next metres it means to drive, for the neighbours."""
        if self._follower is None:
            return list(self._wanted)
        if self._held or self._aim == "refuge":
            return []
        return self._follower.ahead(ROUTE_M)

    def remaining_m(self) -> float | None:
        return None if self._follower is None or self._aim == "refuge" else self._follower.remaining_m

    def bumped(self) -> None:
        """The way was wrong: plan anew from wherever we are now."""
        self._follower, self._looked_s, self._aim = None, -1e9, "goal"

    def step(self, pose: Pose, now_s: float, others: Sequence[Other]) -> Going:
        if self._began_s is None or self._moved_s is None:
            self._began_s = self._moved_s = self._nearer_s = now_s
        if now_s - self._looked_s >= LOOK_S or self._off_path():
            self._looked_s = now_s
            self._look(pose, now_s, others)
        self._note_progress(now_s)
        if now_s - min(self._moved_s, self._nearer_s) > STUCK_S:
            return Going(failed=f"no progress for {STUCK_S:.0f} s: {self._why or 'the way is blocked'}")
        if self._follower is None:
            return Going(waiting=self._why or "no way to go")
        if self._held_back(pose):
            self._moved_s = self._nearer_s = now_s
            return Going(waiting=self._why)
        return self._follow(pose, now_s, others)

    def _note_progress(self, now_s: float) -> None:
        """Going to and fro is none."""
        left_m = self.remaining_m()
        if left_m is not None and left_m < self._left_m - NEARER_M:
            self._left_m, self._nearer_s = left_m, now_s

    def _off_path(self) -> bool:
        return self._follower is not None and self._follower.off_path_m > OFF_PATH_M

    def _held_back(self, pose: Pose) -> bool:
        """Wait at a distance until the last stretch may be entered."""
        assert self._follower is not None
        self._held = False
        if self._aim == "goal" and route_gap_m(pose, self.zone) < ZONE_M and (why := self.may_enter()):
            self._held, self._why = True, why
        return self._held

    def _follow(self, pose: Pose, now_s: float, others: Sequence[Other]) -> Going:
        assert self._follower is not None
        step = self._follower.step(pose, now_s)
        if step.done:
            return self._arrived(now_s)
        limit_mps, by = speed_limit_mps(pose, step.v_mps >= 0, others)
        if abs(step.v_mps) > limit_mps:
            share = limit_mps / abs(step.v_mps)
            step = step._replace(v_mps=step.v_mps * share, omega_radps=step.omega_radps * share)
            self._blocked_by = by
        blocked = limit_mps < CREEP_MPS and abs(step.v_mps) < CREEP_MPS and abs(step.omega_radps) < 0.05
        if blocked:
            self._why = f"{by} is in the way"
            return Going(waiting=self._why)
        self._moved_s, self._why = now_s, ""
        return Going(v_mps=step.v_mps, omega_radps=step.omega_radps)

    def _arrived(self, now_s: float) -> Going:
        self._moved_s = now_s
        if self._aim == "goal":
            return Going(done=True)
        self._follower, self._rest_until_s, self._why = None, now_s + REFUGE_REST_S, "gave way"
        return Going(waiting=self._why)

    def _look(self, pose: Pose, now_s: float, others: Sequence[Other]) -> None:
        """Choose what to aim at, and plan when the present plan no longer holds."""
        assert self._moved_s is not None
        self.ground.forget(now_s)
        waited_s = now_s - self._moved_s
        before = in_the_way_of((self.rank, self.me), pose, others)
        if before is not None:
            self._why = f"gives way to {before.robot_id}"
            self._flee(pose, others)
            return
        if self._aim == "refuge" and self._follower is not None and waited_s <= PATIENCE_S:
            return
        if now_s < self._rest_until_s:
            return
        if waited_s > RETREAT_S and math.fmod(waited_s, RETREAT_S) < LOOK_S:
            self._flee(pose, others, from_all=True)
            return
        self._plan(pose, others, patient=waited_s < PATIENCE_S)

    def _plan(self, pose: Pose, others: Sequence[Other], patient: bool) -> None:
        me = (self.rank, self.me)
        yielding = [o for o in others if goes_first(me, o)] if patient else []
        firm = [o for o in others if o not in yielding]
        stamp = self._stamp(yielding, firm)
        if self._aim == "goal" and stamp == self._planned and self._follower is not None and not self._off_path():
            return
        self._wanted = ()
        path = self._way(pose, yielding, firm)
        if path is None:
            self._follower, self._planned = None, ()
            return
        self._set(path, "goal")
        self._planned = stamp

    def _stamp(self, yielding: Sequence[Other], firm: Sequence[Other]) -> tuple[object, ...]:
        """What the plan depends on; others' places only as finely as matters."""
        firm_at = tuple((o.robot_id, round(o.x_m, 1), round(o.y_m, 1), _coarse(o.route)) for o in firm)
        still_at = tuple((o.robot_id, round(o.x_m, 1), round(o.y_m, 1)) for o in yielding if not o.moving)
        return (self.ground.version, firm_at, still_at)

    def _way(self, pose: Pose, yielding: Sequence[Other], firm: Sequence[Other]) -> Path | None:
        """The shortest acceptable path: round everybody firm and their routes, round those who stand if that is cheap."""
        goal = (self.goal[0], self.goal[1])
        self.replans += 1
        me = (self.rank, self.me)
        routes = [o.route for o in firm if o.route and not o.silent and (o.moving or not goes_first(me, o))]
        still = [o for o in yielding if not o.moving]
        free = self.ground.path(self.ground.with_others(firm, routes, pose), pose, goal)
        if free is None and (free := self._past(pose, firm)) is not None and any(self._crosses(free, r) for r in routes):
            self._why = "waits for " + ", ".join(o.robot_id for o in firm if o.route) + " to pass"
            return None
        if free is None:
            self._why, self._wanted = self._closed(goal, firm), self._straight(pose, goal)
            return None
        if not still:
            return free
        around = self.ground.path(self.ground.with_others([*firm, *still], routes, pose), pose, goal)
        cheap = around is not None and around.length_m <= DETOUR_RATIO * free.length_m + DETOUR_M
        return around if cheap else free

    def _past(self, pose: Pose, firm: Sequence[Other]) -> Path | None:
        """A path past those who stay, whatever they mean to drive. Who gave way may stand at the very edge of what must
        be free, and word of it be old: speed limits see to both, so a tight way is one."""
        goal = (self.goal[0], self.goal[1])
        wide = self.ground.path(self.ground.with_others(firm, (), pose), pose, goal)
        return wide or self.ground.path(self.ground.with_others(firm, (), pose, tight=True), pose, goal)

    def _straight(self, pose: Pose, goal: Point) -> tuple[Point, ...]:
        """The next metres of the way on the ground without others."""
        field = self.ground.field_to(goal)
        path = None if field is None else field.path_from(pose)
        return () if path is None else tuple(along([(float(x), float(y)) for x, y in path.points_m], 0.25)[:WANTED_POINTS])

    def _crosses(self, path: Path, route: Sequence[Point]) -> bool:
        return any(near_route((float(x), float(y)), route) for x, y in path.points_m[1:])

    def _closed(self, goal: Point, firm: Sequence[Other]) -> str:
        if self.ground.field_to(goal) is None:
            return "the goal lies in an obstacle"
        at_goal = [o.robot_id for o in firm if distance_m((o.x_m, o.y_m), goal) < KEEP_M + 0.1]
        return f"{at_goal[0]} stands at the goal" if at_goal else "no way round " + ", ".join(o.robot_id for o in firm)

    def _flee(self, pose: Pose, others: Sequence[Other], from_all: bool = False) -> None:
        """Head for the nearest place off everybody's route; stay when there is none."""
        self._wanted = ()
        if self._aim == "refuge" and self._follower is not None and not from_all:
            return
        me = (self.rank, self.me)
        routes = [o.route for o in others if o.route and (from_all or not goes_first(me, o))]
        place = self.ground.refuge(list(others), routes, pose)
        if place is None:
            self._follower = None
            return
        space = self.ground.with_others(others, (), pose)
        path = self.ground.path(space, pose, place)
        if path is not None:
            self._set(path, "refuge")

    def _set(self, path: Path, aim: Literal["goal", "refuge"]) -> None:
        self._aim = aim
        yaw = self.goal[2] if aim == "goal" and self.yaw_matters else None
        tolerance_m = 0.008 if aim == "goal" else 0.03
        self._follower = PathFollower(
            path.points_m, yaw, v_mps_max=self.v_mps_max, clearance=self.ground.clear, tolerance_m=tolerance_m
        )


def _coarse(route: Sequence[Point]) -> tuple[tuple[float, float], ...]:
    return tuple((round(x, 1), round(y, 1)) for x, y in route)
