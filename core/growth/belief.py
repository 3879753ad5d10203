"""When a fruit becomes red, as far as a plant can tell from what it was told of it (a grid filter, textbook Bayes).

The time at which a fruit becomes red is one unknown; every sighting's colour and size says something about it. How many
days the colour takes is one more unknown, shared by all fruit of a plant. Both live on grids: no particle, no tuning.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from operator import mul

from core.growth.stages import (
    COLOURS,
    DAY_S,
    FULL_RADIUS_M,
    FULL_RADIUS_SIGMA_M,
    GREEN_DAYS,
    MISTAKE,
    RED_DAYS,
    TURNING_DAYS,
    TURNING_SPREAD,
    hangs,
    normalised,
    radius_share,
    ripeness,
    stage,
)
from core.wire.documents import Document, Ratio
from core.wire.fruit import Colour, GardenSeconds, Radius

STEP_DAYS, FINE_DAYS = 0.5, 0.25
PACES_DAYS = (1.0, 1.2, 1.5, 1.8, 2.2, 2.6, 3.1, 3.7, 4.4, 5.2, 6.2, 7.4, 8.8, 10.5)
"""How long the colour may take."""
RADIUS_SIGMA_RATIO = 0.15
RIPENESS_SIGMA = 0.15
OBSERVATIONS_MAX = 16


class Observation(Document):
    """What one scan said of one fruit."""

    t_s: GardenSeconds
    colour: Colour
    radius_m: Radius
    ripeness: Ratio | None = None


@dataclass(frozen=True, slots=True)
class Pace:
    """What a plant knows of itself: how long its fruit take to turn, and how large they become."""

    turning_days: float = TURNING_DAYS
    full_radius_m: float = FULL_RADIUS_M


@dataclass(frozen=True, slots=True)
class Belief:
    """Probabilities of how long ago a fruit became red: `weights[i]` for `taus[i]` days at `at_s` [garden s]."""

    at_s: float
    taus: tuple[float, ...]
    weights: tuple[float, ...]
    turning_days: float

    def colours(self, now_s: float) -> tuple[float, float, float]:
        """Probabilities of green, turning, red at a time, given that it hangs."""
        days = (now_s - self.at_s) / DAY_S
        sums = _sums(self.weights)
        turned = sums[bisect_left(self.taus, -self.turning_days - days)]
        reddened = sums[bisect_left(self.taus, -days)]
        return turned, reddened - turned, sums[-1] - reddened

    def colour(self, now_s: float) -> Colour:
        likely = self.colours(now_s)
        return COLOURS[likely.index(max(likely))]

    def red(self, now_s: float) -> float:
        """Probability that it hangs there, red, given that it hung there when last seen."""
        days = (now_s - self.at_s) / DAY_S
        red = bisect_left(self.taus, -days)
        hung: float = sum(map(mul, self.weights[red:], _staying(self.taus[red:], days)))
        return hung

    def tau_days(self, now_s: float) -> float:
        """Mean of the days since it became red; negative: still to go."""
        mean = sum(t * w for t, w in zip(self.taus, self.weights, strict=True))
        return mean + (now_s - self.at_s) / DAY_S

    def median_tau_days(self, now_s: float) -> float:
        sums = list(accumulate(self.weights))
        return self.taus[next(i for i, s in enumerate(sums) if s >= 0.5 * sums[-1])] + (now_s - self.at_s) / DAY_S

    def ripeness(self, now_s: float) -> float:
        days = (now_s - self.at_s) / DAY_S
        return sum(w * ripeness(t + days, self.turning_days) for t, w in zip(self.taus, self.weights, strict=True))

    def radius_m(self, radius_m: float, seen_s: float, now_s: float) -> float:
        """What a fruit of this size when last seen has grown to."""
        was = radius_share(self.tau_days(seen_s), self.turning_days)
        return radius_m * max(1.0, radius_share(self.tau_days(now_s), self.turning_days) / max(was, 0.05))


@lru_cache(maxsize=256)
def _sums(weights: tuple[float, ...]) -> tuple[float, ...]:
    """Of the first none, one, two .. of them."""
    return tuple(accumulate(weights, initial=0.0))


@lru_cache(maxsize=64)
def _staying(taus: tuple[float, ...], days: float) -> tuple[float, ...]:
    """Probability that what hung at each of `taus` hangs `days` later: the same for all that one scan saw."""
    return tuple(hangs(tau + days) / hangs(tau) for tau in taus)


def believe(seen: Sequence[Observation], pace: Pace) -> Belief:
    """The belief after all of `seen` (oldest first, not empty)."""
    taus, weights = _posterior(seen, pace.turning_days, pace.full_radius_m)
    return Belief(seen[-1].t_s, taus, tuple(normalised(weights)), pace.turning_days)


def learn(fruits: Sequence[Sequence[Observation]]) -> Pace:
    """A plant's own pace from all its fruit: the posterior mean over `PACES_DAYS`, and the mean size of those full-grown."""
    full_m = _full_radius(fruits)
    telling = [seen for seen in fruits if len({o.colour for o in seen}) > 1]
    if not telling:
        return Pace(TURNING_DAYS, full_m)
    logs = []
    for days in PACES_DAYS:
        prior = -0.5 * (math.log(days / TURNING_DAYS) / TURNING_SPREAD) ** 2
        logs.append(prior + sum(math.log(_colours_fit(seen, days) + 1e-300) for seen in telling))
    top = max(logs)
    weights = normalised([math.exp(log - top) for log in logs])
    return Pace(sum(w * d for w, d in zip(weights, PACES_DAYS, strict=True)), full_m)


