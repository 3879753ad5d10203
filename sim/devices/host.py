"""Puts an emulator on wires: any number of links in, the same bytes out on all, and faults on the way.

Whoever owns time calls `pump`: the world's clockwork, or `run` where there is no world.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable

from core.clock import Clock
from core.errors import LinkDown
from hw.links import ByteLink, MemoryNet, StreamLink
from sim.devices.plants import Emulator

STEP_S = 0.005


class EmulatorHost:
    """An emulator with its links. A link that closes changes nothing for the firmware.

    `wake` is called when bytes arrive, so that a world that strides steps at once.
    """

    def __init__(self, emulator: Emulator, clock: Clock, *, wake: Callable[[], None] = lambda: None) -> None:
        self.emulator, self._clock = emulator, clock
        self.wake = wake
        self._links: dict[ByteLink, asyncio.Task[None]] = {}
        self._waiting = bytearray()
        self._noise_ratio = 0.0
        self._noise_rng = random.Random(0)
        self._silent = False
        self._plugged = True

    # Links

    def attach(self, link: ByteLink) -> None:
        """Take the device's end of a link; it is let go when the other side closes it."""
        task = asyncio.get_running_loop().create_task(self._serve(link))
        self._links[link] = task
        task.add_done_callback(lambda _: self._links.pop(link, None))

    def listen(self, net: MemoryNet, name: str) -> None:
        """Be `memory://NAME` on that net."""
        net.listen(name, self.attach)

    async def serve_tcp(self, host: str, port: int) -> asyncio.Server:
        """Be `socket://HOST:PORT`; port 0 takes a free one (`server.sockets[0].getsockname()`)."""

        async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            link = StreamLink("tcp client", reader, writer)
            self.attach(link)
            await asyncio.wait([self._links[link]])

        return await asyncio.start_server(accept, host, port)

    async def close(self) -> None:
        """Let all links go."""
        tasks = list(self._links.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    # Faults

    def noise(self, ratio: float, rng: random.Random | None = None) -> None:
        """That share of the bytes, both ways, is flipped in one bit or lost."""
        self._noise_ratio = ratio
        self._noise_rng = rng or self._noise_rng

    def silence(self, silent: bool) -> None:
        """Bytes vanish both ways while links stay open: a wire pulled from the connector."""
        self._silent = silent

    async def unplug(self) -> None:
        """Links close, and new ones close at once."""
        self._plugged = False
        await self.close()

    def plug(self) -> None:
        self._plugged = True

    # Time

    def pump(self, now_s: float) -> None:
        """Give the firmware the bytes that have arrived, let it run up to now, send what it answers."""
        if self._waiting:
            data = bytes(self._waiting)
            self._waiting.clear()
            self.emulator.receive(data, now_s)
        self.emulator.step(now_s)
        self.flush()

    def due_s(self) -> float:
        """When the firmware next wants to run; the past if bytes wait."""
        return -math.inf if self._waiting else self.emulator.due_s()

    def flush(self) -> None:
        """Send what the firmware has said."""
        data = self._spoil(self.emulator.transmit())
        if not data:
            return
        for link in list(self._links):
            try:
                link.write(data)
            except LinkDown:
                continue

    async def run(self, advance: Callable[[float], None] = lambda now_s: None, step_s: float = STEP_S) -> None:
        """Without a world: pump for ever, `advance` moves what the emulator hangs on."""
        while True:
            now_s = self._clock.now()
            advance(now_s)
            self.pump(now_s)
            await self._clock.sleep(step_s)

    async def _serve(self, link: ByteLink) -> None:
        try:
            while self._plugged:
                self._waiting += self._spoil(await link.read())
                self.wake()
        except LinkDown:
            pass
        finally:
            await link.close()

    def _spoil(self, data: bytes) -> bytes:
        """What of these bytes gets through."""
        if self._silent:
            return b""
        if not data or self._noise_ratio <= 0.0:
            return data
        rng = self._noise_rng
        heard = bytearray()
        for byte in data:
            if rng.random() >= self._noise_ratio:
                heard.append(byte)
            elif rng.random() < 0.5:
                heard.append(byte ^ 1 << rng.randrange(8))
        return bytes(heard)
