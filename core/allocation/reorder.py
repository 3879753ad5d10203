"""A robot's own queue in a shorter order: 2-opt and Or-opt over what may still change places.

Pure. What is settled stays where it is, and so does all before it; the more urgent stays before the less urgent.
Source: Croes 1958 (2-opt: a part of the way turned round), Or 1976 (a short part put elsewhere).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

from core.allocation.bidding import Condition, Stop, queue_s

PART_MAX = 3
GAIN_S_MIN = 1.0
"""An order that gains less is not worth a change."""
TINY_S = 1e-6

Legs = Sequence[Sequence[float]]
"""`legs[a][b]`: seconds on the way from place a to place b."""


def better_order(me: Condition) -> list[int]:
    """The queue's numbers in an order that is done sooner, as far as local search finds one; else as they are."""
    as_it_is = list(range(len(me.queue)))
    order = list(as_it_is)
    for first, last in _free_parts(me.queue):
        order[first:last] = _shortened(me, first, last)
    if order == as_it_is:
        return as_it_is
    was_s, would_s = queue_s(me, me.queue), queue_s(me, [me.queue[number] for number in order])
    gains = was_s is not None and would_s is not None and would_s <= was_s - GAIN_S_MIN
    return order if gains else as_it_is


def _free_parts(queue: Sequence[Stop]) -> list[tuple[int, int]]:
    """Where stops of one priority stand together, behind all that is settled: first and one past the last."""
    start = max((i + 1 for i, stop in enumerate(queue) if stop.settled or not stop.dock), default=0)
    steps = [i for i in range(start + 1, len(queue)) if queue[i].priority != queue[i - 1].priority]
    return [(a, b) for a, b in pairwise([start, *steps, len(queue)]) if b - a > 1]


def _shortened(me: Condition, first: int, last: int) -> list[int]:
    """The numbers `first` to `last` in a shorter order between what is before and behind them."""
    last_before = me.queue[first - 1] if first else me.current
    before = me.docked_at if last_before is None else last_before.dock
    docks = [before or "here", *(stop.dock for stop in me.queue[first : last + 1])]
    legs = [[_leg_s(me, a, b) for b in docks] for a in docks]
    return [first + place - 1 for place in shortest_found(legs, last - first)]


def _leg_s(me: Condition, a: str, b: str) -> float:
    if a == b or b == "here":
        return 0.0
    way_s = me.travel(a, b)
    return math.inf if way_s is None else way_s


def shortest_found(legs: Legs, count: int) -> list[int]:
    """The places 1 to `count` in a short order: from place 0, and on to place `count + 1` if there is one."""
    tail = list(range(count + 1, len(legs)))
    path = list(range(1, count + 1))
    best_s, better = _length_s(legs, path, tail), True
    while better:
        better = False
        for other in _neighbours(path):
            if (other_s := _length_s(legs, other, tail)) < best_s - TINY_S:
                path, best_s, better = other, other_s, True
                break
    return path


def _length_s(legs: Legs, path: Sequence[int], tail: Sequence[int]) -> float:
    return sum(legs[a][b] for a, b in pairwise([0, *path, *tail]))


def _neighbours(path: list[int]) -> Iterator[list[int]]:
    """The path with one part turned round, or one short part elsewhere."""
    size = len(path)
    for i in range(size - 1):
        for j in range(i + 2, size + 1):
            yield path[:i] + path[i:j][::-1] + path[j:]
    for length in range(1, min(PART_MAX, size - 1) + 1):
        for i in range(size - length + 1):
            part, rest = path[i : i + length], path[:i] + path[i + length :]
            for k in range(len(rest) + 1):
                if k != i:
                    yield rest[:k] + part + rest[k:]
