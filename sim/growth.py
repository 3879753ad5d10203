"""How one fruit grows, ripens and lets go, by its age.

Figures, at 20 C: round tomatoes need 50 to 60 days from flower to ripe, cherry tomatoes some 45, of which the last 5 change
the colour (USDA classes breaker to red). The diameter grows along a sigmoid whose steepest part lies 15 to 20 days after
flowering, and fruit of one truss ripen within about a week, big or small ("Growth rates of glasshouse tomato fruit in
relation to final size", J. Hort. Sci.). Flowers of a truss open a day or two apart; a plant in a pot makes a new truss in 9
to 18 days (de Koning 1994: 0.07 to 0.14 a day between 12 and 20 C).
What breaks a pedicel: cherry tomatoes ripe for picking 0.58 to 2.46 N at the calyx, pulled (Xie et al., Agriculture 2021,
11, 815); the joint of a firm cluster 5 to 8 N (airobotsight.com/?p=3708). In between we let it fall with ripeness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim.scene.tomato import RED_FROM, TURNING_FROM, Colour, colour_of

DENSITY_KGM3 = 1000.0
"""12 g at 28.4 mm across."""
RADIUS_M, RADIUS_SIGMA_M, RADIUS_MIN_M, RADIUS_MAX_M = 0.0140, 0.0011, 0.0115, 0.0160
GREEN_DAYS, TURNING_DAYS, RED_DAYS = (40.0, 3.0), (5.0, 0.7), (12.0, 2.5)
"""Mean and sigma of the days before the colour breaks, until it is red, until the fruit drops."""
STEEPEST_SHARE, STEEPNESS = 0.33, 5.0
"""Gompertz: the diameter grows fastest at this share of the green days, and is 97 % grown at their end."""
SEEN_M = 0.0025
"""A smaller fruit is part of its flower."""
FLOWER_DAYS = (1.0, 1.8)
"""From one flower of a truss to the next, outwards."""
TRUSS_DAYS = (9.0, 18.0)
AGAIN_DAYS = (5.0, 12.0)
"""A place whose fruit is gone flowers again after so many days: it stands for the new truss that a plant would make."""
STRENGTH_N = ((0.0, 6.5), (TURNING_FROM, 6.5), (RED_FROM, 2.0), (1.0, 1.1))
"""Pull that breaks the joint, by ripeness; drawn up to 23 % weaker or stronger for each fruit."""
STRENGTH_SIGMA, STRENGTH_SPREAD = 0.12, 0.23


@dataclass(slots=True, kw_only=True)
class Growing:
    """One fruit. Ages in days since its flower opened."""

    fruit_id: str
    age_days: float
    fed_days: float
    """The part of its age in which the plant had enough water: a thirsty plant's fruit stays smaller."""
    green_days: float
    turning_days: float
    red_days: float
    full_radius_m: float
    toughness: float

    def live(self, days: float, thirst: float) -> None:
        """Let `days` pass in which the plant went short of water by `thirst` (0: never, 1: always)."""
        self.age_days += days
        self.fed_days += days * (1.0 - thirst)

    @property
    def ripeness(self) -> float:
        """0 (flower) .. 1 (drops)."""
        red_from = self.green_days + self.turning_days
        ages = (0.0, self.green_days, red_from, red_from + self.red_days)
        return float(np.interp(self.age_days, ages, (0.0, TURNING_FROM, RED_FROM, 1.0)))

    @property
    def colour(self) -> Colour:
        return colour_of(self.ripeness)

    @property
    def radius_m(self) -> float:
        share = self.fed_days / self.green_days
        return self.full_radius_m * math.exp(-math.exp(-STEEPNESS * (share - STEEPEST_SHARE)))

    @property
    def set(self) -> bool:
        """Whether it is a fruit yet, to be seen and touched."""
        return self.radius_m >= SEEN_M

    @property
    def overripe(self) -> bool:
        return self.age_days >= self.green_days + self.turning_days + self.red_days

    @property
    def mass_kg(self) -> float:
        return DENSITY_KGM3 * 4.0 / 3.0 * math.pi * self.radius_m**3

    @property
    def strength_n(self) -> float:
        """Pull that breaks its joint."""
        at, force_n = zip(*STRENGTH_N, strict=True)
        return self.toughness * float(np.interp(self.ripeness, at, force_n))


def flower(fruit_id: str, age_days: float, rng: np.random.Generator) -> Growing:
    """A fruit whose flower opened `age_days` ago (negative: will open)."""

    def days(mean_sigma: tuple[float, float]) -> float:
        mean, sigma = mean_sigma
        return float(np.clip(rng.normal(mean, sigma), mean - 2 * sigma, mean + 2 * sigma))

    return Growing(
        fruit_id=fruit_id,
        age_days=age_days,
        fed_days=age_days,
        green_days=days(GREEN_DAYS),
        turning_days=days(TURNING_DAYS),
        red_days=days(RED_DAYS),
        full_radius_m=float(np.clip(rng.normal(RADIUS_M, RADIUS_SIGMA_M), RADIUS_MIN_M, RADIUS_MAX_M)),
        toughness=float(np.clip(1.0 + rng.normal(0.0, STRENGTH_SIGMA), 1.0 - STRENGTH_SPREAD, 1.0 + STRENGTH_SPREAD)),
    )


def truss_ages(sizes: list[tuple[int, bool]], rng: np.random.Generator) -> list[list[float]]:
    """Days since flowering of every place of trusses (size, in flower yet), from below upwards and from the stem outwards.

    The lowest truss begins to be ripe.
    """
    ages: list[list[float]] = []
    first_days = GREEN_DAYS[0] + TURNING_DAYS[0] + rng.uniform(1.0, 6.0)
    for size, flowering in sizes:
        age = rng.uniform(0.0, 6.0) if flowering else first_days
        ages.append([])
        for _ in range(size):
            ages[-1].append(float(age))
            age -= rng.uniform(*FLOWER_DAYS)
        first_days -= rng.uniform(*TRUSS_DAYS)
    return ages
