"""Where idle robots wait: moves lessen the one sum that all share, and end."""

from __future__ import annotations

import math
import random

from core.allocation.coverage import FAR_S, GAIN_RATIO, Ways, better_place, reach_s

LINE = {"a": 0.0, "b": 10.0, "c": 20.0, "d": 100.0, "e": 110.0}


def ways(at: float) -> Ways:
    """Seconds along a street from a place to every dock."""
    return {dock: abs(at - place) for dock, place in LINE.items()}


PLACES = {dock: ways(place) for dock, place in LINE.items()}


def without(*taken: str) -> dict[str, Ways]:
    return {name: place for name, place in PLACES.items() if name not in taken}


def test_a_robot_alone_waits_in_the_middle_and_stays_there() -> None:
    assert better_place(ways(-20.0), [], PLACES) == "c"
    assert better_place(ways(20.0), [], PLACES) is None


def test_of_two_side_by_side_one_goes_to_the_docks_that_are_far_from_both() -> None:
    assert better_place(ways(10.0), [ways(20.0)], without("c")) == "d"
    assert better_place(ways(20.0), [ways(100.0)], without("d")) == "b", "then the other sees to the rest"
    assert better_place(ways(100.0), [ways(10.0)], without("b")) is None


def test_little_is_not_worth_a_drive() -> None:
    assert reach_s([ways(10.0), ways(110.0)], LINE) == reach_s([ways(10.0), ways(100.0)], LINE)
    assert better_place(ways(110.0), [ways(10.0)], without("b")) is None


def test_docks_that_nobody_reaches_count_as_far_and_ties_go_by_name() -> None:
    cut_off: Ways = dict.fromkeys(LINE)
    assert reach_s([cut_off], LINE) == len(LINE) * FAR_S
    assert reach_s([], LINE) == len(LINE) * FAR_S
    assert better_place(cut_off, [], {"e": ways(20.0), "c": ways(20.0)}) == "c"
    assert better_place(ways(0.0), [], {}) is None


def test_a_fifth_less_is_not_enough_and_a_dock_beyond_far_counts_as_far() -> None:
    assert (GAIN_RATIO, FAR_S) == (0.2, 600.0)
    assert better_place({"a": 10.0}, [], {"b": {"a": 8.0}}) is None
    assert better_place({"a": 10.0}, [], {"b": {"a": 7.99}}) == "b"
    assert reach_s([{"a": 9000.0, "b": 1.0}], ["a", "b"]) == 601.0
    assert reach_s([{"a": 599.0}], ["a"]) == 599.0


def test_in_any_garden_moving_one_after_the_other_ends_and_comes_near_the_best() -> None:
    seed = 3
    print(f"seed {seed}")
    rng = random.Random(seed)
    ratios = []
    for _ in range(40):
        docks = {f"p{i}": (rng.uniform(0, 60), rng.uniform(0, 20)) for i in range(8)}
        table = {a: {b: math.dist(docks[a], docks[b]) for b in docks} for a in docks}
        robots = [rng.choice(list(docks))] * 3
        moves = 0
        while True:
            before = robots[:]
            for i in range(3):
                others = [table[name] for j, name in enumerate(robots) if j != i]
                free = {name: table[name] for name in docks if name not in robots}
                if (place := better_place(table[robots[i]], others, free)) is not None:
                    was_s = reach_s([table[robots[i]], *others], docks)
                    assert reach_s([table[place], *others], docks) < was_s * (1.0 - GAIN_RATIO)
                    robots[i], moves = place, moves + 1
            if robots == before:
                break
        assert moves <= 12
        best = min(reach_s([table[a], table[b], table[c]], docks) for a in docks for b in docks for c in docks)
        ratios.append(reach_s([table[name] for name in robots], docks) / best)
    print(f"over the best: mean {sum(ratios) / len(ratios):.3f}, worst {max(ratios):.3f}")
    assert sum(ratios) / len(ratios) < 1.15
    assert max(ratios) < 1.0 / (1.0 - GAIN_RATIO) + 0.3
