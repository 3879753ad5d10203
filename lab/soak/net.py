"""The mesh between the soaked services: every message may be lost, doubled, late or out of order, each leg for itself.

A request is delivered as a task of the process that answers it. Whoever asked may give up meanwhile, or be dead: the
message is delivered all the same, and the answer falls on the floor.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any
from urllib.parse import urlsplit

from core.mesh.client import Answer
from lab.soak.life import Life

Asgi = Callable[..., Awaitable[Any]]
LATENCY_S = (0.002, 0.02)
LATE_S = (2.5, 25.0)
"""Later than anybody waits for an answer, up to three leases."""
JITTER_S = 0.8
"""Messages of a disordered leg overtake one another within this time."""


@dataclass(slots=True)
class Weather:
    """What may happen to each leg of a message, as probabilities."""

    request_lost: float = 0.0
    reply_lost: float = 0.0
    duplicated: float = 0.0
    late: float = 0.0
    reordered: float = 0.0


CLEAR = Weather()


@dataclass(frozen=True, slots=True)
class Message:
    """One request as the judge sees it, and later its answer."""

    number: int
    source: str
    target: str
    method: str
    path: str
    body: bytes
    key: str


@dataclass(slots=True)
class Host:
    life: Life
    app: Asgi


class SoakMesh:
    """Carries requests by `host:port`. `cut` names one-way links that carry nothing."""

    def __init__(self, rng: random.Random, faults: Counter[str]) -> None:
        self._rng, self._faults = rng, faults
        self._hosts: dict[str, Host] = {}
        self._names: dict[str, str] = {}
        self.weather = CLEAR
        self.cut: set[tuple[str, str]] = set()
        self.requests = 0
        self._trace = sha256()
        self.touched: Callable[[Message], None] = lambda message: None
        """A fault met a message."""
        self.sent: Callable[[Message], None] = lambda message: None
        """A node asks; whether that arrives is not known yet."""
        self.arrived: Callable[[Message], None] = lambda message: None
        self.answered: Callable[[Message, Answer], None] = lambda message, answer: None
        """The answer has left the node that gave it."""
        self.heard: Callable[[Message, Answer], None] = lambda message, answer: None
        """The answer has come to who asked."""
        self.worst: Callable[[Message, Answer | None], bool] = lambda message, answer: False
        """Asked of every request, and of every answer: whether just this one is lost."""
        self.held_s: Callable[[Message], float] = lambda message: 0.0
        """Asked of every request: how long just this one is kept on its way."""
        self.at_hand: Callable[[Message, Answer], None] = lambda message, answer: None
        """The answer has come, and who asked has not read it yet."""

    def trace(self) -> str:
        """A digest of every request so far: when, from whom, to whom, and every byte of what was said."""
        return self._trace.hexdigest()

    def attach(self, name: str, netloc: str, life: Life, app: Asgi) -> None:
        self._hosts[netloc] = Host(life, app)
        self._names[netloc] = name

    def transport(self, life: Life) -> SoakTransport:
        return SoakTransport(self, life)

    async def carry(self, life: Life, method: str, url: str, headers: Mapping[str, str], body: bytes) -> Answer:
        """Raises ConnectionError when nobody is there; waits for ever when a message is lost."""
        if not life.alive:
            raise ConnectionError("this process is dead")
        parts = urlsplit(url)
        target = self._names.get(parts.netloc, parts.netloc)
        path = parts.path + (f"?{parts.query}" if parts.query else "")
        self.requests += 1
        message = Message(self.requests, life.name, target, method, path, body, headers.get("idempotency-key", ""))
        done: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._trace.update(f"{asyncio.get_running_loop().time():.6f} {life.name} {target} {method} {path} ".encode() + body)
        self.sent(message)
        if self.worst(message, None):
            return await done
        held_s = self.held_s(message)
        for delay_s in self._fates("request_lost", life.name, target, message):
            asyncio.get_running_loop().call_later(held_s + delay_s, self._deliver, message, parts.netloc, headers, done)
        return await done

    def _fates(self, lost: str, source: str, target: str, message: Message) -> list[float]:
        """When copies of a message arrive; none when it is lost."""
        rng, weather = self._rng, self.weather
        if (source, target) in self.cut:
            self.touched(message)
            return []
        delay_s = rng.uniform(*LATENCY_S)
        if weather is CLEAR:
            return [delay_s]
        if rng.random() < getattr(weather, lost):
            return self._struck(lost, message, [])
        if rng.random() < weather.late:
            return self._struck("late", message, [rng.uniform(*LATE_S)])
        if rng.random() < weather.reordered:
            delay_s += rng.uniform(0.0, JITTER_S)
            self._struck("reordered", message, [])
        if lost == "request_lost" and rng.random() < weather.duplicated:
            again_s = delay_s + (rng.uniform(*LATE_S) if rng.random() < 0.3 else rng.uniform(0.0, 0.1))
            return self._struck("duplicated", message, [delay_s, again_s])
        return [delay_s]

    def _struck(self, kind: str, message: Message, fates: list[float]) -> list[float]:
        self._faults[kind] += 1
        self.touched(message)
        return fates

    def _deliver(self, message: Message, netloc: str, headers: Mapping[str, str], done: asyncio.Future[Answer]) -> None:
        host = self._hosts.get(netloc)
        if host is None or not host.life.alive:
            _fail(done, ConnectionError(f"connection to {netloc} refused"))
            return
        self.arrived(message)
        host.life.start(self._handle(host, message, headers, done))

    async def _handle(self, host: Host, message: Message, headers: Mapping[str, str], done: asyncio.Future[Answer]) -> None:
        try:
            answer = await _answer(host.app, message, headers)
        except asyncio.CancelledError:
            _fail(done, ConnectionError("the node died before it answered"))
            raise
        if not host.life.alive:
            _fail(done, ConnectionError("the node died before it answered"))
            return
        self.answered(message, answer)
        if self.worst(message, answer) or not host.life.alive:
            return
        for delay_s in self._fates("reply_lost", message.target, message.source, message):
            asyncio.get_running_loop().call_later(delay_s, self._bring, message, answer, done)

    def _bring(self, message: Message, answer: Answer, done: asyncio.Future[Answer]) -> None:
        if not done.done():
            self.heard(message, answer)
            self.at_hand(message, answer)
            done.set_result(answer)


def _fail(done: asyncio.Future[Answer], error: ConnectionError) -> None:
    if not done.done():
        done.set_exception(error)
        done.exception()


@dataclass(slots=True)
class SoakTransport:
    """One process's way into the mesh (`core.mesh.client.PeerTransport`)."""

    mesh: SoakMesh
    life: Life

    async def send(self, method: str, url: str, headers: Mapping[str, str], body: bytes) -> Answer:
        return await self.mesh.carry(self.life, method, url, headers, body)

    async def aclose(self) -> None:
        """Nothing to give back."""


