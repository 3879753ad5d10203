"""Our drivers on the wall clock, over the ports they meet in life: a pseudo-terminal and TCP."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from core.clock import WallClock
from hw.drivers.firmata import FirmataBoard
from hw.drivers.ssc32 import Ssc32Driver
from hw.drivers.stargazer import StargazerDriver
from hw.links import open_link
from sim.devices import bench_ssc32
from sim.devices.bench_firmata import BenchPins
from sim.devices.bench_stargazer import BenchCamera
from sim.devices.emulate import PtyLink
from sim.devices.firmata import FirmataEmulator
from sim.devices.host import EmulatorHost
from sim.devices.plants import Emulator
from sim.devices.stargazer import StargazerEmulator


@contextlib.asynccontextmanager
async def on_tcp(emulator: Emulator) -> AsyncIterator[str]:
    """Serves the emulator; gives its URL."""
    host = EmulatorHost(emulator, WallClock())
    server = await host.serve_tcp("127.0.0.1", 0)
    running = asyncio.create_task(host.run())
    yield f"socket://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    running.cancel()
    await host.close()
    server.close()
    await server.wait_closed()


@contextlib.asynccontextmanager
async def on_pty(emulator: Emulator) -> AsyncIterator[str]:
    """Serves the emulator on a pseudo-terminal; gives its path."""
    host, link = EmulatorHost(emulator, WallClock()), PtyLink()
    host.attach(link)
    running = asyncio.create_task(host.run())
    yield link.path
    running.cancel()
    await host.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(10.0):
        while not condition():  # noqa: ASYNC110 - drivers have no event for every wish
            await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def driven(driver: Ssc32Driver | StargazerDriver | FirmataBoard) -> AsyncIterator[None]:
    running = asyncio.create_task(driver.run())
    async with asyncio.timeout(10.0):
        await driver.wait_link()
    yield
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running


@pytest.mark.parametrize("port", [on_tcp, on_pty])
def test_a_servo_board(port: Callable[[Emulator], contextlib.AbstractAsyncContextManager[str]]) -> None:
    async def story() -> None:
        emulator = bench_ssc32.bench_emulator(1)
        async with port(emulator) as url:
            driver = Ssc32Driver(url, open_link, WallClock(), outputs=(8,))
            async with driven(driver):
                driver.move({0: 1200.0}, 0.0)
                driver.output(8, True)
                await until(lambda: driver.reading is not None and driver.reading.pulses_us == {0: 1200.0})
                await until(lambda: driver.reading is not None and driver.reading.analog_v != ())

    asyncio.run(story())


def test_a_localizer_over_a_terminal() -> None:
    async def story() -> None:
        rng = random.Random(1)
        async with on_pty(StargazerEmulator(BenchCamera(rng, blind_ratio=0.0), rng, rate_hz=20.0)) as url:
            driver = StargazerDriver(url, open_link, WallClock())
            async with driven(driver), asyncio.timeout(10.0):
                fix = await driver.wait_fix()
                assert fix.marker_id == 24706
                assert fix.x_m**2 + fix.y_m**2 == pytest.approx(0.64, abs=0.1)

    asyncio.run(story())


def test_a_probe_over_a_terminal_that_went_away_and_came_back(tmp_path: Path) -> None:
    async def story() -> None:
        rng = random.Random(1)
        pins, path = BenchPins(rng), tmp_path / "ttyPOT"
        driver = FirmataBoard(str(path), open_link, WallClock())
        probe, tap = driver.probe(0), driver.valve(8)
        running = asyncio.create_task(driver.run())
        for _ in range(2):
            async with on_pty(FirmataEmulator(pins, rng)) as terminal:
                path.symlink_to(terminal)
                async with asyncio.timeout(10.0):
                    await driver.wait_link()
                assert await probe.sample(3) == pytest.approx((1.44,) * 3, abs=0.05)
                await tap.open_for(0.1)
                await until(lambda: pins.levels.get(8, False))
                await until(lambda: not pins.levels[8])
                path.unlink()
            async with asyncio.timeout(10.0):
                await driver.wait_link(up=False)
        running.cancel()

    asyncio.run(story())
