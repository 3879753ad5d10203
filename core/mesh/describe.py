"""The OpenAPI document, completed with what strict bodies and roles add, and a docs page that needs no other host."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import iter_route_contexts
from pydantic.json_schema import models_json_schema

from core.mesh.strict import raw_reader, readers
from core.wire.documents import Problem

_REF = "#/components/schemas/{model}"
CHANGING = frozenset({"POST", "PUT", "PATCH", "DELETE"})


def routes(app: FastAPI) -> Iterator[tuple[str, str, Any]]:
    """Every (method, path, route) of an app, included routers as well; the path as OpenAPI writes it."""
    for route in iter_route_contexts(app.routes):
        for method in sorted(getattr(route, "methods", None) or ()):
            yield method, str(getattr(route, "path_format", route.path)), route


def roles_of(route: Any) -> tuple[str, ...] | None:
    """The roles that may use a route, or None when anybody may."""
    found: list[tuple[str, ...]] = []
    _collect_roles(getattr(route, "dependant", None), found)
    return found[0] if found else None


def _collect_roles(dependant: Any, found: list[tuple[str, ...]]) -> None:
    if dependant is None:
        return
    roles = getattr(dependant.call, "roles", None)
    if isinstance(roles, tuple):
        found.append(roles)
    for inner in dependant.dependencies:
        _collect_roles(inner, found)


def unguarded(app: FastAPI) -> list[str]:
    """Routes that change something and ask for no role: a test wants this list empty."""
    return [f"{method} {path}" for method, path, route in routes(app) if method in CHANGING and roles_of(route) is None]


def describe(app: FastAPI) -> dict[str, Any]:
    """FastAPI's document plus request bodies, security and the problem answer; made once."""
    if app.openapi_schema:
        return app.openapi_schema
    schema = get_openapi(title=app.title, version=app.version, routes=app.routes)
    parts = schema.setdefault("components", {})
    schemas = parts.setdefault("schemas", {})
    parts["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer", "bearerFormat": "JWT"}}
    models: list[Any] = [(Problem, "serialization")]
    for method, path, route in routes(app):
        operation = schema["paths"].get(path, {}).get(method.lower())
        if operation is not None:
            models += _complete(operation, route)
    _, definitions = models_json_schema(models, ref_template=_REF)
    schemas |= definitions.get("$defs", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    app.openapi_schema = schema
    return schema


def _complete(operation: dict[str, Any], route: Any) -> list[Any]:
    used = []
    for reader in readers(route.dependant):
        used.append((reader.model, "validation"))
        content = {"application/json": {"schema": {"$ref": _REF.format(model=reader.model.__name__)}}}
        operation["requestBody"] = {"required": True, "content": content}
    if (taken := raw_reader(route.dependant)) is not None:
        content = {taken.media_type: {"schema": {"type": "string", "format": "binary"}}}
        operation["requestBody"] = {"required": True, "content": content}
    if (roles := roles_of(route)) is not None:
        operation["security"] = [{"token": []}]
        operation["x-roles"] = list(roles)
    operation["responses"].pop("422", None)
    problem = {"application/problem+json": {"schema": {"$ref": _REF.format(model="Problem")}}}
    operation["responses"]["default"] = {"description": "Refused, and why", "content": problem}
    return used


def docs_page(node_id: str, schema: dict[str, Any]) -> str:
    """All operations on one self-contained page."""
    lines = (
        (method.upper(), path, operation.get("summary", ""), ", ".join(operation.get("x-roles", [])) or "anybody")
        for path, operations in schema["paths"].items()
        for method, operation in operations.items()
    )
    rows = "".join("<tr>" + "".join(f"<td>{escape(cell)}" for cell in line) for line in lines)
    return (
        "<!doctype html><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        f"<title>{escape(node_id)}</title>"
        "<style>body{font:15px system-ui;margin:2em;color-scheme:light dark}td{padding:.2em 1em .2em 0}</style>"
        f"<h1>{escape(node_id)}</h1><p>The whole description: <a href=openapi.json>openapi.json</a>.</p>"
        f"<table><tr><th>Method<th>Path<th>What<th>Who{rows}</table>"
    )
