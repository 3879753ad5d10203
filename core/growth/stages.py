"""The life of one fruit by the days since it turned red, and what a detector says of it.

`tau_days` is 0 when the fruit becomes red: green before -turning_days, turning until 0, red from then on.
Figures (at 20 C): a cherry tomato needs some 45 days from flower to red, of which the last 5 change the colour (USDA classes
breaker to red); its diameter follows a Gompertz curve that is steepest 15 to 20 days after flowering ("Growth rates of
glasshouse tomato fruit in relation to final size", J. Hort. Sci.); full-grown cherry tomatoes are some 28 mm across.
How long the colour takes depends on variety and warmth, so each plant learns it from its own fruit (`belief`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from core.wire.fruit import Colour

COLOURS: tuple[Colour, Colour, Colour] = ("green", "turning", "red")
DAY_S = 86400.0
GREEN_DAYS = 40.0
TURNING_DAYS = 5.0
TURNING_SPREAD = 0.35
"""Of the logarithm of the turning days between plants: 5 days, two plants in three between 3.5 and 7."""
RED_DAYS, RED_SIGMA_DAYS = 12.0, 3.0
"""A red fruit falls by itself after so long."""
FULL_RADIUS_M, FULL_RADIUS_SIGMA_M = 0.014, 0.0015
STEEPEST_SHARE, STEEPNESS = 0.42, 6.5
MISTAKE = ((0.950, 0.045, 0.005), (0.045, 0.910, 0.045), (0.005, 0.045, 0.950))
"""P(colour said | true colour), rows the truth: neighbouring colours are sometimes mistaken, green and red seldom."""


def stage(tau_days: float, turning_days: float) -> int:
    """Index into `COLOURS`."""
    return 2 if tau_days >= 0.0 else 1 if tau_days >= -turning_days else 0


def radius_share(tau_days: float, turning_days: float = TURNING_DAYS) -> float:
    """The part of its full radius that a fruit has reached, 0..1."""
    share = (tau_days + turning_days + GREEN_DAYS) / GREEN_DAYS
    return math.exp(-math.exp(-STEEPNESS * (share - STEEPEST_SHARE)))


def hangs(tau_days: float) -> float:
    """Probability that it has not fallen by itself yet."""
    return normal_cdf((RED_DAYS - tau_days) / RED_SIGMA_DAYS)


def ripeness(tau_days: float, turning_days: float = TURNING_DAYS) -> float:
    """0 wholly green .. 1 wholly red: it moves while the fruit turns and a little longer."""
    return normal_cdf((tau_days + 0.5 * turning_days) / (0.4 * turning_days))


def normal_cdf(x: float) -> float:
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


def normalised(weights: Sequence[float]) -> list[float]:
    """Weights that sum to 1; all alike when they are all nothing."""
    total = sum(weights)
    return [w / total for w in weights] if total > 0.0 else [1.0 / len(weights)] * len(weights)
