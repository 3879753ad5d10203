"""Where the robot is: wheels at the body's rate, ceiling markers at 2 Hz, and docks, whose places are known."""

from __future__ import annotations

from collections.abc import Mapping

from core.clock import Clock
from core.estimation.ekf import PoseFilter
from core.estimation.filters import ExponentialFilter, PoseEstimator
from core.estimation.markers import world_pose
from core.geometry.planar import Pose, distance_m, wrap
from core.robots.garden_map import GardenMap
from core.wire.body import BodyState
from core.wire.geometry import Pose2

FILTERS = {"kalman": PoseFilter, "exponential": ExponentialFilter}
BLIND_S_MAX = 12.0
"""Driving this long without a believed fix is driving blind."""
SIGMA_M_MAX = 0.15
DOCK_SIGMA_M = 0.02
AT_DOCK_M = 0.30
AT_DOCK_RAD = 0.6


class Localisation:
    """Feed it every `BodyState`; ask for `pose`, `lost` and `docked_at`."""

    def __init__(self, kind: str, wheelbase_m: float, markers: Mapping[int, Pose2], garden: GardenMap, clock: Clock) -> None:
        self._kind, self._wheelbase_m = kind, wheelbase_m
        self._markers = {number: (p.x_m, p.y_m, p.yaw_rad) for number, p in markers.items()}
        self._docks: dict[str, Pose] = {d.name: (d.pose.x_m, d.pose.y_m, d.pose.yaw_rad) for d in garden.docks}
        self._clock = clock
        self._filter: PoseEstimator = FILTERS[kind](wheelbase_m)
        self._last: BodyState | None = None
        self._moved_blind_s = 0.0
        self.docked_at = ""
        """The dock whose charge current flows into us; empty when undocked."""
        self.docked_s = 0.0
        """Since when [garden s]."""
        self.fixes = 0
        self.rejected = 0

    @property
    def pose(self) -> Pose | None:
        return self._filter.pose

    @property
    def sigma_m(self) -> float:
        return self._filter.position_sigma_m

    @property
    def lost(self) -> str:
        """Why the pose should not be driven on; empty while it may."""
        if self.docked_at:
            return ""
        if self._filter.pose is None:
            return "does not know where it is: no ceiling marker seen yet"
        if self._filter.lost:
            return "lost: the markers contradict the wheels"
        if self._moved_blind_s > BLIND_S_MAX:
            return f"lost: drove {self._moved_blind_s:.0f} s without a ceiling marker"
        return f"lost: position only known to {self.sigma_m:.2f} m" if self.sigma_m > SIGMA_M_MAX else ""

    def take(self, state: BodyState) -> None:
        """One sample of the body."""
        last, self._last = self._last, state
        if last is None or state.odometry_epoch != last.odometry_epoch:
            self._filter.predict(0.0, 0.0, state.stamp_s)
        else:
            d_left_m, d_right_m = state.left_m - last.left_m, state.right_m - last.right_m
            self._filter.predict(d_left_m, d_right_m, state.stamp_s)
            if d_left_m or d_right_m:
                self._moved_blind_s += state.stamp_s - last.stamp_s
        if state.marker is not None and (last is None or last.marker is None or last.marker.count != state.marker.count):
            self._look(state)
        self._sit(state, last)

    def _look(self, state: BodyState) -> None:
        marker = state.marker
        if marker is None or (place := self._markers.get(marker.marker_id)) is None:
            return
        x_m, y_m, yaw_rad = world_pose((marker.x_m, marker.y_m, marker.yaw_rad), place)
        if self._filter.correct(x_m, y_m, yaw_rad, state.stamp_s - marker.age_s):
            self.fixes += 1
            self._moved_blind_s = 0.0
        else:
            self.rejected += 1

    def _sit(self, state: BodyState, last: BodyState | None) -> None:
        """On a dock the place is known to a centimetre or two, which helps when the estimate is worse than that."""
        if not state.docked:
            self.docked_at = ""
            return
        if not self.docked_at and (name := self.dock_here()):
            self.docked_at, self.docked_s = name, self._clock.now()
            if self._filter.lost or self.sigma_m > DOCK_SIGMA_M:
                self._filter.correct(*self._docks[name], state.stamp_s)

    def dock_here(self) -> str:
        """The dock we would stand at by the estimate; empty when none is so near."""
        pose = self._filter.pose
        if pose is None or not self._docks:
            return ""
        name, place = min(self._docks.items(), key=lambda item: distance_m(item[1], pose))
        near = distance_m(place, pose) < AT_DOCK_M and abs(wrap(place[2] - pose[2])) < AT_DOCK_RAD
        return name if near else ""
