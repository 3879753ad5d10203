"""Byte links: a device's wire, opened by URL. Real and simulated hardware differ in nothing else.

- `/dev/ttyUSB0`, `/dev/ttyUSB0?baud=57600` or `serial:///dev/...`: a real port, through pyserial
- `socket://HOST:PORT`: a TCP byte stream (a simulator's emulator, a ser2net box)
- `unix:///PATH`: a local stream
- `memory://NAME`: a link of a `MemoryNet`, for tests and the virtual garden
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from asyncio import get_running_loop
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Protocol
from urllib.parse import parse_qs, urlsplit

from core.clock import Clock
from core.errors import ConfigError, LinkDown

READ_BYTES_MAX = 4096
WRITE_BUFFER_BYTES_MAX = 64 * 1024


class ByteLink(Protocol):
    """A duplex byte stream. No framing: a write may arrive in pieces, several may arrive as one."""

    @property
    def name(self) -> str: ...

    async def read(self) -> bytes:
        """At least one byte; raises LinkDown when the other side is gone."""
        ...

    def write(self, data: bytes) -> None:
        """Queues bytes without waiting; raises LinkDown when closed or when the buffer is full."""
        ...

    async def close(self) -> None: ...


Opener = Callable[[str], Awaitable[ByteLink]]
"""Opens a URL; handed to drivers so that tests and the virtual garden can bring their own wires."""


class StreamLink:
    """A link over an asyncio stream pair (TCP, unix socket, serial)."""

    def __init__(self, name: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._name, self._reader, self._writer = name, reader, writer

    @property
    def name(self) -> str:
        return self._name

    async def read(self) -> bytes:
        try:
            data = await self._reader.read(READ_BYTES_MAX)
        except OSError as error:
            raise LinkDown(f"{self._name} failed: {error}") from error
        if not data:
            raise LinkDown(f"{self._name} was closed by the other side")
        return data

    def write(self, data: bytes) -> None:
        if self._writer.is_closing():
            raise LinkDown(f"{self._name} is closed")
        if self._writer.transport.get_write_buffer_size() > WRITE_BUFFER_BYTES_MAX:
            raise LinkDown(f"{self._name} does not take bytes any more")
        self._writer.write(data)

    def write_past_the_loop(self, data: bytes) -> None:
        """What of it the wire takes at once, although the loop hangs: for a device's last words. Never raises."""
        transport = self._writer.transport
        port = transport.get_extra_info("socket") or transport.get_extra_info("serial")
        with contextlib.suppress(OSError, ValueError, AttributeError):
            os.write(port.fileno(), data)

    async def close(self) -> None:
        self._writer.close()
        try:
            await self._writer.wait_closed()
        except OSError:
            return


async def open_link(url: str) -> ByteLink:
    """Open a byte link by URL; raises LinkDown when nothing is there, ConfigError for a URL of no known kind."""
    parts = urlsplit(url)
    try:
        if parts.scheme == "socket":
            if parts.hostname is None or parts.port is None:
                raise ConfigError(f"{url!r} lacks a host or a port", hint="write socket://127.0.0.1:9101")
            reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
        elif parts.scheme == "unix":
            reader, writer = await asyncio.open_unix_connection(parts.path)
        elif parts.scheme == "serial" or (parts.scheme == "" and parts.path.startswith("/")):
            return await _open_serial(url, parts.path, parse_qs(parts.query))
        else:
            raise ConfigError(f"cannot open {url!r}", hint="use /dev/tty..., socket://HOST:PORT or unix:///PATH")
    except OSError as error:
        raise LinkDown(f"cannot open {url}: {error.strerror or error}") from error
    return StreamLink(url, reader, writer)


async def _open_serial(url: str, path: str, query: dict[str, list[str]]) -> ByteLink:
    import serial
    import serial_asyncio_fast

    baud = int(query.get("baud", ["115200"])[0])
    try:
        reader, writer = await serial_asyncio_fast.open_serial_connection(url=path, baudrate=baud)
    except serial.SerialException as error:
        raise LinkDown(f"cannot open {url}: {error}") from error
    return StreamLink(url, reader, writer)


