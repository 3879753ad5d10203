"""How to come at a fruit: the pitch of the hand, the joints on the way in and out, and the room left to its neighbours.

Everything in the base frame of a docked robot [m]. The hand comes along its own x axis, straight at the fruit, and goes
back the same way, so that what was not touched coming in is not touched going out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from core.errors import Refused
from core.manipulation.arm import Joints, Point3, inverse
from core.manipulation.eye import singular
from core.manipulation.swing import obstruction
from core.robots.gardener import GRIPPER_OPEN_M, HAND_M, SHOULDER_X_M

LOOK_M = 0.12
"""Tool point short of the fruit while the servo looks: from nearer the eye, which sits above the fingers, loses it."""
BACK_M = 0.20
"""Tool point short of the fruit, as far as the arm can, where the hand may swing aside without touching the plant."""
READY_M = 0.05
"""Tool point short of the fruit before the last, straight advance."""
TURNS_M = (READY_M, 0.075, 0.10, LOOK_M)
"""Short of the fruit level fingers are turned, at the nearest of these with room for it: fingers that stand one above the
other hide the fruit from the eye, so the hand looks with them level."""
RETREAT_M = 0.09
"""Straight back with the fruit, until nothing hangs between the fingers and the plant."""
STEP_M = 0.015
PULL_TILTS_RAD = (0.30, -0.30, 0.0)
"""The hand tips up or down while it pulls: the stalk bends over its knuckle and breaks at less force. In order of liking."""
PULL_LIFTS_RAD = (0.0, 0.35, -0.35, 0.7)
"""The way back leads so much further up than the hand came, where others hang in front. In order of liking."""
PULL_SHARES, TILTED_SHARE = (0.15, 0.3, 0.45, 0.6, 0.8, 1.0), 0.6
"""Steps of the way back; after `TILTED_SHARE` of it the hand is tipped wholly."""
ROOM_PULLED_M = 0.002
"""More room than this is not worth a way back that is liked less."""
OPENING_SLACK_M = 0.004
"""The fingers open this much wider than the fruit on either side: room for error, none for its neighbour."""
PITCHES_RAD = tuple(math.radians(d) for d in range(-54, 73, 6))
ROLLS_RAD = tuple(math.radians(d) for d in (0, 20, -20, 40, -40, 60, -60, 80, -80, 90))
"""For a wrist that rolls."""
VARIED_RAD = math.radians(24.0)
"""Ways whose pitches differ by less look past the same leaves."""
ROOM_M_MIN = -0.004
"""A fruit gives way by so much on its stalk and slides along the finger; with less room the hand stays away."""
ROOM_SHY_M = 0.0
"""With less room than this to where the inventory has the others the hand looks from aside first."""
ROOM_ENOUGH_M = 0.012
"""More room than this to a neighbour is worth nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of the hand as a box in the tool's frame, reaching forward to `front_m`; beside the opening or not."""

    front_m: float
    half_width_m: float
    beside_opening: bool
    low_m: float
    high_m: float


HAND_PARTS = (
    Part(front_m=0.015, half_width_m=0.005, beside_opening=True, low_m=-0.0105, high_m=0.0105),
    Part(front_m=-0.012, half_width_m=0.005, beside_opening=True, low_m=-0.006, high_m=0.006),
    Part(front_m=-0.075, half_width_m=0.011, beside_opening=False, low_m=-0.022, high_m=0.011),
    Part(front_m=-0.100, half_width_m=0.018, beside_opening=False, low_m=0.030, high_m=0.060),
)
"""Finger tips, fingers, palm with the hose, camera."""
HOSE = (Part(front_m=-0.016, half_width_m=0.004, beside_opening=False, low_m=-0.025, high_m=-0.014),)
"""The nozzle's end below the fingers: it may brush past a fruit, but a way on which it does not is the better one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """A fruit that is not wanted now."""

    centre: Point3
    radius_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Approach:
    """One way to a fruit. `path` runs from the looking pose to the grasp; going back is the same in reverse."""

    pitch_rad: float
    opening_m: float
    roll_rad: float
    path: tuple[Joints, ...]
    back: Joints
    """Further back on the same line: from there the hand comes in."""
    room_m: float
    """Between the hand and the nearest neighbour; negative when it would be pushed."""
    hose_room_m: float
    """The same for the hose."""

    @property
    def look(self) -> Joints:
        return self.path[0]

    @property
    def grasp(self) -> Joints:
        return self.path[-1]


def opening_for(radius_m: float) -> float:
    """How wide to open for a fruit of this radius [m]."""
    return min(GRIPPER_OPEN_M, 2 * (radius_m + OPENING_SLACK_M))


def along(fruit: Point3, pitch_rad: float, short_m: float) -> Point3:
    """The point `short_m` before the fruit on the hand's way to it."""
    bearing = math.atan2(fruit[1], fruit[0] - SHOULDER_X_M)
    cos = math.cos(pitch_rad)
    return (
        fruit[0] - short_m * cos * math.cos(bearing),
        fruit[1] - short_m * cos * math.sin(bearing),
        fruit[2] - short_m * math.sin(pitch_rad),
    )


