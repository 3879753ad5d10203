"""Where brains knock: a local stream that only this robot's brain may use, one at a time, the newest wins."""

from __future__ import annotations

import asyncio
import hmac
import os
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import urlsplit

import structlog

from core.clock import Clock
from core.errors import ConfigError, GardenError, LinkDown, Unauthorised, Unprocessable
from core.wire.body import BodyState, Control, Hello, LineBuffer, Setpoint, decode, encode
from hw.links import READ_BYTES_MAX, ByteLink, StreamLink
from robot_service.body.gate import wants_anything

HELLO_WITHIN_S = 2.0
KNOCKING_MAX = 8
_log = structlog.get_logger("robot.body.stream")

Accept = Callable[[ByteLink], None]
MemoryListen = Callable[[str, Accept], None]
"""`MemoryNet.listen`, for bodies in one process with their brain."""


@asynccontextmanager
async def listening(url: str, accept: Accept, memory: MemoryListen | None = None) -> AsyncIterator[None]:
    """Hand every new link at `url` to `accept`; raises ConfigError when nobody can listen there."""
    parts = urlsplit(url)
    if parts.scheme == "memory":
        if memory is None:
            raise ConfigError(f"{url} works only within one process", hint="use unix:///PATH")
        memory(url.removeprefix("memory://"), accept)
        yield
        return

    async def arrived(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        accept(StreamLink(url, reader, writer))

    server = await _server(url, arrived)
    try:
        yield
    finally:
        server.close()
        if parts.scheme == "unix":
            _forget(Path(parts.path))


def _forget(path: Path) -> None:
    path.unlink(missing_ok=True)


Arrived = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


async def _server(url: str, arrived: Arrived) -> asyncio.Server:
    parts = urlsplit(url)
    try:
        if parts.scheme == "unix":
            return await asyncio.start_unix_server(arrived, sock=_unix_socket(Path(parts.path)), limit=READ_BYTES_MAX)
        if parts.hostname is None or parts.port is None:
            raise ConfigError(f"{url} lacks a host or a port", hint="write unix:///PATH or socket://127.0.0.1:PORT")
        return await asyncio.start_server(arrived, parts.hostname, parts.port, limit=READ_BYTES_MAX)
    except OSError as error:
        raise ConfigError(f"cannot listen at {url}: {error.strerror or error}") from error


def _unix_socket(path: Path) -> socket.socket:
    """Only this user may connect; a socket that a dead body left behind is replaced."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    sock = socket.socket(socket.AF_UNIX)
    try:
        sock.bind(str(path))
        os.chmod(path, 0o600)
    except OSError:
        sock.close()
        raise
    return sock


class BrainPort:
    """The body's end of the stream: the newest setpoint in, states out."""

    def __init__(
        self,
        url: str,
        secret: str,
        clock: Clock,
        *,
        woken: Callable[[], None],
        ordered: Callable[[Control], None],
        memory: MemoryListen | None = None,
    ) -> None:
        self._url, self._secret, self._clock, self._memory = url, secret.encode(), clock, memory
        self._woken, self._ordered = woken, ordered
        self._knocking: asyncio.Queue[ByteLink] = asyncio.Queue(KNOCKING_MAX)
        self._link: ByteLink | None = None
        self.setpoint: Setpoint | None = None
        self.heard_s = 0.0
        self.brains = 0
        """Brains let in so far: grows with each."""

    @property
    def connected(self) -> bool:
        return self._link is not None

    async def run(self) -> None:
        """Listen and attend for ever."""
        async with listening(self._url, self._accept, self._memory), asyncio.TaskGroup() as group:
            while True:
                group.create_task(self._attend(await self._knocking.get()))

    def send(self, state: BodyState) -> None:
        """To the brain, if there is one; a brain that does not read is let go."""
        if self._link is None:
            return
        try:
            self._link.write(encode(state))
        except LinkDown as error:
            self._let_go(self._link, str(error))

    def _accept(self, link: ByteLink) -> None:
        try:
            self._knocking.put_nowait(link)
        except asyncio.QueueFull:
            _log.warning("too many brains knock at once")

    async def _attend(self, link: ByteLink) -> None:
        lines = LineBuffer()
        try:
            async with self._clock.timeout(HELLO_WITHIN_S):
                rest = await self._greeted(link, lines)
            older = self._let_in(link)
            if older is not None:
                await older.close()
            while True:
                for line in rest:
                    self._take(link, line)
                rest = lines.feed(await link.read())
        except TimeoutError:
            _log.warning("a brain said nothing", within_s=HELLO_WITHIN_S)
        except LinkDown as error:
            self._let_go(link, str(error))
        except GardenError as error:
            _log.warning("brain refused", why=str(error))
            self._let_go(link, str(error))
        finally:
            self._let_go(link, "closed")
            await link.close()

    async def _greeted(self, link: ByteLink, lines: LineBuffer) -> list[bytes]:
        """Wait for the right first line; the lines that came with it."""
        while not (got := lines.feed(await link.read())):
            continue
        hello = decode(got[0])
        said = hello.secret if isinstance(hello, Hello) else None
        if not isinstance(said, str) or not hmac.compare_digest(said.encode(), self._secret):
            raise Unauthorised("this is not our brain")
        return got[1:]

    def _let_in(self, link: ByteLink) -> ByteLink | None:
        """The brain it takes over from, if there was one."""
        older, self._link, self.setpoint = self._link, link, None
        self.brains += 1
        _log.info("brain connected", number=self.brains, instead_of_another=older is not None)
        self._woken()
        return older

    def _let_go(self, link: ByteLink, why: str) -> None:
        if link is self._link:
            self._link, self.setpoint = None, None
            _log.info("brain gone", why=why)
            self._woken()

    def _take(self, link: ByteLink, line: bytes) -> None:
        if link is not self._link:
            raise LinkDown("a newer brain took over")
        message = decode(line)
        if isinstance(message, Setpoint):
            self.setpoint, self.heard_s = message, self._clock.now()
            if wants_anything(message):
                self._woken()
        elif isinstance(message, Control):
            self._ordered(message)
        else:
            raise Unprocessable("a brain sends setpoints and orders only")
