"""Water, arm, tap and probe."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from core.robots import gardener as g
from hw.protocols.vh400 import ratio_of
from sim.physics.water import TAP_MLPS, TAP_PIN, PumpFault
from sim.pot import ProbeFault
from sim.world import World

DOSE_S = 20.0


def pump(world: World, seconds: float) -> None:
    world.servo_rig("robot-1").set_output(g.PUMP_CHANNEL, True)
    world.advance(seconds)
    world.servo_rig("robot-1").set_output(g.PUMP_CHANNEL, False)


def test_the_arm_reaches_the_nozzle_point_and_touches_nothing(
    world: World, reach_out: Callable[[World], None], quiet: Callable[[World], None]
) -> None:
    reach_out(world)
    nozzle = world.truth().robot("robot-1").nozzle
    plant = world.scenario.plants[0]
    assert nozzle.x_m == pytest.approx(plant.x_m - g.NOZZLE_POINT_M[0], abs=0.01)
    assert nozzle.y_m == pytest.approx(plant.y_m, abs=0.01)
    assert nozzle.z_m == pytest.approx(g.SOIL_HEIGHT_M + g.NOZZLE_POINT_M[2], abs=0.01)
    assert world.truth().robot("robot-1").collisions.arm == 0
    quiet(world)


def test_twenty_seconds_of_pumping_put_the_papers_dose_into_the_soil(
    world: World, reach_out: Callable[[World], None]
) -> None:
    reach_out(world)
    pump(world, DOSE_S)
    world.advance(1.0)
    truth = world.truth()
    assert truth.plant("plant-1").poured_ml == pytest.approx(150.0, rel=0.04)
    assert truth.robot("robot-1").tank_ml == pytest.approx(1200.0 - truth.plant("plant-1").poured_ml)
    assert truth.spilt_ml == 0.0
    assert truth.plant("plant-1").moisture_ratio == pytest.approx(0.2, abs=0.003)


def test_water_falls_where_the_nozzle_is(world: World) -> None:
    pump(world, 2.0)
    truth = world.truth()
    assert truth.plant("plant-1").poured_ml == 0.0
    assert truth.spilt_ml == pytest.approx(15.0, rel=0.05)


def test_an_empty_tank_gives_nothing(world: World) -> None:
    world.robots["robot-1"].tank.level_ml = 7.5
    pump(world, 5.0)
    assert world.truth().robot("robot-1").tank_ml == 0.0
    assert world.truth().spilt_ml == pytest.approx(7.5)
    assert world.at_rest


def test_a_stuck_pump_runs_on_or_never_runs(world: World) -> None:
    robot = world.robots["robot-1"]
    robot.faults.pump = PumpFault.STUCK_OFF
    pump(world, 2.0)
    assert world.truth().robot("robot-1").pumped_ml == 0.0
    robot.faults.pump = PumpFault.STUCK_ON
    world.advance(2.0)
    assert world.truth().robot("robot-1").pumped_ml == pytest.approx(15.0, rel=0.05)
    assert not world.at_rest
    robot.faults.pump = PumpFault.OK
    world.advance(0.1)
    assert not world.truth().robot("robot-1").pumping


def test_the_tap_fills_the_robot_that_stands_below_it(world: World) -> None:
    dock = world.scenario.docks()["station/tap"]
    world.teleport("robot-1", dock.x_m, dock.y_m, dock.yaw_rad)
    board = world.board_pins("station")
    board.set_digital(TAP_PIN, True)
    world.advance(4.0)
    board.set_digital(TAP_PIN, False)
    assert world.truth().robot("robot-1").tank_ml == pytest.approx(1200.0 + 4.0 * TAP_MLPS)
    assert world.truth().spilt_ml == 0.0
    board.set_digital(TAP_PIN, True)
    world.advance(4.0)
    assert not world.at_rest
    truth = world.truth()
    assert truth.robot("robot-1").tank_ml == g.TANK_ML
    assert truth.tap_ml == pytest.approx(8.0 * TAP_MLPS)
    assert truth.spilt_ml == pytest.approx(1200.0 + truth.tap_ml - g.TANK_ML)


def test_a_tap_without_a_robot_floods_the_floor(world: World) -> None:
    world.board_pins("station").set_digital(TAP_PIN, True)
    world.advance(1.0)
    assert world.truth().spilt_ml == pytest.approx(TAP_MLPS)


def test_the_tank_sensor_tells_the_level(world: World) -> None:
    world.robots["robot-1"].tank.level_ml = 750.0
    volts = [world.servo_rig("robot-1").analog_v(g.TANK_INPUT) for _ in range(50)]
    assert sum(volts) / 50 == pytest.approx(g.TANK_SENSOR_V_FULL / 2, abs=0.005)
    assert len(set(volts)) > 1
    assert world.servo_rig("robot-1").analog_v(g.FORCE_INPUT) < 0.05


def test_the_probe_reads_the_moisture_through_its_curve(world: World) -> None:
    pins = world.board_pins("plant-1")
    ratios = [ratio_of(pins.analog_v(0)) for _ in range(50)]
    assert sum(ratios) / 50 == pytest.approx(0.15, abs=0.002)


def test_probe_faults_have_their_voltages_and_go_away(world: World) -> None:
    pot, pins = world.pots["plant-1"], world.board_pins("plant-1")
    pot.probe_fault = ProbeFault.OPEN
    assert pins.analog_v(0) < 0.05
    pot.probe_fault = ProbeFault.SHORT
    assert pins.analog_v(0) > 3.5
    pot.probe_fault = ProbeFault.STUCK
    stuck_v = pins.analog_v(0)
    pot.soil.pour(300.0)
    world.stride(120.0)
    assert pins.analog_v(0) == stuck_v
    pot.probe_fault = ProbeFault.OK
    assert pins.analog_v(0) > stuck_v + 0.1


def test_servos_turn_no_faster_than_they_can_and_then_hold(world: World) -> None:
    servo = g.SERVOS["pan"]
    world.servo_rig("robot-1").set_pulse(servo.channel, servo.pulse_us(1.2))
    assert not world.at_rest
    world.advance(0.3)
    assert 0.4 < world.truth().robot("robot-1").arm_rad[0] < 0.3 * servo.speed_radps_max + 0.01
    world.advance(1.2)
    assert world.truth().robot("robot-1").arm_rad[0] == pytest.approx(1.2, abs=0.01)
    assert world.at_rest


def test_the_gripper_opens_by_its_servo(world: World) -> None:
    servo = g.SERVOS["gripper"]
    world.servo_rig("robot-1").set_pulse(servo.channel, servo.pulse_us(g.gripper_rad(0.030)))
    world.advance(2.0)
    assert world.truth().robot("robot-1").gripper_m == pytest.approx(0.030)
    finger = world.data.qpos[world.model.joint("robot-1/finger-left").qposadr[0]]
    assert finger == pytest.approx(0.015, abs=0.001)


def test_the_folded_arm_stays_within_the_footprint(world: World) -> None:
    for site in ("tool", "nozzle"):
        x_m, y_m, _ = world.data.site(f"robot-1/{site}").xpos
        assert world.robots["robot-1"].pose.x_m == pytest.approx(0.0, abs=0.01)
        assert (x_m**2 + y_m**2) ** 0.5 < g.BODY_RADIUS_M


def test_an_arm_that_strikes_the_pot_is_stopped_by_it_and_counted(world: World, quiet: Callable[[World], None]) -> None:
    dock = world.scenario.docks()["plant-1"]
    world.teleport("robot-1", dock.x_m, dock.y_m, dock.yaw_rad)
    for joint, angle in {"shoulder": -0.17, "elbow": 0.0, "wrist": 0.0}.items():
        servo = g.SERVOS[joint]
        world.servo_rig("robot-1").set_pulse(servo.channel, servo.pulse_us(angle))
    world.advance(4.0)
    truth = world.truth().robot("robot-1")
    assert truth.collisions.arm == 1
    assert not truth.fallen
    assert truth.arm_rad[1] > -0.15
    quiet(world)
