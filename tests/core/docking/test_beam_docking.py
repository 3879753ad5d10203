"""Our own docking on a kinematic plane model: noisy odometry, real beam geometry, contact that stops the wheels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from core.estimation.odometry import advance
from core.geometry.planar import Pose, compose
from core.planning.docking import BeamDocking, DockCommand, WatchdogRectangle
from core.robots import gardener

WHEELBASE_M = 0.235
DOCK: Pose = (0.3, -0.4, 2.2)


@dataclass
class Plane:
    """A robot before a dock. `pose` is the truth in the dock frame."""

    pose: Pose
    rng: np.random.Generator
    turn_scale: float
    travel_scale: float
    red_left: bool = True
    left_m: float = 0.0
    right_m: float = 0.0
    bump_left: bool = False
    bump_right: bool = False
    ir_red: bool = False
    ir_green: bool = False
    contacts: bool = False
    docked: bool = False

    def move(self, command: DockCommand, dt_s: float) -> None:
        d_left = (command.v_mps - command.omega_radps * WHEELBASE_M / 2) * dt_s
        d_right = (command.v_mps + command.omega_radps * WHEELBASE_M / 2) * dt_s
        self.left_m, self.right_m = self.left_m + d_left, self.right_m + d_right
        run, turn = (d_left + d_right) / 2 * self.travel_scale, (d_right - d_left) * self.turn_scale
        turn += float(self.rng.normal(0, 0.02)) * abs(run) / WHEELBASE_M
        x, y, yaw = advance(self.pose, run - turn / 2, run + turn / 2, WHEELBASE_M)
        touching = x >= 0.0
        self.bump_left = self.bump_right = touching and command.v_mps > 0.0
        self.pose = (min(x, 0.0), y, yaw)
        self.contacts = self.pose[0] >= -0.015 and abs(y) <= 0.02 and abs(yaw) <= math.radians(6)
        self.docked = self.contacts and command.v_mps == command.omega_radps == 0.0
        self._see()

    def _see(self) -> None:
        x, y, yaw = self.pose
        ahead = gardener.BODY_RADIUS_M - x - gardener.IR_RECEIVER_X_M * math.cos(yaw)
        bearing = math.atan2(y + gardener.IR_RECEIVER_X_M * math.sin(yaw), ahead)
        bearing += float(self.rng.normal(0, math.radians(0.5)))
        left = math.radians(-3) <= bearing <= math.radians(22)
        right = math.radians(-22) <= bearing <= math.radians(3)
        self.ir_red, self.ir_green = (left, right) if self.red_left else (right, left)


def dock_once(rng: np.random.Generator, *, with_pose: bool, red_left: bool = True) -> tuple[str, float]:
    start = (-0.55 + rng.normal(0, 0.03), rng.normal(0, 0.03), rng.normal(0, math.radians(5)))
    plane = Plane(start, rng, rng.uniform(0.88, 1.0), rng.uniform(0.93, 1.07), red_left)
    docking = BeamDocking(DOCK, WHEELBASE_M, red_left=red_left)
    bias = rng.normal(0, 0.008, 3) * np.array([1, 1, 1.2])
    now_s = 0.0
    while now_s < 70.0:
        noise = bias + rng.normal(0, 0.002, 3)
        seen = compose(DOCK, (plane.pose[0] + noise[0], plane.pose[1] + noise[1], plane.pose[2] + noise[2]))
        command = docking.step(plane, seen if with_pose else None, now_s)
        if command.status != "running":
            return command.status, now_s
        plane.move(command, 0.04)
        now_s += 0.04
    return "endless", now_s


@pytest.mark.parametrize(("with_pose", "red_left"), [(True, True), (False, True), (False, False)])
def test_it_mates_within_30_s_from_99_of_100_starts(with_pose: bool, red_left: bool) -> None:
    seed = 11
    print("seed", seed)
    rng = np.random.default_rng(seed)
    ends = [dock_once(rng, with_pose=with_pose, red_left=red_left) for _ in range(200)]
    good = [t for status, t in ends if status == "docked" and t <= 30.0]
    print(len(good), "mated; median", np.median(good), "s; worst", max(t for _, t in ends))
    assert len(good) >= 198


def test_a_dock_that_never_charges_ends_in_failure_with_the_reason() -> None:
    rng = np.random.default_rng(3)
    plane = Plane((-0.5, 0.0, 0.0), rng, 1.0, 1.0)
    docking = BeamDocking(DOCK, WHEELBASE_M)
    for i in range(5000):
        command = docking.step(plane, compose(DOCK, plane.pose), i * 0.04)
        if command.status != "running":
            break
        plane.move(command, 0.04)
        plane.docked = False
    assert (command.status, command.v_mps, command.omega_radps) == ("failed", 0.0, 0.0)
    assert "no charge current" in command.why


def test_leaving_the_rectangle_stops_the_docking() -> None:
    plane = Plane((-0.5, 0.0, 0.0), np.random.default_rng(0), 1.0, 1.0)
    command = BeamDocking(DOCK, WHEELBASE_M).step(plane, compose(DOCK, (-0.5, 0.6, 0.0)), 0.0)
    assert (command.status, command.v_mps) == ("outside", 0.0)


@pytest.mark.parametrize(
    ("in_dock", "inside"), [((0, 0, 0), True), ((-1.35, 0.45, 1), True), ((-1.45, 0, 0), False), ((-0.5, -0.55, 0), False)]
)
def test_the_watchdog_rectangle_is_1_by_1_5_m_before_the_dock(in_dock: Pose, inside: bool) -> None:
    assert WatchdogRectangle(dock=DOCK).inside(compose(DOCK, in_dock)) is inside
