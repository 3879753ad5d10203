"""The gardener's arm in plain numbers: where its links are, and which joint angles reach a point. No arrays here.

Base frame [m]; joints pan, shoulder, elbow, wrist [rad] as in `core.robots.gardener`. In the arm's vertical plane a point
is (r, z): r from the pan axis along the panned direction. Pitch is the hand's angle above the horizontal.
"""

from __future__ import annotations

import math
from functools import lru_cache

from core.errors import Refused
from core.robots.gardener import (
    ARM_JOINTS,
    BODY_HEIGHT_M,
    BODY_RADIUS_M,
    CAMERA_IN_HAND_M,
    FOREARM_M,
    HAND_M,
    MAST_RADIUS_M,
    NOZZLE_IN_HAND_M,
    SERVOS,
    SHOULDER_X_M,
    SHOULDER_Z_M,
    UPPER_ARM_M,
)

Joints = tuple[float, float, float, float]
Point3 = tuple[float, float, float]
Plane = tuple[float, float]

TOOL_IN_HAND_M: Point3 = (HAND_M, 0.0, 0.0)
NOZZLE_PITCHES_RAD = tuple(math.radians(d) for d in (-45, -50, -40, -55, -35, -60, -30, -65, -25, -70, -20, -10, 0))
"""In order of preference: pointing at the soil, not over the rim."""
_SLACK_RAD = 1e-9

CLEAR_M = 0.03
"""The arm's middle line stays so far above floor, deck and mast, and beside the mast and the body's rim: half of its
fingers, opened and turned, is 27 mm."""
SWEEP_RAD = 0.1
"""A joint-space move is looked at so often on its way."""
CLEAR_SLACK_M = 0.005
"""On its way it may come nearer by so much: the board tells where it is to 10 us, which moves the hand by 4 mm."""
_EYE = CAMERA_IN_HAND_M[0], CAMERA_IN_HAND_M[2] + 0.015
_HOSE = NOZZLE_IN_HAND_M[0], NOZZLE_IN_HAND_M[2] - 0.004
"""Corners of the hand along (hand x, hand z) from the wrist: the camera's above it, the hose's end below it."""
_MAST = -MAST_RADIUS_M - CLEAR_M, MAST_RADIUS_M + CLEAR_M


def plane_points(q: Joints) -> tuple[Plane, Plane, Plane, Plane]:
    """Shoulder, elbow, wrist and tool point as (r, z) [m] in the arm's plane, z above the floor."""
    a, b, c = q[1], q[1] + q[2], q[1] + q[2] + q[3]
    elbow = (UPPER_ARM_M * math.cos(a), SHOULDER_Z_M + UPPER_ARM_M * math.sin(a))
    wrist = (elbow[0] + FOREARM_M * math.cos(b), elbow[1] + FOREARM_M * math.sin(b))
    tool = (wrist[0] + HAND_M * math.cos(c), wrist[1] + HAND_M * math.sin(c))
    return (0.0, SHOULDER_Z_M), elbow, wrist, tool


def hand_point(q: Joints, in_hand_m: Point3 = TOOL_IN_HAND_M) -> Point3:
    """A point fixed in the hand (origin: wrist axis; x along the hand, z up), in the base frame [m]."""
    _, _, (r, z), _ = plane_points(q)
    pitch = q[1] + q[2] + q[3]
    cos, sin = math.cos(pitch), math.sin(pitch)
    r += in_hand_m[0] * cos - in_hand_m[2] * sin
    z += in_hand_m[0] * sin + in_hand_m[2] * cos
    cos, sin = math.cos(q[0]), math.sin(q[0])
    return SHOULDER_X_M + r * cos - in_hand_m[1] * sin, r * sin + in_hand_m[1] * cos, z


def reach_m(q: Joints) -> float:
    """How far any part of the arm stands out from the base's centre, seen from above [m]."""
    cos, sin = math.cos(q[0]), math.sin(q[0])
    return max(math.hypot(SHOULDER_X_M + r * cos, r * sin) for r, _ in plane_points(q))


def clearance_m(q: Joints) -> float:
    """How far the arm stays above the floor, its own body's deck and its mast, at the lowest [m]; negative inside them.

    Forearm and hand with its eye and its hose, as lines; the upper arm cannot come so low. In the arm's plane the round
    body is a stretch of r, its disc's cut, and the mast one about r = 0; both are widened by `CLEAR_M`.
    """
    _, elbow, wrist, tool = plane_points(q)
    pitch = q[1] + q[2] + q[3]
    cos, sin = math.cos(pitch), math.sin(pitch)
    eye, hose = ((wrist[0] + x * cos - z * sin, wrist[1] + x * sin + z * cos) for x, z in (_EYE, _HOSE))
    middle_m = -SHOULDER_X_M * math.cos(q[0])
    half_m = math.sqrt((BODY_RADIUS_M + CLEAR_M) ** 2 - (SHOULDER_X_M * math.sin(q[0])) ** 2)
    deck = middle_m - half_m, middle_m + half_m
    least_m = min(elbow[1], wrist[1], tool[1], eye[1], hose[1])
    for a, b in ((elbow, wrist), (wrist, tool), (wrist, eye), (wrist, hose)):
        least_m = min(least_m, _lowest_m(a, b, deck) - BODY_HEIGHT_M, _lowest_m(a, b, _MAST) - SHOULDER_Z_M)
    return least_m


