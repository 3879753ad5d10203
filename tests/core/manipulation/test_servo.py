"""The servo sees a ball: its matrix is the derivative, its calibration finds it, its steps arrive, its guess sharpens."""

from __future__ import annotations

import math

import numpy as np
import pytest

from core.errors import Refused, Unprocessable
from core.geometry.pinhole import from_fov
from core.manipulation.approach import (
    HOSE,
    LOOK_M,
    READY_M,
    ROLLS_RAD,
    VARIED_RAD,
    Obstacle,
    along,
    approaches,
    opening_for,
    room_m,
    travel_rad,
    turn_m,
    varied,
    way_in,
    way_out,
)
from core.manipulation.arm import hand_point
from core.manipulation.eye import beside, camera_pose, looking, scan_poses, singular
from core.manipulation.servo import Target, calibrate, interaction_matrix, servo_step
from core.manipulation.swing import obstruction
from core.robots.gardener import ARM_HOME_RAD, CAMERA_FOV_Y_DEG, DOCK_TO_STEM_M

CAMERA = from_fov(640, 480, math.radians(CAMERA_FOV_Y_DEG))
AHEAD = np.eye(4)
FRUIT = (0.42, 0.05, 0.50)
LOW = (0.48, 0.05, 0.43)
"""On the lowest truss, where most ripe fruit hang."""


def seen(p_cam: np.ndarray) -> np.ndarray:
    return Target(p_base=p_cam, P=np.eye(3)).features(CAMERA, AHEAD)


def test_the_interaction_matrix_is_the_derivative_of_the_features() -> None:
    p = np.array([0.03, -0.02, 0.25])
    L = interaction_matrix(CAMERA, *seen(p))
    for axis in range(3):
        move = np.zeros(3)
        move[axis] = 1e-6
        np.testing.assert_allclose((seen(p - move) - seen(p)) / 1e-6, L[:, axis], rtol=1e-3, atol=1e-2)


def test_calibration_by_small_moves_finds_the_analytic_matrix() -> None:
    p, rng = np.array([0.0, 0.01, 0.30]), np.random.default_rng(3)
    moves = rng.uniform(-0.01, 0.01, (12, 3))
    changes = np.array([seen(p - move) - seen(p) for move in moves]) + rng.normal(0.0, 0.3, (12, 3))
    found, wanted = calibrate(moves, changes), interaction_matrix(CAMERA, *seen(p))
    assert np.abs(found - wanted).max() < 0.05 * np.abs(wanted).max()
    with pytest.raises(Unprocessable, match="three directions"):
        calibrate(moves * [1.0, 1.0, 0.0], changes)


def test_servo_steps_bring_the_fruit_to_its_place_in_the_picture() -> None:
    p, goal = np.array([0.04, -0.03, 0.24]), seen(np.array([0.0, 0.045, 0.15]))
    for _ in range(12):
        u, v, r = seen(p)
        p = p - servo_step(interaction_matrix(CAMERA, u, v, r), np.array([u, v, r]) - goal)
    np.testing.assert_allclose(p, [0.0, 0.045, 0.15], atol=1e-3)


def test_sightings_from_several_places_measure_the_distance_of_a_fruit_of_unknown_size() -> None:
    rng, truth, radius_m = np.random.default_rng(5), np.array(FRUIT), 0.0160
    target = Target.expected(truth + np.array([0.02, -0.01, 0.015]), 0.02, 0.0135)
    for height in (0.40, 0.46, 0.52, 0.58):
        T = camera_pose(looking((0.20, 0.0, height), 0.0))
        z = Target(p_base=truth, P=np.eye(3), radius_m=radius_m).features(CAMERA, T) + rng.normal(0.0, 1.0, 3)
        assert target.distance2(CAMERA, T, z) < 16.0
        target.see(CAMERA, T, z)
    assert float(np.linalg.norm(target.p_base - truth)) < 0.006
    assert target.sigma_m < 0.008


def test_looks_from_aside_have_the_fruit_in_the_picture_from_both_sides_and_touch_nothing() -> None:
    bearings = []
    for q in beside(LOW):
        assert obstruction(q) == ""
        T = camera_pose(q)
        u, v, r = Target.expected(np.array(LOW), 0.01, 0.0135).features(CAMERA, T)
        assert r < u < CAMERA.width - r
        assert r < v < CAMERA.height / 2 + r, "above the fingers"
        assert math.dist(hand_point(q), LOW) > LOOK_M
        sight = np.array(LOW) - T[:3, 3]
        bearings.append(math.degrees(math.atan2(sight[1], sight[0])))
    assert max(bearings) - min(bearings) > 20.0


def test_two_looks_from_aside_tell_where_a_fruit_is_that_the_inventory_has_too_near_and_too_small() -> None:
    truth, radius_m = np.array(LOW), 0.0150
    target = Target.expected(truth + np.array([-0.010, 0.002, 0.004]), 0.0075, 0.0125)
    first = np.linalg.norm(target.p_base - truth)
    for T in [camera_pose(q) for q in beside(LOW)[:2]]:
        assert not target.known
        target.see(CAMERA, T, Target(p_base=truth, P=np.eye(4), radius_m=radius_m).features(CAMERA, T))
    assert target.known
    assert float(np.linalg.norm(target.p_base - truth)) < 0.5 * first
    assert target.radius_m > 0.0130


