"""Wheels on astroturf: straight, round, round again, and over the edge."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from core.robots import gardener as g
from sim.world import TICK_S, World

SIDE_M = 0.85


class Odometer:
    """Dead reckoning from the encoders, and a driver that believes it."""

    def __init__(self, world: World, wheelbase_m: float) -> None:
        self.world, self.wheelbase_m = world, wheelbase_m
        self.robot = world.robots["robot-1"]
        self.x_m = self.y_m = self.yaw_rad = 0.0
        self._last = self.robot.drive.travel_m()

    def drive(self, v_mps: float, omega_radps: float) -> None:
        half = omega_radps * self.wheelbase_m / 2
        self.robot.set_wheels(v_mps - half, v_mps + half)
        self.world.advance(TICK_S)
        left, right = (now - then for now, then in zip(self.robot.drive.travel_m(), self._last, strict=True))
        self._last = self.robot.drive.travel_m()
        turn = (right - left) / self.wheelbase_m
        self.x_m += (left + right) / 2 * math.cos(self.yaw_rad + turn / 2)
        self.y_m += (left + right) / 2 * math.sin(self.yaw_rad + turn / 2)
        self.yaw_rad += turn

    def straight(self, to: tuple[float, float], heading: float, v_mps: float) -> None:
        def left_m() -> float:
            return (to[0] - self.x_m) * math.cos(heading) + (to[1] - self.y_m) * math.sin(heading)

        while left_m() > 0.005:
            self.drive(min(v_mps, max(0.04, 2 * left_m())), 2 * (heading - self.yaw_rad))

    def turn(self, heading: float) -> None:
        while abs(off := heading - self.yaw_rad) > 0.01:
            self.drive(0.0, math.copysign(min(1.0, max(0.15, 3 * abs(off))), off))

    def loop(self, number: int) -> None:
        corners = [(SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0)]
        for nth, corner in enumerate(corners, start=4 * number):
            self.straight(corner, nth * math.pi / 2, 0.25)
            self.turn((nth + 1) * math.pi / 2)


def test_a_square_by_odometry_alone_ends_five_to_fifteen_percent_off_each_loop(world: World) -> None:
    world.teleport("robot-1", -0.7, -0.6, 0.0)
    odometer = Odometer(world, g.WHEELBASE_M["create2"])
    for number in range(3):
        before = odometer.robot.pose
        odometer.loop(number)
        after = odometer.robot.pose
        assert math.hypot(odometer.x_m, odometer.y_m) < 0.03
        drift = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) / (4 * SIDE_M)
        assert 0.05 <= drift <= 0.15, f"loop {number}, seed {world.seed}: {drift:.3f}"


def test_driving_straight_is_nearly_straight_and_a_little_short(world: World) -> None:
    world.teleport("robot-1", -1.0, 0.0, 0.0)
    world.robots["robot-1"].set_wheels(0.3, 0.3)
    world.advance(5.0)
    pose, travel = world.robots["robot-1"].pose, world.robots["robot-1"].drive.travel_m()
    assert sum(travel) / 2 == pytest.approx(1.5 - 0.3**2 / 1.2 / 2, abs=0.02)
    assert 0.94 < (pose.x_m + 1.0) / (sum(travel) / 2) < 1.0
    assert abs(pose.y_m) < 0.10


def test_turns_come_out_short(world: World) -> None:
    for turn in (1.0, -1.0):
        world.robots["robot-1"].set_wheels(0.0, 0.0)
        world.advance(1.0)
        yaw = world.robots["robot-1"].pose.yaw_rad
        left, right = world.robots["robot-1"].drive.travel_m()
        world.robots["robot-1"].set_wheels(-0.1 * turn, 0.1 * turn)
        world.advance(1.5)
        after = world.robots["robot-1"].drive.travel_m()
        believed = ((after[1] - right) - (after[0] - left)) / g.WHEELBASE_M["create2"]
        truly = world.robots["robot-1"].pose.yaw_rad - yaw
        assert 0.88 < truly / believed < 0.97


def test_a_slippery_floor_makes_turns_shorter_still(world: World) -> None:
    yaws = []
    for slip in (1.0, 4.0):
        world.teleport("robot-1", 0.0, 0.0, 0.0)
        world.robots["robot-1"].faults.wheel_slip = slip
        world.robots["robot-1"].set_wheels(-0.1, 0.1)
        world.advance(1.5)
        yaws.append(world.robots["robot-1"].pose.yaw_rad)
        world.robots["robot-1"].set_wheels(0.0, 0.0)
        world.advance(0.5)
    assert yaws[1] < 0.85 * yaws[0]


def test_a_setpoint_holds_until_replaced_and_nonsense_is_a_stop(world: World) -> None:
    robot = world.robots["robot-1"]
    robot.set_wheels(0.2, 0.2)
    world.advance(1.0)
    assert world.truth().robot("robot-1").v_mps == pytest.approx(0.2, abs=0.02)
    robot.set_wheels(math.nan, math.inf)
    world.advance(1.0)
    assert abs(world.truth().robot("robot-1").v_mps) < 1e-3
    assert world.at_rest


def test_over_the_edge_cliffs_speak_first_then_wheels_hang_then_it_falls(
    world: World, quiet: Callable[[World], None]
) -> None:
    robot = world.robots["robot-1"]
    world.teleport("robot-1", 1.7, -1.0, 0.0)
    assert not robot.sense().cliff_front_left
    robot.set_wheels(0.1, 0.1)
    seen: list[str] = []
    for _ in range(500):
        world.advance(TICK_S)
        sense = robot.sense()
        for name, now in (
            ("cliff", sense.cliff_front_left and sense.cliff_front_right),
            ("caster", sense.drop_caster),
            ("wheels", sense.drop_left and sense.drop_right),
            ("fallen", robot.fallen),
        ):
            if now and name not in seen:
                seen.append(name)
    assert seen == ["cliff", "caster", "wheels", "fallen"]
    assert world.truth().robot("robot-1").z_m < -0.5
    quiet(world)


def test_a_stop_at_the_first_cliff_keeps_the_robot_on_the_field(world: World) -> None:
    robot = world.robots["robot-1"]
    world.teleport("robot-1", 1.5, -1.0, 0.0)
    robot.set_wheels(0.3, 0.3)
    while not robot.sense().cliff_front_left:
        world.advance(TICK_S)
    robot.set_wheels(0.0, 0.0)
    world.advance(2.0)
    assert not robot.sense().drop_left
    assert not robot.fallen


def test_the_older_create_drives_on_its_own_wheels(world: World) -> None:
    robots = tuple(robot.model_copy(update={"create": "create1"}) for robot in world.scenario.robots)
    older = World(world.scenario.model_copy(update={"robots": robots}), 3)
    robot = older.robots["robot-1"]
    robot.set_wheels(-0.129, 0.129)
    older.advance(2.0)
    left, right = robot.drive.travel_m()
    believed = (right - left) / g.WHEELBASE_M["create1"]
    assert 0.88 < robot.pose.yaw_rad / believed < 0.97


@pytest.mark.parametrize("kick_radps", [0.35, 3.0])
def test_a_wheel_that_was_kicked_comes_to_rest(world: World, kick_radps: float) -> None:
    world.advance(1.0)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        world.data.qvel[world.model.joint(f"robot-1/{side}-wheel").dofadr[0]] = sign * kick_radps
    world.advance(2.0)
    assert world.at_rest
