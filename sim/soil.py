"""A pot's water balance: doses in; evaporation, transpiration and drainage out; a probe that lags behind.

A single bucket (Allen et al., FAO Irrigation and Drainage Paper 56, chapters 7 and 8, reduced to one store): a plant gives
off its full demand until the soil is rather dry, then less and less down to the wilting point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

CAPACITY_RATIO = 0.40
"""Field capacity of potting soil: what lies above drains away."""
STRESS_RATIO = 0.12
"""Below this the stomata close."""
WILTING_RATIO = 0.05
DRAIN_S = 60.0
"""Time constant of drainage through the pot's holes."""
PROBE_LAG_S = 15.0
"""Water needs this long to spread to the probe (first order)."""
SUNRISE_H, SUNSET_H = 6.0, 20.0
NIGHT_SHARE = 0.15
"""Part of a day's loss that does not depend on light (evaporation from the soil, all day round)."""
DAY_S = 86400.0


def light_ratio(hour: float) -> float:
    """Daylight 0..1 at an hour of the day: a half sine from sunrise to sunset."""
    hour %= 24.0
    if not SUNRISE_H < hour < SUNSET_H:
        return 0.0
    return math.sin(math.pi * (hour - SUNRISE_H) / (SUNSET_H - SUNRISE_H))


def demand_mlps(litres_per_day: float, hour: float) -> float:
    """What a plant and its soil give off just now [ml/s] when water is plentiful; a day of it is `litres_per_day`."""
    return 1000.0 * litres_per_day * _share_ps(hour)


@lru_cache(maxsize=1)
def _share_ps(hour: float) -> float:
    """Part of a day's loss that falls into this second [1/s]; asked for every pot of a garden at the same hour."""
    by_night = NIGHT_SHARE / DAY_S
    daylight_s = (SUNSET_H - SUNRISE_H) * 3600.0
    by_day = (1.0 - NIGHT_SHARE) * math.pi / (2.0 * daylight_s) * light_ratio(hour)
    return by_night + by_day


@dataclass(slots=True, kw_only=True)
class Soil:
    """One pot's soil. Everything in millilitres: stored + given off + drained = at first + poured, always."""

    volume_ml: float
    stored_ml: float
    litres_per_day: float
    """What this plant would lose on a day with plenty of water."""
    probe_ratio: float
    """Moisture as the soil round the probe has it."""
    poured_ml: float = 0.0
    given_off_ml: float = 0.0
    drained_ml: float = 0.0

    @classmethod
    def of(cls, litres: float, moisture_ratio: float, litres_per_day: float) -> Soil:
        volume_ml = 1000.0 * litres
        return cls(
            volume_ml=volume_ml,
            stored_ml=volume_ml * moisture_ratio,
            litres_per_day=litres_per_day,
            probe_ratio=moisture_ratio,
        )

    @property
    def moisture_ratio(self) -> float:
        return self.stored_ml / self.volume_ml

    @property
    def supply(self) -> float:
        """The part of its demand that the plant gets: 1 with plenty of water, 0 at the wilting point."""
        return min(1.0, max(0.0, (self.moisture_ratio - WILTING_RATIO) / (STRESS_RATIO - WILTING_RATIO)))

    def pour(self, dose_ml: float) -> None:
        self.stored_ml += dose_ml
        self.poured_ml += dose_ml

    def advance(self, seconds: float, hour: float) -> None:
        """Let `seconds` pass (up to a few minutes at a time) at `hour` of the day."""
        loss_ml = demand_mlps(self.litres_per_day, hour) * seconds * self.supply
        self.stored_ml -= loss_ml
        self.given_off_ml += loss_ml
        excess_ml = self.stored_ml - CAPACITY_RATIO * self.volume_ml
        if excess_ml > 0.0:
            drain_ml = excess_ml * -math.expm1(-seconds / DRAIN_S)
            self.stored_ml -= drain_ml
            self.drained_ml += drain_ml
        self.probe_ratio += (self.moisture_ratio - self.probe_ratio) * -math.expm1(-seconds / PROBE_LAG_S)
