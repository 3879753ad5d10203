"""A garden that is left alone for days: what ripens within reach lies in a basket soon, and no fruit is counted twice."""

import pytest

from lab.days import Days, garden_of, live

IN_TIME_RATIO_MIN = 0.9
ERROR_RATIO_MAX = 0.1


def held(told: Days) -> None:
    """What is promised of harvests, and that nothing is counted twice."""
    due = told.due()
    late = [fruit for fruit in due if not fruit.in_time]
    assert len(late) <= (1.0 - IN_TIME_RATIO_MIN) * len(due), f"seed {told.seed}: {late} of {len(due)}"
    assert not told.picked_twice
    assert told.said_picked == told.in_baskets
    assert not [scan for scan in told.settled() if scan.doubled]


def test_in_a_day_what_was_ripe_within_reach_is_harvested_and_counted_once():
    told = live(garden_of(), 1.0, 1, "stand-in")
    held(told)
    assert told.due()
    assert len(told.scans) >= 2


@pytest.mark.soak
@pytest.mark.parametrize("detector", ["best", "stand-in"])
def test_ten_days_of_growth_harvests_and_inventories(detector):
    told = live(garden_of(plants=2), 10.0, 1, detector)
    held(told)
    off = [scan for scan in told.settled() if scan.error_ratio > ERROR_RATIO_MAX]
    assert not off, f"seed {told.seed}, {len(off)} of {len(told.settled())}: {off}"
