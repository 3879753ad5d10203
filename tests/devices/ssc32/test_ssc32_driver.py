from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from structlog.testing import capture_logs

from hw.drivers.ssc32 import Ssc32Driver
from sim.devices.bench_ssc32 import BenchRig
from sim.devices.ssc32 import Ssc32Emulator

Run = Callable[[Callable[[Any], Awaitable[None]]], None]
URL = "memory://device"
PUMP = 8


class Desk:
    """A driver, a board and what hangs on it."""

    def __init__(self, cable: Any) -> None:
        self.cable, self.clock = cable, cable.clock
        self.rig = BenchRig()
        self.driver = Ssc32Driver(URL, cable.net.open, cable.clock, outputs=(PUMP,))

    async def begin(self) -> None:
        self.cable.plug(Ssc32Emulator(self.rig, random.Random(1)))
        self.cable.start(self.driver)
        await self.driver.wait_link()

    def power_cycle(self) -> None:
        self.rig = BenchRig()
        self.cable.plug(Ssc32Emulator(self.rig, random.Random(2)))

    async def is_well(self) -> None:
        """The proof of recovery: link up, fresh reading, a move that arrives."""
        await self.driver.wait_link()
        self.driver.move({0: 1300.0}, 0.2)
        await self.clock.sleep(2.0)
        reading = self.driver.reading
        assert self.driver.link.up
        assert reading is not None
        assert self.clock.now() - reading.stamp_s < 0.6
        assert self.rig.pulses_us[0] == reading.pulses_us[0] == 1300.0


@pytest.fixture
def at_desk(on_cable: Run) -> Run:
    def run(story: Callable[[Desk], Awaitable[None]]) -> None:
        async def main(cable: Any) -> None:
            desk = Desk(cable)
            await desk.begin()
            await story(desk)
            await desk.is_well()
            await cable.stop()

        on_cable(main)

    return run


def test_the_first_move_goes_without_time_and_later_ones_with_it(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 1500, 1: 1000}, 1.0)
        desk.driver.move({1: 1200, 2: 1700}, 1.0)
        await desk.clock.sleep(0.01)
        sent = desk.cable.written()
        assert b"#0P1500#1P1000\r" in sent
        assert b"#2P1700\r#1P1200T1000\r" in sent
        assert desk.rig.pulses_us[1] < 1010

    at_desk(story)


def test_the_reading_follows_the_board(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 1000}, 0.0)
        desk.driver.move({0: 2000}, 1.0)
        await desk.clock.sleep(0.55)
        reading = desk.driver.reading
        assert reading is not None
        assert reading.moving
        assert reading.pulses_us[0] == pytest.approx(1500, abs=60)
        assert reading.analog_v == pytest.approx((2.0, 3.5), abs=0.05)
        await desk.clock.sleep(1.0)
        assert desk.driver.reading is not None
        assert not desk.driver.reading.moving

    at_desk(story)


def test_a_pulse_that_has_arrived_reads_to_the_microsecond(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 1000}, 0.0)
        desk.driver.move({0: 1234}, 0.5)
        await desk.clock.sleep(1.5)
        assert desk.driver.reading is not None
        assert desk.driver.reading.pulses_us[0] == desk.rig.pulses_us[0] == 1234

    at_desk(story)


def test_a_pulse_that_stopped_elsewhere_reads_as_the_board_tells(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 1000}, 0.0)
        desk.driver.move({0: 2000}, 1.0)
        await desk.clock.sleep(0.5)
        desk.driver.stop()
        await desk.clock.sleep(1.5)
        reading = desk.driver.reading
        assert reading is not None
        assert reading.pulses_us[0] == pytest.approx(desk.rig.pulses_us[0], abs=10)
        assert reading.pulses_us[0] < 1900

    at_desk(story)


