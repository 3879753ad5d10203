"""uvicorn with the patience taken out: half-sent requests are dropped, floods are refused, signals are ours."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
from collections.abc import Iterator
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from core.errors import ConfigError

REQUEST_WITHIN_S = 5.0
"""A request, body included, must have come in within this many seconds of its first byte."""
CONNECTIONS_MAX = 1000
HEADER_BYTES_MAX = 16 * 1024
_WAITING = (h11.IDLE, h11.SEND_BODY)
_SLOW = (
    b'{"title":"Request Timeout","status":408,"detail":"the request did not come in whole",'
    b'"hint":"send head and body at once"}'
)
_BROKEN = b'{"title":"Bad Request","status":400,"detail":"this is not HTTP/1.1","hint":"speak HTTP/1.1, without TLS"}'


class ImpatientProtocol(H11Protocol):
    """Closes connections whose request does not arrive."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._deadline = self.loop.call_later(REQUEST_WITHIN_S, self._too_slow)

    def data_received(self, data: bytes) -> None:
        if self._deadline is None:
            self._deadline = self.loop.call_later(REQUEST_WITHIN_S, self._too_slow)
        super().data_received(data)
        if self.conn.their_state not in _WAITING:
            self._forget()

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

    def _too_slow(self) -> None:
        self._deadline = None
        self._say_and_close(b"408 Request Timeout", _SLOW)

    def _say_and_close(self, status: bytes, problem: bytes) -> None:
        if self.transport.is_closing():
            return
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            head = (
                b"HTTP/1.1 %s\r\ncontent-type: application/problem+json\r\nconnection: close\r\ncontent-length: %d\r\n\r\n"
            )
            self.transport.write(head % (status, len(problem)) + problem)
        self.transport.close()

    def _forget(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class Server(uvicorn.Server):
    """Leaves signals to `core.mesh.node`."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def handle_exit(self, sig: int, frame: Any) -> None:
        self.should_exit = True


def make_server(app: FastAPI) -> Server:
    config = uvicorn.Config(
        app,
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
        h11_max_incomplete_event_size=HEADER_BYTES_MAX,
    )
    return Server(config)


def listen(host: str, port: int) -> socket.socket:
    """A bound socket (port 0: any free one); raises ConfigError that names the port."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol named, asyncio switches Nagle's algorithm off on what is accepted: 40 ms an answer otherwise.
    sock = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
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
