"""uvicorn with the patience taken out: half-sent requests are dropped, floods are refused, signals are ours."""

from __future__ import annotations

import asyncio
import contextlib
import re
import signal
import socket
import ssl
from collections.abc import Callable, Iterator
from typing import Any

import uvicorn
from fastapi import FastAPI
from starlette.responses import Response
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from core.errors import ConfigError
from core.mesh.chassis import front
from core.mesh.guard import LINK
from core.mesh.tls import name_in

REQUEST_WITHIN_S = 5.0
"""A request, body included, must have come in within this many seconds of its first byte."""
CONNECTIONS_MAX = 1000
HEAD_BYTES_MAX = 16 * 1024
_SLOW = (
    b'{"title":"Request Timeout","status":408,"detail":"the request did not come in whole",'
    b'"hint":"send head and body at once"}'
)
_BROKEN = (
    b'{"title":"Bad Request","status":400,"detail":"this is not HTTP/1.1, or its head is too long",'
    b'"hint":"speak plain HTTP/1.1, with a head of at most 16 KiB"}'
)
_PLAIN_GET = re.compile(rb"GET ([^ ?]+) HTTP/1\.1\r\n")
_NOT_PLAIN = re.compile(
    rb"\r\n(?:if-|connection:(?! *keep-alive\r)|content-(?!type:|length: *0\r)|expect|transfer-|upgrade|range)",
    re.IGNORECASE,
)
"""Headers that may change the answer, or what comes after it."""
SEND_BUFFER_BYTES = 256 * 1024
"""A whole inventory leaves in one piece."""


class ReadyAnswer:
    """The bytes of an answer, head and body, put together anew only when the answer or the date has changed."""

    __slots__ = ("_bytes", "_defaults", "_make", "_response")

    def __init__(self, make: Callable[[], Response]) -> None:
        self._make = make
        self._response: Response | None = None
        self._defaults: list[tuple[bytes, bytes]] = []
        self._bytes = b""

    def encoded(self, defaults: list[tuple[bytes, bytes]]) -> bytes:
        """`defaults` are headers that every answer carries; a new list when one of them is new."""
        response = self._make()
        if response is not self._response or defaults is not self._defaults:
            head = [b"HTTP/1.1 %d OK\r\n" % response.status_code]
            for name, value in (*defaults, *response.raw_headers):
                head += (name, b": ", value, b"\r\n")
            self._bytes = b"".join((*head, b"\r\n", response.body))
            self._response, self._defaults = response, defaults
        return self._bytes


