"""Reading request bodies without mercy: JSON as RFC 8259 has it, every key once, every number finite."""

from __future__ import annotations

from typing import Any, TypeVar

from fastapi import Depends, Request
from pydantic import BaseModel, ValidationError

from core.errors import BadRequest, Unprocessable
from core.mesh.plain import NotFinite, check

M = TypeVar("M", bound=BaseModel)
_READS = frozenset({"GET", "HEAD", "OPTIONS"})


def body(model: type[M], hint: str = "") -> Any:
    """`request: WaterRequest = body(WaterRequest)` in an endpoint: the body, checked strictly.

    `hint` is for a document whose fields everybody must know of: no body at all then lacks them, as {} does.
    """
    return Depends(Reader(model, hint))


class Reader:
    """The dependency behind `body`; `create_app` finds it to describe the body in the OpenAPI document."""

    def __init__(self, model: type[BaseModel], hint: str = "") -> None:
        self.model, self._hint = model, hint

    async def __call__(self, request: Request) -> Any:
        raw = await request.body()
        return parse(self.model, raw or (b"{}" if self._hint else b""), self._hint)


def raw(media_type: str) -> Any:
    """`jpeg: bytes = raw("image/jpeg")` in an endpoint: the body as it is, of this type."""
    return Depends(RawReader(media_type))


class RawReader:
    """The dependency behind `raw`."""

    def __init__(self, media_type: str) -> None:
        self.media_type = media_type

    async def __call__(self, request: Request) -> bytes:
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != self.media_type:
            raise BadRequest(f"this takes {self.media_type}", hint=f"send Content-Type: {self.media_type}")
        return await request.body()


def parse(model: type[M], raw: bytes, hint: str = "") -> M:
    """One document from bytes; raises BadRequest for what is not JSON, Unprocessable for what is not this document.

    NaN, infinities and numbers too large for a float are not JSON either, but it is clear what they are: Unprocessable.
    """
    _check_json(raw)
    try:
        return model.model_validate_json(raw, strict=True)
    except ValidationError as error:
        raise Unprocessable(_told(error), hint=hint or f"a {model.__name__} as in /openapi.json") from error


def _told(error: ValidationError) -> str:
    parts = []
    for item in error.errors(include_url=False, include_context=False, include_input=False)[:8]:
        where = ".".join(str(part) for part in item["loc"])
        parts.append(f"{where}: {item['msg']}" if where else item["msg"])
    return "; ".join(parts)[:1000]


def _check_json(raw: bytes) -> None:
    if not raw:
        raise BadRequest("the body is empty", hint="send a JSON object")
    try:
        check(raw)
    except NotFinite as error:
        raise Unprocessable(f"a number in the body cannot be: {error}"[:300]) from None
    except ValueError as error:
        raise BadRequest(f"the body is not JSON as it should be: {error}"[:300]) from None


async def plain_read(request: Request) -> None:
    """Dependency of every route: refuses what a read does not know. A change is looked at once its caller is known."""
    if request.method in _READS:
        await no_surplus(request)


async def no_surplus(request: Request) -> None:
    """Raises Unprocessable for a query parameter, BadRequest for a body that the route does not know."""
    route = request.scope.get("route")
    dependant = getattr(route, "dependant", None)
    if dependant is None:
        return
    known = query_names(dependant)
    if (strange := next((name for name in request.query_params if name not in known), None)) is not None:
        hint = f"known here: {', '.join(sorted(known))}" if known else "this takes no query parameter"
        raise Unprocessable(f"no query parameter {strange[:40]!r}", hint=hint)
    takes_any = readers(dependant) or raw_reader(dependant)
    if request.method not in _READS and not takes_any and (await request.body()).strip() not in (b"", b"{}"):
        raise BadRequest("this takes no body", hint="send none, or {}")


def query_names(dependant: Any) -> set[str]:
    """The query parameters of a route and of its dependencies."""
    names = {field.alias for field in dependant.query_params}
    return names.union(*(query_names(inner) for inner in dependant.dependencies))


def readers(dependant: Any) -> list[Reader]:
    """Every `body(...)` of a route, also of its dependencies."""
    found = [dependant.call] if isinstance(dependant.call, Reader) else []
    for inner in dependant.dependencies:
        found += readers(inner)
    return found


def raw_reader(dependant: Any) -> RawReader | None:
    """The `raw(...)` of a route, also of its dependencies."""
    if isinstance(dependant.call, RawReader):
        return dependant.call
    return next((found for inner in dependant.dependencies if (found := raw_reader(inner))), None)