@dataclass(slots=True)
class _Talk:
    """One ASGI conversation (ASGI 3.0, HTTP)."""

    body: bytes | None
    status: int = 500
    headers: dict[str, str] = field(default_factory=dict)
    parts: list[bytes] = field(default_factory=list)
    done: asyncio.Event = field(default_factory=asyncio.Event)

    async def receive(self) -> dict[str, Any]:
        if self.body is None:
            await self.done.wait()
            return {"type": "http.disconnect"}
        body, self.body = self.body, None
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(self, message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            self.headers = {k.decode().lower(): v.decode() for k, v in message.get("headers", [])}
        elif message["type"] == "http.response.body":
            self.parts.append(message.get("body", b""))
            if not message.get("more_body", False):
                self.done.set()


async def _answer(app: Asgi, message: Message, headers: Mapping[str, str]) -> Answer:
    path, _, query = message.path.partition("?")
    talk = _Talk(message.body)
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": message.method,
        "headers": [(name.lower().encode(), value.encode()) for name, value in headers.items()], "scheme": "http",
        "path": path, "raw_path": path.encode(), "query_string": query.encode(), "server": (message.target, 80),
        "client": (message.source, 0), "root_path": "",
    }  # fmt: skip
    try:
        await app(scope, talk.receive, talk.send)
    except Exception:
        return Answer(500, b"", {})
    return Answer(talk.status, b"".join(talk.parts), talk.headers)