def test_the_six_scan_poses_look_at_the_plant_and_touch_nothing() -> None:
    poses = scan_poses()
    assert len({tuple(np.round(q, 3)) for q in poses}) == 6
    for q in poses:
        assert obstruction(q) + singular(q) == ""
        T = camera_pose(q)
        stem = T[:3, :3].T @ (np.array([DOCK_TO_STEM_M, 0.0, T[2, 3]]) - T[:3, 3])
        assert stem[2] > 0.25
        assert abs(stem[0] / stem[2]) < 0.5


def test_the_way_in_is_straight_and_ends_at_the_fruit() -> None:
    for way in approaches(FRUIT, 0.0135, [])[:4]:
        assert hand_point(way.grasp) == pytest.approx(FRUIT, abs=1e-9)
        points = np.array([hand_point(q) for q in way.path])
        assert np.linalg.norm(points[0] - points[-1]) == pytest.approx(LOOK_M)
        off = np.cross(points - points[-1], points[0] - points[-1]) / LOOK_M
        assert np.abs(off).max() < 1e-9
        assert travel_rad(way.path) < 2.0


def test_a_hand_keeps_away_from_the_neighbours_it_can_keep_away_from() -> None:
    above = Obstacle(centre=(FRUIT[0] - 0.03, FRUIT[1], FRUIT[2] + 0.035), radius_m=0.0135)
    best = approaches(FRUIT, 0.0135, [above])[0]
    level = room_m(FRUIT, 0.0, opening_for(0.0135), [above])
    assert best.room_m > level
    assert best.pitch_rad > 0.0, "it comes from below"
    beside = Obstacle(centre=(FRUIT[0], FRUIT[1] + 0.025, FRUIT[2]), radius_m=0.0135)
    assert approaches(FRUIT, 0.0135, [beside])[0].room_m < 0.0, "such a neighbour is pushed, and it is said"


def test_fruit_out_of_reach_is_refused_with_the_reason() -> None:
    with pytest.raises(Refused, match=r"stand|outside|reach"):
        approaches((0.60, 0.0, 1.10), 0.0135, [])
    with pytest.raises(Refused, match="touch"):
        way_in((0.50, 0.0, 0.255), 0.0)
    assert singular((0.0, 0.5, -0.01, 0.0))
    assert singular(ARM_HOME_RAD)
    assert not singular(approaches(FRUIT, 0.0135, [])[0].grasp)
    assert along(FRUIT, 0.0, 0.0) == pytest.approx(FRUIT)


def test_ways_that_are_tried_one_after_another_come_from_different_sides() -> None:
    ways = approaches(FRUIT, 0.0135, [])
    chosen = varied(ways, 3)
    assert len(chosen) == 3
    assert chosen[0] is ways[0], "the best first"
    pitches = sorted(way.pitch_rad for way in chosen)
    assert min(np.diff(pitches)) > VARIED_RAD
    assert varied(ways[:1], 3) == ways[:1]


def test_fingers_that_must_stand_upright_are_turned_further_off_when_a_neighbour_hangs_beside_the_way() -> None:
    beside_it = [Obstacle(centre=(FRUIT[0], FRUIT[1] + side * 0.033, FRUIT[2]), radius_m=0.0135) for side in (1, -1)]
    upright = next(way for way in approaches(FRUIT, 0.0135, beside_it, ROLLS_RAD) if abs(way.roll_rad) > 1.0)
    assert turn_m(FRUIT, upright, beside_it) == READY_M
    tool = along(FRUIT, upright.pitch_rad, READY_M)
    before = [*beside_it, Obstacle(centre=(tool[0], tool[1] + 0.030, tool[2]), radius_m=0.010)]
    assert turn_m(FRUIT, upright, before) > READY_M


def test_a_way_on_which_the_hose_would_brush_a_fruit_is_liked_less() -> None:
    free = approaches(FRUIT, 0.0135, [])[0]
    c, s = math.cos(free.pitch_rad), math.sin(free.pitch_rad)
    x, y, z = along(FRUIT, free.pitch_rad, 0.035)
    below = Obstacle(centre=(x + 0.030 * s, y, z - 0.030 * c), radius_m=0.0135)
    assert room_m(FRUIT, free.pitch_rad, opening_for(0.0135), [below]) > 0.0
    assert room_m(FRUIT, free.pitch_rad, opening_for(0.0135), [below], parts=HOSE) < 0.0
    assert approaches(FRUIT, 0.0135, [below])[0].hose_room_m > 0.0


def test_a_fruit_is_carried_past_the_one_that_hangs_before_it() -> None:
    way = next(way for way in approaches(FRUIT, 0.0135, []) if way.pitch_rad == 0.0)
    x, y, z = along(FRUIT, way.pitch_rad, 0.035)
    before = Obstacle(centre=(x, y, z - 0.022), radius_m=0.0135)

    def nearest_m(path: list[tuple[float, float, float, float]]) -> float:
        return min(math.dist(hand_point(q), before.centre) for q in path) - 2 * 0.0135

    assert nearest_m(way_out(FRUIT, way, 0.0135, [])) < -0.003, "straight back drags it along"
    assert nearest_m(way_out(FRUIT, way, 0.0135, [before])) > 0.0