class MemoryLink:
    """One end of an in-memory link with latency; bytes arrive in order, never in the same instant."""

    def __init__(self, name: str, clock: Clock, latency_s: float) -> None:
        self._name, self._clock, self._latency_s = name, clock, latency_s
        self._buffer = bytearray()
        self._flight: deque[bytes | None] = deque()
        """On the way to the peer, oldest first; None is the end. The loop's timers of one instant fire in any order."""
        self._reader: asyncio.Future[None] | None = None
        self._closed = False
        self.peer: MemoryLink | None = None
        self.muted = False
        """True while bytes written here vanish (a cut cable that nobody has noticed)."""

    @property
    def name(self) -> str:
        return self._name

    async def read(self) -> bytes:
        while not self._buffer:
            if self._closed:
                raise LinkDown(f"{self._name} was closed by the other side")
            if self._reader is not None:
                raise RuntimeError(f"two readers at {self._name}")
            self._reader = get_running_loop().create_future()
            try:
                await self._reader
            finally:
                self._reader = None
        if len(self._buffer) <= READ_BYTES_MAX:
            data = bytes(self._buffer)
            self._buffer.clear()
        else:
            data = bytes(self._buffer[:READ_BYTES_MAX])
            del self._buffer[:READ_BYTES_MAX]
        return data

    def write(self, data: bytes) -> None:
        if self._closed or self.peer is None:
            raise LinkDown(f"{self._name} is closed")
        if not self.muted and data:
            self._launch(bytes(data))

    async def close(self) -> None:
        self._shut()
        if self.peer is not None and not self.muted:
            self._launch(None)

    def _launch(self, data: bytes | None) -> None:
        self._flight.append(data)
        loop = get_running_loop()
        loop.call_at(loop.time() + self._latency_s, self._land)

    def _land(self) -> None:
        data = self._flight.popleft()
        if self.peer is None:
            return
        if data is None:
            self.peer._shut()
        else:
            self.peer._deliver(data)

    def cut(self) -> None:
        """The owner died: nothing written from now on arrives, and the other side sees the end."""
        self.muted = True
        if self.peer is not None:
            asyncio.get_running_loop().call_later(self._latency_s, self.peer._shut)

    def _deliver(self, data: bytes) -> None:
        if not self._closed:
            self._buffer += data
            self._stir()

    def _shut(self) -> None:
        self._closed = True
        self._stir()

    def _stir(self) -> None:
        """Wake the reader."""
        if self._reader is not None and not self._reader.done():
            self._reader.set_result(None)


def memory_pair(clock: Clock, name: str = "memory", latency_s: float = 0.001) -> tuple[MemoryLink, MemoryLink]:
    """Two connected ends."""
    here, there = MemoryLink(name, clock, latency_s), MemoryLink(name, clock, latency_s)
    here.peer, there.peer = there, here
    return here, there


class MemoryNet:
    """Named in-memory ports: emulators `listen`, drivers `open` `memory://NAME`."""

    def __init__(self, clock: Clock, latency_s: float = 0.001) -> None:
        self._clock, self._latency_s = clock, latency_s
        self._listeners: dict[str, Callable[[ByteLink], None]] = {}

    def listen(self, name: str, accept: Callable[[ByteLink], None]) -> None:
        """`accept` gets the device's end of every new link."""
        self._listeners[name] = accept

    def close(self, name: str) -> None:
        """Nobody listens there any more; open links stay."""
        self._listeners.pop(name, None)

    async def open(self, url: str) -> ByteLink:
        await self._clock.sleep(self._latency_s)
        name = url.removeprefix("memory://")
        if (accept := self._listeners.get(name)) is None:
            raise LinkDown(f"cannot open {url}: nobody listens")
        here, there = memory_pair(self._clock, url, self._latency_s)
        accept(there)
        return here
