"""Running a much used route without FastAPI's general machinery: the same checks in the same order."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.routing import APIRoute
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from core.mesh.strict import Reader, parse, plain_read


def route_of(app: FastAPI, method: str, path: str) -> APIRoute:
    """Raises LookupError when the app has no such route."""
    for route in app.routes:
        if isinstance(route, APIRoute) and route.path == path and method in (route.methods or ()):
            return route
    raise LookupError(f"no route {method} {path}")


def run_directly(route: APIRoute) -> ASGIApp:
    """The route as an ASGI app, for requests without a query.

    The endpoint must take nothing but `allow(...)` and `body(...)`, in this order, and return a Response; raises ValueError
    for one that takes more.
    """
    allow, reader = _takes(route)

    async def run(scope: Scope, receive: Receive, send: Send) -> None:
        given: dict[str, Any] = {allow.name: allow.call.caller(scope)}
        given[reader.name] = parse(reader.call.model, await whole(receive))
        response: Response = await route.endpoint(**given)
        await response(scope, receive, send)

    return run


def _takes(route: APIRoute) -> tuple[Any, Any]:
    dependant = route.dependant
    needs = [needed for needed in dependant.dependencies if needed.call is not plain_read]
    kinds = (dependant.path_params, dependant.query_params, dependant.header_params, dependant.cookie_params)
    more = [field.name for fields in kinds for field in fields]
    more += [name for name in (dependant.request_param_name, dependant.response_param_name) if name]
    if more or len(needs) != 2 or not hasattr(needs[0].call, "caller") or not isinstance(needs[1].call, Reader):
        raise ValueError(f"{route.path} takes more than a caller and a body: {', '.join(more)}")
    return needs[0], needs[1]


async def whole(receive: Receive) -> bytes:
    """A request's body, or what came of it before the client went away."""
    content = b""
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return content
        content += bytes(message.get("body", b""))
        if not message.get("more_body", False):
            return content
