from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from structlog.testing import capture_logs

from core.errors import ConfigError, DriverTimeout, LinkDown, Refused
from hw.drivers.firmata import BURST_S, FirmataBoard
from hw.drivers.probes import _split, open_probe, open_valve
from sim.devices.bench_firmata import BenchPins
from sim.devices.firmata import FirmataEmulator
from sim.devices.outbox import Outbox

Run = Callable[[Callable[[Any], Awaitable[None]]], None]
TAP = 8


class Shed:
    """A board with a probe on A0 and a tap on pin 8."""

    def __init__(self, cable: Any) -> None:
        self.cable, self.clock = cable, cable.clock
        self.rng = random.Random(5)
        self.pins = BenchPins(self.rng)
        self.board = FirmataBoard("memory://device", cable.net.open, cable.clock)
        self.probe, self.tap = self.board.probe(0), self.board.valve(TAP)

    @property
    def flows(self) -> bool:
        return self.pins.levels.get(TAP, False)

    async def begin(self) -> None:
        self.cable.plug(FirmataEmulator(self.pins, self.rng))
        self.cable.start(self.board)
        await self.board.wait_link()

    async def is_well(self) -> None:
        """The proof of recovery: samples come, and the tap opens and shuts by itself."""
        await self.board.wait_link()
        volts = await self.probe.sample(5)
        assert volts == pytest.approx((1.44,) * 5, abs=0.05)
        await self.tap.open_for(1.0)
        await self.clock.sleep(0.9)
        assert self.flows
        await self.clock.sleep(0.2)
        assert not self.flows


@pytest.fixture
def in_shed(on_cable: Run) -> Run:
    def run(story: Callable[[Shed], Awaitable[None]]) -> None:
        async def main(cable: Any) -> None:
            shed = Shed(cable)
            await shed.begin()
            await story(shed)
            await shed.is_well()
            await cable.stop()

        on_cable(main)

    return run


