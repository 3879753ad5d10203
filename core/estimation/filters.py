"""Where the robot is: the contract of a pose filter, and the paper's own."""

from __future__ import annotations

from typing import Protocol

from core.estimation.history import Jury, Track
from core.estimation.odometry import advance
from core.geometry.planar import Pose, between, compose, distance_m, wrap

WEIGHT_RATIO = 0.10
GATE_M = 0.45
GATE_RAD = 0.6
REJECTS_TO_RELOCALISE = 4
FIXES_TO_START = 2


class PoseEstimator(Protocol):
    """Fuses wheel travel with late, noisy, sometimes jumping absolute fixes. World frame."""

    @property
    def pose(self) -> Pose | None:
        """Base in the world; None until the first agreed fix, unless a start pose was given."""
        ...

    @property
    def position_sigma_m(self) -> float: ...

    @property
    def lost(self) -> bool:
        """True when the pose should not be driven on: unknown, too uncertain, or contradicted by the newest fixes."""
        ...

    def predict(self, d_left_m: float, d_right_m: float, stamp_s: float) -> None:
        """Wheel travel since the last call [m], seen at garden time `stamp_s`."""
        ...

    def correct(self, x_m: float, y_m: float, yaw_rad: float, stamp_s: float) -> bool:
        """A fix of the base in the world, true at `stamp_s` (now minus its age); False when it was not believed."""
        ...


class ExponentialFilter:
    """Odometry with full confidence, pulled towards each fix by 10 % of the difference, position and heading alike.

    Source: paper 000, section 3. The outlier gate and the delay compensation are ours.
    """

    def __init__(self, wheelbase_m: float, pose: Pose | None = None, weight_ratio: float = WEIGHT_RATIO) -> None:
        self._wheelbase_m, self._weight = wheelbase_m, weight_ratio
        self._pose: Pose | None = pose
        self._odometry: Pose = (0.0, 0.0, 0.0)
        self._track, self._poses = Track(), Track()
        self._jury = Jury(FIXES_TO_START if pose is None else REJECTS_TO_RELOCALISE)
        self._spread_m = 0.05

    @property
    def pose(self) -> Pose | None:
        return self._pose

    @property
    def position_sigma_m(self) -> float:
        """A running mean of how far fixes lie from the estimate [m]: this filter has no covariance."""
        return self._spread_m

    @property
    def lost(self) -> bool:
        return self._pose is None or self._jury.votes >= REJECTS_TO_RELOCALISE - 1

    def predict(self, d_left_m: float, d_right_m: float, stamp_s: float) -> None:
        self._odometry = advance(self._odometry, d_left_m, d_right_m, self._wheelbase_m)
        self._track.add(stamp_s, self._odometry)
        if self._pose is not None:
            self._pose = advance(self._pose, d_left_m, d_right_m, self._wheelbase_m)
            self._poses.add(stamp_s, self._pose)

    def correct(self, x_m: float, y_m: float, yaw_rad: float, stamp_s: float) -> bool:
        fix = (x_m, y_m, yaw_rad)
        odometry = self._track.at(stamp_s)
        if odometry is None:
            return False
        then = self._poses.at(stamp_s)
        if then is None or distance_m(then, fix) > GATE_M or abs(wrap(yaw_rad - then[2])) > GATE_RAD:
            return self._jury.hear(fix, odometry) and self._restart(fix, odometry)
        self._jury.clear()
        self._spread_m += 0.1 * (distance_m(then, fix) - self._spread_m)
        assert self._pose is not None
        self._shift(self._weight * (x_m - then[0]), self._weight * (y_m - then[1]), self._weight * wrap(yaw_rad - then[2]))
        return True

    def _shift(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Move the present and the remembered past alike, so that the next late fix is judged against what we now think."""
        assert self._pose is not None
        self._pose = (self._pose[0] + dx_m, self._pose[1] + dy_m, wrap(self._pose[2] + dyaw_rad))
        moved = [(t, (p[0] + dx_m, p[1] + dy_m, wrap(p[2] + dyaw_rad))) for t, p in self._poses.samples]
        self._poses.samples.clear()
        self._poses.samples.extend(moved)

    def _restart(self, fix: Pose, odometry: Pose) -> bool:
        self._poses.samples.clear()
        for stamp_s, sample in self._track.samples:
            self._poses.add(stamp_s, compose(fix, between(odometry, sample)))
        self._pose = self._poses.samples[-1][1]
        self._jury = Jury(REJECTS_TO_RELOCALISE)
        return True
