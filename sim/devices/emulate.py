"""`garden emulate DEVICE --pty PATH`: an emulated device as a serial port, for any program that opens one."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import os
import signal
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, cast

import typer

from core.clock import Clock, WallClock
from core.errors import ConfigError, LinkDown
from sim.devices.host import EmulatorHost
from sim.devices.plants import Emulator

DEVICES = {
    "create1": ("sim.devices.bench", "create1"),
    "create2": ("sim.devices.bench", "create2"),
    "ssc32": ("sim.devices.bench_ssc32", "bench_emulator"),
    "stargazer": ("sim.devices.bench_stargazer", "bench_emulator"),
    "firmata": ("sim.devices.bench_firmata", "bench_emulator"),
}
"""Device name -> module and function that puts it on a bench, from a seed."""
READ_BYTES_MAX = 4096


def bench_emulator(device: str, seed: int) -> Emulator:
    """That device on its bench; raises ConfigError for a name nobody emulates."""
    if device not in DEVICES:
        raise ConfigError(f"no emulator is called {device!r}", hint=f"choose one of {', '.join(DEVICES)}")
    module, function = DEVICES[device]
    return cast(Emulator, getattr(importlib.import_module(module), function)(seed))


class PtyLink:
    """A pseudo-terminal in raw mode; `path` is what clients open, close and open again.

    Bytes that nobody reads are lost once the terminal's buffer is full, as on a wire.
    """

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._arrived: asyncio.Queue[bytes] = asyncio.Queue()
        self._closed = False
        asyncio.get_running_loop().add_reader(self._master, self._take)

    @property
    def name(self) -> str:
        return self.path

    async def read(self) -> bytes:
        return await self._arrived.get()

    def write(self, data: bytes) -> None:
        if self._closed:
            raise LinkDown(f"{self.path} is closed")
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    async def close(self) -> None:
        if not self._closed:
            self._closed = True
            asyncio.get_running_loop().remove_reader(self._master)
            os.close(self._master)
            os.close(self._slave)

    def _take(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._arrived.put_nowait(os.read(self._master, READ_BYTES_MAX))


@contextlib.contextmanager
def _linked(path: Path, target: str) -> Iterator[None]:
    """A symbolic link to the terminal while the context lasts; an older link is replaced, a file is not."""
    if path.exists() and not path.is_symlink():
        raise ConfigError(f"{path} is there already", hint="give --pty a path that does not exist")
    path.unlink(missing_ok=True)
    path.symlink_to(target)
    try:
        yield
    finally:
        if path.is_symlink() and os.readlink(path) == target:
            path.unlink()


async def emulate(emulator: Emulator, path: Path, clock: Clock, ended: asyncio.Event) -> None:
    """Serve an emulator at `path` until `ended` is set; prints the path once it can be opened."""
    link = PtyLink()
    host = EmulatorHost(emulator, clock)
    host.attach(link)
    try:
        with _linked(path, link.path):
            print(path, flush=True)
            running, waiting = asyncio.create_task(host.run()), asyncio.create_task(ended.wait())
            await asyncio.wait([running, waiting], return_when=asyncio.FIRST_COMPLETED)
            if running.done():
                running.result()
            running.cancel()
    finally:
        await host.close()


async def _until_signalled(emulator: Emulator, path: Path) -> None:
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    await emulate(emulator, path, WallClock(), ended)


def emulate_command(
    device: Annotated[str, typer.Argument(help=f"One of {', '.join(DEVICES)}.")],
    pty: Annotated[Path, typer.Option("--pty", help="Where clients open the device; a symbolic link is made here.")],
    seed: Annotated[int, typer.Option(help="Of the bench's noise.")] = 1,
) -> None:
    """Emulate a device on a pseudo-terminal until Ctrl-C."""
    asyncio.run(_until_signalled(bench_emulator(device, seed), pty))


if __name__ == "__main__":
    typer.run(emulate_command)