def way_in(fruit: Point3, pitch_rad: float, from_m: float = LOOK_M, to_m: float = 0.0) -> tuple[Joints, ...]:
    """Joints every `STEP_M` from `from_m` before the fruit to `to_m`; raises Refused where one cannot be or touches."""
    count = max(1, math.ceil(abs(from_m - to_m) / STEP_M))
    path = []
    for index in range(count + 1):
        q = inverse(along(fruit, pitch_rad, from_m + (to_m - from_m) * index / count), pitch_rad)
        if why := singular(q) or obstruction(q):
            raise Refused(why, hint="try another pitch")
        path.append(q)
    return tuple(path)


def room_m(
    fruit: Point3,
    pitch_rad: float,
    opening_m: float,
    others: Sequence[Obstacle],
    roll_rad: float = 0.0,
    parts: Sequence[Part] = HAND_PARTS,
) -> float:
    """The least distance between the hand (or some `parts` of it), anywhere on its way in, and another fruit's skin [m].

    Roll turns the fingers about the hand's axis; palm and camera stay.
    """
    c, s = math.cos(roll_rad), math.sin(roll_rad)
    bearing = math.atan2(fruit[1], fruit[0] - SHOULDER_X_M)
    least = math.inf
    for other in others:
        x, y, z = _in_hand(fruit, bearing, pitch_rad, other.centre)
        for part in parts:
            across, up = (c * y + s * z, c * z - s * y) if part.beside_opening else (y, z)
            ahead = x - part.front_m
            if ahead > other.radius_m or ahead < -LOOK_M - HAND_M:
                continue
            half_y = part.half_width_m + (opening_m / 2 if part.beside_opening else 0.0)
            middle, half_z = (part.low_m + part.high_m) / 2, (part.high_m - part.low_m) / 2
            off = _off(abs(across) - half_y, abs(up - middle) - half_z)
            least = min(least, math.hypot(max(off, 0.0), ahead) - other.radius_m if ahead > 0 else off - other.radius_m)
    return least


def approaches(
    fruit: Point3, radius_m: float, others: Sequence[Obstacle], rolls_rad: Sequence[float] = (0.0,)
) -> list[Approach]:
    """Every way that the arm can go, the best first: most room to the neighbours, then the least pitch.

    Of each pitch the roll with the most room, among those that the wrist has.

    Raises Refused with the reason of the pitch that came nearest to working when there is none.
    """
    opening_m = opening_for(radius_m)
    found: list[Approach] = []
    why: Refused | None = None
    for pitch_rad in PITCHES_RAD:
        try:
            path = way_in(fruit, pitch_rad)
        except Refused as refusal:
            why = why or refusal
            continue
        roll, room = roomiest(fruit, pitch_rad, opening_m, others, rolls_rad)
        back = _furthest_back(fruit, pitch_rad)
        hose = room_m(fruit, pitch_rad, opening_m, others, parts=HOSE)
        found.append(
            Approach(
                pitch_rad=pitch_rad,
                opening_m=opening_m,
                roll_rad=roll,
                path=path,
                back=back or path[0],
                room_m=room,
                hose_room_m=hose,
            )
        )
    if not found:
        raise Refused(f"no way of the hand to the fruit: {why}", hint="another dock or robot may reach it")
    return sorted(found, key=lambda a: (-min(a.room_m, a.hose_room_m, ROOM_ENOUGH_M), abs(a.pitch_rad)))


def roomiest(
    fruit: Point3, pitch_rad: float, opening_m: float, others: Sequence[Obstacle], rolls_rad: Sequence[float]
) -> tuple[float, float]:
    """The roll [rad] of the fingers with the most room, the least of equals, and that room [m]."""
    rooms = {roll: room_m(fruit, pitch_rad, opening_m, others, roll) for roll in rolls_rad}
    roll = max(rolls_rad, key=lambda turn: (min(rooms[turn], ROOM_ENOUGH_M), -abs(turn)))
    return roll, rooms[roll]


