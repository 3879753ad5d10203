"""RFC 9457 problem documents."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from starlette.responses import Response

from core.wire.documents import Problem

DETAIL_CHARS_MAX = 1000
_HINTS = {
    400: "GET /docs and /openapi.json tell what is taken",
    401: "send `Authorization: Bearer TOKEN`; `garden token` prints one",
    403: "GET /docs tells who may",
    404: "GET /openapi.json lists what there is",
    405: "another method may do: see the Allow header and /docs",
    409: "read how it stands now, and why, at /state and /history",
    412: "read it again and send its ETag as If-Match",
    413: "send less",
    422: "GET /docs and /openapi.json tell what is taken",
}
_LATER = "try again in a moment; GET /readyz tells what is missing"


def problem_response(
    scope: Mapping[str, Any],
    status: int,
    title: str,
    detail: str,
    hint: str = "",
    headers: Mapping[str, str] | None = None,
) -> Response:
    """A problem+json answer; an empty title becomes the status's phrase, an empty hint the usual one of the status."""
    title = title or HTTPStatus(status).phrase
    path = str(scope.get("path", ""))[:200].encode("utf-8", "replace").decode()
    detail = detail[:DETAIL_CHARS_MAX].encode("utf-8", "replace").decode() or title
    hint = hint or _HINTS.get(status, _LATER)
    problem = Problem(title=title, status=status, detail=detail, hint=hint, instance=path)
    more = dict(headers or {})
    if status == 401:
        more["www-authenticate"] = "Bearer"
    if status == 413:
        more["connection"] = "close"
    return Response(problem.model_dump_json(), status, more, media_type="application/problem+json")
