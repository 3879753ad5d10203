"""What a robot found out by working: a pump or a tap that gave nothing. No sensor tells, and nobody tells of a repair."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from core.clock import Clock
from core.wire.body import BodyState

AGAIN_S, AGAIN_S_MAX = 120.0, 600.0
"""A part that failed is trusted again after this, twice as long each time that it fails again."""
PUMP = "pump"
LEAK_ML = 40.0
"""So much less in the tank, with the pump off, is a leak: twice what two readings of its level differ by."""
LEAK_FOR_S = 3.0
"""Water that slops while the robot drives comes back sooner."""
PUMPED_S = 5.0
"""After the pump stopped the level still falls to where it belongs."""


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


@dataclass(slots=True)
class LeakWatch:
    """Sees every state of the body: a tank that empties while nobody pumps leaks, or its pump does not stop."""

    told: Callable[[str], None]
    _full_ml: float | None = None
    """What the tank held when the pump was last off, as far as has been seen."""
    _since_s: float | None = None
    """Since when it has held too little."""
    _pumped_s: float = -math.inf

    def see(self, state: BodyState) -> None:
        """`told` hears how much is gone, again for every `LEAK_ML` more."""
        level_ml, now_s = state.tank_ml, state.stamp_s
        if state.pump:
            self._pumped_s = now_s
        if level_ml is None or now_s - self._pumped_s < PUMPED_S:
            self._full_ml = self._since_s = None
            return
        self._full_ml = max(level_ml, self._full_ml or level_ml)
        gone_ml = self._full_ml - level_ml
        if gone_ml < LEAK_ML:
            self._since_s = None
        elif self._since_s is None:
            self._since_s = now_s
        elif now_s - self._since_s >= LEAK_FOR_S:
            self._full_ml, self._since_s = level_ml, None
            self.told(f"the tank lost {gone_ml:.0f} ml while the pump was off")
