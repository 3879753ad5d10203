"""What a plant expects of its fruit some time ahead, and how much of what it knows may have become wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from core.growth.belief import Belief, Pace
from core.growth.stages import DAY_S
from core.wire.fruit import Forecast, Fruit, FruitCounts, FruitForecast

LEVEL = 0.9
NEW_FRUIT_PER_DAY = 0.5
"""Nobody has seen them yet: a plant in a pot makes a truss of some six in 9 to 18 days (de Koning 1994)."""
HORIZON_DAYS = 30


@dataclass(frozen=True, slots=True)
class Hope:
    """A fruit and what is believed of its ripening."""

    fruit: Fruit
    belief: Belief


def forecast(
    plant_id: str, hopes: Sequence[Hope], pace: Pace, scanned_s: float | None, now_s: float, ahead_s: float
) -> Forecast:
    """Ripe fruit `ahead_s` from now, if nobody picks; the number lies in ripe_min..ripe_max with probability `LEVEL`."""
    then_s = now_s + ahead_s
    each = [_one(hope, now_s, then_s) for hope in hopes]
    chances = [fruit.ripe_probability for fruit in each]
    low, high = interval(chances, LEVEL)
    return Forecast(
        plant_id=plant_id, now_s=now_s, ahead_s=ahead_s, scanned_s=scanned_s, now=_counts(hopes, now_s),
        then=_counts(hopes, then_s), ripe=sum(chances), ripe_min=low, ripe_max=high, level=LEVEL,
        uncertainty=uncertainty(hopes, scanned_s, now_s), turning_days=pace.turning_days, fruits=each,
    )  # fmt: skip


def uncertainty(hopes: Sequence[Hope], scanned_s: float | None, now_s: float) -> float:
    """The probability that the inventory is wrong about a fruit of the plant, drawn at random: gone, of another colour, or
    never listed. 1 when no scan was ever made."""
    if scanned_s is None:
        return 1.0
    days = max(0.0, now_s - scanned_s) / DAY_S
    right = sum(hope.fruit.confidence * _as_told(hope, now_s) for hope in hopes)
    listed = sum(hope.fruit.confidence for hope in hopes)
    # An empty plant may have one fruit that was not seen.
    return min(1.0, max(0.0, 1.0 - (right + 1.0) / (max(listed, 0.0) + 1.0 + NEW_FRUIT_PER_DAY * days)))


def interval(chances: Sequence[float], level: float) -> tuple[int, int]:
    """The central interval of a sum of independent yes-or-no events (the Poisson-binomial distribution, exactly)."""
    odds = [1.0]
    for p in chances:
        odds = [a * (1.0 - p) + b * p for a, b in zip([*odds, 0.0], [0.0, *odds], strict=True)]
    tail, low, below = (1.0 - level) / 2.0, 0, 0.0
    while low < len(chances) and below + odds[low] <= tail:
        below += odds[low]
        low += 1
    high, above = len(chances), 0.0
    while high > low and above + odds[high] <= tail:
        above += odds[high]
        high -= 1
    return low, high


def _as_told(hope: Hope, now_s: float) -> float:
    likely = hope.belief.colours(now_s)
    return likely[("green", "turning", "red").index(hope.fruit.colour)]


def _one(hope: Hope, now_s: float, then_s: float) -> FruitForecast:
    fruit, belief = hope.fruit, hope.belief
    return FruitForecast(
        fruit_id=fruit.fruit_id, colour=belief.colour(then_s), ripeness=min(1.0, belief.ripeness(then_s)),
        radius_m=min(0.2, belief.radius_m(fruit.radius_m, fruit.last_seen_s, then_s)),
        ripe_probability=min(1.0, fruit.confidence * belief.red(then_s)), ripe_in_s=_ripe_in_s(belief, now_s),
    )  # fmt: skip


def _ripe_in_s(belief: Belief, now_s: float) -> float | None:
    """Until it is more likely red than not."""
    left_days = -belief.median_tau_days(now_s)
    return None if left_days > HORIZON_DAYS else max(0.0, left_days * DAY_S)


def _counts(hopes: Sequence[Hope], at_s: float) -> FruitCounts:
    colours = [hope.belief.colour(at_s) for hope in hopes if hope.fruit.confidence >= 0.5]
    return FruitCounts(**{colour: colours.count(colour) for colour in ("green", "turning", "red")})
