"""Reading every endpoint's signature once: a soak starts hundreds of services, and each would read its routes anew.

Only what follows from an endpoint's source is kept: parameters, models, path. What a service is made of is not: its
endpoints are new closures over its new parts, and whatever these know comes from their disk.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from types import CodeType
from typing import Any
from unittest import mock

from fastapi.dependencies import models
from fastapi.routing import APIRoute, request_response

_Key = tuple[str, CodeType, frozenset[str]]
_known: dict[_Key, APIRoute] = {}


@contextmanager
def routes_read_once() -> Iterator[None]:
    """While in it, a route whose endpoint was compiled from the same source takes over what was read of the first."""
    read = APIRoute.__init__

    def init(route: APIRoute, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        key = (path, endpoint.__code__, frozenset(options.get("methods") or ()))
        if (before := _known.get(key)) is None:
            read(route, path, endpoint, **options)
            _known[key] = _without_its_service(route)
            return
        route.__dict__.update(before.__dict__)
        route.endpoint, route.dependant = endpoint, replace(before.dependant, call=endpoint)
        route.dependency_overrides_provider = options.get("dependency_overrides_provider")
        route.app = request_response(route.get_route_handler())

    with mock.patch.object(APIRoute, "__init__", init):
        yield


def _without_its_service(route: APIRoute) -> APIRoute:
    """What was read, holding on to nothing of the service it was read in."""
    kept = copy(route)
    kept.endpoint, kept.app, kept.dependency_overrides_provider = _nobody, _nobody, None
    kept.dependant = replace(route.dependant, call=_nobody)
    return kept


def forget_the_dead() -> None:
    """FastAPI remembers of some thousand endpoints what they are, and with each all that it closes over."""
    for remembered in vars(models).values():
        if hasattr(remembered, "cache_clear"):
            remembered.cache_clear()


async def _nobody(*_: Any) -> None:
    raise AssertionError("a route that was read is no route yet")
