"""RFC 9457 problem documents."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from starlette.responses import Response

from core.wire.documents import Problem


def problem_response(
    scope: Mapping[str, Any],
    status: int,
    title: str,
    detail: str,
    hint: str = "",
    headers: Mapping[str, str] | None = None,
) -> Response:
    """A problem+json answer; an empty title becomes the status's phrase."""
    title = title or HTTPStatus(status).phrase
    path = str(scope.get("path", ""))[:200].encode("utf-8", "replace").decode()
    detail = detail.encode("utf-8", "replace").decode()
    problem = Problem(title=title, status=status, detail=detail, hint=hint, instance=path)
    more = dict(headers or {})
    if status == 401:
        more["www-authenticate"] = "Bearer"
    if status == 413:
        more["connection"] = "close"
    return Response(problem.model_dump_json(), status, more, media_type="application/problem+json")