def remember(seen: Sequence[Observation], new: Observation) -> list[Observation]:
    """The observations worth keeping: the newest, and of the older ones those next to a change of colour."""
    kept = [*seen, new]
    while len(kept) > OBSERVATIONS_MAX:
        dull = [i for i in range(1, len(kept) - 1) if kept[i - 1].colour == kept[i].colour == kept[i + 1].colour]
        del kept[dull[0] if dull else 0]
    return kept


def _posterior(seen: Sequence[Observation], turning_days: float, full_m: float) -> tuple[tuple[float, ...], list[float]]:
    """The grid of days since red at the newest observation, and its weights, not normalised."""
    newest_s = seen[-1].t_s
    first = -(GREEN_DAYS + turning_days)
    count = int((RED_DAYS + 4.0 - first) / STEP_DAYS)
    taus = tuple(first + (i + 0.5) * STEP_DAYS for i in range(count))
    weights = [hangs(tau) / count for tau in taus]
    for observation in seen:
        ago_days, said = (newest_s - observation.t_s) / DAY_S, COLOURS.index(observation.colour)
        for i, tau in enumerate(taus):
            weights[i] *= MISTAKE[stage(tau - ago_days, turning_days)][said]
            if observation.ripeness is not None:
                weights[i] *= _hue(observation.ripeness, ripeness(tau - ago_days, turning_days))
    for observation in (seen[0], seen[-1])[: len(seen)]:
        ago_days = (newest_s - observation.t_s) / DAY_S
        for i, tau in enumerate(taus):
            weights[i] *= _size(observation.radius_m, full_m * radius_share(tau - ago_days, turning_days))
    return taus, weights


def _colours_fit(seen: Sequence[Observation], turning_days: float) -> float:
    """How well a pace explains the colours of one fruit, whenever it became red. Far from a change they tell nothing."""
    near = [o for i, o in enumerate(seen) if {p.colour for p in seen[max(0, i - 2) : i + 3]} != {o.colour}]
    dated = [((o.t_s - seen[-1].t_s) / DAY_S, COLOURS.index(o.colour)) for o in near]
    span_days = turning_days - dated[0][0]
    count = int((RED_DAYS + span_days) / FINE_DAYS) + 1
    total = 0.0
    for i in range(count):
        tau, likely = RED_DAYS - i * FINE_DAYS, 1.0
        for days, colour in dated:
            likely *= MISTAKE[stage(tau + days, turning_days)][colour]
        total += likely
    return total


def _size(radius_m: float, expected_m: float) -> float:
    """Heavy tails: a leaf may hide half of it."""
    off = (radius_m - expected_m) / (RADIUS_SIGMA_RATIO * max(expected_m, 0.002))
    return 1.0 / (1.0 + 0.5 * off * off)


def _hue(said: float, expected: float) -> float:
    off = (said - expected) / RIPENESS_SIGMA
    return 0.05 + math.exp(-0.5 * off * off)


def _full_radius(fruits: Sequence[Sequence[Observation]]) -> float:
    """Mean radius of full-grown fruit, drawn to the published one while few were seen."""
    grown = [seen[-1].radius_m for seen in fruits if seen and seen[-1].colour != "green"]
    worth = (FULL_RADIUS_SIGMA_M / (RADIUS_SIGMA_RATIO * FULL_RADIUS_M)) ** 2
    return (FULL_RADIUS_M + worth * sum(grown)) / (1.0 + worth * len(grown))
