"""Moving the arm past pot and dock: joint-space legs, each checked on the way, and how long each takes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from core.errors import Refused
from core.manipulation.arm import Joints, limit_broken, plane_points
from core.robots.gardener import (
    ARM_HOME_RAD,
    ARM_JOINTS,
    BODY_HEIGHT_M,
    BODY_RADIUS_M,
    DOCK_TO_STEM_M,
    POT_RADIUS_M,
    SERVOS,
    SHOULDER_X_M,
    SOIL_HEIGHT_M,
)

SPEED_SHARE = 0.5
"""Of a servo's top speed: an open-loop arm that hurries, rings."""
LEG_S_MIN = 0.3
MARGIN_M = 0.015
STEP_RAD = 0.03
DOCK_HEIGHT_M = 0.12
RAISED_RAD: tuple[Joints, ...] = (
    (0.0, math.radians(110.0), math.radians(-100.0), 0.0),
    (0.0, math.radians(90.0), math.radians(-60.0), math.radians(-30.0)),
    (0.0, math.radians(120.0), math.radians(-90.0), math.radians(30.0)),
)
"""Poses above everything, between folded and forward."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """One group move."""

    q: Joints
    duration_s: float


def leg_s(a: Joints, b: Joints, speed_share: float = SPEED_SHARE, least_s: float = LEG_S_MIN) -> float:
    """How long a straight joint-space move takes [s], by its slowest servo; `least_s` at least."""
    moves = zip(ARM_JOINTS, a, b, strict=True)
    return max(least_s, *(abs(y - x) / (speed_share * SERVOS[name].speed_radps_max) for name, x, y in moves))


def obstruction(q: Joints, soil_height_m: float = SOIL_HEIGHT_M) -> str:
    """What the arm would touch at a docked robot, as a sentence; empty when clear.

    The pot is the disc of `POT_RADIUS_M` round the stem, up to its rim; before it stands the dock, and the body is below.
    """
    cos, sin = math.cos(q[0]), math.sin(q[0])
    points = plane_points(q)
    for (ra, za), (rb, zb) in pairwise(points[1:]):
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            r, z = ra + share * (rb - ra), za + share * (zb - za)
            x, y = SHOULDER_X_M + r * cos, r * sin
            if math.hypot(x - DOCK_TO_STEM_M, y) < POT_RADIUS_M + MARGIN_M and z < soil_height_m + MARGIN_M:
                return "the arm would touch the pot"
            if z < (BODY_HEIGHT_M if math.hypot(x, y) < BODY_RADIUS_M else DOCK_HEIGHT_M) + MARGIN_M:
                return "the arm would touch the body or the dock"
    return ""


def clear(a: Joints, b: Joints) -> bool:
    """True when the straight joint-space move from a to b touches nothing."""
    steps = max(1, math.ceil(max(abs(y - x) for x, y in zip(a, b, strict=True)) / STEP_RAD))
    return not any(obstruction(_between(a, b, i / steps)) for i in range(steps + 1))


def _between(a: Joints, b: Joints, share: float) -> Joints:
    p, s, e, w = (x + share * (y - x) for x, y in zip(a, b, strict=True))
    return p, s, e, w


def swing(start: Joints, goal: Joints) -> tuple[Leg, ...]:
    """Legs from `start` to `goal`: straight if that is clear, else up first and then forward.

    Raises Refused when the goal is out of range or every way touches something.
    """
    if why := limit_broken(goal) or obstruction(goal):
        raise Refused(why, hint="choose another goal")
    if clear(start, goal):
        return (Leg(q=goal, duration_s=leg_s(start, goal)),)
    for up in RAISED_RAD:
        for via in (up, (goal[0], *up[1:])):
            if clear(start, via) and clear(via, goal):
                return Leg(q=via, duration_s=leg_s(start, via)), Leg(q=goal, duration_s=leg_s(via, goal))
    raise Refused("no way of the arm to its goal is clear", hint="fold the arm first")


def fold(start: Joints) -> tuple[Leg, ...]:
    """Legs from `start` back to the folded pose."""
    return swing(start, ARM_HOME_RAD)


def arm_work_s(goal: Joints) -> float:
    """Seconds to reach `goal` from the folded pose, for bids."""
    return sum(leg.duration_s for leg in swing(ARM_HOME_RAD, goal))
