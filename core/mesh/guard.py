"""The layer around every app: who may read, how much may be sent, what came of it, answered once."""

from __future__ import annotations

import asyncio
import hashlib
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import cast

import structlog
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from core.clock import Clock
from core.errors import BadRequest, Conflict, GardenError, TooLarge, Unauthorised, Unprocessable
from core.mesh.auth import Caller, Verifier
from core.mesh.direct import whole
from core.mesh.problems import problem_response

KEPT_ANSWERS = 256
KEPT_FOR_S = 600.0
_OPEN_PATHS = frozenset({"/healthz", "/readyz", "/introduction"})
VOUCHED = "garden.caller"
"""Where in an ASGI scope a request has its Caller that came under a seal, not with a token. Servers put nothing there."""
LINK = "garden.link"
"""Where in an ASGI scope a request over TLS has the node whose certificate was shown, "" without one."""
_BOUND = frozenset({"plant", "robot"})
"""Roles whose tokens are taken, over TLS, from their own node alone; people ask from anywhere."""
_READS = frozenset({"GET", "HEAD", "OPTIONS"})
_METHODS = _READS | {"POST", "PUT", "PATCH", "DELETE"}
BROKEN = GardenError("something broke in here", hint="the log says what")
_log = structlog.get_logger("garden.http")
Headers = Iterable[tuple[bytes, bytes]]


def header(headers: Headers, name: bytes) -> str:
    """The first value of a header, or nothing."""
    for key, value in headers:
        if key == name:
            return value.decode("latin-1")
    return ""


def bearer(headers: Headers) -> str:
    """The request's token; raises Unauthorised when it carries none."""
    scheme, _, token = header(headers, b"authorization").partition(" ")
    if scheme.lower() != "bearer" or not token.strip():
        raise Unauthorised("this needs a token", hint="send `Authorization: Bearer TOKEN`; `garden token` prints one")
    return token.strip()


def caller_of(scope: Scope, verifier: Verifier, now_s: float) -> Caller:
    """Who asks; raises Unauthorised."""
    if (vouched := scope.get(VOUCHED)) is not None:
        return cast(Caller, vouched)
    caller = verifier.verify(bearer(scope["headers"]), now_s)
    link = scope.get(LINK)
    if link is not None and link != caller.subject and caller.role in _BOUND:
        raise Unauthorised(
            f"the token is {caller.subject}'s, and {link or 'nobody'} showed a certificate",
            hint=f"over TLS {caller.subject} shows its own certificate",
        )
    return caller


@dataclass(frozen=True, slots=True)
class _Kept:
    """An answer given to an Idempotency-Key."""

    request: bytes
    at_s: float
    messages: tuple[Message, ...]
    """Empty when the answer held only then (`Cache-Control: no-store`): the route knows the key and answers anew."""


def request_counter(registry: CollectorRegistry) -> Counter:
    """Requests answered, by method, route and status."""
    return Counter("garden_http_requests_total", "Requests answered", ["method", "route", "status"], registry=registry)


