"""A pose filter that learns how its odometry lies.

State: x, y, yaw, and three systematic errors of the odometry that the garden's turf and a heavy robot cause:
`travel` (true distance / measured - 1), `turn` (true turn / measured - 1) and `veer` (turn per metre of straight driving).
Source: extended Kalman filter (Thrun, Burgard, Fox, Probabilistic Robotics, chapter 3), errors as in Borenstein's UMBmark.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.estimation.filters import FIXES_TO_START, REJECTS_TO_RELOCALISE
from core.estimation.history import HISTORY_S, Jury, Track
from core.estimation.odometry import advance
from core.geometry.planar import Pose, between, compose, wrap

Array = NDArray[np.float64]

FIX_SIGMA_M = 0.009
FIX_SIGMA_RAD = math.radians(0.8)
"""A little above the sensor's, since the stamp of a fix is known only so well."""
GATE_CHI2 = 16.3
"""Three degrees of freedom, 99.9 %."""
LOST_SIGMA_M = 0.25
TRAVEL_SIGMA, TURN_SIGMA, VEER_SIGMA_RADPM = 0.08, 0.08, 0.10
NOISE_M2_PER_M = 0.006**2
NOISE_RAD2_PER_RAD = 0.015**2
NOISE_RAD2_PER_M = 0.012**2
WANDER_PER_M = 1e-3**2
"""The systematic errors may change slowly (turf, tank, tyres)."""


@dataclass(slots=True)
class _Step:
    """One wheel increment and the belief after it."""

    stamp_s: float
    d_left_m: float
    d_right_m: float
    mean: Array
    P: Array


class PoseFilter:
    """EKF over pose and odometry errors, with an innovation gate, re-localisation and delay compensation."""

    def __init__(self, wheelbase_m: float, pose: Pose | None = None) -> None:
        self._wheelbase_m = wheelbase_m
        self._mean: Array = np.zeros(6)
        self._P: Array = np.diag([0.05, 0.05, 0.05, TRAVEL_SIGMA, TURN_SIGMA, VEER_SIGMA_RADPM]) ** 2
        self._known = pose is not None
        if pose is not None:
            self._mean[:3] = pose
        self._odometry: Pose = (0.0, 0.0, 0.0)
        self._track = Track()
        self._steps: deque[_Step] = deque()
        self._jury = Jury(REJECTS_TO_RELOCALISE if self._known else FIXES_TO_START)

    @property
    def pose(self) -> Pose | None:
        x, y, yaw = (float(v) for v in self._mean[:3])
        return (x, y, wrap(yaw)) if self._known else None

    @property
    def covariance(self) -> Array:
        """(3, 3) of x [m], y [m], yaw [rad]."""
        return self._P[:3, :3].copy()

    @property
    def position_sigma_m(self) -> float:
        return math.sqrt(max(self._P[0, 0], self._P[1, 1]))

    @property
    def odometry_errors(self) -> tuple[float, float, float]:
        """What it has learnt: travel [ratio], turn [ratio], veer [rad/m]."""
        travel, turn, veer = (float(v) for v in self._mean[3:])
        return travel, turn, veer

    @property
    def lost(self) -> bool:
        doubted = self._jury.votes >= REJECTS_TO_RELOCALISE - 1
        return not self._known or doubted or self.position_sigma_m > LOST_SIGMA_M

    def predict(self, d_left_m: float, d_right_m: float, stamp_s: float) -> None:
        still = d_left_m == 0.0 and d_right_m == 0.0
        if not still:
            self._odometry = advance(self._odometry, d_left_m, d_right_m, self._wheelbase_m)
            self._mean, self._P = _moved(self._mean, self._P, d_left_m, d_right_m, self._wheelbase_m)
        self._track.add(stamp_s, self._odometry)
        self._steps.append(_Step(stamp_s, d_left_m, d_right_m, self._mean, self._P))
        while self._steps[0].stamp_s < stamp_s - HISTORY_S:
            self._steps.popleft()

    def correct(self, x_m: float, y_m: float, yaw_rad: float, stamp_s: float) -> bool:
        fix = (x_m, y_m, yaw_rad)
        odometry = self._track.at(stamp_s)
        if odometry is None:
            return False
        if not self._known:
            return self._jury.hear(fix, odometry) and self._restart(fix, odometry)
        later, mean, P = self._rewind(stamp_s)
        believed = _updated(mean, P, fix)
        if believed is None:
            return self._jury.hear(fix, odometry) and self._restart(fix, odometry)
        self._jury.clear()
        self._mean, self._P = believed
        self._replay(later)
        return True

    def _rewind(self, stamp_s: float) -> tuple[list[_Step], Array, Array]:
        """The belief at that instant and the increments since; the one it falls into is cut in two."""
        later: list[_Step] = []
        while len(self._steps) > 1 and self._steps[-1].stamp_s > stamp_s:
            later.append(self._steps.pop())
        later.reverse()
        base = self._steps[-1]
        if not later:
            return later, base.mean, base.P
        share = min(1.0, max(0.0, (stamp_s - base.stamp_s) / max(later[0].stamp_s - base.stamp_s, 1e-9)))
        first = later[0]
        mean, P = _moved(base.mean, base.P, share * first.d_left_m, share * first.d_right_m, self._wheelbase_m)
        rest = _Step(first.stamp_s, (1 - share) * first.d_left_m, (1 - share) * first.d_right_m, first.mean, first.P)
        self._steps.append(_Step(stamp_s, share * first.d_left_m, share * first.d_right_m, mean, P))
        return [rest, *later[1:]], mean, P

    def _replay(self, later: list[_Step]) -> None:
        self._steps[-1].mean, self._steps[-1].P = self._mean, self._P
        for step in later:
            if step.d_left_m != 0.0 or step.d_right_m != 0.0:
                self._mean, self._P = _moved(self._mean, self._P, step.d_left_m, step.d_right_m, self._wheelbase_m)
            step.mean, step.P = self._mean, self._P
            self._steps.append(step)

    def _restart(self, fix: Pose, odometry: Pose) -> bool:
        """Believe the fix outright; what was learnt about the odometry is kept, less surely."""
        mean, P = self._mean.copy(), self._P.copy()
        mean[:3] = compose(fix, between(odometry, self._odometry))
        P[:3, :] = P[:, :3] = 0.0
        P[:3, :3] = np.diag([0.03, 0.03, 0.04]) ** 2
        prior = np.diag([TRAVEL_SIGMA, TURN_SIGMA, VEER_SIGMA_RADPM]) ** 2
        P[3:, 3:] = 0.5 * (P[3:, 3:] + prior)
        stamp_s = self._steps[-1].stamp_s
        self._mean, self._P, self._known = mean, P, True
        self._steps.clear()
        self._steps.append(_Step(stamp_s, 0.0, 0.0, mean, P))
        self._jury = Jury(REJECTS_TO_RELOCALISE)
        return True


