from __future__ import annotations

import math
import random

import pytest

from core.soil import Limits, ProbeState, Reading, judge, remember
from hw.protocols import vh400

LIMITS = Limits(ratio_of=vh400.ratio_of)


def noisy(rng: random.Random, volts: float = 1.4) -> tuple[float, ...]:
    return tuple(vh400.code_volts(vh400.code_of(volts + rng.gauss(0, 0.0025))) for _ in range(5))


def test_a_good_reading_is_the_median_through_the_curve() -> None:
    assert judge((1.0, 1.2, 1.19), (), 0.0, LIMITS) == (ProbeState.GOOD, vh400.ratio_of(1.19))


@pytest.mark.parametrize(
    ("samples_v", "state"),
    [
        ((0.0, 0.01, 0.0), ProbeState.OPEN),
        ((0.4, 1.9, 1.0), ProbeState.OPEN),
        ((4.995, 4.995, 5.0), ProbeState.SHORT),
        ((3.6, 3.61, 3.6), ProbeState.OUT_OF_RANGE),
        ((1.0, math.nan, 1.0), ProbeState.OUT_OF_RANGE),
    ],
)
def test_a_bad_reading_has_a_state_of_its_own_and_no_value(samples_v: tuple[float, ...], state: ProbeState) -> None:
    assert judge(samples_v, (), 0.0, LIMITS) == (state, None)


def test_sixty_readings_without_a_flicker_are_stuck_and_fifty_nine_are_not() -> None:
    history: tuple[Reading, ...] = ()
    states = []
    for i in range(60):
        states.append(judge((1.4,) * 5, history, i * 10.0, LIMITS)[0])
        history = remember(history, (1.4,) * 5, i * 10.0, LIMITS)
    assert states == [ProbeState.GOOD] * 59 + [ProbeState.STUCK]


def test_one_flicker_frees_a_stuck_probe() -> None:
    history = tuple(Reading(i * 10.0, (1.4,) * 5) for i in range(60))
    assert judge((1.4, 1.4, 1.405, 1.4, 1.4), history, 600.0, LIMITS)[0] is ProbeState.GOOD


def test_a_living_probe_in_still_soil_is_never_stuck() -> None:
    for seed in range(5):
        rng, history = random.Random(seed), tuple[Reading, ...]()
        for i in range(1000):
            samples_v = noisy(rng)
            assert judge(samples_v, history, i * 10.0, LIMITS)[0] is ProbeState.GOOD, f"seed {seed}"
            history = remember(history, samples_v, i * 10.0, LIMITS)
        assert len(history) == LIMITS.stuck_readings


def test_a_failed_sampling_leaves_the_last_reading_until_it_is_stale() -> None:
    history = (Reading(100.0, (1.4, 1.405)),)
    assert judge((), history, 150.0, LIMITS)[0] is ProbeState.GOOD
    assert judge((), history, 161.0, LIMITS) == (ProbeState.STALE, None)
    assert remember(history, (), 150.0, LIMITS) == history


def test_a_probe_never_heard_is_down() -> None:
    assert judge((), (), 1000.0, LIMITS) == (ProbeState.DOWN, None)
