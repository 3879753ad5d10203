"""Where to hold the nozzle over the soil, and how to bring it there, past the fruit that hang about.

Everything in the base frame of a docked robot [m]. Water falls straight down, so that any place over the soil will do; the
hand comes in along its own x axis and goes out the same way, as it does for a pick (`core.manipulation.approach`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from core.errors import Refused
from core.manipulation.approach import HAND_PARTS, HOSE, ROOM_ENOUGH_M, Obstacle, room_m, way_in
from core.manipulation.arm import NOZZLE_PITCHES_RAD, Joints, Point3, hand_point, inverse
from core.robots.gardener import NOZZLE_IN_HAND_M, SOIL_RADIUS_M

IN_M = (0.15, 0.12, 0.09)
"""The straight way in begins so far before its end, the longest that the arm can."""
ASIDE_M = (0.0, 0.035, -0.035, 0.06, -0.06)
NEARER_M = (0.0, 0.025, -0.02)
HIGHER_M = (0.0, 0.04, 0.08)
"""From the place that the plant names: to the left and right, towards the dock, up. In order of liking."""
RIM_M = 0.03
"""The nozzle keeps this far inside the soil's edge: the base does not stand quite where it thinks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pouring:
    """One way. `path` ends where the nozzle is over the soil; going back is the same in reverse."""

    path: tuple[Joints, ...]
    room_m: float
    """Between the hand, anywhere on its way, and the nearest fruit; negative when it would be pushed."""


def pouring(nozzle: Point3, stem: Point3, fruit: Sequence[Obstacle]) -> Pouring:
    """The first way with room enough, else the one with the most.

    `nozzle` is where the plant would have it, `stem` the foot of its stem. Raises Refused with the reason of the place it
    likes best when the arm can go no way at all.
    """
    best: Pouring | None = None
    why: Refused | None = None
    for at in _places(nozzle, stem):
        for pitch_rad in NOZZLE_PITCHES_RAD:
            try:
                way = _way(at, pitch_rad, fruit)
            except Refused as refusal:
                why = why or refusal
                continue
            if way.room_m >= ROOM_ENOUGH_M:
                return way
            if best is None or way.room_m > best.room_m:
                best = way
    if best is None:
        raise Refused(f"the nozzle cannot reach the soil: {why}", hint="dock again")
    return best


def _places(nozzle: Point3, stem: Point3) -> Iterator[Point3]:
    """Over the soil, the nearest to what the plant names first."""
    offsets = [(-nearer, aside, up) for up in HIGHER_M for nearer in NEARER_M for aside in ASIDE_M]
    for dx, dy, dz in sorted(offsets, key=lambda offset: math.hypot(*offset)):
        at = nozzle[0] + dx, nozzle[1] + dy, nozzle[2] + dz
        if dx == dy == 0.0 or math.hypot(at[0] - stem[0], at[1] - stem[1]) <= SOIL_RADIUS_M - RIM_M:
            yield at


def _way(at: Point3, pitch_rad: float, fruit: Sequence[Obstacle]) -> Pouring:
    tool = hand_point(inverse(at, pitch_rad, NOZZLE_IN_HAND_M))
    room = min(room_m(tool, pitch_rad, 0.0, fruit, parts=parts) for parts in (HAND_PARTS, HOSE))
    return Pouring(path=_straight(tool, pitch_rad), room_m=room)


def _straight(tool: Point3, pitch_rad: float) -> tuple[Joints, ...]:
    first: Refused | None = None
    for from_m in IN_M:
        try:
            return way_in(tool, pitch_rad, from_m)
        except Refused as refusal:
            first = first or refusal
    assert first is not None
    raise first
