"""What a plant expects of its fruit: learnt from its own, honest about what it cannot know."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.growth.belief import OBSERVATIONS_MAX, Observation, Pace, believe, learn, remember
from core.growth.forecast import Hope, forecast, interval, uncertainty
from core.growth.stages import COLOURS, DAY_S, TURNING_DAYS, radius_share, stage
from core.wire.fruit import Colour, Fruit


def told(day: float, colour: Colour, radius_m: float = 0.0138) -> Observation:
    return Observation(t_s=day * DAY_S, colour=colour, radius_m=radius_m)


def life(red_day: float, turning_days: float, days: list[float]) -> list[Observation]:
    """What faultless scans say of a fruit that becomes red on `red_day`."""
    seen: list[Observation] = []
    for day in days:
        tau = day - red_day
        seen = remember(seen, told(day, COLOURS[stage(tau, turning_days)], 0.014 * radius_share(tau, turning_days)))
    return seen


def fruit_of(name: str, seen: list[Observation], confidence: float = 0.99) -> Fruit:
    return Fruit(fruit_id=name, colour=seen[-1].colour, confidence=confidence, x_m=0.1, y_m=0.0, z_m=0.2,
                 radius_m=seen[-1].radius_m, last_seen_s=seen[-1].t_s)  # fmt: skip


HALF_DAYS = [0.5 * i for i in range(30)]


@pytest.mark.parametrize("turning_days", [2.5, 4.0, 6.0, 8.0])
def test_a_plant_learns_how_long_its_fruit_take_to_redden(turning_days: float) -> None:
    pace = learn([life(6.0 + 1.3 * i, turning_days, HALF_DAYS) for i in range(6)])
    assert pace.turning_days == pytest.approx(turning_days, rel=0.25)


def test_without_a_change_of_colour_the_published_figure_stands() -> None:
    assert learn([[told(0.0, "green"), told(1.0, "green")]]).turning_days == TURNING_DAYS
    assert learn([]) == Pace()


def test_a_fruit_seen_turn_is_expected_red_when_its_time_is_over() -> None:
    seen = life(9.0, 5.0, [0.5 * i for i in range(14)])  # last seen on day 6.5, turned on day 4
    belief = believe(seen, Pace(turning_days=5.0))
    assert believe(seen[:1], Pace()).red(seen[0].t_s + DAY_S) < 0.05
    assert belief.red(seen[-1].t_s + DAY_S) < 0.3
    assert belief.red(seen[-1].t_s + 4.0 * DAY_S) > 0.8


def test_a_small_green_fruit_is_expected_to_grow_and_a_red_one_is_not() -> None:
    small = believe([told(0.0, "green", 0.006)], Pace())
    assert small.radius_m(0.006, 0.0, 5.0 * DAY_S) > 0.007
    red = believe([told(0.0, "red")], Pace())
    assert red.radius_m(0.0138, 0.0, 5.0 * DAY_S) == pytest.approx(0.0138, rel=0.02)


def test_what_is_known_grows_old_until_the_next_scan() -> None:
    seen = [life(5.0 + i, 5.0, [0.0]) for i in range(8)]
    hopes = [Hope(fruit_of(f"f{i}", s), believe(s, Pace())) for i, s in enumerate(seen)]
    grown = [uncertainty(hopes, 0.0, day * DAY_S) for day in (0, 1, 2, 4, 8)]
    assert grown == sorted(grown)
    assert grown[0] < 0.35 < grown[-1]
    assert uncertainty(hopes, None, 0.0) == uncertainty([], None, 0.0) == 1.0
    assert uncertainty([], 0.0, 0.0) == 0.0 < uncertainty([], 0.0, DAY_S)


@given(st.lists(st.floats(0.0, 1.0), max_size=12))
def test_the_interval_holds_the_expected_number(chances: list[float]) -> None:
    low, high = interval(chances, 0.9)
    assert 0 <= low <= high <= len(chances)
    assert low - 1 <= sum(chances) <= high + 1


@pytest.mark.parametrize("seed", [1, 2])
def test_the_forecast_a_day_ahead_holds_the_truth_as_often_as_it_says(seed: int) -> None:
    rng, held, trials, off = random.Random(seed), 0, 40, 0.0
    for _ in range(trials):
        red_days = [rng.uniform(1.0, 16.0) for _ in range(10)]
        turning = [max(3.0, rng.gauss(5.0, 0.7)) for _ in red_days]
        seen = [life(red, t, [0.5 * i for i in range(9)]) for red, t in zip(red_days, turning, strict=True)]
        pace = learn(seen)
        hopes = [Hope(fruit_of(f"f{i}", s), believe(s, pace)) for i, s in enumerate(seen)]
        told_then = forecast("plant-1", hopes, pace, 4.0 * DAY_S, 4.0 * DAY_S, DAY_S)
        truth = sum(red <= 5.0 for red in red_days)
        held += told_then.ripe_min <= truth <= told_then.ripe_max
        off += told_then.ripe - truth
    assert held / trials >= 0.85, f"seed {seed}"
    assert abs(off / trials) < 0.6, f"seed {seed}"


def test_memory_is_bounded_and_keeps_the_changes() -> None:
    seen: list[Observation] = []
    for i in range(100):
        seen = remember(seen, told(i, "green" if i < 40 else "turning" if i < 70 else "red"))
    assert len(seen) == OBSERVATIONS_MAX
    days = [o.t_s / DAY_S for o in seen]
    assert {39.0, 40.0, 69.0, 70.0, 99.0} <= set(days)
