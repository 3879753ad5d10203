from __future__ import annotations

import math
import random
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from structlog.testing import capture_logs

from hw.drivers.stargazer import StargazerDriver
from sim.devices.plants import MarkerSight
from sim.devices.stargazer import StargazerEmulator

Run = Callable[[Callable[[Any], Awaitable[None]]], None]
LATENCY_S = 0.06


class Room:
    """A driver, a strict sensor below one marker, and the garden time of each look."""

    def __init__(self, cable: Any) -> None:
        self.cable, self.clock = cable, cable.clock
        self.blind = False
        self.looks_s: list[float] = []
        self.driver = StargazerDriver("memory://device", cable.net.open, cable.clock, latency_s=LATENCY_S)

    def sight(self, now_s: float) -> MarkerSight | None:
        self.looks_s.append(now_s)
        return None if self.blind else MarkerSight(marker_id=7, theta_deg=90.0, x_cm=50.0, y_cm=-20.0, z_cm=221.64)

    def sensor(self) -> StargazerEmulator:
        return StargazerEmulator(self, random.Random(1), latency_s=LATENCY_S, byte_gap_s=0.03)

    async def begin(self) -> None:
        self.cable.plug(self.sensor())
        self.cable.start(self.driver)
        await self.driver.wait_link()

    async def is_well(self) -> None:
        """The proof of recovery: link up and true fixes at their rate."""
        self.blind = False
        await self.driver.wait_link()
        await self.clock.sleep(2.0)
        before = self.driver.fixes
        await self.clock.sleep(10.0)
        assert self.driver.fixes - before in (19, 20, 21)
        fix = await self.driver.wait_fix()
        assert fix.marker_id == 7
        assert (fix.x_m, fix.y_m, fix.yaw_rad) == pytest.approx((0.5, -0.2, -math.pi / 2))


@pytest.fixture
def in_room(on_cable: Run) -> Run:
    def run(story: Callable[[Room], Awaitable[None]]) -> None:
        async def main(cable: Any) -> None:
            room = Room(cable)
            await room.begin()
            await story(room)
            await room.is_well()
            await cable.stop()

        on_cable(main)

    return run


def test_a_fix_is_stamped_with_the_look_it_came_from(in_room: Run) -> None:
    async def story(room: Room) -> None:
        fix = await room.driver.wait_fix()
        assert fix.stamp_s == pytest.approx(room.looks_s[-1], abs=0.003)
        assert fix.height_m == pytest.approx(2.2164)

    in_room(story)


def test_calcstart_is_sent_a_byte_at_a_time(in_room: Run) -> None:
    async def story(room: Room) -> None:
        await room.clock.sleep(1.0)
        assert [len(data) for data in room.cable.to_device] == [1] * 12
        assert room.cable.written() == b"~#CalcStart`"

    in_room(story)


def test_a_dead_zone_is_a_report_without_a_marker(in_room: Run) -> None:
    async def story(room: Room) -> None:
        room.blind = True
        await room.clock.sleep(1.0)
        fix = await room.driver.wait_fix()
        assert fix.marker_id is None
        assert room.driver.dead_zones > 0
        await room.clock.sleep(30.0)
        assert room.driver.link.up

    in_room(story)


def test_at_rest_it_looks_no_more_and_is_still_known_to_be_there(in_room: Run) -> None:
    async def story(room: Room) -> None:
        room.driver.rest(True)
        await room.clock.sleep(2.0)
        looks = len(room.looks_s)
        await room.clock.sleep(100.0)
        assert len(room.looks_s) == looks
        assert room.driver.link.up
        room.driver.rest(False)

    in_room(story)


def test_a_sensor_that_dies_at_rest_is_noticed(in_room: Run) -> None:
    async def story(room: Room) -> None:
        room.driver.rest(True)
        await room.clock.sleep(5.0)
        room.cable.tap.deaf = True
        await room.clock.sleep(40.0)
        assert not room.driver.link.up
        room.cable.tap.deaf = False
        room.driver.rest(False)

    in_room(story)


def test_a_rest_taken_back_at_once_leaves_it_looking(in_room: Run) -> None:
    async def story(room: Room) -> None:
        for _ in range(3):
            room.driver.rest(True)
            await room.clock.sleep(0.1)
            room.driver.rest(False)
            await room.clock.sleep(0.1)

    in_room(story)


@pytest.mark.parametrize("seed", range(3))
def test_garbage_between_frames_hurts_nothing(in_room: Run, seed: int) -> None:
    async def story(room: Room) -> None:
        rng = random.Random(seed)
        before = room.driver.fixes
        for _ in range(100):
            room.cable.inject(rng.randbytes(rng.randint(1, 20)))
            await room.clock.sleep(rng.random() * 0.2)
        assert room.driver.fixes > before, f"seed {seed}"

    in_room(story)


@pytest.mark.parametrize("data", [b"~^I7|+90.00|+50", b"~^I7|+90.00|+5x.00|-20.00|221.64`", b"~", b"`|`~!`"])
def test_a_broken_frame_is_no_fix(in_room: Run, data: bytes) -> None:
    async def story(room: Room) -> None:
        before = room.driver.fixes
        await room.driver.wait_fix()
        room.cable.inject(data)
        await room.clock.sleep(0.1)
        assert room.driver.fixes == before + 1

    in_room(story)


def test_a_marker_kilometres_away_is_taken_for_damage(in_room: Run) -> None:
    async def story(room: Room) -> None:
        room.cable.inject(b"~^I7|+90.00|+50000.00|-20.00|221.64`")
        await room.clock.sleep(0.01)
        assert room.driver.garbled == 1

    in_room(story)


def test_silence_takes_the_link_down_and_says_so_once(in_room: Run) -> None:
    async def story(room: Room) -> None:
        await room.clock.sleep(2.0)
        with capture_logs() as logs:
            room.cable.tap.deaf = room.cable.tap.mute = True
            await room.clock.sleep(4.0)
            assert not room.driver.link.up
            await room.clock.sleep(60.0)
        assert [log["event"] for log in logs] == ["link down"]
        room.cable.tap.deaf = room.cable.tap.mute = False

    in_room(story)


def test_it_comes_back_after_being_unplugged(in_room: Run) -> None:
    async def story(room: Room) -> None:
        await room.cable.unplug()
        await room.driver.wait_link(up=False)
        await room.clock.sleep(20.0)
        room.cable.plug()

    in_room(story)


def test_a_sensor_left_stopped_is_started(in_room: Run) -> None:
    async def story(room: Room) -> None:
        await room.cable.unplug()
        stopped = room.sensor()
        stopped._byte_gap_s = 0.0
        stopped.receive(b"~#CalcStop`", room.clock.now())
        stopped._byte_gap_s = 0.03
        room.cable.plug(stopped)

    in_room(story)
