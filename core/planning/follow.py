"""Following a path: regulated pure pursuit, turning on the spot where the path turns sharply, and a final heading.

Source: Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm; speed regulation by curvature and nearness
as in Macenski et al., Regulated Pure Pursuit.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.geometry.planar import Pose, distance_m, wrap
from core.robots import gardener

ACCEL_MPS2 = 0.4
BRAKE_MPS2 = 0.3
OMEGA_ACCEL_RADPS2 = 4.0
LOOKAHEAD_MIN_M, LOOKAHEAD_MAX_M, LOOKAHEAD_S = 0.12, 0.30, 0.7
TURN_START_RAD, TURN_END_RAD = 0.7, 0.10
TURN_OMEGA_RADPS = 1.4
SLOW_MPS = 0.04
POSITION_TOLERANCE_M = 0.008
RETRY_M = 0.035
YAW_TOLERANCE_RAD = math.radians(1.2)
SIDEWAYS_MPS2 = 0.25
"""The most centripetal acceleration: water in the tank stays there."""
NEAR_M = 0.12
"""Clearance beyond the body under which speed falls."""

Clearance = Callable[[float, float], float]
"""World position -> distance to the nearest obstacle or edge [m]."""


class Step(NamedTuple):
    v_mps: float
    omega_radps: float
    done: bool


class PathFollower:
    """Turns pose estimates into setpoints along one polyline. Call `step` 20 to 50 times a second."""

    def __init__(
        self,
        points_m: NDArray[np.float64],
        goal_yaw_rad: float | None = None,
        *,
        v_mps_max: float = gardener.CRUISE_MPS,
        clearance: Clearance | None = None,
        tolerance_m: float = POSITION_TOLERANCE_M,
    ) -> None:
        """`points_m` is (N, 2) in the world frame; without `goal_yaw_rad` any heading will do at the end."""
        self._points = [(float(x), float(y)) for x, y in points_m]
        if len(self._points) == 1:
            self._points = self._points * 2
        self._lengths = [distance_m(a, b) for a, b in zip(self._points, self._points[1:], strict=False)]
        self._starts = [sum(self._lengths[:i]) for i in range(len(self._lengths))]
        self.length_m = sum(self._lengths)
        self._ends = [start_m + length_m for start_m, length_m in zip(self._starts, self._lengths, strict=True)]
        self._corners = _corners(self._points, self._starts)
        self._goal_yaw = goal_yaw_rad
        self._v_max, self._clearance, self._tolerance_m = v_mps_max, clearance, tolerance_m
        self._along_m, self._v, self._omega = 0.0, 0.0, 0.0
        self._turning, self._arrived, self._done = True, False, False
        self._now_s: float | None = None
        self.off_path_m = 0.0
        """How far the robot is from the path."""

    @property
    def remaining_m(self) -> float:
        return max(0.0, self.length_m - self._along_m)

    def ahead(self, reach_m: float) -> list[tuple[float, float]]:
        """The next stretch of the path as points, to tell neighbours."""
        end_m = min(self.length_m, self._along_m + reach_m)
        corners = [p for p, s in zip(self._points, [*self._starts, self.length_m], strict=True) if self._along_m < s < end_m]
        return [self._at(self._along_m), *corners, self._at(end_m)]

    def step(self, pose: Pose, now_s: float) -> Step:
        """One setpoint for the estimated pose; `done` once it stands at the goal with the right heading."""
        dt_s = 0.02 if self._now_s is None else min(0.2, max(0.0, now_s - self._now_s))
        self._now_s = now_s
        v, omega = (0.0, 0.0) if self._done else self._wanted(pose)
        self._v = _slew(self._v, v, ACCEL_MPS2 * dt_s, 2 * ACCEL_MPS2 * dt_s)
        self._omega = _slew(self._omega, omega, OMEGA_ACCEL_RADPS2 * dt_s, 2 * OMEGA_ACCEL_RADPS2 * dt_s)
        if self._done:
            self._v = self._omega = 0.0
        return Step(self._v, self._omega, self._done)

    def _wanted(self, pose: Pose) -> tuple[float, float]:
        self._project(pose)
        goal = self._points[-1]
        gap_m = distance_m(pose, goal)
        if not self._arrived and self._reached(pose, gap_m):
            self._arrived = True
        if self._arrived and gap_m > RETRY_M:
            self._arrived, self._turning = False, True
        if self._arrived:
            return 0.0, self._align(pose)
        return self._pursue(pose, gap_m)

    def _reached(self, pose: Pose, gap_m: float) -> bool:
        """On the goal, or past it so closely that turning back would gain nothing."""
        if gap_m < self._tolerance_m:
            return True
        ahead_m = math.cos(math.atan2(self._points[-1][1] - pose[1], self._points[-1][0] - pose[0]) - pose[2]) * gap_m
        return gap_m < RETRY_M and ahead_m <= self._tolerance_m / 2 and self.remaining_m < RETRY_M

    def _align(self, pose: Pose) -> float:
        error = 0.0 if self._goal_yaw is None else wrap(self._goal_yaw - pose[2])
        if abs(error) < YAW_TOLERANCE_RAD:
            self._done = abs(self._v) < SLOW_MPS and abs(self._omega) < 0.3
            return 0.0
        return _spin(error)

    def _pursue(self, pose: Pose, gap_m: float) -> tuple[float, float]:
        lookahead_m = min(LOOKAHEAD_MAX_M, max(LOOKAHEAD_MIN_M, LOOKAHEAD_S * self._v))
        last = self.remaining_m < 0.02 and gap_m < LOOKAHEAD_MIN_M
        target = self._points[-1] if last else self._at(self._along_m + lookahead_m)
        alpha = wrap(math.atan2(target[1] - pose[1], target[0] - pose[0]) - pose[2])
        if abs(alpha) > (TURN_END_RAD if self._turning else TURN_START_RAD):
            self._turning = True
            return 0.0, _spin(alpha)
        self._turning = False
        reach_m = max(distance_m(pose, target), 0.05)
        curvature = 2 * math.sin(alpha) / reach_m
        v = self._speed(pose, gap_m, curvature)
        return v, v * curvature

    def _speed(self, pose: Pose, gap_m: float, curvature: float) -> float:
        limits = [self._v_max, math.sqrt(2 * BRAKE_MPS2 * max(gap_m, 1e-4))]
        limits.append(math.sqrt(SIDEWAYS_MPS2 / max(abs(curvature), 1e-3)))
        limits.append(math.sqrt((0.15 * self._v_max) ** 2 + 2 * BRAKE_MPS2 * self._next_corner_m()))
        if self._clearance is not None:
            spare_m = self._clearance(pose[0], pose[1]) - gardener.BODY_RADIUS_M
            limits.append(self._v_max * max(0.4, min(1.0, spare_m / NEAR_M)))
        return max(SLOW_MPS, min(limits))

    def _next_corner_m(self) -> float:
        """Distance to the next corner too sharp to be driven round at speed; infinite when there is none."""
        at = bisect_right(self._corners, self._along_m)
        return self._corners[at] - self._along_m if at < len(self._corners) else math.inf

    def _project(self, pose: Pose) -> None:
        """Move the progress along the path to the nearest point of its next half metre; never back by much."""
        low_m, high_m = self._along_m - 0.05, self._along_m + 0.5
        best = (math.inf, self._along_m)
        for i in range(bisect_left(self._ends, low_m), bisect_right(self._starts, high_m)):
            start_m, length_m = self._starts[i], self._lengths[i]
            if length_m == 0.0:
                continue
            (ax, ay), (bx, by) = self._points[i], self._points[i + 1]
            share = ((pose[0] - ax) * (bx - ax) + (pose[1] - ay) * (by - ay)) / (length_m * length_m)
            along_m = min(max(start_m + share * length_m, max(low_m, start_m)), min(high_m, start_m + length_m))
            share = max(0.0, along_m - start_m) / length_m
            best = min(best, (math.hypot(ax + share * (bx - ax) - pose[0], ay + share * (by - ay) - pose[1]), along_m))
        if best[0] < math.inf:
            self.off_path_m, self._along_m = best
        else:
            self.off_path_m = distance_m(pose, self._points[-1])

    def _at(self, along_m: float) -> tuple[float, float]:
        """The point this far along; beyond the end it goes on straight, so that the end is met squarely."""
        last = len(self._lengths) - 1
        for i in range(min(bisect_left(self._ends, along_m), last), last + 1):
            if (length_m := self._lengths[i]) > 0.0:
                (ax, ay), (bx, by) = self._points[i], self._points[i + 1]
                share = max(0.0, along_m - self._starts[i]) / length_m
                return ax + share * (bx - ax), ay + share * (by - ay)
        return self._points[-1]


def _corners(points: list[tuple[float, float]], starts: list[float]) -> list[float]:
    """How far along the sharp corners lie [m], in order."""
    found = []
    for i in range(1, len(starts)):
        (ax, ay), (bx, by), (cx, cy) = points[i - 1 : i + 2]
        if abs(wrap(math.atan2(cy - by, cx - bx) - math.atan2(by - ay, bx - ax))) > TURN_START_RAD:
            found.append(starts[i])
    return found


def _spin(error_rad: float) -> float:
    """Yaw rate that turns an error away without overshoot under the acceleration limit."""
    rate = min(TURN_OMEGA_RADPS, math.sqrt(1.2 * OMEGA_ACCEL_RADPS2 * abs(error_rad)), max(2.5 * abs(error_rad), 0.06))
    return math.copysign(rate, error_rad)


def _slew(now: float, wanted: float, up: float, down: float) -> float:
    """Approach `wanted` by at most `up` when growing in size, `down` when shrinking."""
    limit = up if abs(wanted) > abs(now) and wanted * now >= 0 else down
    return now + min(limit, max(-limit, wanted - now))
