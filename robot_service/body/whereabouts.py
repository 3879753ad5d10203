"""Where the base stands, as far as its body can tell by itself: the last ceiling marker, and the wheels since then."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

from core.estimation.markers import world_pose
from core.geometry.planar import Pose, compose, distance_m
from core.wire.geometry import Pose2
from hw.ports import BaseReading, MarkerFix

READINGS = 40
"""At 50 Hz, so many go back further than a fix is old when it comes."""
JUMP_M = 0.2
"""A fix so far from where the wheels say is believed when the next one says the same: the sensor jumps now and then."""


class Whereabouts:
    """`place` is the base in the world frame; `seen_s` when a marker last confirmed it."""

    def __init__(self, markers: Mapping[int, Pose2], wheelbase_m: float) -> None:
        self._markers = {number: (p.x_m, p.y_m, p.yaw_rad) for number, p in markers.items()}
        self._wheelbase_m = wheelbase_m
        self._readings: deque[BaseReading] = deque(maxlen=READINGS)
        self._fix: MarkerFix | None = None
        self._doubted: Pose | None = None
        self.place: Pose | None = None
        self.seen_s = -math.inf

    def forget(self) -> None:
        """The wheels' counters began anew, or the robot was lifted: only a marker can tell."""
        self._readings.clear()
        self.place = self._doubted = None

    def look(self, base: BaseReading, fix: MarkerFix | None) -> None:
        """Take the newest readings."""
        last = self._readings[-1] if self._readings else None
        if last is None or base.stamp_s > last.stamp_s:
            self._readings.append(base)
            step = (0.0, 0.0, 0.0) if last is None else self._step(last, base)
            self.place = None if self.place is None else compose(self.place, step)
            self._doubted = None if self._doubted is None else compose(self._doubted, step)
        if fix is not None and fix is not self._fix:
            self._fix = fix
            marker = None if fix.marker_id is None else self._markers.get(fix.marker_id)
            if marker is not None:
                seen = world_pose((fix.x_m, fix.y_m, fix.yaw_rad), marker)
                self._take(compose(seen, self._since(fix.stamp_s)), fix.stamp_s)

    def _take(self, seen: Pose, stamp_s: float) -> None:
        doubted, self._doubted = self._doubted, None
        known = [place for place in (self.place, doubted) if place is not None]
        if self.place is not None and all(distance_m(place, seen) > JUMP_M for place in known):
            self._doubted = seen
            return
        self.place, self.seen_s = seen, stamp_s

    def _since(self, stamp_s: float) -> Pose:
        """What the wheels did since then."""
        then = next((reading for reading in reversed(self._readings) if reading.stamp_s <= stamp_s), None)
        return (0.0, 0.0, 0.0) if then is None else self._step(then, self._readings[-1])

    def _step(self, a: BaseReading, b: BaseReading) -> Pose:
        left_m, right_m = b.left_m - a.left_m, b.right_m - a.right_m
        ahead_m, turn_rad = (left_m + right_m) / 2, (right_m - left_m) / self._wheelbase_m
        return ahead_m * math.cos(turn_rad / 2), ahead_m * math.sin(turn_rad / 2), turn_rad