def turn_m(fruit: Point3, way: Approach, others: Sequence[Obstacle]) -> float:
    """How far before the fruit [m] the level fingers can come, and turn there to the way's roll, touching no neighbour."""
    if not way.roll_rad:
        return READY_M
    for short_m in TURNS_M:
        tool = along(fruit, way.pitch_rad, short_m)
        if all(
            room_m(tool, way.pitch_rad, way.opening_m, others, share * way.roll_rad) >= ROOM_M_MIN
            for share in (0.0, 0.33, 0.67, 1.0)
        ):
            return short_m
    return LOOK_M


def way_out(fruit: Point3, way: Approach, radius_m: float, others: Sequence[Obstacle]) -> list[Joints]:
    """Joints on the way back with a fruit of this radius: straight, or past what it or the hand would drag along.

    Raises Refused when the arm can go none.
    """
    best: tuple[float, list[Joints]] | None = None
    for lift_rad in PULL_LIFTS_RAD:
        for tilt_rad in PULL_TILTS_RAD:
            try:
                path, room = _pulled(fruit, way, radius_m, others, lift_rad, tilt_rad)
            except Refused:
                continue
            if room >= ROOM_PULLED_M:
                return path
            if best is None or room > best[0]:
                best = room, path
    if best is None:
        raise Refused("no way back with the fruit", hint="let go")
    return best[1]


def _pulled(
    fruit: Point3, way: Approach, radius_m: float, others: Sequence[Obstacle], lift_rad: float, tilt_rad: float
) -> tuple[list[Joints], float]:
    """One way back, and the room it leaves to the others, the hand's and the fruit's [m]."""
    path, least = [], math.inf
    for share in PULL_SHARES:
        tool = along(fruit, way.pitch_rad - lift_rad, share * RETREAT_M)
        pitch_rad = way.pitch_rad + tilt_rad * min(1.0, share / TILTED_SHARE)
        path.append(inverse(tool, pitch_rad))
        carried = min((math.dist(tool, other.centre) - other.radius_m - radius_m for other in others), default=math.inf)
        hand = room_m(tool, pitch_rad, 2 * radius_m, others, way.roll_rad)
        least = min(least, carried, hand, room_m(tool, pitch_rad, 2 * radius_m, others, parts=HOSE))
    return path, least


def varied(ways: Sequence[Approach], count: int) -> list[Approach]:
    """Up to `count` ways, the best first, each from another side (`VARIED_RAD`) than those before it."""
    chosen: list[Approach] = []
    for way in ways:
        if len(chosen) < count and all(abs(way.pitch_rad - other.pitch_rad) > VARIED_RAD for other in chosen):
            chosen.append(way)
    return chosen


def _furthest_back(fruit: Point3, pitch_rad: float) -> Joints | None:
    """Joints up to `BACK_M` before the fruit, straight behind the looking pose; None when there are none."""
    found: Joints | None = None
    for step in range(1, round((BACK_M - LOOK_M) / STEP_M) + 1):
        try:
            q = inverse(along(fruit, pitch_rad, LOOK_M + step * STEP_M), pitch_rad)
        except Refused:
            break
        if singular(q) or obstruction(q):
            break
        found = q
    return found


def travel_rad(path: Sequence[Joints]) -> float:
    """The largest joint travel summed along a path [rad]: what its duration follows from."""
    return sum(max(abs(b - a) for a, b in zip(p, q, strict=True)) for p, q in pairwise(path))


def _in_hand(fruit: Point3, bearing: float, pitch_rad: float, p: Point3) -> Point3:
    """A point in the frame of a hand whose tool is at the fruit: x on, y left, z the hand's upper side."""
    dx, dy, dz = p[0] - fruit[0], p[1] - fruit[1], p[2] - fruit[2]
    r, y = dx * math.cos(bearing) + dy * math.sin(bearing), -dx * math.sin(bearing) + dy * math.cos(bearing)
    cos, sin = math.cos(pitch_rad), math.sin(pitch_rad)
    return r * cos + dz * sin, y, -r * sin + dz * cos


def _off(dy: float, dz: float) -> float:
    """Distance from a rectangle of a point that lies `dy` and `dz` outside its sides; negative inside."""
    return max(dy, dz) if dy <= 0 and dz <= 0 else math.hypot(max(dy, 0.0), max(dz, 0.0))