def test_the_invalid_first_analog_answer_is_never_shown(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        assert desk.driver.reading is not None
        assert desk.driver.reading.analog_v == ()
        await desk.clock.sleep(0.6)
        assert desk.driver.reading.analog_v == pytest.approx((2.0, 3.5), abs=0.05)

    at_desk(story)


def test_stop_is_one_write_with_the_pump_first(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 1000, 1: 1000}, 0.0)
        desk.driver.move({0: 2000, 1: 2000}, 1.0)
        desk.driver.output(PUMP, True)
        await desk.clock.sleep(0.45)
        assert desk.rig.outputs[PUMP]
        desk.cable.written()
        desk.driver.stop()
        await desk.clock.sleep(0.002)
        assert desk.cable.to_device == [b"#8L\rSTOP0\rSTOP1\r"]
        assert not desk.rig.outputs[PUMP]
        await desk.clock.sleep(1.0)
        assert desk.rig.pulses_us[0] == pytest.approx(1450, abs=30)

    at_desk(story)


def test_an_output_that_noise_switched_on_is_soon_off_again(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.cable.tap.inner.receive(b"#8H\r", desk.clock.now())
        assert desk.rig.outputs[PUMP]
        await desk.clock.sleep(0.6)
        assert not desk.rig.outputs[PUMP]

    at_desk(story)


@pytest.mark.parametrize("seed", range(3))
def test_two_percent_of_damaged_bytes_never_leave_the_pump_running(at_desk: Run, seed: int) -> None:
    async def story(desk: Desk) -> None:
        desk.cable.host.noise(0.02, random.Random(seed))
        for _ in range(20):
            desk.driver.output(PUMP, True)
            await desk.clock.sleep(1.0)
            desk.driver.stop()
            await desk.clock.sleep(4.0)
            assert not desk.rig.outputs.get(PUMP, False), f"seed {seed}"
        desk.cable.host.noise(0.0)

    at_desk(story)


def test_polling_is_slow_at_rest_and_fast_in_motion(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        async def polls(seconds: float) -> int:
            desk.cable.written()
            await desk.clock.sleep(seconds)
            return desk.cable.written().count(b"Q\r")

        desk.driver.rest(True)
        await desk.clock.sleep(1.0)
        assert await polls(10.0) == 10
        desk.driver.rest(False)
        assert await polls(10.0) == pytest.approx(20, abs=1)
        desk.driver.output(PUMP, True)
        assert await polls(10.0) == pytest.approx(100, abs=1)
        desk.driver.output(PUMP, False)

    at_desk(story)


def test_garbage_between_answers_costs_one_reading_and_no_link(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        rng = random.Random(3)
        since_s = desk.driver.link.since_s
        desk.driver.output(PUMP, True)
        for _ in range(200):
            desk.cable.inject(rng.randbytes(rng.randint(1, 3)))
            await desk.clock.sleep(0.1 * rng.random())
        desk.driver.output(PUMP, False)
        await desk.clock.sleep(1.0)
        assert desk.driver.garbled > 5
        assert desk.driver.link.since_s == since_s

    at_desk(story)


def test_a_partial_answer_is_thrown_away(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.cable.tap.mute = True
        await desk.clock.sleep(0.55)
        desk.cable.tap.mute = False
        desk.cable.inject(b"\x66")
        await desk.clock.sleep(1.1)
        assert desk.driver.link.up

    at_desk(story)


def test_silence_takes_the_link_down_and_says_so_once(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        with capture_logs() as logs:
            desk.cable.tap.deaf = True
            await desk.driver.wait_link(up=False)
            assert "no reply on memory://device" in desk.driver.link.why
            await desk.clock.sleep(30.0)
            assert not desk.driver.link.up
        assert [log["event"] for log in logs] == ["link down"]
        desk.cable.tap.deaf = False

    at_desk(story)


def test_a_running_pump_is_switched_off_at_reconnection(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.output(PUMP, True)
        await desk.clock.sleep(0.5)
        await desk.cable.unplug()
        await desk.driver.wait_link(up=False)
        await desk.clock.sleep(5.0)
        assert desk.rig.outputs[PUMP], "the board itself stops nothing"
        desk.cable.plug()
        await desk.driver.wait_link()
        assert not desk.rig.outputs[PUMP]

    at_desk(story)


def test_what_is_asked_while_unplugged_is_not_done_later(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        await desk.cable.unplug()
        await desk.driver.wait_link(up=False)
        desk.driver.output(PUMP, True)
        desk.driver.move({5: 2000}, 1.0)
        desk.cable.plug()
        await desk.driver.wait_link()
        await desk.clock.sleep(2.0)
        assert 5 not in desk.rig.pulses_us
        assert not desk.rig.outputs.get(PUMP, False)

    at_desk(story)


def test_a_board_that_kept_its_power_keeps_its_positions_known(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 1000}, 0.0)
        await desk.clock.sleep(0.01)
        await desk.cable.unplug()
        await desk.driver.wait_link(up=False)
        desk.cable.plug()
        await desk.driver.wait_link()
        desk.cable.written()
        desk.driver.move({0: 2000}, 1.0)
        await desk.clock.sleep(0.05)
        assert b"#0P2000T1000\r" in desk.cable.written()

    at_desk(story)


def test_a_board_that_lost_its_power_is_noticed(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 1000}, 0.0)
        await desk.clock.sleep(1.0)
        desk.power_cycle()
        with capture_logs() as logs:
            await desk.clock.sleep(1.1)
        assert [log["channels"] for log in logs] == [[0]]
        desk.cable.written()
        desk.driver.move({0: 1500}, 1.0)
        await desk.clock.sleep(0.01)
        assert b"#0P1500\r" in desk.cable.written()

    at_desk(story)


def test_a_new_driver_stops_what_a_dead_one_left_moving(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 1000}, 0.0)
        desk.driver.move({0: 2000}, 10.0)
        await desk.clock.sleep(0.1)
        heir = Ssc32Driver(URL, desk.cable.net.open, desk.clock, outputs=(PUMP,))
        await desk.cable.die()
        desk.cable.start(heir)
        desk.driver = heir
        await heir.wait_link()
        await desk.clock.sleep(0.1)
        held_us = desk.rig.pulses_us[0]
        await desk.clock.sleep(5.0)
        assert desk.rig.pulses_us[0] == held_us < 1100

    at_desk(story)


def test_something_else_on_the_wire_is_not_taken_for_a_board(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        await desk.cable.unplug()
        await desk.driver.wait_link(up=False)
        desk.cable.plug(Ssc32Emulator(desk.rig, random.Random(1), version="Grbl 1.1"))
        await desk.clock.sleep(5.0)
        assert not desk.driver.link.up
        assert "Grbl" in desk.driver.link.why
        await desk.cable.unplug()
        desk.power_cycle()

    at_desk(story)


@pytest.mark.parametrize("pulse_us", [float("nan"), float("inf")])
def test_a_move_that_is_not_finite_is_refused(at_desk: Run, pulse_us: float) -> None:
    async def story(desk: Desk) -> None:
        with pytest.raises(ValueError, match="not finite"):
            desk.driver.move({0: pulse_us}, 1.0)

    at_desk(story)


def test_pulses_beyond_the_range_are_clamped(at_desk: Run) -> None:
    async def story(desk: Desk) -> None:
        desk.driver.move({0: 9000, 1: -3}, 0.0)
        await desk.clock.sleep(0.01)
        assert desk.rig.pulses_us == {0: 2500, 1: 500}

    at_desk(story)


def test_the_end_of_the_driver_leaves_the_pump_off(on_cable: Run) -> None:
    async def story(cable: Any) -> None:
        desk = Desk(cable)
        await desk.begin()
        desk.driver.output(PUMP, True)
        await desk.clock.sleep(0.2)
        await cable.stop()
        assert desk.rig.outputs == {PUMP: False}

    on_cable(story)
