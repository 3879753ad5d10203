"""Time, power, chance and keeping: rest and strides, batteries, determinism, checkpoints."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable

import numpy as np
import pytest

from core.errors import ConfigError
from core.robots import gardener as g
from core.robots.markers import ceiling_markers
from core.scenario import Arena, Plant, Robot, Scenario, Station, StationDock, find
from sim.physics.markers import JUMP_M, RANGE_M
from sim.world import World


def dock(world: World, name: str = "plant-1") -> None:
    pose = world.scenario.docks()[name]
    world.teleport("robot-1", pose.x_m, pose.y_m, pose.yaw_rad)


def test_a_world_left_alone_rests_and_a_day_of_strides_costs_little(world: World) -> None:
    world.advance(0.5)
    assert world.at_rest
    pose = world.robots["robot-1"].pose
    begin = time.process_time()
    for _ in range(24 * 60):
        world.stride(60.0)
    assert time.process_time() - begin < 2.0
    assert world.time_s == pytest.approx(0.5 + 86400.0)
    assert world.truth().hour == pytest.approx(10.0, abs=0.01)
    assert world.at_rest
    assert world.robots["robot-1"].pose == pose


def test_strides_and_steps_tell_the_same_story(world: World) -> None:
    dock(world)
    start = world.snapshot()
    world.advance(30.0)
    stepped = world.truth()
    world.restore(start)
    world.stride(30.0)
    strode = world.truth()
    assert strode.time_s == pytest.approx(stepped.time_s)
    assert strode.plant("plant-1").stored_ml == pytest.approx(stepped.plant("plant-1").stored_ml, abs=1e-3)
    assert strode.robot("robot-1").battery_ratio == pytest.approx(stepped.robot("robot-1").battery_ratio, abs=1e-6)


def test_the_pack_drains_by_use_and_charges_only_when_mated_and_allowed(world: World) -> None:
    robot = world.robots["robot-1"]

    def change_wh(seconds: float) -> float:
        before = robot.pack.charge_ah
        world.advance(seconds)
        return (robot.pack.charge_ah - before) * g.PACK_V

    idle_wh = change_wh(2.0)
    robot.set_wheels(0.05, -0.05)
    driving_wh = change_wh(2.0)
    robot.set_wheels(0.0, 0.0)
    world.advance(1.0)
    assert driving_wh < 2 * idle_wh < 0
    assert idle_wh == pytest.approx(-g.IDLE_W * 2 / 3600, rel=0.1)
    dock(world)
    world.advance(0.1)
    assert robot.sense().charging
    assert robot.sense().current_a > 0
    assert change_wh(2.0) == pytest.approx((g.CHARGE_W - g.IDLE_W) * 2 / 3600, rel=0.1)
    robot.may_charge = lambda: False
    world.advance(0.1)
    assert robot.sense().contacts
    assert not robot.sense().charging
    assert robot.sense().current_a < 0
    robot.may_charge = lambda: True


def test_a_full_pack_stays_full_at_the_dock_and_still_takes_current(world: World) -> None:
    dock(world)
    world.advance(0.1)
    for _ in range(12 * 60):
        world.stride(60.0)
    sense = world.robots["robot-1"].sense()
    assert sense.charge_ah / sense.capacity_ah > 0.997
    assert sense.capacity_ah == pytest.approx(6.77, abs=0.01)
    assert sense.charging
    assert sense.current_a > 0


def test_an_empty_pack_stops_wheels_and_pump_and_a_dock_revives_it(world: World) -> None:
    robot = world.robots["robot-1"]
    robot.pack.charge_ah = 1e-4
    robot.set_wheels(0.1, 0.1)
    robot.set_output(g.PUMP_CHANNEL, True)
    world.advance(3.0)
    assert not robot.powered
    assert abs(world.truth().robot("robot-1").v_mps) < 1e-3
    pumped_ml = robot.pumped_ml
    world.advance(1.0)
    assert robot.pumped_ml == pumped_ml
    robot.set_wheels(0.0, 0.0)
    robot.set_output(g.PUMP_CHANNEL, False)
    dock(world)
    world.stride(600.0)
    assert robot.powered


def test_a_dead_battery_by_fault_stops_the_robot_until_it_is_taken_back(world: World) -> None:
    robot = world.robots["robot-1"]
    robot.set_wheels(0.1, 0.1)
    world.advance(1.0)
    robot.faults.dead_battery = True
    world.advance(1.0)
    assert abs(world.truth().robot("robot-1").v_mps) < 1e-3
    assert robot.sense().charge_ah == 0.0
    assert robot.sight(0.0) is None
    robot.faults.dead_battery = False
    world.advance(1.0)
    assert world.truth().robot("robot-1").v_mps == pytest.approx(0.1, abs=0.01)


def play(world: World) -> list[float]:
    robots = list(world.robots.values())
    for step in range(20):
        for nth, robot in enumerate(robots):
            robot.set_wheels(0.15 * math.sin(step + nth), 0.15 * math.cos(step))
            robot.set_pulse(1, 1500.0 + 20 * step)
        world.advance(0.5)
    return [*world.data.qpos.tolist(), *world.data.qvel.tolist()]


def test_the_same_seed_and_the_same_inputs_give_the_same_world(pair: World) -> None:
    played, sights = play(pair), [pair.marker_camera("robot-1").sight(0.0) for _ in range(5)]
    twin = World(pair.scenario, pair.seed)
    assert play(twin) == played
    assert [twin.marker_camera("robot-1").sight(0.0) for _ in range(5)] == sights


def test_another_seed_is_another_garden(world: World) -> None:
    other = World(world.scenario, world.seed + 1)
    assert other.truth().plants[0].fruit != world.truth().plants[0].fruit


def test_a_world_goes_on_from_its_checkpoint_as_if_nothing_had_happened(pair: World) -> None:
    pair.robots["robot-1"].set_wheels(0.1, 0.12)
    pair.robots["robot-1"].faults.wheel_slip = 2.0
    pair.pots["plant-1"].soil.pour(20.0)
    pair.advance(1.0)
    kept = json.loads(json.dumps(pair.snapshot()))
    pair.advance(1.0)
    wanted = (pair.truth(), pair.data.qpos.tolist(), pair.marker_camera("robot-1").sight(0.0))
    twin = World(pair.scenario, pair.seed)
    twin.restore(kept)
    twin.advance(1.0)
    assert (twin.truth(), twin.data.qpos.tolist(), twin.marker_camera("robot-1").sight(0.0)) == wanted


def test_another_gardens_checkpoint_is_refused(world: World) -> None:
    kept = world.snapshot() | {"seed": 12345}
    with pytest.raises(ConfigError, match="another world"):
        world.restore(kept)


def test_markers_are_seen_everywhere_and_mostly_two_centimetres_right(world: World) -> None:
    arena = world.scenario.arena
    markers = world.markers()
    for x_m in np.linspace(-arena.length_m / 2, arena.length_m / 2, 41):
        for y_m in np.linspace(-arena.width_m / 2, arena.width_m / 2, 31):
            assert min(math.hypot(m.x_m - x_m, m.y_m - y_m) for m in markers.values()) < RANGE_M
    world.teleport("robot-1", 0.4, -0.3, 1.0)
    pose = world.robots["robot-1"].pose
    errors = []
    for _ in range(2000):
        sight = world.marker_camera("robot-1").sight(0.0)
        assert sight is not None
        marker = markers[sight.marker_id]
        errors.append(math.hypot(marker.x_m + sight.x_cm / 100 - pose.x_m, marker.y_m + sight.y_cm / 100 - pose.y_m))
        assert abs(math.radians(-sight.theta_deg) - pose.yaw_rad) < math.radians(2.1)
        assert sight.z_cm == pytest.approx(225.0, abs=0.1)
    jumps = [error for error in errors if error > 0.02 * math.sqrt(2) + 1e-9]
    assert 1 <= len(jumps) <= 20
    assert JUMP_M[0] - 0.03 < min(jumps) <= max(jumps) < JUMP_M[1] + 0.03


def test_a_blinded_camera_sees_nothing(world: World) -> None:
    world.robots["robot-1"].faults.marker_blind = True
    assert world.marker_camera("robot-1").sight(0.0) is None


@pytest.mark.parametrize(("length_m", "width_m"), [(1.5, 1.5), (4, 3), (20, 20), (7.3, 2.1)])
def test_no_place_of_any_arena_is_far_from_a_marker(length_m: float, width_m: float) -> None:
    arena = Arena(length_m=length_m, width_m=width_m)
    markers = ceiling_markers(arena)
    for x_m in np.linspace(-length_m / 2, length_m / 2, 23):
        for y_m in np.linspace(-width_m / 2, width_m / 2, 23):
            nearest = min(math.hypot(m.x_m - x_m, m.y_m - y_m) for m in markers.values())
            assert nearest <= arena.marker_spacing_m * 0.7072


def crowd() -> Scenario:
    places = [(x, y) for x in (-4.5, -1.5, 1.5, 4.5) for y in (-2.5, 0.0, 2.5)]
    return Scenario(
        arena=Arena(length_m=14, width_m=8),
        plants=tuple(Plant(id=f"plant-{i}", x_m=x, y_m=y, dock_yaw_deg=180) for i, (x, y) in enumerate(places)),
        robots=tuple(Robot(id=f"robot-{i}", x_m=-3 + 2 * i, y_m=-1.2) for i in range(4)),
        station=Station(docks=(StationDock(id="tap", x_m=6.9, y_m=0, dock_yaw_deg=180, tap=True),)),
    )


def test_twelve_pots_and_four_robots_are_built_and_driven(quiet: Callable[[World], None]) -> None:
    world = World(crowd(), 5)
    for robot in world.robots.values():
        robot.set_wheels(0.1, 0.12)
    world.advance(2.0)
    truth = world.truth()
    assert len(truth.plants) == 12
    assert all(robot.v_mps > 0.08 for robot in truth.robots)
    quiet(world)


def test_the_default_garden_starts_whole_and_at_rest(quiet: Callable[[World], None]) -> None:
    world = World(find("garden"), 7)
    world.advance(0.2)
    truth = world.truth()
    assert truth.at_rest
    assert truth.spilt_ml == truth.tap_ml == 0.0
    for plant, planned in zip(truth.plants, world.scenario.plants, strict=True):
        assert plant.moisture_ratio == pytest.approx(planned.moisture_ratio, abs=1e-4)
        assert len(plant.fruit) == planned.fruit
        assert {fruit.colour for fruit in plant.fruit} >= {"green", "red"}
        assert all(0.008 < fruit.radius_m <= 0.016 for fruit in plant.fruit)
    for robot, planned_robot in zip(truth.robots, world.scenario.robots, strict=True):
        assert not robot.fallen
        assert math.hypot(robot.pose.x_m - planned_robot.x_m, robot.pose.y_m - planned_robot.y_m) < 0.01
    assert type(truth).model_validate_json(truth.model_dump_json()) == truth
    quiet(world)
