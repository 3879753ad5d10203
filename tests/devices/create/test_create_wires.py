"""The Create on real wires: TCP, and a pseudo-terminal opened as a serial port."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from core.clock import WallClock
from core.errors import ConfigError
from hw.drivers.create import CreateDriver
from hw.links import open_link
from hw.protocols.create import Mode, Model
from sim.devices.bench import create2
from sim.devices.emulate import DEVICES, bench_emulator, emulate
from sim.devices.host import EmulatorHost

SERIAL_S_MAX = 10.0


async def drive_a_little(url: str, clock: WallClock) -> None:
    driver = CreateDriver(url, Model.CREATE2, open_link, clock, wheelbase_m=0.235, wheel_diameter_m=0.072)
    running = asyncio.create_task(driver.run())
    await driver.wait_link()
    for _ in range(20):
        driver.drive(0.3, 0.0)
        reading = await driver.wait_reading()
    assert reading.oi_mode == Mode.FULL
    assert reading.left_m > 0.02
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def on_wall_time(story: Callable[[WallClock], Awaitable[None]]) -> None:
    async def main() -> None:
        async with asyncio.timeout(SERIAL_S_MAX):
            await story(WallClock())

    asyncio.run(main())


def test_the_driver_drives_over_tcp_and_reconnects() -> None:
    async def story(clock: WallClock) -> None:
        host = EmulatorHost(create2(1), clock)
        server = await host.serve_tcp("127.0.0.1", 0)
        running = asyncio.create_task(host.run())
        port = server.sockets[0].getsockname()[1]
        for _ in range(2):
            await drive_a_little(f"socket://127.0.0.1:{port}", clock)
        running.cancel()
        server.close()
        await host.close()

    on_wall_time(story)


def test_the_driver_drives_over_a_terminal_and_the_link_is_gone_afterwards(tmp_path: Path) -> None:
    path = tmp_path / "tty"

    async def story(clock: WallClock) -> None:
        ended = asyncio.Event()
        serving = asyncio.create_task(emulate(create2(1), path, clock, ended))
        await drive_a_little(str(path), clock)
        ended.set()
        await serving

    on_wall_time(story)
    assert not path.is_symlink()


def test_a_file_in_the_way_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "tty").write_text("precious")

    async def story(clock: WallClock) -> None:
        with pytest.raises(ConfigError, match="is there already"):
            await emulate(create2(1), tmp_path / "tty", clock, asyncio.Event())

    on_wall_time(story)
    assert (tmp_path / "tty").read_text() == "precious"


@pytest.mark.parametrize("device", DEVICES)
def test_every_device_of_the_table_can_be_put_on_its_bench(device: str) -> None:
    emulator = bench_emulator(device, 1)
    emulator.step(1.0)
    assert isinstance(emulator.transmit(), bytes)


def test_an_unknown_device_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(ConfigError) as refused:
        bench_emulator("toaster", 1)
    assert "create2" in refused.value.hint
