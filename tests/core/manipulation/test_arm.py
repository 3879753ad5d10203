"""The arm: there and back, limits, the nozzle over the soil, and nothing touched on the way."""

from __future__ import annotations

import math

import numpy as np
import pytest

from core.errors import Refused
from core.manipulation.arm import (
    NOZZLE_IN_HAND_M,
    TOOL_IN_HAND_M,
    Joints,
    hand_point,
    inverse,
    limit_broken,
    nozzle_goal,
    plane_points,
    reach_m,
)
from core.manipulation.kinematics import forward, map_points
from core.manipulation.swing import arm_work_s, clear, fold, leg_s, obstruction, swing
from core.robots import gardener

HOME: Joints = gardener.ARM_HOME_RAD
SOIL_M = (gardener.DOCK_TO_STEM_M - 0.06, 0.0, gardener.SOIL_HEIGHT_M + 0.06)


def random_joints(rng: np.random.Generator) -> Joints:
    low = [gardener.SERVOS[name].min_rad for name in gardener.ARM_JOINTS]
    high = [gardener.SERVOS[name].max_rad for name in gardener.ARM_JOINTS]
    p, s, e, w = (float(v) for v in rng.uniform(low, high))
    return p, s, min(e, -0.05), w


def test_inverse_brings_the_tool_where_forward_says_it_is() -> None:
    rng, found = np.random.default_rng(1), 0
    for _ in range(400):
        q = random_joints(rng)
        pitch = q[1] + q[2] + q[3]
        wrist_r = plane_points(q)[2][0]
        if wrist_r < 0.02 or hand_point(q)[0] - gardener.SHOULDER_X_M < 0.0:
            continue
        for tool in (TOOL_IN_HAND_M, NOZZLE_IN_HAND_M):
            point = hand_point(q, tool)
            if math.hypot(point[0] - gardener.SHOULDER_X_M, point[1]) < 0.05:
                continue
            try:
                again = inverse(point, pitch, tool)
            except Refused:
                continue
            found += 1
            assert hand_point(again, tool) == pytest.approx(point, abs=1e-9)
    assert found > 100


def test_the_transform_agrees_with_the_plain_numbers_and_is_rigid() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        q = random_joints(rng)
        T = forward(q)
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        assert map_points(T, np.array([NOZZLE_IN_HAND_M]))[0] == pytest.approx(hand_point(q, NOZZLE_IN_HAND_M), abs=1e-12)


def test_all_zero_is_stretched_out_forward_and_level_and_positive_raises() -> None:
    reach = gardener.SHOULDER_X_M + gardener.UPPER_ARM_M + gardener.FOREARM_M + gardener.HAND_M
    assert hand_point((0, 0, 0, 0)) == pytest.approx((reach, 0.0, gardener.SHOULDER_Z_M))
    assert hand_point((0, 0.1, 0, 0))[2] > gardener.SHOULDER_Z_M
    assert hand_point((0.1, 0, 0, 0))[1] > 0.0


@pytest.mark.parametrize("point", [(1.5, 0.0, 0.3), (0.10, 0.0, 0.29), (0.4, 0.0, 2.0)])
def test_what_is_out_of_reach_is_refused_with_the_reason(point: tuple[float, float, float]) -> None:
    with pytest.raises(Refused, match=r"shoulder|wrist|elbow"):
        inverse(point, 0.0)
    with pytest.raises(Refused):
        nozzle_goal((1.5, 0.0, 0.3))


def test_a_point_behind_the_robot_is_refused_by_the_pan_joint() -> None:
    with pytest.raises(Refused, match="pan"):
        inverse((-0.25, 0.05, 0.3), 0.0)


@pytest.mark.parametrize("dx", [-0.02, 0.0, 0.02])
@pytest.mark.parametrize("dy", [-0.03, 0.0, 0.03])
def test_the_nozzle_reaches_the_soil_from_any_allowed_docking_error(dx: float, dy: float) -> None:
    point = (SOIL_M[0] + dx, SOIL_M[1] + dy, SOIL_M[2])
    q = nozzle_goal(point)
    assert hand_point(q, NOZZLE_IN_HAND_M) == pytest.approx(point, abs=1e-9)
    assert limit_broken(q) == ""
    assert q[1] + q[2] + q[3] < 0.0
    legs = swing(HOME, q)
    assert legs[-1].q == q
    assert sum(leg.duration_s for leg in legs) <= 6.0


def test_every_leg_of_every_swing_is_clear_and_not_faster_than_the_servos() -> None:
    rng, found = np.random.default_rng(3), 0
    for _ in range(60):
        goal = random_joints(rng)
        try:
            legs = swing(HOME, goal)
        except Refused:
            continue
        found += 1
        at = HOME
        for leg in legs:
            assert clear(at, leg.q)
            fastest = max(abs(b - a) for a, b in zip(at, leg.q, strict=True)) / leg.duration_s
            assert fastest <= 2.0
            at = leg.q
        assert at == goal
    assert found > 10


def test_a_goal_in_the_pot_is_refused_and_says_so() -> None:
    q = inverse((0.50, 0.0, 0.20), math.radians(-60))
    assert "pot" in obstruction(q)
    with pytest.raises(Refused, match="pot"):
        swing(HOME, q)


def test_a_swing_past_the_pot_goes_up_first() -> None:
    low_left, low_right = (1.3, 0.2, -0.9, 0.3), (-1.3, 0.2, -0.9, 0.3)
    assert obstruction(low_left) == obstruction(low_right) == ""
    assert not clear(low_left, low_right)
    legs = swing(low_left, low_right)
    assert len(legs) == 2
    assert plane_points(legs[0].q)[2][1] > 0.35


def test_folding_brings_it_within_the_footprint() -> None:
    legs = fold(nozzle_goal(SOIL_M))
    assert legs[-1].q == HOME
    assert reach_m(HOME) <= gardener.BODY_RADIUS_M
    assert arm_work_s(nozzle_goal(SOIL_M)) == pytest.approx(sum(leg.duration_s for leg in legs), rel=0.3)


def test_a_leg_takes_as_long_as_its_slowest_servo() -> None:
    assert leg_s((0, 0, 0, 0), (0.1, 1.5, 0, 0)) == pytest.approx(1.5)
    assert leg_s(HOME, HOME) == pytest.approx(0.3)