_EYE = np.eye(6)


def _moved(mean: Array, P: Array, d_left_m: float, d_right_m: float, wheelbase_m: float) -> tuple[Array, Array]:
    """Prediction: mean and covariance after one increment."""
    x, y, yaw, travel, turn, veer = mean.tolist()
    s_m = (d_left_m + d_right_m) / 2
    w_rad = (d_right_m - d_left_m) / wheelbase_m
    true_s, true_w = s_m * (1 + travel), w_rad * (1 + turn) + s_m * veer
    middle = yaw + true_w / 2
    cos, sin = math.cos(middle), math.sin(middle)
    F = _EYE.copy()
    F[0, 2], F[1, 2] = -true_s * sin, true_s * cos
    F[0, 3], F[1, 3] = s_m * cos, s_m * sin
    F[2, 4], F[2, 5] = w_rad, s_m
    F[0, 4], F[1, 4] = -true_s * sin * w_rad / 2, true_s * cos * w_rad / 2
    F[0, 5], F[1, 5] = -true_s * sin * s_m / 2, true_s * cos * s_m / 2
    moved_mean = np.array([x + true_s * cos, y + true_s * sin, yaw + true_w, travel, turn, veer])
    moved_P = F @ P @ F.T
    run_m, spun_rad = abs(s_m), abs(w_rad)
    q_m = NOISE_M2_PER_M * run_m + 1e-7 * spun_rad
    q_rad = NOISE_RAD2_PER_RAD * spun_rad + NOISE_RAD2_PER_M * run_m
    q_error = WANDER_PER_M * (run_m + 0.1 * spun_rad)
    moved_P.reshape(36)[::7] += (q_m, q_m, q_rad, q_error, q_error, q_error)
    return moved_mean, moved_P


_R = np.diag([FIX_SIGMA_M, FIX_SIGMA_M, FIX_SIGMA_RAD]) ** 2


def _updated(mean: Array, P: Array, fix: Pose) -> tuple[Array, Array] | None:
    """Correction by a direct look at the pose; None when the innovation is out of the gate."""
    nu = np.array([fix[0] - mean[0], fix[1] - mean[1], wrap(fix[2] - float(mean[2]))])
    S_inv = np.linalg.inv(P[:3, :3] + _R)
    if float(nu @ S_inv @ nu) > GATE_CHI2:
        return None
    K = P[:, :3] @ S_inv
    KH = np.zeros((6, 6))
    KH[:, :3] = K
    joseph = np.eye(6) - KH
    return mean + K @ nu, joseph @ P @ joseph.T + K @ _R @ K.T
