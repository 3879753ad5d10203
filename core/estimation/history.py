"""What both pose filters need to judge fixes that arrive late, jump, or contradict them for good."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from core.geometry.planar import Pose, between, compose, distance_m, wrap

HISTORY_S = 2.0
"""A fix older than this is no use."""


@dataclass(slots=True)
class Track:
    """The recent past of an odometry-driven pose, to ask where it was."""

    samples: deque[tuple[float, Pose]] = field(default_factory=deque)

    def add(self, stamp_s: float, pose: Pose) -> None:
        self.samples.append((stamp_s, pose))
        while self.samples[0][0] < stamp_s - HISTORY_S:
            self.samples.popleft()

    def at(self, stamp_s: float) -> Pose | None:
        """The pose at that instant, interpolated; None when it is too long ago."""
        after: tuple[float, Pose] | None = None
        for sample in reversed(self.samples):
            if sample[0] <= stamp_s:
                return sample[1] if after is None else _mix(sample, after, stamp_s)
            after = sample
        return None


def _mix(a: tuple[float, Pose], b: tuple[float, Pose], stamp_s: float) -> Pose:
    share = (stamp_s - a[0]) / max(b[0] - a[0], 1e-9)
    (ax, ay, ayaw), (bx, by, byaw) = a[1], b[1]
    return ax + share * (bx - ax), ay + share * (by - ay), wrap(ayaw + share * wrap(byaw - ayaw))


@dataclass(slots=True)
class Jury:
    """Collects rejected fixes: several in a row that agree with one another through odometry outvote the estimate."""

    needed: int
    tolerance_m: float = 0.12
    tolerance_rad: float = 0.15
    votes: int = 0
    _fix: Pose | None = None
    _odometry: Pose | None = None

    def clear(self) -> None:
        self.votes, self._fix, self._odometry = 0, None, None

    def hear(self, fix: Pose, odometry: Pose) -> bool:
        """One rejected fix and the raw odometry pose of its instant; True when the fixes have won."""
        agrees = False
        if self._fix is not None and self._odometry is not None:
            moved = between(self._odometry, odometry)
            expected = compose(self._fix, moved)
            slack_m = self.tolerance_m + 0.2 * math.hypot(moved[0], moved[1])
            agrees = distance_m(expected, fix) < slack_m and abs(wrap(expected[2] - fix[2])) < self.tolerance_rad
        self.votes = self.votes + 1 if agrees else 1
        self._fix, self._odometry = fix, odometry
        return self.votes >= self.needed
