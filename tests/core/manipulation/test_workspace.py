"""The arm's room: nothing of it goes through the floor or its own body, and all that the skills do stays allowed."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from itertools import pairwise

import pytest

from core.errors import Refused
from core.manipulation import swing as swinging
from core.manipulation.approach import PULL_LIFTS_RAD, PULL_TILTS_RAD, _pulled, along, approaches, way_in
from core.manipulation.arm import (
    CLEAR_M,
    CLEAR_SLACK_M,
    Joints,
    Point3,
    clearance_m,
    hand_point,
    inverse,
    nozzle_goal,
    strikes,
)
from core.manipulation.eye import beside, scan_poses
from core.manipulation.pouring import pouring
from core.robots import gardener as g

HOME: Joints = g.ARM_HOME_RAD
UNDER: Joints = (0.0, math.radians(-10.0), math.radians(-60.0), math.radians(-30.0))
"""The fingers below the floor."""


def drawn(rng: random.Random) -> Joints:
    p, s, e, w = (rng.uniform(g.SERVOS[name].min_rad, g.SERVOS[name].max_rad) for name in g.ARM_JOINTS)
    return p, s, e, w


def between(a: Joints, b: Joints, share: float) -> Joints:
    p, s, e, w = (x + share * (y - x) for x, y in zip(a, b, strict=True))
    return p, s, e, w


def inside(q: Joints) -> bool:
    """In space, by turning one link after another: is a point of forearm or hand in the floor, the body or the mast?"""
    cos, sin = math.cos(q[0]), math.sin(q[0])
    r, z, pitch = 0.0, g.SHOULDER_Z_M, 0.0
    for number, (angle, length_m) in enumerate(zip(q[1:], (g.UPPER_ARM_M, g.FOREARM_M, g.HAND_M), strict=True)):
        pitch += angle
        for _ in range(12):
            r, z = r + length_m / 12 * math.cos(pitch), z + length_m / 12 * math.sin(pitch)
            x, y = g.SHOULDER_X_M + r * cos, r * sin
            body = math.hypot(x, y) < g.BODY_RADIUS_M and z < g.BODY_HEIGHT_M
            mast = number > 0 and abs(r) < g.MAST_RADIUS_M and z < g.SHOULDER_Z_M
            if z < 0.0 or body or mast:
                return True
    return False


def test_no_pose_within_the_joints_ranges_puts_the_arm_into_floor_body_or_mast() -> None:
    rng = random.Random(3)
    poses = [drawn(rng) for _ in range(20_000)]
    bad = [q for q in poses if inside(q)]
    assert len(bad) > 500
    assert all(strikes(HOME, q) for q in bad)
    assert sum(clearance_m(q) >= CLEAR_M for q in poses) > 0.8 * len(poses)


def test_no_way_between_allowed_poses_leads_through_floor_body_or_mast() -> None:
    rng = random.Random(4)
    pairs = [(a, b) for a, b in ((drawn(rng), drawn(rng)) for _ in range(500)) if clearance_m(a) >= CLEAR_M]
    through = [(a, b) for a, b in pairs if any(inside(between(a, b, i / 60)) for i in range(61))]
    assert len(through) > 40
    assert all(strikes(a, b) for a, b in through)
    assert sum(not strikes(a, b) for a, b in pairs) > 0.6 * len(pairs)


def test_from_every_allowed_pose_the_straight_way_home_is_clear() -> None:
    rng = random.Random(5)
    poses = [q for q in (drawn(rng) for _ in range(2000)) if clearance_m(q) >= CLEAR_M]
    assert not any(strikes(q, HOME) for q in poses)


def test_from_within_the_way_leads_out_and_no_further_in() -> None:
    raised = between(UNDER, HOME, 0.5)
    assert clearance_m(UNDER) < -0.02
    assert strikes(HOME, UNDER).startswith("there")
    assert not strikes(UNDER, raised)
    rng, further, out = random.Random(6), 0, 0
    while out < 30 or further < 10:
        start, goal = drawn(rng), drawn(rng)
        if clearance_m(start) > 0.0 or clearance_m(goal) < CLEAR_M:
            continue
        sunk_m = clearance_m(start) - min(clearance_m(between(start, goal, i / 100)) for i in range(101))
        if sunk_m > 0.03:
            further += 1
            assert strikes(start, goal).startswith("on its way")
        elif sunk_m < CLEAR_SLACK_M:
            out += 1
            assert not strikes(start, goal)


@pytest.mark.parametrize(
    ("q", "clear_m"),
    [
        (UNDER, -0.0864),
        ((0.0, math.radians(30.0), math.radians(-155.0), math.radians(-60.0)), 0.1726 - g.SHOULDER_Z_M),
        (inverse((0.07, 0.11, 0.14), math.radians(-90.0)), 0.14 - g.BODY_HEIGHT_M),
    ],
    ids=["fingertip under the floor", "eye at the mast", "fingertip over the deck"],
)
def test_the_clearance_is_that_of_the_lowest_point(q: Joints, clear_m: float) -> None:
    assert clearance_m(q) == pytest.approx(clear_m, abs=1e-3)


# What the skills ask for


def ways(*path: Joints) -> Iterator[tuple[Joints, Joints]]:
    yield from pairwise(path)


def swung(start: Joints, goal: Joints) -> Iterator[tuple[Joints, Joints]]:
    try:
        yield from ways(start, *(leg.q for leg in swinging.swing(start, goal)))
    except Refused:
        return


def watering(stem: Point3) -> Iterator[tuple[Joints, Joints]]:
    nozzle = stem[0] - g.NOZZLE_POINT_M[0], stem[1], stem[2] + g.NOZZLE_POINT_M[2]
    yield from swung(HOME, nozzle_goal(nozzle))
    yield from swung(nozzle_goal(nozzle), HOME)
    path = pouring(nozzle, stem, []).path
    yield from swung(HOME, path[0])
    yield from ways(*path)


def scanning(stem: Point3) -> Iterator[tuple[Joints, Joints]]:
    for a, b in pairwise((HOME, *scan_poses(stem), HOME)):
        yield from swung(a, b)


def picking(fruit: Point3, radius_m: float) -> Iterator[tuple[Joints, Joints]]:
    for q in beside(fruit):
        yield from swung(HOME, q)
    for way in approaches(fruit, radius_m, [])[::3]:
        yield from swung(HOME, way.back)
        yield from ways(way.back, *way.path)
        yield from ways(way.grasp, *_further(fruit, way.pitch_rad))
        yield from ways(way.grasp, *_withdrawn(way.grasp), HOME)
        for lift_rad in PULL_LIFTS_RAD:
            for tilt_rad in PULL_TILTS_RAD:
                try:
                    out, _ = _pulled(fruit, way, radius_m, [], lift_rad, tilt_rad)
                except Refused:
                    continue
                yield from ways(way.grasp, *out)
        yield from swung(way.grasp, g.ARM_BASKET_RAD)


def _further(fruit: Point3, pitch_rad: float) -> tuple[Joints, ...]:
    try:
        return way_in(fruit, pitch_rad, 0.0, -0.023)
    except Refused:
        return ()


def _withdrawn(q: Joints) -> Iterator[Joints]:
    tool, pitch_rad = hand_point(q), q[1] + q[2] + q[3]
    for number in range(1, 6):
        try:
            yield inverse(along(tool, pitch_rad, number * 0.03), pitch_rad)
        except Refused:
            return


def test_all_that_the_skills_do_stays_far_from_the_limit() -> None:
    """So that the board's coarse pulses and a base that stands a little off never make the gate refuse it."""
    seed = 1
    print("seed", seed)
    rng = random.Random(seed)
    moves = [*swung(HOME, g.ARM_BASKET_RAD), *swung(g.ARM_BASKET_RAD, HOME)]
    moves += [(HOME, q) for q in swinging.RAISED_RAD]
    for _ in range(3):
        stem = g.DOCK_TO_STEM_M + rng.uniform(-0.01, 0.03), rng.uniform(-0.03, 0.03), g.SOIL_HEIGHT_M
        moves += [*watering(stem), *scanning(stem)]
    picked = 0
    for height_m in (0.27, 0.28, 0.29, 0.30, 0.31, 0.32, 0.34, 0.36, 0.4, 0.45, 0.5, 0.6, 0.7):
        fruit = g.DOCK_TO_STEM_M + rng.uniform(-0.2, 0.0), rng.uniform(-0.15, 0.15), height_m
        try:
            moves += list(picking(fruit, rng.uniform(0.008, 0.02)))
        except Refused:
            continue
        picked += 1
    assert picked > 5
    assert not [(a, b) for a, b in moves if strikes(a, b)]
    assert min(clearance_m(between(a, b, share)) for a, b in moves for share in (0.5, 1.0)) > 2 * CLEAR_M
