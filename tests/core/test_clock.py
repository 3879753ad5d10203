"""The three clocks keep garden time."""

import asyncio

import pytest

from core.clock import VirtualClock, WallClock, WorldClock
from core.virtual import VirtualLoop, run_virtual


def test_ten_virtual_days_pass_at_once():
    async def main():
        clock = VirtualClock(start_s=100.0)
        await clock.sleep(10 * 86400)
        return clock.now()

    assert run_virtual(main()) == pytest.approx(100.0 + 10 * 86400)


def test_offloaded_work_takes_its_stated_cost_on_the_virtual_clock():
    async def main():
        clock = VirtualClock()
        return await clock.offload(lambda: 42, cost_s=1.5), clock.now()

    assert run_virtual(main()) == (42, pytest.approx(1.5))


def test_a_virtual_garden_that_waits_for_nothing_says_so():
    async def main():
        await asyncio.get_running_loop().create_future()

    with pytest.raises(RuntimeError, match="deadlocked"):
        run_virtual(main())


def test_a_virtual_timeout_costs_no_wall_time():
    async def main():
        clock = VirtualClock()
        with pytest.raises(TimeoutError):
            async with clock.timeout(3600.0):
                await clock.sleep(7200.0)
        return clock.now()

    assert run_virtual(main()) == pytest.approx(3600.0)


def test_the_world_clock_stands_still_until_the_world_speaks():
    async def main():
        clock = WorldClock()
        await asyncio.sleep(5.0)
        return clock.now()

    assert run_virtual(main()) == 0.0


def test_the_world_clock_runs_at_the_worlds_rate():
    async def main():
        clock = WorldClock()
        clock.steer(50.0, 3.0)
        await asyncio.sleep(2.0)
        return clock.now()

    assert run_virtual(main()) == pytest.approx(56.0)


def test_the_world_clock_never_runs_back():
    async def main():
        clock = WorldClock()
        clock.steer(50.0, 3.0)
        await asyncio.sleep(1.0)
        before = clock.now()
        clock.steer(51.0, 3.0)
        return before, clock.now()

    before, after = run_virtual(main())
    assert after == before == pytest.approx(53.0)


def test_a_silent_world_stops_garden_time():
    async def main():
        clock = WorldClock(silence_s=3.0)
        clock.steer(0.0, 2.0)
        await asyncio.sleep(60.0)
        return clock.now()

    assert run_virtual(main()) == pytest.approx(6.0)


def test_a_sleeper_notices_that_the_world_was_paused_and_resumed():
    async def main():
        clock = WorldClock(silence_s=1e9)
        clock.steer(0.0, 1.0)
        sleeper = asyncio.create_task(clock.sleep(10.0))
        await asyncio.sleep(4.0)
        clock.steer(4.0, 0.0)
        await asyncio.sleep(100.0)
        assert not sleeper.done()
        clock.steer(4.0, 6.0)
        await asyncio.sleep(1.1)
        return sleeper.done()

    assert run_virtual(main())


def test_a_world_timeout_is_counted_in_garden_seconds():
    async def main():
        clock = WorldClock(silence_s=1e9)
        clock.steer(0.0, 10.0)
        with pytest.raises(TimeoutError):
            async with clock.timeout(5.0):
                await asyncio.sleep(60.0)
        return asyncio.get_running_loop().time()

    assert run_virtual(main()) == pytest.approx(0.5, abs=0.05)


def test_a_timeout_of_none_never_fires():
    async def main():
        clock = WorldClock(silence_s=1e9)
        clock.steer(0.0, 1.0)
        async with clock.timeout(None):
            await clock.sleep(1000.0)
        return clock.now()

    assert run_virtual(main()) >= 1000.0


def test_the_wall_clock_is_unix_time():
    async def main():
        return WallClock().now()

    assert asyncio.run(main()) > 1.7e9


def test_a_virtual_loop_starts_at_zero():
    loop = VirtualLoop()
    assert loop.time() == 0.0
    loop.close()
