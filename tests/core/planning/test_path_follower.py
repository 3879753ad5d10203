"""The follower on a kinematic robot with lagging wheels, seen through a noisy estimate."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from core.estimation.odometry import arc
from core.geometry.planar import Pose, distance_m, wrap
from core.planning.follow import ACCEL_MPS2, PathFollower

DT_S = 0.02
Points = list[tuple[float, float]]
L_SHAPE: Points = [(0.0, 0.0), (1.0, 0.0), (1.0, 0.8)]
ROUND: Points = [(math.sin(a), 1 - math.cos(a)) for a in np.linspace(0, 2.5, 40)]
ZIGZAG: Points = [(0.0, 0.0), (0.6, 0.5), (1.2, 0.0), (1.8, 0.5)]


def follow(
    points: Points, start: Pose, goal_yaw_rad: float | None, seed: int = 0, noise_m: float = 0.003, **how: float
) -> tuple[Pose, float, float, list[float]]:
    """Final true pose, duration [s], the most it was off the path [m], and speeds."""
    rng, pose, v, omega, off, speeds = np.random.default_rng(seed), start, 0.0, 0.0, 0.0, list[float]()
    follower = PathFollower(np.array(points), goal_yaw_rad, **how)  # type: ignore[arg-type]
    for i in range(6000):
        noise = rng.normal(0, (noise_m, noise_m, noise_m))
        seen = (pose[0] + noise[0], pose[1] + noise[1], pose[2] + noise[2])
        wanted = follower.step(seen, i * DT_S)
        if wanted.done:
            return pose, i * DT_S, off, speeds
        v += (wanted.v_mps - v) * 0.4
        omega += (wanted.omega_radps - omega) * 0.4
        pose = arc(pose, v * DT_S, omega * DT_S * 0.95)
        off = max(off, _off(points, pose))
        speeds.append(wanted.v_mps)
    raise AssertionError(f"never done: at {pose}")


def _off(points: Points, pose: Pose) -> float:
    best = math.inf
    for (ax, ay), (bx, by) in pairwise(points):
        length = math.hypot(bx - ax, by - ay)
        along = (pose[0] - ax) * (bx - ax) + (pose[1] - ay) * (by - ay)
        share = min(1.0, max(0.0, along / max(length**2, 1e-12)))
        best = min(best, distance_m(pose, (ax + share * (bx - ax), ay + share * (by - ay))))
    return best


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("points", [L_SHAPE, ROUND, ZIGZAG], ids=["corner", "arc", "zigzag"])
@pytest.mark.parametrize("yaw", [0.0, 2.5, -1.6])
def test_it_ends_within_15_mm_and_2_degrees_and_stays_near_the_path(points: Points, yaw: float, seed: int) -> None:
    pose, took_s, off_m, _ = follow(points, (points[0][0], points[0][1], 1.0), yaw, seed)
    assert distance_m(pose, points[-1]) <= 0.015
    assert abs(wrap(pose[2] - yaw)) <= math.radians(2.0)
    assert off_m <= 0.05
    assert took_s <= 30.0


def test_it_hurries_where_it_may() -> None:
    _, took_s, _, speeds = follow([(0.0, 0.0), (3.0, 0.0)], (0.0, 0.0, 0.0), 0.0)
    assert max(speeds) == pytest.approx(0.3)
    assert took_s <= 3.0 / 0.3 + 4.0


def test_it_gains_speed_within_its_limit() -> None:
    _, _, _, speeds = follow(L_SHAPE, (0.0, 0.0, 0.0), None)
    assert max(np.diff(speeds)) <= ACCEL_MPS2 * DT_S + 1e-9


def test_it_turns_on_the_spot_when_the_path_lies_behind() -> None:
    pose, _, off_m, _ = follow([(0.0, 0.0), (1.0, 0.0)], (0.0, 0.0, math.pi - 0.1), None, noise_m=0.0)
    assert off_m <= 0.02
    assert distance_m(pose, (1.0, 0.0)) <= 0.015


def test_it_slows_where_things_are_near() -> None:
    follower = PathFollower(np.array([(0.0, 0.0), (3.0, 0.0)]), clearance=lambda x, y: 0.20)
    speeds = [follower.step((0.5, 0.0, 0.0), i * DT_S).v_mps for i in range(100)]
    assert 0.08 <= max(speeds) <= 0.15


def test_standing_at_the_goal_already_it_only_turns() -> None:
    pose, _, _, speeds = follow([(0.5, 0.5), (0.5, 0.5)], (0.5, 0.5, 0.0), 1.0, noise_m=0.0)
    assert max(speeds) == 0.0
    assert pose[2] == pytest.approx(1.0, abs=0.035)


def test_it_tells_where_it_will_be() -> None:
    follower = PathFollower(np.array(L_SHAPE))
    follower.step((0.5, 0.02, 0.0), 0.0)
    assert np.allclose(follower.ahead(0.8), [(0.5, 0.0), (1.0, 0.0), (1.0, 0.3)])
    assert follower.remaining_m == pytest.approx(1.3)
    assert follower.off_path_m == pytest.approx(0.02)


def test_once_done_it_stays_done() -> None:
    follower = PathFollower(np.array([(0.0, 0.0), (0.001, 0.0)]))
    for i in range(10):
        last = follower.step((0.0, 0.0, 0.0), i * DT_S)
    assert last == (0.0, 0.0, True)