class ImpatientProtocol(HttpToolsProtocol):
    """Closes connections whose request does not arrive; answers the plainest reads from ready bytes."""

    _deadline: asyncio.TimerHandle | None = None
    _head_bytes = 0
    _in_head = True
    _whole = True
    """Nothing of a request has come that is not complete."""
    _plain = b""
    _ready: ReadyAnswer | None = None
    """The last plain GET, byte for byte, and what answers it."""
    _answered_s = 0.0
    _link: str | None = None
    """Who is at the other end, by its certificate; None without TLS."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if (link := transport.get_extra_info("ssl_object")) is not None:
            self._link = name_in(link.getpeercert())
        self.transport = _Corked(transport, self.loop)  # type: ignore[assignment]
        self._deadline = self.loop.call_later(REQUEST_WITHIN_S, self._too_slow)

    def data_received(self, data: bytes) -> None:
        if self._whole and self._answered_at_once(data):
            return
        if self._deadline is None:
            self._deadline = self.loop.call_later(REQUEST_WITHIN_S, self._too_slow)
        self._whole = False
        super().data_received(data)
        if self._in_head and not self._whole:
            self._head_bytes += len(data)
            if self._head_bytes > HEAD_BYTES_MAX:
                self._say_and_close(b"400 Bad Request", _BROKEN)
        if self._whole:
            self._forget()

    def on_headers_complete(self) -> None:
        self._in_head = False
        super().on_headers_complete()
        if self._link is not None:
            self.scope[LINK] = self._link  # type: ignore[literal-required]

    def on_message_complete(self) -> None:
        super().on_message_complete()
        self._in_head, self._head_bytes, self._whole = True, 0, True

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget()
        super().connection_lost(exc)

    def shutdown(self) -> None:
        """A request still being answered may finish; a stream never would, and is closed."""
        super().shutdown()
        cycle = self.cycle
        if cycle is not None and cycle.response_started and not cycle.response_complete:
            self.transport.close()

    def send_400_response(self, msg: str) -> None:
        self._say_and_close(b"400 Bad Request", _BROKEN)

    def timeout_keep_alive_handler(self) -> None:
        """uvicorn's word for a connection that was idle too long; our own answers only note the time they were given."""
        left_s = self._answered_s + self.timeout_keep_alive - self.loop.time()
        if left_s > 0:
            self.timeout_keep_alive_task = self.loop.call_later(left_s, self.timeout_keep_alive_handler)
        else:
            super().timeout_keep_alive_handler()

    def _answered_at_once(self, data: bytes) -> bool:
        """True when this was a whole, plain GET of a path that has ready bytes, and the answer is written."""
        if (self.cycle is not None and not self.cycle.response_complete) or self.pipeline:
            return False
        if data != self._plain:
            self._plain, self._ready = data, self._ready_for(data)
        if self._ready is None:
            return False
        self._forget()
        self._answered_s = self.loop.time()
        if self.timeout_keep_alive_task is None:
            left_s = self.timeout_keep_alive
            self.timeout_keep_alive_task = self.loop.call_later(left_s, self.timeout_keep_alive_handler)
        self.transport.write_at_once(self._ready.encoded(self.server_state.default_headers))  # type: ignore[attr-defined]
        return True

    def _ready_for(self, data: bytes) -> ReadyAnswer | None:
        plain = _PLAIN_GET.match(data)
        ready: ReadyAnswer | None = self.config.ready.get(plain[1]) if plain else None  # type: ignore[attr-defined]
        if ready is None or data.find(b"\r\n\r\n") != len(data) - 4 or _NOT_PLAIN.search(data):
            return None
        return ready

    def _too_slow(self) -> None:
        self._deadline = None
        self._say_and_close(b"408 Request Timeout", _SLOW)

    def _say_and_close(self, status: bytes, problem: bytes) -> None:
        if self.transport.is_closing():
            return
        cycle = self.cycle
        if cycle is None or cycle.response_complete or not cycle.response_started:
            head = b"HTTP/1.1 %s\r\ncontent-type: application/problem+json\r\n"
            head += b"connection: close\r\ncontent-length: %d\r\n\r\n"
            self.transport.write(head % (status, len(problem)) + problem)
        self.transport.close()

    def _forget(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class _Corked:
    """A transport that sends head and body in one piece: what is written in one turn of the loop goes together."""

    __slots__ = ("_inner", "_loop", "_parts")

    def __init__(self, inner: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._inner, self._loop = inner, loop
        self._parts: list[bytes] = []

    def write(self, data: bytes) -> None:
        if not self._parts:
            self._loop.call_soon(self._flush)
        self._parts.append(data)

    def write_at_once(self, data: bytes) -> None:
        self._flush()
        self._inner.write(data)

    def close(self) -> None:
        self._flush()
        self._inner.close()

    def _flush(self) -> None:
        if self._parts:
            data = b"".join(self._parts)
            self._parts.clear()
            self._inner.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


class Server(uvicorn.Server):
    """Leaves signals to `core.mesh.node`, and listens by itself."""

    def __init__(self, config: uvicorn.Config, tls: ssl.SSLContext | None = None) -> None:
        super().__init__(config)
        self._tls = tls

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def handle_exit(self, sig: int, frame: Any) -> None:
        self.should_exit = True

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """As uvicorn's, which would leave a client a whole minute to shake hands."""
        await super().startup(sockets=[])
        config, loop = self.config, asyncio.get_running_loop()
        patience_s = REQUEST_WITHIN_S if self._tls else None

        def accepted() -> asyncio.Protocol:
            return ImpatientProtocol(config, self.server_state, self.lifespan.state)

        for sock in sockets or ():
            listening = await loop.create_server(
                accepted, sock=sock, ssl=self._tls, ssl_handshake_timeout=patience_s, backlog=config.backlog
            )
            self.servers.append(listening)


def make_server(app: FastAPI, tls: ssl.SSLContext | None = None) -> Server:
    """With `tls` (`core.mesh.tls.serving`) it speaks HTTPS and nothing else."""
    config = uvicorn.Config(
        front(app),
        http=ImpatientProtocol,
        ws="none",
        lifespan="off",
        loop="none",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=CONNECTIONS_MAX,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=1,
    )
    config.ready = {path: ReadyAnswer(make) for path, make in app.state.ready_bytes.items()}  # type: ignore[attr-defined]
    return Server(config, tls)


def listen(host: str, port: int) -> socket.socket:
    """A bound socket (port 0: any free one); raises ConfigError that names the port."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol named, asyncio switches Nagle's algorithm off on what is accepted: 40 ms an answer otherwise.
    sock = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        sock.bind((host, port))
    except OSError as error:
        sock.close()
        raise ConfigError(f"cannot listen on {host}:{port}: {error.strerror}", hint="is another garden running?") from error
    sock.listen(1024)
    sock.setblocking(False)
    return sock


def on_signals(server: Server) -> None:
    """SIGTERM and SIGINT end the server, and with it the process, cleanly."""
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, server.handle_exit, number, None)
