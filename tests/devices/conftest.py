"""A cable between an emulator and a driver, on virtual time, that can be cut, muted and dirtied."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import hypothesis
import pytest

from core.clock import VirtualClock
from core.virtual import run_virtual
from hw.drivers.session import Session
from hw.links import MemoryNet
from sim.devices.host import EmulatorHost
from sim.devices.plants import Emulator

# A shared machine's pauses are no fault of the code, and a test run must be repeatable.
hypothesis.settings.register_profile("devices", deadline=None, derandomize=True, max_examples=60)
hypothesis.settings.load_profile("devices")


class Tap:
    """An emulator with somebody listening in, who may swallow either direction and add bytes of his own."""

    def __init__(self, inner: Emulator, heard: list[bytes]) -> None:
        self.inner, self.heard = inner, heard
        self.deaf = self.mute = False
        self.extra = b""

    def receive(self, data: bytes, now_s: float) -> None:
        self.heard.append(data)
        if not self.deaf:
            self.inner.receive(data, now_s)

    def step(self, now_s: float) -> None:
        self.inner.step(now_s)

    def transmit(self) -> bytes:
        data, self.extra = self.inner.transmit() * (not self.mute) + self.extra, b""
        return data

    def due_s(self) -> float:
        return self.inner.due_s()


class Cable:
    """Runs an emulator behind `memory://device` and keeps what the host wrote."""

    def __init__(self) -> None:
        self.clock = VirtualClock(1000.0)
        self.net = MemoryNet(self.clock)
        self.to_device: list[bytes] = []
        self.host: EmulatorHost | None = None
        self._kick = asyncio.Event()
        self._drivers: list[asyncio.Task[None]] = []
        self._device: asyncio.Task[None] | None = None

    @property
    def tap(self) -> Tap:
        assert self.host is not None
        assert isinstance(self.host.emulator, Tap)
        return self.host.emulator

    def plug(self, emulator: Emulator | None = None) -> None:
        """(Re)connect; another emulator means that the device was exchanged, or has lost its power."""
        if self.host is None:
            assert emulator is not None
            self.host = EmulatorHost(Tap(emulator, self.to_device), self.clock, wake=self._kick.set)
            self.host.listen(self.net, "device")
        elif emulator is not None:
            self.tap.inner = emulator
        self.host.plug()

    async def unplug(self) -> None:
        assert self.host is not None
        await self.host.unplug()

    def inject(self, data: bytes) -> None:
        """Bytes to the host that the device never sent."""
        self.tap.extra += data
        self._kick.set()

    def start(self, *drivers: Session) -> None:
        self._drivers += [asyncio.create_task(driver.run()) for driver in drivers]
        self._device = self._device or asyncio.create_task(self._run())

    async def stop(self) -> None:
        """End the drivers; the device lives on."""
        drivers, self._drivers = self._drivers, []
        for task in drivers:
            task.cancel()
        await asyncio.gather(*drivers, return_exceptions=True)
        await self.clock.sleep(0.05)

    async def die(self) -> None:
        """End the drivers as SIGKILL does: the link closes, and nothing is said before."""
        self.tap.deaf = True
        await self.stop()
        self.tap.deaf = False

    def written(self) -> bytes:
        """What the host wrote since the last call."""
        data = b"".join(self.to_device)
        self.to_device.clear()
        return data

    async def _run(self) -> None:
        while True:
            assert self.host is not None
            self.host.pump(self.clock.now())
            self._kick.clear()
            wait_s = min(60.0, max(0.0, self.host.due_s() - self.clock.now()))
            try:
                async with self.clock.timeout(wait_s):
                    await self._kick.wait()
            except TimeoutError:
                continue


@pytest.fixture
def on_cable() -> Callable[[Callable[[Cable], Awaitable[None]]], None]:
    """Runs a story on virtual time with a fresh cable."""

    def run(story: Callable[[Cable], Awaitable[None]]) -> None:
        async def main() -> None:
            async with asyncio.timeout(10_000):
                await story(Cable())

        run_virtual(main())

    return run
