"""The mesh's real transport: a small HTTP/1.1 client that keeps a few connections to each peer.

One request is one write and one future, which is what makes asking 200 robots at once cheap. Answers may have a length,
be chunked (RFC 9112, section 7.1) or end with the connection; whatever is not HTTP is an OSError, as silence is.

A request that its caller gave up still has its connection until the answer comes: a peer that has fallen behind is not
asked on ever more connections, which would leave it further behind.
"""

from __future__ import annotations

import asyncio
import re
import ssl
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from urllib.parse import quote, urlsplit

from core.errors import BadRequest
from core.mesh.client import ANSWER_BYTES_MAX, Answer
from core.mesh.tls import name_in

KEPT_S = 25.0
"""Shorter than our servers keep an idle connection, so that no request meets one that is closing."""
CONNECTIONS_MAX = 8
"""To one peer; whoever comes when all are taken waits for one."""
LATE_S = 10.0
"""An answer that nobody waits for any more is given up after this."""
HEAD_BYTES_MAX = 64 * 1024
_SAFE = re.compile(r"[A-Za-z0-9/%:=&?~+!$,;'@()*._-]*")
_CONTROL = re.compile(r"[\x00-\x08\x0a-\x1f\x7f]")
_STATUS = re.compile(rb"HTTP/1\.[01] ([1-5][0-9][0-9])(?: |$)")


@dataclass(frozen=True, slots=True)
class _Target:
    """A URL, taken apart once."""

    place: tuple[str, int, bool]
    """Host, port, with TLS."""
    origin: str
    """Scheme, host and port as they were written."""
    start: str
    """What follows the method in a request's first lines."""


class HttpTransport:
    """A PeerTransport over TCP. The caller holds the time-out."""

    def __init__(self, tls: ssl.SSLContext | None = None, expected: Callable[[str], str | None] | None = None) -> None:
        """`expected` tells which node answers at an address (`https://HOST:PORT`), None for a stranger's.

        With it nobody is asked but over TLS, and nobody answers in another's place (`core.mesh.tls`).
        """
        self._tls, self._expected = tls, expected
        self._hosts: dict[tuple[str, int, bool], _Host] = {}
        self._targets: dict[str, _Target] = {}
        self._open: set[_Connection] = set()

    async def send(self, method: str, url: str, headers: Mapping[str, str], body: bytes) -> Answer:
        target = self._target(url)
        if self._expected is not None and not target.place[2]:
            raise ConnectionError("it would be asked in plain HTTP, and this garden speaks TLS")
        data = _request(method, target, headers, body)
        if (host := self._hosts.get(target.place)) is None:
            host = self._hosts[target.place] = _Host()
        await host.enter()
        if (connection := host.kept()) is not None:
            try:
                self._check(connection, target, host)
                return await connection.ask(data, method == "HEAD", host.left)
            except ConnectionResetError:
                # It was closing while we wrote: a GET may simply be asked again, on a new connection.
                if method != "GET":
                    raise
            await host.enter()
        try:
            connection = await self._connect(target.place)
        except BaseException:
            host.leave()
            raise
        self._check(connection, target, host)
        return await connection.ask(data, method == "HEAD", host.left)

    def _check(self, connection: _Connection, target: _Target, host: _Host) -> None:
        """Hang up, before anything is said, when another node answers than should; raises ConnectionError."""
        expected = self._expected(target.origin) if self._expected is not None else None
        if expected is not None and connection.name != expected:
            connection.close()
            host.leave()
            raise ConnectionError(f"{connection.name or 'a node without a name'} answers there, not {expected}")

    async def aclose(self) -> None:
        for host in self._hosts.values():
            host.close()
        for connection in list(self._open):
            connection.close()
        self._hosts.clear()
        await asyncio.sleep(0)

    async def _connect(self, place: tuple[str, int, bool]) -> _Connection:
        host, port, tls = place
        loop = asyncio.get_running_loop()
        context = (self._tls or ssl.create_default_context()) if tls else None
        _, connection = await loop.create_connection(lambda: _Connection(self._open), host, port, ssl=context)
        return connection

    def _target(self, url: str) -> _Target:
        target = self._targets.get(url)
        if target is None:
            if len(self._targets) > 2000:
                self._targets.clear()
            target = self._targets[url] = _parsed(url)
        return target