class Guard:
    """Pure ASGI, so that the answer to anything at all is counted and none is a traceback."""

    def __init__(
        self,
        app: ASGIApp,
        *,
        clock: Clock,
        verifier: Verifier | None,
        requests: Counter,
        registry: CollectorRegistry,
        body_bytes_max: int,
        open_reads: bool,
        direct: Mapping[tuple[str, str], ASGIApp],
    ) -> None:
        """`direct` holds apps for whole (method, path)s, which requests without a query reach at once."""
        self._app, self._direct = app, direct
        self._clock = clock
        self._verifier = verifier
        self._body_bytes_max = body_bytes_max
        self._open_reads = open_reads
        self._kept: OrderedDict[str, _Kept] = OrderedDict()
        self._running: set[str] = set()
        self._born_s: float | None = None
        self._requests = requests
        self._seconds = Histogram(
            "garden_http_request_seconds",
            "Time from request to answer",
            ["route"],
            buckets=(0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3),
            registry=registry,
        )
        self._uptime = Gauge("garden_uptime_seconds", "Garden time since start", registry=registry)
        self._known: dict[tuple[str, str, int], tuple[Counter, Histogram]] = {}
        """Looking the two up by their labels takes longer than counting."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        loop = asyncio.get_running_loop()
        began_s, status = loop.time(), 0
        if self._born_s is None:
            self._born_s = self._clock.now()
            self._uptime.set_function(lambda: self._clock.now() - (self._born_s or 0.0))

        async def counted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._answer(scope, receive, counted)
        except GardenError as error:
            await self._refuse(scope, receive, counted, error, begun=status != 0)
        except ClientDisconnect:
            status = status or 408  # the body never came in whole; nobody is there to hear so
        except Exception:
            _log.exception("request failed", method=scope["method"], path=scope["path"])
            await self._refuse(scope, receive, counted, BROKEN, begun=status != 0)
        finally:
            route = getattr(scope.get("route"), "path", "unmatched")
            known = route != "unmatched" and scope["method"] in _METHODS
            self._count(scope["method"] if known else "any", route, status, loop.time() - began_s)

    def _count(self, method: str, route: str, status: int, took_s: float) -> None:
        if (counts := self._known.get((method, route, status))) is None:
            counts = self._requests.labels(method, route, status), self._seconds.labels(route)
            self._known[method, route, status] = counts
        counts[0].inc()
        counts[1].observe(took_s)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, error: GardenError, begun: bool) -> None:
        if begun:
            raise error
        await problem_response(scope, error.status, error.title, str(error), error.hint)(scope, receive, send)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers: list[tuple[bytes, bytes]] = scope["headers"]
        self._check_enrolled(scope)
        receive = self._measured(headers, receive)
        key = header(headers, b"idempotency-key") if scope["method"] == "POST" else ""
        if key:
            await self._once(key, scope, receive, send)
        else:
            await self._run(scope, receive, send)

    async def _run(self, scope: Scope, receive: Receive, send: Send) -> None:
        direct = None if scope["query_string"] else self._direct.get((scope["method"], scope["path"]))
        await (direct or self._app)(scope, receive, send)

    def _check_enrolled(self, scope: Scope) -> None:
        """Whoever wants a change shows a token before anything else is looked at; the route then asks for the role."""
        if self._verifier is None:
            return
        reads = scope["method"] in _READS
        if not reads or not (self._open_reads or scope["path"] in _OPEN_PATHS):
            caller_of(scope, self._verifier, self._clock.now())

    def _asker(self, scope: Scope) -> str:
        """Whose keys are told apart: a node's by its name, whether it shows a token or a seal."""
        if self._verifier is None:
            return header(scope["headers"], b"authorization")
        caller = caller_of(scope, self._verifier, self._clock.now())
        return f"{caller.role} {caller.subject}"

    def _measured(self, headers: Headers, receive: Receive) -> Receive:
        """Refuse bodies that say they are too long, and end those that turn out to be."""
        said = header(headers, b"content-length")
        if said and header(headers, b"transfer-encoding"):
            raise BadRequest("Content-Length and Transfer-Encoding exclude each other")
        if said and (not said.isascii() or not said.isdigit()):
            raise BadRequest("Content-Length is not a number")
        if said and int(said[:20]) > self._body_bytes_max:
            raise self._too_large()
        taken = 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > self._body_bytes_max:
                raise self._too_large()
            return message

        return counted

    def _too_large(self) -> TooLarge:
        return TooLarge("the body is too long", hint=f"at most {self._body_bytes_max} bytes")

    async def _once(self, key: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Run a keyed POST once; the same key gets the same answer again, unless that says `no-store`.

        Only good answers are kept: whatever was refused changed nothing and may be tried anew.
        """
        if len(key) > 128:
            raise Unprocessable("the Idempotency-Key is longer than 128 characters")
        content = await whole(receive)
        full_key = "\0".join((self._asker(scope), scope["path"], key))
        request = hashlib.sha256(content).digest()
        if full_key in self._running:
            raise Conflict("the first request with this Idempotency-Key is still at work", hint="ask again in a moment")
        if (kept := self._recall(full_key)) is not None:
            if kept.request != request:
                raise Unprocessable("this Idempotency-Key came before with another body", hint="take a new key")
            if kept.messages:
                for message in kept.messages:
                    await send(message)
                return
        self._running.add(full_key)
        try:
            await self._run_kept(full_key, request, content, scope, receive, send)
        finally:
            self._running.discard(full_key)

    async def _run_kept(
        self, full_key: str, request: bytes, content: bytes, scope: Scope, receive: Receive, send: Send
    ) -> None:
        messages: list[Message] = []
        fed = False

        async def feed() -> Message:
            nonlocal fed
            if fed:
                return await receive()
            fed = True
            return {"type": "http.request", "body": content, "more_body": False}

        async def keep(message: Message) -> None:
            messages.append(message)
            await send(message)

        await self._run(scope, feed, keep)
        if messages and 200 <= messages[0].get("status", 0) < 300:
            lasts = header(messages[0]["headers"], b"cache-control") != "no-store"
            self._kept[full_key] = _Kept(request, self._clock.now(), tuple(messages) if lasts else ())
            if len(self._kept) > KEPT_ANSWERS:
                self._kept.popitem(last=False)

    def _recall(self, full_key: str) -> _Kept | None:
        kept = self._kept.get(full_key)
        if kept is not None and self._clock.now() - kept.at_s > KEPT_FOR_S:
            del self._kept[full_key]
            return None
        return kept
