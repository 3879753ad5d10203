"""An in-memory mesh: the services' HTTP on virtual time, with latency, loss and dead nodes."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import httpx

from core.clock import Clock

Asgi = Callable[..., Awaitable[Any]]


@dataclass(slots=True)
class Leg:
    """How one direction between two hosts behaves."""

    cut: bool = False
    loss_ratio: float = 0.0
    delay_s: float = 0.0


@dataclass(slots=True)
class Host:
    """A node as the mesh sees it; its handlers run as its own tasks, and die with it."""

    app: Asgi
    up: bool = True
    handlers: set[asyncio.Task[httpx.Response]] = field(default_factory=set)


class MemoryMesh:
    """Routes requests to ASGI apps by `host:port`. `transport(name)` is one node's way into it.

    Request and reply are delayed, lost or cut each on its own leg: losing a reply after the act is what finds bugs.
    """

    def __init__(self, clock: Clock, rng: random.Random, latency_s: float = 0.002) -> None:
        self._clock, self._rng, self._latency_s = clock, rng, latency_s
        self._hosts: dict[str, Host] = {}
        self._names: dict[str, str] = {}
        self._legs: dict[tuple[str, str], Leg] = {}
        self.requests = 0

    def attach(self, name: str, netloc: str, app: Asgi) -> None:
        """Node `name` now answers at `netloc`."""
        self._hosts[netloc] = Host(app)
        self._names[netloc] = name

    def detach(self, netloc: str) -> None:
        """The node is gone: connections are refused and its running handlers never answer."""
        if (host := self._hosts.pop(netloc, None)) is not None:
            host.up = False
            for task in host.handlers:
                task.cancel()

    def leg(self, source: str, target: str) -> Leg:
        """The one-way behaviour from node to node, to be changed in place."""
        return self._legs.setdefault((source, target), Leg())

    def transport(self, name: str) -> MemoryTransport:
        return MemoryTransport(self, name)

    async def carry(self, source: str, request: httpx.Request) -> httpx.Response:
        """Deliver one request from node `source` and bring the answer back."""
        self.requests += 1
        netloc = request.url.netloc.decode()
        target = self._names.get(netloc, netloc)
        await self._cross(source, target)
        if (host := self._hosts.get(netloc)) is None:
            raise httpx.ConnectError(f"connection to {netloc} refused", request=request)
        response = await self._handle(host, request)
        await self._cross(target, source)
        return response

    async def _cross(self, source: str, target: str) -> None:
        leg = self._legs.get((source, target))
        await self._clock.sleep(self._latency_s + (leg.delay_s if leg else 0.0))
        if leg and (leg.cut or self._rng.random() < leg.loss_ratio):
            await self._clock.sleep(1e9)

    async def _handle(self, host: Host, request: httpx.Request) -> httpx.Response:
        """Run the handler as a task of its own node, so that a caller who gives up does not stop it."""
        task = asyncio.create_task(_answer(host.app, request))
        host.handlers.add(task)
        task.add_done_callback(host.handlers.discard)
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            if task.cancelled() and not host.up:
                raise httpx.ReadError("the node died before it answered", request=request) from None
            raise


async def _answer(app: Asgi, request: httpx.Request) -> httpx.Response:
    """The app's whole answer; 500 when it raised before it answered. (ASGI 3.0, HTTP; `httpx.ASGITransport` in short.)"""
    question: bytes | None = await request.aread()
    done = asyncio.Event()
    head: dict[str, Any] = {"status": 500, "headers": []}
    parts: list[bytes] = []

    async def receive() -> dict[str, Any]:
        nonlocal question
        if question is None:
            await done.wait()
            return {"type": "http.disconnect"}
        message = {"type": "http.request", "body": question, "more_body": False}
        question = None
        return message

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            head.update(status=message["status"], headers=list(message.get("headers", [])))
        elif message["type"] == "http.response.body":
            parts.append(message.get("body", b""))
            if not message.get("more_body", False):
                done.set()

    with contextlib.suppress(Exception):
        await app(_scope(request), receive, send)
    return httpx.Response(head["status"], headers=head["headers"], content=b"".join(parts), request=request)


def _scope(request: httpx.Request) -> dict[str, Any]:
    url = request.url
    return {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": request.method,
        "headers": [(name.lower(), value) for name, value in request.headers.raw], "scheme": url.scheme,
        "path": url.path, "raw_path": url.raw_path.split(b"?")[0], "query_string": url.query,
        "server": (url.host, url.port), "client": (url.host, 0), "root_path": "",
    }  # fmt: skip


class MemoryTransport(httpx.AsyncBaseTransport):
    """One node's transport; `alive` false when the node was killed: nothing leaves it any more."""

    def __init__(self, mesh: MemoryMesh, name: str) -> None:
        self._mesh, self._name = mesh, name
        self.alive = True

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        if not self.alive:
            raise httpx.ConnectError("this node is dead", request=request)
        limit_s = request.extensions.get("timeout", {}).get("read")
        try:
            async with asyncio.timeout(limit_s):
                return await self._mesh.carry(self._name, request)
        except TimeoutError as error:
            raise httpx.ReadTimeout(f"no answer from {request.url} in {limit_s} s", request=request) from error
