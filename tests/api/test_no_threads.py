"""Nothing that answers a request may run in a thread: threads escape the virtual clock (and the loop's order)."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from typing import Any

from doors import Doors
from fastapi import APIRouter, Depends, FastAPI

from core.mesh.describe import routes

PURE: frozenset[Any] = frozenset()
"""Plain functions that may be called in a thread all the same, each with its reason. There is none."""


def runs_on_the_loop(call: Any) -> bool:
    """A coroutine function, or an object whose `__call__` is one: FastAPI and Starlette run all others in threads."""
    if inspect.iscoroutinefunction(call) or inspect.isasyncgenfunction(call):
        return True
    return not inspect.isroutine(call) and inspect.iscoroutinefunction(getattr(call, "__call__", None))  # noqa: B004


def calls(dependant: Any) -> Iterator[Any]:
    """The endpoint and all it depends on."""
    if dependant.call is not None:
        yield dependant.call
    for inner in dependant.dependencies:
        yield from calls(inner)


def in_threads(app: FastAPI) -> list[str]:
    """What would run in a thread, by route; handlers of exceptions and of start and end as well."""
    found: list[str] = []
    for method, path, route in routes(app):
        dependant = getattr(route, "dependant", None)
        called = [route.endpoint] if dependant is None else list(calls(dependant))
        found += [f"{method} {path}: {_name(call)}" for call in called if call not in PURE and not runs_on_the_loop(call)]
    others = (*app.exception_handlers.values(), *app.router.on_startup, *app.router.on_shutdown)
    return found + [_name(call) for call in others if not runs_on_the_loop(call)]


def _name(call: Any) -> str:
    return getattr(call, "__qualname__", type(call).__name__)


def test_no_route_of_any_service_runs_in_a_thread(doors: Doors) -> None:
    for kind, app in doors.apps.items():
        assert len(list(routes(app))) > 8, kind
        assert in_threads(app) == [], kind


class Sync:
    def __call__(self) -> int:
        return 1


class Async:
    async def __call__(self) -> int:
        return 1


def plain(a: int = 0) -> int:
    return a


async def nested(found: int = Depends(plain)) -> int:
    return found


async def endpoint(found: int = 0) -> int:
    return found


def test_the_search_finds_every_way_into_a_thread() -> None:
    def app_with(add: Callable[[FastAPI], object]) -> list[str]:
        app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
        add(app)
        return in_threads(app)

    router = APIRouter(dependencies=[Depends(plain)])
    router.get("/x")(endpoint)
    ways: list[Callable[[FastAPI], object]] = [
        lambda app: app.get("/x")(plain),
        lambda app: app.add_api_route("/x", plain),
        lambda app: app.api_route("/x", methods=["POST"])(plain),
        lambda app: app.add_route("/x", plain),
        lambda app: app.get("/x", dependencies=[Depends(plain)])(endpoint),
        lambda app: app.get("/x", dependencies=[Depends(nested)])(endpoint),
        lambda app: app.get("/x", dependencies=[Depends(Sync())])(endpoint),
        lambda app: app.include_router(router),
        lambda app: app.add_exception_handler(KeyError, plain),
    ]
    for number, add in enumerate(ways):
        assert app_with(add), number
    assert app_with(lambda app: app.get("/x", dependencies=[Depends(Async())])(endpoint)) == []
