from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.estimation.markers import Pose, compose, invert, marker_view, world_pose

poses = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-math.pi, math.pi))


def same(one: Pose, other: Pose) -> bool:
    turn = math.remainder(one[2] - other[2], math.tau)
    return math.hypot(one[0] - other[0], one[1] - other[1]) < 1e-9 and abs(turn) < 1e-9


@given(poses, poses)
def test_there_and_back_is_where_we_began(sensor: Pose, marker: Pose) -> None:
    assert same(world_pose(marker_view(sensor, marker), marker), sensor)


@given(poses)
def test_a_pose_and_its_inverse_cancel(pose: Pose) -> None:
    assert same(compose(pose, invert(pose)), (0.0, 0.0, 0.0))


def test_a_marker_turned_a_quarter_turns_the_fix() -> None:
    x_m, y_m, yaw_rad = world_pose((1.0, 0.0, 0.1), (2.0, 3.0, math.pi / 2))
    assert (x_m, y_m, yaw_rad) == pytest.approx((2.0, 4.0, math.pi / 2 + 0.1))


@given(poses, poses)
def test_yaw_stays_within_half_a_turn(fix: Pose, marker: Pose) -> None:
    assert abs(world_pose(fix, marker)[2]) <= math.pi + 1e-12