def _lowest_m(a: Plane, b: Plane, stretch: Plane) -> float:
    """The least z of the line from a to b above a stretch of r; infinite when no part of it lies there."""
    if b[0] < a[0]:
        a, b = b, a
    low, high = max(a[0], stretch[0]), min(b[0], stretch[1])
    if low > high:
        return math.inf
    if b[0] - a[0] < 1e-9:
        return min(a[1], b[1])
    slope = (b[1] - a[1]) / (b[0] - a[0])
    return min(a[1] + slope * (low - a[0]), a[1] + slope * (high - a[0]))


@lru_cache(maxsize=64)
def strikes(start: Joints, goal: Joints) -> str:
    """What the joint-space move from `start` to `goal` would strike, as a sentence; empty when nothing.

    The goal must be clear by `CLEAR_M`. From a start that is not, the way may lead no further in.
    """
    if clearance_m(goal) < CLEAR_M:
        return "there the arm would touch the floor or its own body"
    least_m = min(CLEAR_M, clearance_m(start)) - CLEAR_SLACK_M
    steps = math.ceil(max(abs(b - a) for a, b in zip(start, goal, strict=True)) / SWEEP_RAD)
    for step in range(1, steps):
        p, s, e, w = (a + step / steps * (b - a) for a, b in zip(start, goal, strict=True))
        if clearance_m((p, s, e, w)) < least_m:
            return "on its way the arm would touch the floor or its own body"
    return ""


def limit_broken(q: Joints) -> str:
    """Which joint is out of its range, as a sentence; empty when none is."""
    for name, angle in zip(ARM_JOINTS, q, strict=True):
        servo = SERVOS[name]
        if not servo.min_rad - _SLACK_RAD <= angle <= servo.max_rad + _SLACK_RAD:
            low, high = math.degrees(servo.min_rad), math.degrees(servo.max_rad)
            return f"{name} at {math.degrees(angle):.0f} degrees is outside {low:.0f} .. {high:.0f}"
    return ""


def inverse(point_base_m: Point3, pitch_rad: float, in_hand_m: Point3 = TOOL_IN_HAND_M) -> Joints:
    """Joints that bring a point of the hand (default: the tool) to `point_base_m` at this pitch, elbow up.

    Raises Refused when it is out of reach or a joint would leave its range. Source: law of cosines on the two links.
    """
    dx, dy = point_base_m[0] - SHOULDER_X_M, point_base_m[1]
    cos, sin = math.cos(pitch_rad), math.sin(pitch_rad)
    r = math.hypot(dx, dy) - (in_hand_m[0] * cos - in_hand_m[2] * sin)
    z = point_base_m[2] - SHOULDER_Z_M - (in_hand_m[0] * sin + in_hand_m[2] * cos)
    span_m = math.hypot(r, z)
    bend = (span_m**2 - UPPER_ARM_M**2 - FOREARM_M**2) / (2 * UPPER_ARM_M * FOREARM_M)
    if not -1.0 <= bend <= 1.0:
        raise Refused(f"the wrist would have to stand {span_m:.2f} m from the shoulder", hint="dock again")
    elbow = -math.acos(bend)
    lift = math.atan2(z, r) - math.atan2(FOREARM_M * math.sin(elbow), UPPER_ARM_M + FOREARM_M * math.cos(elbow))
    shoulder = math.remainder(lift, math.tau)
    q = (math.atan2(dy, dx), shoulder, elbow, math.remainder(pitch_rad - shoulder - elbow, math.tau))
    if broken := limit_broken(q):
        raise Refused(broken, hint="try another pitch or dock again")
    return q


def nozzle_goal(point_base_m: Point3) -> Joints:
    """Joints that bring the nozzle to a point (base frame [m]), at the first pitch that works.

    Raises Refused with the first reason when none does.
    """
    first: Refused | None = None
    for pitch_rad in NOZZLE_PITCHES_RAD:
        try:
            return inverse(point_base_m, pitch_rad, NOZZLE_IN_HAND_M)
        except Refused as refusal:
            first = first or refusal
    assert first is not None
    raise first
