"""A robot's own queue in a shorter order, by a street of known distances."""

import random
from dataclasses import replace
from itertools import pairwise, permutations

import pytest

from core.allocation.bidding import Condition, Stop, queue_s
from core.allocation.queue import Entry, TaskQueue
from core.allocation.reorder import _neighbours, better_order, shortest_found


def travel(place, dock):
    return abs((0.0 if place == "here" else float(place)) - float(dock))


def stop(dock, **more):
    return Stop(dock=dock, work_s=10.0, task_id=f"{dock}:1", **more)


def robot(*queue):
    return Condition(robot_id="robot-1", can=frozenset({"inventory"}), travel=travel, queue=queue)


def test_a_street_is_served_from_one_end_to_the_other():
    me = robot(stop("30"), stop("10"), stop("40"), stop("20"))
    assert better_order(me) == [1, 3, 0, 2]


def test_what_is_settled_stays_and_so_does_all_before_it():
    me = robot(stop("30"), stop("10", settled=True), stop("40"), stop("20"))
    assert better_order(me) == [0, 1, 3, 2]


def test_the_urgent_stay_before_the_less_urgent():
    me = robot(stop("30", priority=7), stop("10", priority=7), stop("40"), stop("20"))
    assert better_order(me) == [1, 0, 3, 2]


def test_errands_of_its_own_stay():
    me = robot(stop("30"), Stop(dock="", charge=True, settled=True), stop("50"), stop("40"))
    assert better_order(me) == [0, 1, 3, 2]


def test_an_order_that_cannot_be_reached_or_gains_nothing_is_left_as_it_is():
    walled = replace(robot(stop("30"), stop("10")), travel=lambda place, dock: None)
    assert better_order(walled) == [0, 1]
    assert better_order(robot(stop("10"), stop("10.4"), stop("10.2"))) == [0, 1, 2]
    assert better_order(robot()) == []


def test_no_order_is_ever_worse_than_the_one_before():
    rng = random.Random(5)
    print("seed 5")
    for _ in range(50):
        me = robot(*(stop(f"{rng.uniform(0, 100):.3f}", priority=rng.choice((5, 5, 7))) for _ in range(rng.randrange(8))))
        me = replace(me, queue=tuple(sorted(me.queue, key=lambda s: -s.priority)))
        order = better_order(me)
        assert sorted(order) == list(range(len(me.queue)))
        assert queue_s(me, [me.queue[number] for number in order]) <= queue_s(me, me.queue)


@pytest.mark.parametrize("tail", [0, 1])
def test_local_search_ends_near_the_shortest_of_all_orders(tail):
    rng = random.Random(6)
    print("seed 6")
    for _ in range(20):
        places = [complex(rng.random(), rng.random()) for _ in range(6 + tail)]
        legs = [[abs(a - b) for b in places] for a in places]
        ends = [6] * tail
        lengths = [sum(legs[a][b] for a, b in pairwise([0, *p, *ends])) for p in permutations(range(1, 6))]
        found = shortest_found(legs, 5)
        assert sum(legs[a][b] for a, b in pairwise([0, *found, *ends])) <= 1.1 * min(lengths)


def test_the_way_on_to_what_comes_after_counts():
    """10 and 20 are on the way to 30, which is more urgent than nothing but stays last: its priority is lower."""
    me = robot(stop("20"), stop("10"), stop("30", priority=3))
    assert better_order(me) == [1, 0, 2]
    back = robot(stop("10"), stop("20"), stop("0", priority=3))
    assert better_order(back) == [0, 1, 2]


def test_the_way_begins_where_the_robot_will_be():
    there = replace(robot(stop("10"), stop("30")), docked_at="40")
    assert better_order(there) == [1, 0]
    busy = replace(robot(stop("10"), stop("30")), current=stop("40"))
    assert better_order(busy) == [1, 0]
    settled = robot(stop("40", settled=True), stop("10"), stop("30"))
    assert better_order(settled) == [0, 2, 1]


def test_a_gain_of_one_second_is_worth_it_and_less_is_not():
    """Two tasks on one side: the other order saves twice the way between them, less the way back."""
    for gap, order in ((1.0, [1, 0]), (0.999, [0, 1])):
        assert better_order(robot(stop(f"{10.0 + gap}"), stop("10.0"))) == order


def test_a_stop_without_a_dock_is_not_moved_nor_what_is_before_it():
    me = robot(stop("30"), Stop(dock="", refill=True), stop("20"), stop("10"))
    assert better_order(replace(me, taps=("0",), tank_ml=1500.0)) == [0, 1, 3, 2]


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_few_places_are_put_in_their_shortest_order(count):
    legs = [[abs(a - b) for b in (0.0, 3.0, 1.0, 2.0)[: count + 1]] for a in (0.0, 3.0, 1.0, 2.0)[: count + 1]]
    assert shortest_found(legs, count) == [[], [1], [2, 1], [2, 3, 1]][count]


@pytest.mark.parametrize("size", [1, 2, 3, 5, 6, 8])
def test_the_neighbours_of_an_order_are_all_turned_and_all_shifted_parts(size):
    path = list(range(size))
    turned = {(*path[:i], *path[i:j][::-1], *path[j:]) for i in range(size) for j in range(i + 2, size + 1)}
    shifted = set()
    for length in range(1, min(3, size - 1) + 1):
        for i in range(size - length + 1):
            rest = path[:i] + path[i + length :]
            shifted |= {(*rest[:k], *path[i : i + length], *rest[k:]) for k in range(len(rest) + 1)}
    found = [tuple(each) for each in _neighbours(path)]
    assert set(found) == (turned | shifted) - {tuple(path)}
    assert tuple(path) not in found


def test_a_queue_is_arranged_behind_what_runs():
    queue = TaskQueue([Entry(task_id=name, kind="inventory", running=name == "a") for name in "abcd"])
    queue.arrange([2, 0, 1])
    assert [entry.task_id for entry in queue.entries] == ["a", "d", "b", "c"]