def _parsed(url: str) -> _Target:
    parts = urlsplit(url)
    tls = parts.scheme == "https"
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise BadRequest(f"{url!r} is no http address")
    what = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    if not _SAFE.fullmatch(what):
        what = quote(what, safe="/%:=&?~+!$,;'@()*._-")
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    port = parts.port or (443 if tls else 80)
    origin = f"{parts.scheme}://{parts.netloc}"
    return _Target((parts.hostname, port, tls), origin, f" {what} HTTP/1.1\r\nhost: {host}:{port}\r\n")


def _request(method: str, target: _Target, headers: Mapping[str, str], body: bytes) -> bytes:
    lines = [method, target.start]
    for name, value in headers.items():
        if _CONTROL.search(value):
            raise BadRequest(f"the header {name} holds a control character")
        lines += (name, ": ", value, "\r\n")
    if body or method not in ("GET", "HEAD", "DELETE"):
        lines.append(f"content-length: {len(body)}\r\n")
    lines.append("\r\n")
    return "".join(lines).encode("latin-1", "replace") + body


@dataclass(slots=True)
class _Host:
    """The connections to one peer: those at rest, and how many are taken."""

    taken: int = 0
    idle: list[_Connection] = field(default_factory=list)
    _waiting: deque[asyncio.Future[None]] = field(default_factory=deque)

    async def enter(self) -> None:
        """Wait for one's turn; first come, first served."""
        if self.taken < CONNECTIONS_MAX:
            self.taken += 1
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting.append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if not turn.cancelled():
                self.leave()  # our turn came as we gave up
            raise

    def leave(self) -> None:
        while self._waiting:
            turn = self._waiting.popleft()
            if not turn.done():
                turn.set_result(None)
                return
        self.taken -= 1

    def left(self, connection: _Connection) -> None:
        """A request has ended, however."""
        if connection.reusable:
            self.idle.append(connection)
        else:
            connection.close()
        self.leave()

    def kept(self) -> _Connection | None:
        """A connection that is open and not too old; the youngest first."""
        now_s = asyncio.get_running_loop().time()
        while self.idle:
            connection = self.idle.pop()
            if connection.reusable and now_s - connection.used_s < KEPT_S:
                return connection
            connection.close()
        return None

    def close(self) -> None:
        while self._waiting:
            turn = self._waiting.popleft()
            if not turn.done():
                turn.set_exception(ConnectionResetError("the transport was closed"))


