from __future__ import annotations

import asyncio
import math
from collections.abc import Coroutine
from typing import Any

import pytest

from core.clock import VirtualClock
from core.virtual import run_virtual
from sim.clockwork import STRIDE_S_MAX, TICK_S, Clockwork


class StandInWorld:
    def __init__(self, resting: bool = True) -> None:
        self.time_s, self.at_rest = 0.0, resting
        self.steps: list[tuple[str, float]] = []

    def advance(self, dt_s: float) -> None:
        self.time_s += dt_s
        self.steps.append(("advance", dt_s))

    def stride(self, dt_s: float) -> None:
        self.time_s += dt_s
        self.steps.append(("stride", dt_s))


class SlowClock(VirtualClock):
    """A machine on which every wait, even none, takes some time."""

    def __init__(self, cost_s: float) -> None:
        super().__init__()
        self.cost_s = cost_s

    async def sleep(self, seconds: float) -> None:
        await super().sleep(max(seconds, self.cost_s))


class StandInHost:
    def __init__(self, due_s: float = math.inf) -> None:
        self.due, self.pumped = due_s, list[float]()

    def pump(self, now_s: float) -> None:
        self.pumped.append(now_s)
        self.due = math.inf

    def due_s(self) -> float:
        return self.due


def run_for(
    seconds: float, clockwork: Clockwork, clock: VirtualClock, during: Coroutine[Any, Any, None] | None = None
) -> None:
    async def main() -> None:
        task = asyncio.create_task(clockwork.run(clock))
        other = asyncio.create_task(during) if during is not None else None
        await asyncio.sleep(seconds + 1e-6)
        task.cancel()
        if other is not None:
            await other

    run_virtual(main())


def test_a_moving_world_ticks_every_20_ms_and_a_device_runs_when_it_is_due() -> None:
    world, host = StandInWorld(resting=False), StandInHost(due_s=0.05)
    run_for(1.0, Clockwork(world, [host]), VirtualClock())
    assert world.time_s == pytest.approx(1.0)
    assert {kind for kind, _ in world.steps} == {"advance"}
    assert host.pumped == [pytest.approx(0.06)]


def test_a_resting_world_strides_and_leaves_its_devices_alone() -> None:
    world, host = StandInWorld(), StandInHost()
    run_for(20 * STRIDE_S_MAX, Clockwork(world, [host]), VirtualClock())
    assert world.steps[:20] == [("stride", pytest.approx(STRIDE_S_MAX))] * 20
    assert world.time_s == pytest.approx(20 * STRIDE_S_MAX)
    assert host.pumped == []


def test_a_stride_ends_when_a_device_is_due() -> None:
    world, host = StandInWorld(), StandInHost(due_s=0.123)
    run_for(0.4, Clockwork(world, [host]), VirtualClock())
    assert host.pumped == [pytest.approx(0.123)]


def test_bytes_wake_a_striding_world_at_once() -> None:
    world, host = StandInWorld(), StandInHost()
    clockwork = Clockwork(world, [host])

    async def bytes_arrive() -> None:
        await asyncio.sleep(0.2)
        host.due = 0.0
        clockwork.wake()

    run_for(0.4, clockwork, VirtualClock(), bytes_arrive())
    assert host.pumped == [pytest.approx(0.2, abs=0.002)]


def test_garden_time_runs_at_the_speed_and_follows_a_change_of_it() -> None:
    world = StandInWorld()
    clockwork = Clockwork(world, [], speed=3.0)

    async def faster() -> None:
        await asyncio.sleep(2.1)
        clockwork.steer(speed=10.0)

    run_for(3.1, clockwork, VirtualClock(), faster())
    assert world.time_s == pytest.approx(2.1 * 3 + 1.0 * 10, abs=0.01)


@pytest.mark.parametrize("resting", [True, False])
def test_a_paused_world_stands_still_and_goes_on_where_it_was(resting: bool) -> None:
    world = StandInWorld(resting=resting)
    clockwork = Clockwork(world, [])
    seen = []

    async def pause() -> None:
        await asyncio.sleep(1.0)
        clockwork.steer(paused=True)
        await asyncio.sleep(0.1)
        seen.append((world.time_s, clockwork.beat()))
        await asyncio.sleep(4.9)
        seen.append((world.time_s, clockwork.beat()))
        clockwork.steer(paused=False)

    run_for(8.0, clockwork, VirtualClock(), pause())
    assert seen[0] == seen[1]
    assert seen[0][1].rate == 0
    assert world.time_s == pytest.approx(3.0, abs=2 * TICK_S)


def test_when_the_machine_is_too_slow_garden_time_slows_and_the_feed_says_so() -> None:
    world = StandInWorld(resting=False)
    clockwork = Clockwork(world, [], speed=4.0)
    beats = []

    async def listen() -> None:
        async for beat in clockwork.feed():
            beats.append(beat)
            if len(beats) == 4:
                return

    run_for(3.0, clockwork, SlowClock(cost_s=0.01), listen())
    assert world.time_s == pytest.approx(3.0 * TICK_S / 0.01, rel=0.05)
    assert beats[-1].rate == pytest.approx(2.0, rel=0.05)


def test_the_feed_speaks_at_once_at_a_change_and_every_second_at_rest() -> None:
    clockwork = Clockwork(StandInWorld(), [], speed=2.0)
    heard: list[tuple[float, float, float]] = []

    async def listen() -> None:
        async for beat in clockwork.feed():
            heard.append((asyncio.get_running_loop().time(), beat.garden_s, beat.rate))
            if len(heard) == 4:
                return

    async def change() -> None:
        await asyncio.sleep(0.01)
        listener = asyncio.create_task(listen())
        await asyncio.sleep(1.5)
        clockwork.steer(speed=5.0)
        await listener

    run_for(4.0, clockwork, VirtualClock(), change())
    assert [t for t, _, _ in heard] == pytest.approx([0.01, 1.01, 1.51, 2.51])
    assert [garden for _, garden, _ in heard] == pytest.approx([0.02, 2.02, 3.02, 8.02], abs=0.005)
    assert [rate for _, _, rate in heard] == [2.0, 2.0, 5.0, 5.0]
