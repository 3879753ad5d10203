"""What every service has: card, health, metrics, docs, events, one way to say no, one way to check who asks."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from importlib import metadata
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Header, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, StreamingResponse
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from core.clock import Clock
from core.errors import Forbidden, GardenError, Unavailable
from core.mesh.auth import ANYBODY, ROLES, Caller, Verifier
from core.mesh.describe import describe, docs_page
from core.mesh.direct import route_of, run_directly
from core.mesh.events import EventLog
from core.mesh.guard import Guard, caller_of, request_counter
from core.mesh.peers import Peers
from core.mesh.problems import problem_response
from core.mesh.strict import body, no_surplus, parse, plain_read, raw
from core.wire.documents import Document, HistoryEntry, NodeCard

IdempotencyKey = Annotated[str, Header(max_length=128)]
"""Of a route that remembers its keys longer than the guard does."""
SSE_SILENCE_S = 15.0

__all__ = ["Allow", "allow", "body", "create_app", "parse", "raw", "serve_direct", "serve_ready", "version"]


class Health(Document):
    status: str = "ok"


class Readiness(Document):
    ready: bool = True
    discovery: list[str] = []
    """Where this node's peers come from."""


def version() -> str:
    """The installed version of the garden."""
    return metadata.version("robot-garden")


class Allow:
    """Dependency of a route that changes something: a token of one of `roles`. The endpoint receives the Caller."""

    def __init__(self, roles: tuple[str, ...]) -> None:
        self.roles = roles

    async def __call__(self, request: Request) -> Caller:
        caller = self.caller(request.scope)
        await no_surplus(request)
        return caller

    def caller(self, scope: Scope) -> Caller:
        """Who asks; raises Unauthorised or Forbidden."""
        state = scope["app"].state
        verifier: Verifier | None = state.verifier
        if verifier is None:
            return ANYBODY
        caller = caller_of(scope, verifier, state.clock.now())
        self._check(caller)
        return caller

    def _check(self, caller: Caller) -> None:
        if caller.role not in self.roles:
            roles = ", ".join(self.roles)
            raise Forbidden(f"{caller.subject} is a {caller.role}", hint=f"this takes the token of a: {roles}")


def allow(*roles: str) -> Any:
    """`caller: Caller = allow("operator")` in an endpoint; raises Unauthorised (401) or Forbidden (403)."""
    if unknown := set(roles) - set(ROLES):
        raise ValueError(f"no such role: {unknown}")
    return Depends(Allow(roles))


def create_app(
    *,
    card: Callable[[], NodeCard],
    clock: Clock,
    verifier: Verifier | None,
    ready: Callable[[], list[str]],
    events: EventLog | None = None,
    registry: CollectorRegistry | None = None,
    body_bytes_max: int = 65536,
    open_reads: bool = True,
    page: str = "",
) -> FastAPI:
    """A node's HTTP side, to which the service adds its own routes.

    `ready` lists what is still missing (empty: ready). `verifier` None switches authentication off, for tests.
    With `open_reads` false every request but health needs a token. Every POST with an `Idempotency-Key` is answered once
    and the same again; an answer with `Cache-Control: no-store` is asked of the route anew. A browser that asks for `/`
    gets `page`, if there is one.
    `app.state` holds clock, verifier, events and registry.
    """
    app = FastAPI(
        title="Robot Garden",
        version=version(),
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        dependencies=[Depends(plain_read)],
    )
    registry = registry if registry is not None else CollectorRegistry()
    app.state.direct, app.state.peers = {}, None
    app.state.open_reads, app.state.ready_bytes, app.state.requests = open_reads, {}, request_counter(registry)
    app.state.clock, app.state.verifier, app.state.events, app.state.registry = clock, verifier, events, registry
    app.add_middleware(
        Guard,
        clock=clock,
        verifier=verifier,
        requests=app.state.requests,
        registry=registry,
        body_bytes_max=body_bytes_max,
        open_reads=open_reads,
        direct=app.state.direct,
    )
    _refusals(app)
    _plain_routes(app, card, ready, registry, page)
    if events is not None:
        _event_route(app, events)
    app.openapi = lambda: describe(app)  # type: ignore[method-assign]
    return app


def serve_ready(app: FastAPI, path: str, make: Callable[[], Response]) -> None:
    """Let the server answer plain GETs of `path` with what `make` returns, without the app in between.

    `path` must be a route as well: it answers whoever sends conditions, queries or anything unusual, and every test.
    `make` must be cheap. Does nothing where reads need a token.
    """
    counter = app.state.requests.labels("GET", path, 200)

    def counted() -> Response:
        counter.inc()
        return make()

    if app.state.open_reads:
        app.state.ready_bytes[path.encode()] = counted


