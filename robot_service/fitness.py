"""What a robot found out by working: a pump or a tap that gave nothing. No sensor tells, and nobody tells of a repair."""

from __future__ import annotations

from dataclasses import dataclass, field

from core.clock import Clock

AGAIN_S, AGAIN_S_MAX = 120.0, 600.0
"""A part that failed is trusted again after this, twice as long each time that it fails again."""
PUMP = "pump"


@dataclass(slots=True)
class _Failure:
    why: str
    until_s: float
    rest_s: float


@dataclass(slots=True)
class Fitness:
    """By part: `PUMP`, or the name of a dock with a tap."""

    clock: Clock
    _failures: dict[str, _Failure] = field(default_factory=dict)

    def failed(self, part: str, why: str) -> None:
        """It gave nothing, or not enough; `why` is told to plants and people."""
        before = self._failures.get(part)
        rest_s = AGAIN_S if before is None else min(2.0 * before.rest_s, AGAIN_S_MAX)
        self._failures[part] = _Failure(why, self.clock.now() + rest_s, rest_s)

    def worked(self, part: str) -> None:
        self._failures.pop(part, None)

    def looked_after(self) -> None:
        """Somebody has been at the robot: all is trusted again."""
        self._failures.clear()

    def why_not(self, part: str) -> str:
        """Why it is not to be counted on now; empty when it is."""
        failure = self._failures.get(part)
        return "" if failure is None or self.clock.now() >= failure.until_s else failure.why

    def told(self) -> list[str]:
        """Everything that is not to be counted on now."""
        return [why for part in self._failures if (why := self.why_not(part))]
