"""What robots run into, and what their infrared eyes see of docks."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from core.robots import gardener as g
from core.scenario import launch_pose
from sim.physics.beams import MATED_ACROSS_M, MATED_ALONG_M, MATED_RAD
from sim.world import TICK_S, World


def stand(world: World, dock: str, back_m: float = 0.0, left_m: float = 0.0, turn_rad: float = 0.0) -> None:
    """Puts robot-1 before a dock, in the docked pose's own frame."""
    pose = world.scenario.docks()[dock]
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    x_m, y_m = pose.x_m - back_m * cos - left_m * sin, pose.y_m - back_m * sin + left_m * cos
    world.teleport("robot-1", x_m, y_m, pose.yaw_rad + turn_rad)


def drive_until_bumped(world: World, seconds: float) -> tuple[bool, bool]:
    robot = world.robots["robot-1"]
    left = right = False
    for _ in range(round(seconds / TICK_S)):
        world.advance(TICK_S)
        left, right = left or robot.sense().bump_left, right or robot.sense().bump_right
    return left, right


@pytest.mark.parametrize(("aside_m", "bumps"), [(0.0, (True, True)), (0.17, (True, False)), (-0.17, (False, True))])
def test_a_pot_presses_the_bumper_on_its_side(world: World, aside_m: float, bumps: tuple[bool, bool]) -> None:
    world.teleport("robot-1", 1.40, 1.1 + aside_m, math.pi)
    world.robots["robot-1"].set_wheels(0.15, 0.15)
    assert drive_until_bumped(world, 0.9 + 4 * abs(aside_m)) == bumps
    truth = world.truth().robot("robot-1")
    assert truth.collisions.robot_pot == 1
    assert math.hypot(truth.pose.x_m - 1.0, truth.pose.y_m - 1.1) > g.POT_RADIUS_M + g.BODY_RADIUS_M - 0.01


def test_a_pot_stops_the_wheels_of_a_robot_that_leans_on_it(world: World, quiet: Callable[[World], None]) -> None:
    world.teleport("robot-1", 1.40, 1.1, math.pi)
    world.robots["robot-1"].set_wheels(0.3, 0.3)
    world.advance(8.0)
    pose = world.robots["robot-1"].pose
    assert math.hypot(pose.x_m - 1.0, pose.y_m - 1.1) > g.POT_RADIUS_M + g.BODY_RADIUS_M - 0.01
    assert world.truth().robot("robot-1").collisions.robot_pot == 1
    quiet(world)


def test_two_robots_that_meet_both_feel_it_and_both_count_it(pair: World, quiet: Callable[[World], None]) -> None:
    pair.teleport("robot-1", -0.4, 0.0, 0.0)
    pair.teleport("robot-2", 0.4, 0.0, math.pi)
    for robot in pair.robots.values():
        robot.set_wheels(0.2, 0.2)
    pair.advance(3.0)
    truth = pair.truth()
    assert [robot.collisions.robot_robot for robot in truth.robots] == [1, 1]
    for robot in pair.robots.values():
        assert robot.sense().bump_left
        assert robot.sense().bump_right
    quiet(pair)


@pytest.mark.parametrize("dock", ["plant-1", "station/tap", "station/spare"])
def test_contacts_touch_in_the_docked_pose_and_nowhere_else(world: World, dock: str) -> None:
    robot = world.robots["robot-1"]
    outside = {"back_m": 0.06, "left_m": 0.06, "turn_rad": math.radians(15.0)}
    stand(world, dock)
    assert world.truth().robot("robot-1").docked_at == dock
    for name, off in outside.items():
        stand(world, dock, **{name: off})
        assert not robot.sense().contacts, name
    for name, edge in (("back_m", MATED_ALONG_M), ("left_m", MATED_ACROSS_M), ("turn_rad", MATED_RAD)):
        stand(world, dock, back_m=0.5)
        stand(world, dock, **{name: 0.95 * edge})
        assert robot.sense().contacts, name
        stand(world, dock, back_m=0.5)
        stand(world, dock, **{name: 1.05 * edge})
        assert not robot.sense().contacts, name


def test_driving_straight_in_from_the_launch_point_mates_without_a_bump(world: World) -> None:
    launch = launch_pose(world.scenario.docks()["plant-1"])
    world.teleport("robot-1", launch.x_m, launch.y_m, launch.yaw_rad)
    robot = world.robots["robot-1"]
    robot.set_wheels(0.1, 0.1)
    for _ in range(400):
        world.advance(TICK_S)
        sense = robot.sense()
        assert (sense.bump_left, sense.bump_right) == (False, False)
        if sense.contacts:
            break
    robot.set_wheels(0.0, 0.0)
    world.advance(1.0)
    truth = world.truth().robot("robot-1")
    assert truth.docked_at == "plant-1"
    assert truth.charging
    assert truth.collisions.robot_dock == 0


def test_a_crooked_robot_bumps_into_the_dock_instead(world: World) -> None:
    stand(world, "plant-1", back_m=0.1, left_m=0.05, turn_rad=math.radians(-15))
    world.robots["robot-1"].set_wheels(0.1, 0.1)
    assert any(drive_until_bumped(world, 2.0))
    assert world.truth().robot("robot-1").collisions.robot_dock == 1


def test_red_and_green_share_the_centre_line_and_keep_to_their_sides(world: World) -> None:
    robot = world.robots["robot-1"]

    def seen(back_m: float, left_m: float) -> str:
        stand(world, "plant-1", back_m, left_m)
        sense = robot.sense()
        return "r" * sense.ir_red + "g" * sense.ir_green + "f" * sense.ir_field

    assert g.DOCK_RED_SIDE == "left"
    assert seen(0.0, 0.0) == "rgf"
    assert seen(0.7, 0.0) == "rg"
    assert seen(0.7, 0.20) == "r"
    assert seen(0.7, -0.20) == "g"
    assert seen(0.15, 0.25) == "f"
    assert seen(0.7, 0.70) == ""
    assert seen(1.8, 0.0) == ""


def test_a_robot_in_between_hides_the_dock(pair: World) -> None:
    stand(pair, "plant-1", back_m=1.0)
    assert pair.robots["robot-1"].sense().ir_red
    dock = pair.scenario.docks()["plant-1"]
    pair.teleport("robot-2", dock.x_m - 0.45, dock.y_m, 0.0)
    assert not pair.robots["robot-1"].sense().ir_red


def test_the_wall_sensor_looks_to_the_right(world: World) -> None:
    beside_m = g.POT_RADIUS_M + g.BODY_RADIUS_M + 0.03
    world.teleport("robot-1", 1.0 + 0.1, 1.1 - beside_m, math.pi)
    assert world.robots["robot-1"].sense().wall is True
    world.teleport("robot-1", 1.0 + 0.1, 1.1 - beside_m, 0.0)
    assert world.robots["robot-1"].sense().wall is False