def serve_direct(app: FastAPI, method: str, path: str, handler: ASGIApp | None = None) -> None:
    """Let requests without a query reach a route past FastAPI, which goes on to describe it and to answer all others.

    `handler` answers instead of the endpoint; without one the endpoint does, as `run_directly` has it (LookupError and
    ValueError as there).
    """
    route = route_of(app, method, path)
    run = handler or run_directly(route)

    async def direct(scope: Scope, receive: Receive, send: Send) -> None:
        scope["route"] = route
        await run(scope, receive, send)

    app.state.direct[method, path] = direct


def front(app: FastAPI) -> ASGIApp:
    """The app as a server calls it: what `serve_direct` serves meets the guard at once.

    FastAPI's own layers around the guard take as long as the guard does, and do for these routes only what it does.
    """
    if app.middleware_stack is None:
        app.middleware_stack = app.build_middleware_stack()
    guard = app.middleware_stack
    while not isinstance(guard, Guard):
        guard = guard.app  # type: ignore[attr-defined]
    direct = app.state.direct

    async def call(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and (scope["method"], scope["path"]) in direct:
            scope["app"] = app
            await guard(scope, receive, send)
        else:
            await app(scope, receive, send)

    return call


def _refusals(app: FastAPI) -> None:
    async def on_garden_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, GardenError)
        return problem_response(request.scope, error.status, error.title, str(error), error.hint)

    async def on_http_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        headers = dict(error.headers or {})
        return problem_response(request.scope, error.status_code, "", str(error.detail), headers=headers)

    async def on_parameters(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        told = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()[:8])
        return problem_response(request.scope, 422, "", told)

    app.add_exception_handler(GardenError, on_garden_error)
    app.add_exception_handler(HTTPException, on_http_error)
    app.add_exception_handler(RequestValidationError, on_parameters)


def _plain_routes(
    app: FastAPI, card: Callable[[], NodeCard], ready: Callable[[], list[str]], registry: CollectorRegistry, page: str
) -> None:
    @app.get("/", summary="Node card", tags=["node"], response_model=NodeCard)
    async def node_card(request: Request) -> NodeCard | HTMLResponse:
        if page and "text/html" in request.headers.get("accept", ""):
            return HTMLResponse(page)
        return card()

    @app.get("/healthz", summary="The process answers", tags=["node"])
    async def healthz() -> Health:
        return Health()

    @app.get("/readyz", summary="Able to do its work, or why not", tags=["node"])
    async def readyz() -> Readiness:
        if missing := ready():
            raise Unavailable("; ".join(missing), hint="it is usually a matter of seconds; `garden doctor` looks closer")
        peers: Peers | None = app.state.peers
        return Readiness(discovery=[] if peers is None else list(peers.sources))

    @app.get("/metrics", summary="Prometheus metrics", tags=["node"], response_class=Response)
    async def metrics() -> Response:
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(docs_page(card().id, app.openapi()))


def _event_route(app: FastAPI, events: EventLog) -> None:
    @app.get("/events", summary="What happened, as Server-Sent Events", tags=["node"], response_class=StreamingResponse)
    async def stream(
        after: int | None = Query(default=None, ge=0, le=2**53, description="replay from the event after this id"),
        follow: bool = Query(default=True, description="false: end after what is known now"),
        last_event_id: str = Header(default="", max_length=20),
    ) -> StreamingResponse:
        start = after if after is not None else _number(last_event_id, events.last_id)
        source = _stream(events, start) if follow else _replay(events, start)
        return StreamingResponse(source, media_type="text/event-stream", headers={"cache-control": "no-store"})


def _number(text: str, otherwise: int) -> int:
    return int(text) if text.isascii() and text.isdigit() else otherwise


def _sse(entry: HistoryEntry) -> str:
    return f"id: {entry.id}\nevent: {entry.kind}\ndata: {entry.model_dump_json()}\n\n"


async def _replay(events: EventLog, after: int) -> AsyncIterator[str]:
    for entry in events.since(after):
        yield _sse(entry)


async def _stream(events: EventLog, after: int) -> AsyncIterator[str]:
    yield ": listening\n\n"
    follower = events.follow(after)
    while True:
        following = asyncio.ensure_future(anext(follower))
        try:
            while not (await asyncio.wait({following}, timeout=SSE_SILENCE_S))[0]:
                yield ": nothing new\n\n"
            entry = following.result()
        finally:
            following.cancel()
        yield _sse(entry)
