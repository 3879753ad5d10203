"""Both pose filters on a simulated square loop whose odometry lies, with late, noisy and jumping markers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from core.estimation.ekf import PoseFilter
from core.estimation.filters import ExponentialFilter, PoseEstimator
from core.estimation.odometry import advance, arc
from core.geometry.planar import Pose, compose, distance_m, invert, wrap

BASE_M = 0.235
DT_S = 0.02
START: Pose = (-0.4, -0.4, 0.0)


@dataclass
class Walk:
    """Drives squares; the wheels report travel by their own lights. All instants are steps of DT_S."""

    seed: int
    turn: float = 0.92
    travel: float = 0.97
    veer_radpm: float = 0.06
    jumps: float = 0.04
    delay_s: float = 0.2

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.truth: list[Pose] = [START]
        self.left_m, self.right_m = 0.0, 0.0

    @property
    def now_s(self) -> float:
        return (len(self.truth) - 1) * DT_S

    def step(self, filter_: PoseEstimator, v_mps: float, omega_radps: float) -> None:
        run, spin = v_mps * DT_S, omega_radps * DT_S
        true_run = run * self.travel + float(self.rng.normal(0, 0.002)) * abs(run) ** 0.5 * 0.3
        true_spin = spin * self.turn + run * self.veer_radpm
        self.truth.append(arc(self.truth[-1], true_run, true_spin))
        filter_.predict(run - spin * BASE_M / 2, run + spin * BASE_M / 2, self.now_s)
        if len(self.truth) % 25 == 0:
            self.look(filter_)

    def look(self, filter_: PoseEstimator) -> None:
        late = round(self.delay_s / DT_S)
        if late >= len(self.truth):
            return
        x, y, yaw = self.truth[-1 - late]
        dx, dy = self.rng.normal(0, 0.007, 2)
        if self.rng.random() < self.jumps:
            way, far = self.rng.uniform(0, math.tau), self.rng.uniform(0.2, 0.6)
            dx, dy = far * math.cos(way), far * math.sin(way)
        dyaw = float(self.rng.normal(0, math.radians(0.6)))
        filter_.correct(x + dx, y + dy, wrap(yaw + dyaw), self.now_s - self.delay_s)

    def loop(self, filter_: PoseEstimator) -> None:
        """One square of 85 cm, closed by the filter's own belief as a robot would."""
        for corner in ((0.45, -0.4), (0.45, 0.45), (-0.4, 0.45), (-0.4, -0.4)):
            for _ in range(1500):
                x, y, yaw = filter_.pose or self.truth[-1]
                error = wrap(math.atan2(corner[1] - y, corner[0] - x) - yaw)
                if math.hypot(corner[0] - x, corner[1] - y) < 0.02:
                    break
                turning = abs(error) > 0.3
                self.step(filter_, 0.0 if turning else 0.25, max(-1.2, min(1.2, 3.0 * error)))


def errors(walk: Walk, filter_: PoseEstimator, loops: int) -> list[float]:
    out = []
    for _ in range(loops):
        walk.loop(filter_)
        assert filter_.pose is not None
        out.append(distance_m(filter_.pose, walk.truth[-1]))
    return out


@pytest.mark.parametrize("seed", range(3))
def test_the_kalman_filter_is_within_2_cm_after_20_loops(seed: int) -> None:
    found = errors(Walk(seed), PoseFilter(BASE_M, START), 20)
    print("seed", seed, [round(e, 4) for e in found])
    assert found[-1] <= 0.02
    assert max(found[3:]) <= 0.03


def test_the_papers_filter_accumulates_no_error_over_20_loops() -> None:
    found = errors(Walk(5), ExponentialFilter(BASE_M, START), 20)
    print("seed 5", [round(e, 3) for e in found])
    assert max(found[10:]) <= max(found[:10]) + 0.05
    assert found[-1] <= 0.15


def test_odometry_alone_drifts_by_tenths_of_a_metre() -> None:
    walk = Walk(5)
    walk.look = lambda filter_: None  # type: ignore[method-assign]
    assert errors(walk, PoseFilter(BASE_M, START), 3)[-1] > 0.2


