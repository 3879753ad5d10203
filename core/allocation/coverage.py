"""Where an idle robot waits, so that robots together are near to every dock that may ask for them.

All robots share one sum: over the docks, the seconds from each to its nearest robot. An idle robot moves to the place that
lessens this sum most, the others staying where they are, and stays when it would lessen it by little. So every move lessens
the same sum by a share of it, and moving ends; nobody needs to know more than where its neighbours stand.
Source: Cortes, Martinez, Karatas and Bullo, Coverage control for mobile sensing networks (2004), with docks for a density:
the discrete k-median, by local search.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

GAIN_RATIO = 0.2
"""A move lessens the sum by so much of it at least."""
FAR_S = 600.0
"""A dock that nobody can reach counts as so far."""

Ways = Mapping[str, float | None]
"""Seconds from one place to every dock; None: no way."""


def reach_s(robots: Iterable[Ways], docks: Iterable[str]) -> float:
    """The sum over `docks` of the seconds from the nearest of `robots`."""
    stood = list(robots)
    return sum(min((_way_s(ways, dock) for ways in stood), default=FAR_S) for dock in docks)


def better_place(here: Ways, others: Sequence[Ways], places: Mapping[str, Ways]) -> str | None:
    """The place to wait at, of `places` by name, or None to stay.

    `here` and `others`: the ways of this robot and of its neighbours to all docks. Ties go by name.
    """
    docks = list(here)
    now_s = reach_s([here, *others], docks)
    sums_s = {name: reach_s([ways, *others], docks) for name, ways in places.items()}
    best = min(sums_s, key=lambda name: (sums_s[name], name), default=None)
    return best if best is not None and sums_s[best] < now_s * (1.0 - GAIN_RATIO) else None


def _way_s(ways: Ways, dock: str) -> float:
    way_s = ways.get(dock)
    return FAR_S if way_s is None else min(way_s, FAR_S)