def test_five_samples_take_a_tenth_of_a_second_and_then_the_wire_is_quiet(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        before_s = shed.clock.now()
        assert len(await shed.probe.sample(5)) == 5
        assert shed.clock.now() - before_s < 0.11
        await shed.clock.sleep(0.5)
        shed.cable.written()
        assert shed.cable.host.due_s() == float("inf")
        await shed.clock.sleep(60.0)
        assert shed.cable.written() == b""

    in_shed(story)


def test_a_set_of_samples_is_one_message_each_way(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.clock.sleep(0.5)
        shed.cable.written()
        before_s = shed.clock.now()
        assert await shed.probe.sample(5) == pytest.approx((1.44,) * 5, abs=0.05)
        assert shed.clock.now() - before_s < 0.02
        assert shed.cable.to_device == [b"\xc0\x01" * 5 + b"\xc0\x00"]

    in_shed(story)


class Older(FirmataEmulator):
    """Before StandardFirmata 2.4: turning a report on sends nothing by itself."""

    def _report_analog(self, channel: int, on: bool, now_s: float) -> None:
        said = self._out
        self._out = Outbox()
        super()._report_analog(channel, on, now_s)
        self._out = said


def test_an_older_firmware_is_listened_to_at_the_sampling_interval(on_cable: Run) -> None:
    async def main(cable: Any) -> None:
        shed = Shed(cable)
        cable.plug(Older(shed.pins, shed.rng))
        cable.start(shed.board)
        await shed.board.wait_link()
        before_s = shed.clock.now()
        assert await shed.probe.sample(5) == pytest.approx((1.44,) * 5, abs=0.05)
        assert shed.clock.now() - before_s == pytest.approx(BURST_S + 0.1, abs=0.01)
        await shed.clock.sleep(0.5)
        shed.cable.written()
        await shed.is_well()
        await cable.stop()

    on_cable(main)


def test_many_samples_do_not_overrun_the_boards_buffer(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.clock.sleep(0.5)
        shed.cable.written()
        assert len(await shed.probe.sample(40)) == 40
        await shed.clock.sleep(0.1)
        assert shed.cable.to_device == [b"\xc0\x01", b"\xc0\x00"]

    in_shed(story)


def test_two_samplings_at_once_take_turns(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        mine, other = await asyncio.gather(shed.probe.sample(3), shed.board.probe(1).sample(3))
        assert mine == pytest.approx((1.44,) * 3, abs=0.05)
        assert other == pytest.approx((2.5,) * 3, abs=0.01)

    in_shed(story)


def test_the_tap_shuts_by_itself(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.tap.open_for(2.0)
        await shed.clock.sleep(1.95)
        assert shed.flows
        await shed.clock.sleep(0.06)
        assert not shed.flows

    in_shed(story)


def test_the_tap_shuts_when_told(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.tap.open_for(100.0)
        await shed.clock.sleep(1.0)
        await shed.tap.shut()
        await shed.clock.sleep(0.01)
        assert not shed.flows

    in_shed(story)


@pytest.mark.parametrize("for_s", [0.0, -1.0, float("nan"), float("inf"), 601.0])
def test_a_tap_never_opens_for_an_odd_time(in_shed: Run, for_s: float) -> None:
    async def story(shed: Shed) -> None:
        with pytest.raises(Refused):
            await shed.tap.open_for(for_s)
        assert not shed.flows

    in_shed(story)


def test_a_shut_command_that_was_lost_is_repeated(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.tap.open_for(1.0)
        await shed.clock.sleep(0.9)
        shed.cable.tap.deaf = True
        await shed.clock.sleep(0.6)
        assert shed.flows
        shed.cable.tap.deaf = False
        await shed.clock.sleep(8.0)
        assert not shed.flows

    in_shed(story)


def test_an_open_tap_is_shut_first_thing_after_a_reconnection(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.tap.open_for(100.0)
        await shed.clock.sleep(1.0)
        await shed.cable.unplug()
        await shed.board.wait_link(up=False)
        await shed.clock.sleep(5.0)
        assert shed.flows, "the board itself shuts nothing"
        with pytest.raises(LinkDown):
            await shed.tap.open_for(1.0)
        shed.cable.plug()
        await shed.board.wait_link()
        await shed.clock.sleep(0.01)
        assert not shed.flows

    in_shed(story)


def test_a_tap_left_open_by_a_dead_process_is_shut_by_the_next(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.tap.open_for(500.0)
        await shed.clock.sleep(1.0)
        await shed.cable.die()
        assert shed.flows
        shed.board = FirmataBoard("memory://device", shed.cable.net.open, shed.clock)
        shed.probe, shed.tap = shed.board.probe(0), shed.board.valve(TAP)
        shed.cable.start(shed.board)
        await shed.board.wait_link()
        await shed.clock.sleep(0.01)
        assert not shed.flows

    in_shed(story)


def test_the_end_of_the_driver_shuts_the_tap(on_cable: Run) -> None:
    async def main(cable: Any) -> None:
        shed = Shed(cable)
        await shed.begin()
        await shed.tap.open_for(100.0)
        await shed.clock.sleep(0.5)
        assert shed.flows
        await cable.stop()
        assert not shed.flows

    on_cable(main)


def test_a_silent_board_times_out_a_second_late_and_is_set_up_anew(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.clock.sleep(0.5)
        shed.cable.tap.deaf = True
        before_s = shed.clock.now()
        with pytest.raises(DriverTimeout):
            await shed.probe.sample(5)
        assert shed.clock.now() - before_s == pytest.approx(1.1, abs=0.01)
        await shed.clock.sleep(2.0)
        assert not shed.board.link.up
        with pytest.raises(LinkDown):
            await shed.probe.sample(5)
        shed.cable.tap.deaf = False

    in_shed(story)


def test_being_unplugged_while_sampling_is_a_link_down_and_said_once(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        with capture_logs() as logs:
            sampling = asyncio.create_task(shed.probe.sample(50))
            await shed.clock.sleep(0.2)
            await shed.cable.unplug()
            with pytest.raises(LinkDown):
                await sampling
            await shed.clock.sleep(30.0)
        assert [log["event"] for log in logs] == ["link down"]
        shed.cable.plug()

    in_shed(story)


def test_a_board_that_restarts_by_itself_is_set_up_again(in_shed: Run) -> None:
    async def story(shed: Shed) -> None:
        await shed.clock.sleep(1.0)
        shed.cable.written()
        shed.cable.plug(FirmataEmulator(shed.pins, shed.rng))
        shed.cable.inject(b"")
        await shed.clock.sleep(0.5)
        assert b"\xf4\x08\x01\xf5\x08\x00" in shed.cable.written()

    in_shed(story)


@pytest.mark.parametrize("seed", range(3))
def test_garbage_and_partial_messages_are_survived(in_shed: Run, seed: int) -> None:
    async def story(shed: Shed) -> None:
        rng = random.Random(seed)
        for _ in range(100):
            shed.cable.inject(rng.randbytes(rng.randint(1, 20)))
            await shed.clock.sleep(rng.random() * 0.1)
        shed.cable.inject(b"\xe0\x01")
        await shed.clock.sleep(3.0)

    in_shed(story)


def test_parts_may_each_run_the_board(on_cable: Run) -> None:
    async def main(cable: Any) -> None:
        shed = Shed(cable)
        cable.plug(FirmataEmulator(shed.pins, shed.rng))
        cable.start(shed.probe, shed.tap)
        await shed.is_well()
        assert len(cable.host._links) == 1
        cable._drivers[0].cancel()
        await shed.clock.sleep(1.0)
        await shed.is_well()

    on_cable(main)


def test_the_query_for_the_board_does_not_reach_the_link(on_cable: Run) -> None:
    async def main(cable: Any) -> None:
        pins = BenchPins(random.Random(1))
        cable.plug(FirmataEmulator(pins, random.Random(1), vref_v=3.3))
        probe = open_probe("memory://device?pin=1&vref=3.3", cable.net.open, cable.clock)
        cable.start(probe)
        assert await probe.sample(2) == pytest.approx((2.5, 2.5), abs=0.01)
        await cable.stop()
        tap = open_valve("memory://device?valve=9", cable.net.open, cable.clock)
        cable.start(tap)
        await cable.clock.sleep(1.0)
        await tap.open_for(5.0)
        await cable.clock.sleep(0.1)
        assert pins.levels == {9: True}

    on_cable(main)


@pytest.mark.parametrize(
    ("url", "link_url"),
    [
        ("socket://127.0.0.1:9101?pin=2", "socket://127.0.0.1:9101"),
        ("unix:///run/pot?pin=1", "unix:///run/pot"),
        ("/dev/ttyACM0?pin=1", "/dev/ttyACM0?baud=57600"),
        ("/dev/ttyACM0?baud=115200&vref=3.3", "/dev/ttyACM0?baud=115200"),
    ],
)
def test_what_is_left_of_a_url_is_the_links(url: str, link_url: str) -> None:
    assert _split(url)[0] == link_url


@pytest.mark.parametrize("query", ["pin=one", "vref=0", "bits=40"])
def test_a_url_that_makes_no_sense_is_refused(on_cable: Run, query: str) -> None:
    async def main(cable: Any) -> None:
        with pytest.raises(ConfigError):
            open_probe(f"memory://device?{query}", cable.net.open, cable.clock)

    on_cable(main)