def test_it_learns_how_its_odometry_lies() -> None:
    filter_ = PoseFilter(BASE_M, START)
    errors(Walk(1), filter_, 6)
    travel, turn, veer = filter_.odometry_errors
    assert travel == pytest.approx(-0.03, abs=0.01)
    assert turn == pytest.approx(-0.08, abs=0.015)
    assert veer == pytest.approx(0.06, abs=0.02)


@pytest.mark.parametrize("make", [PoseFilter, ExponentialFilter])
def test_a_single_jump_is_not_believed(make: Callable[[float, Pose], PoseEstimator]) -> None:
    filter_ = make(BASE_M, START)
    filter_.predict(0.0, 0.0, 0.0)
    assert not filter_.correct(START[0] + 0.55, START[1], START[2], 0.0)
    assert filter_.pose == pytest.approx(START, abs=1e-9)
    assert filter_.correct(START[0] + 0.01, START[1], START[2], 0.0)


@pytest.mark.parametrize("make", [PoseFilter, ExponentialFilter])
def test_a_robot_that_was_carried_away_finds_itself_again(make: Callable[[float, Pose], PoseEstimator]) -> None:
    filter_, lost = make(BASE_M, START), False
    for i in range(8):
        filter_.predict(0.01, 0.01, i * 0.5)
        filter_.correct(1.0 + i * 0.01, 0.7, 0.0, i * 0.5)
        lost = lost or filter_.lost
    assert lost
    assert not filter_.lost
    assert filter_.pose == pytest.approx((1.07, 0.7, 0.0), abs=0.05)


@pytest.mark.parametrize("make", [PoseFilter, ExponentialFilter])
def test_it_starts_anywhere_from_two_fixes_that_agree(make: Callable[[float], PoseEstimator]) -> None:
    filter_ = make(BASE_M)
    filter_.predict(0.0, 0.0, 0.0)
    assert (filter_.pose, filter_.lost) == (None, True)
    for i, x in enumerate((0.9, 0.31, 0.30)):
        filter_.predict(0.0, 0.0, 0.5 + i)
        filter_.correct(x, -0.2, 3.0, 0.5 + i)
    assert filter_.pose == pytest.approx((0.30, -0.2, 3.0), abs=0.02)
    assert not filter_.lost


def test_a_late_fix_corrects_the_instant_it_was_true() -> None:
    filter_ = PoseFilter(BASE_M, (0.0, 0.0, 0.0))
    for i in range(51):
        filter_.predict(0.006, 0.006, i * DT_S)
    pose = filter_.pose
    assert pose is not None
    then = (pose[0] - 0.006 * 25, 0.0, 0.0)
    assert filter_.correct(*then, 0.5)
    assert filter_.pose == pytest.approx(pose, abs=1e-6)
    assert not filter_.correct(*then, -5.0)


def test_fixes_shrink_the_uncertainty_and_driving_grows_it() -> None:
    filter_ = PoseFilter(BASE_M, (0.0, 0.0, 0.0))
    filter_.predict(0.0, 0.0, 0.0)
    before = filter_.position_sigma_m
    filter_.correct(0.0, 0.0, 0.0, 0.0)
    near = filter_.position_sigma_m
    for i in range(200):
        filter_.predict(0.01, 0.01, 0.02 * i)
    assert near < before
    assert filter_.position_sigma_m > 3 * near
    assert np.all(np.linalg.eigvalsh(filter_.covariance) > 0)


def test_an_arc_is_exact_for_any_cut() -> None:
    whole = advance((0.2, -0.1, 0.7), 0.30, 0.42, BASE_M)
    cut: Pose = (0.2, -0.1, 0.7)
    for _ in range(10):
        cut = advance(cut, 0.030, 0.042, BASE_M)
    assert cut == pytest.approx(whole, abs=1e-12)
    assert advance((0, 0, 0), 1.0, 1.0, BASE_M) == pytest.approx((1.0, 0.0, 0.0))


def test_there_and_back_is_where_we_began() -> None:
    rng = np.random.default_rng(2)
    for x, y, yaw in rng.uniform(-3, 3, (50, 3)):
        assert compose((x, y, yaw), invert((x, y, yaw))) == pytest.approx((0, 0, 0), abs=1e-12)