class _Connection(asyncio.Protocol):
    """One request at a time."""

    def __init__(self, open_: set[_Connection]) -> None:
        self._open = open_
        self._transport: asyncio.Transport | None = None
        self._waiting: asyncio.Future[Answer] | None = None
        self._left: Callable[[_Connection], None] | None = None
        """Told once the request under way has ended; None between requests."""
        self._given_up: asyncio.TimerHandle | None = None
        self._reader = _Reader(headless=False)
        self.used_s = 0.0
        self.reusable = False
        self.name = ""
        """The node that answers, by its certificate."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self.name = name_in(transport.get_extra_info("peercert"))
        self._open.add(self)

    async def ask(self, data: bytes, headless: bool, left: Callable[[_Connection], None]) -> Answer:
        """`left` is called when the connection is free for others or gone, maybe after the caller has given up."""
        loop = asyncio.get_running_loop()
        self._left, self.reusable = left, False
        if self._transport is None or self._transport.is_closing():
            self._end()
            raise ConnectionResetError("the connection was closed")
        self._reader = _Reader(headless)
        self._waiting = loop.create_future()
        self._transport.write(data)
        try:
            return await self._waiting
        except asyncio.CancelledError:
            if self._left is not None:
                self._given_up = loop.call_later(LATE_S, self.close)
            raise

    def data_received(self, data: bytes) -> None:
        if self._left is None:
            self.close()  # bytes that nobody asked for
            return
        try:
            answer = self._reader.feed(data)
        except ValueError as error:
            self._fail(ConnectionError(f"the answer is not HTTP: {error}"))
            self.close()
            return
        if answer is not None:
            self._answered(answer)

    def connection_lost(self, exc: Exception | None) -> None:
        self._open.discard(self)
        self._reader.keep = False
        if (answer := self._reader.at_end()) is not None:
            self._answered(answer)
        elif self._reader.begun:
            self._fail(ConnectionError("the answer broke off"))
        else:
            self._fail(ConnectionResetError(str(exc or "the connection was closed without an answer")))
        self.reusable = False
        self._end()

    def close(self) -> None:
        self.reusable = False
        if self._transport is not None:
            self._transport.abort()
        self._end()

    def _answered(self, answer: Answer) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(answer)
        self.reusable, self.used_s = self._reader.keep, asyncio.get_running_loop().time()
        self._end()

    def _fail(self, error: ConnectionError) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_exception(error)

    def _end(self) -> None:
        if self._given_up is not None:
            self._given_up.cancel()
            self._given_up = None
        if self._left is not None:
            left, self._left = self._left, None
            left(self)


class _Reader:
    """One answer out of bytes that come in pieces; raises ValueError for what is not HTTP."""

    def __init__(self, headless: bool) -> None:
        self._headless = headless
        """The answer to a HEAD: lengths are told, bytes are not."""
        self._data = bytearray()
        self._status = 0
        self._headers: dict[str, str] = {}
        self._left: int | None = None
        """Bytes of the body still to come; None: until the connection ends."""
        self._chunks: bytearray | None = None
        self.keep = False
        self.begun = False

    def feed(self, data: bytes) -> Answer | None:
        self.begun = True
        self._data += data
        while self._status == 0:
            end = self._data.find(b"\r\n\r\n")
            if end < 0:
                if len(self._data) > HEAD_BYTES_MAX:
                    raise ValueError("its head is too long")
                return None
            self._read_head(bytes(self._data[:end]))
            del self._data[: end + 4]
        return self._body()

    def at_end(self) -> Answer | None:
        """The answer when the connection ended: only one that was to be read to the end is whole."""
        if self._status and self._left is None and self._chunks is None:
            return Answer(self._status, bytes(self._data), self._headers)
        return None

    def _read_head(self, head: bytes) -> None:
        first, *lines = head.split(b"\r\n")
        if (matched := _STATUS.match(first)) is None:
            raise ValueError(f"it begins with {first[:40]!r}")
        status = int(matched[1])
        if status < 200:
            return  # a word on the way; the answer follows
        for line in lines:
            name, colon, value = line.partition(b":")
            if not colon or not name or name != name.strip():
                raise ValueError("a header line without a name")
            self._headers[name.decode("latin-1").lower()] = value.strip().decode("latin-1")
        self._status = status
        self._measure(first.startswith(b"HTTP/1.1"))

    def _measure(self, modern: bool) -> None:
        headers = self._headers
        self.keep = modern and headers.get("connection", "").lower() != "close"
        if self._headless or self._status in (204, 304):
            self._left = 0
        elif headers.get("transfer-encoding", "").lower() == "chunked":
            self._chunks = bytearray()
        elif (length := headers.get("content-length")) is not None:
            if not length.isascii() or not length.isdigit():
                raise ValueError("its length is not a number")
            self._left = int(length)
            self._check_size(self._left)
        else:
            self.keep = False

    def _body(self) -> Answer | None:
        if self._chunks is not None:
            return self._chunked(self._chunks)
        self._check_size(len(self._data))
        if self._left is None or len(self._data) < self._left:
            return None
        self.keep = self.keep and len(self._data) == self._left
        return Answer(self._status, bytes(self._data[: self._left]), self._headers)

    def _chunked(self, whole: bytearray) -> Answer | None:
        while (line_end := self._data.find(b"\r\n")) >= 0:
            size = _chunk_size(bytes(self._data[:line_end]))
            end = line_end + 2 + size + 2
            self._check_size(len(whole) + size)
            if len(self._data) < end:
                return None
            if self._data[end - 2 : end] != b"\r\n":
                raise ValueError("a chunk does not end where it should (or trailers follow)")
            whole += self._data[line_end + 2 : end - 2]
            del self._data[:end]
            if size == 0:
                self.keep = self.keep and not self._data
                return Answer(self._status, bytes(whole), self._headers)
        if len(self._data) > 1000:
            raise ValueError("a chunk without a size")
        return None

    def _check_size(self, size: int) -> None:
        if size > ANSWER_BYTES_MAX:
            raise ValueError(f"it is longer than {ANSWER_BYTES_MAX} bytes")


def _chunk_size(line: bytes) -> int:
    digits = line.partition(b";")[0].strip()
    if not re.fullmatch(rb"[0-9A-Fa-f]{1,8}", digits):
        raise ValueError("a chunk's size is not a number")
    return int(digits, 16)
