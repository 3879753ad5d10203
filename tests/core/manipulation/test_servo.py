"""The servo sees a ball: its matrix is the derivative, its calibration finds it, its steps arrive, its guess sharpens."""

from __future__ import annotations

import math

import numpy as np
import pytest

from core.errors import Refused, Unprocessable
from core.geometry.pinhole import from_fov
from core.manipulation.approach import (
    LOOK_M,
    Obstacle,
    along,
    approaches,
    opening_for,
    room_m,
    travel_rad,
    way_in,
)
from core.manipulation.arm import hand_point
from core.manipulation.eye import camera_pose, looking, scan_poses, singular
from core.manipulation.servo import Target, calibrate, interaction_matrix, servo_step
from core.manipulation.swing import obstruction
from core.robots.gardener import ARM_HOME_RAD, CAMERA_FOV_Y_DEG, DOCK_TO_STEM_M

CAMERA = from_fov(640, 480, math.radians(CAMERA_FOV_Y_DEG))
AHEAD = np.eye(4)
FRUIT = (0.42, 0.05, 0.50)


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
