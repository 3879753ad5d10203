"""Asking this node's own app, in its process: what came under a seal meets the same checks as what came with a token."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import unquote

import structlog
from starlette.types import ASGIApp, Message

from core.errors import GardenError
from core.mesh.auth import Caller
from core.mesh.client import Answer
from core.mesh.guard import BROKEN, VOUCHED
from core.mesh.problems import problem_response

_log = structlog.get_logger("garden.parcels")


async def ask(
    app: ASGIApp, caller: Caller, method: str, path: str, headers: Mapping[str, str], body: bytes, *, within_s: float,
    bytes_max: int,
) -> Answer:  # fmt: skip
    """The app's answer to `caller`; a problem of 502 in place of one that is endless or longer than `bytes_max`."""
    scope = _scope(caller, method, path, headers)
    talk = _Talk(body, bytes_max)
    patience = asyncio.get_running_loop().call_later(within_s, talk.over.set)
    try:
        await app(scope, talk.receive, talk.send)
    except Exception:
        _log.exception("a request in a parcel failed", method=method, path=path)
        return _problem(scope, BROKEN)
    finally:
        patience.cancel()
    if talk.whole:
        return Answer(talk.status, b"".join(talk.parts), talk.headers)
    return _problem(scope, GardenError("the answer does not fit into a parcel", hint="ask from one hop away"), 502)


def _scope(caller: Caller, method: str, path: str, headers: Mapping[str, str]) -> dict[str, Any]:
    raw_path, _, query = path.partition("?")
    return {
        "type": "http", "asgi": {"version": "3.0", "spec_version": "2.3"}, "http_version": "1.1", "method": method,
        "headers": [(name.encode("latin-1"), value.encode("latin-1")) for name, value in headers.items()],
        "scheme": "http", "path": unquote(raw_path), "raw_path": raw_path.encode(), "query_string": query.encode(),
        "server": ("parcel", None), "client": None, "root_path": "", VOUCHED: caller,
    }  # fmt: skip


def _problem(scope: dict[str, Any], error: GardenError, status: int = 0) -> Answer:
    response = problem_response(scope, status or error.status, error.title, str(error), error.hint)
    return Answer(response.status_code, bytes(response.body), {"content-type": "application/problem+json"})


@dataclass(slots=True)
class _Talk:
    """One ASGI conversation (ASGI 3.0, HTTP)."""

    body: bytes | None
    bytes_max: int
    status: int = 500
    headers: dict[str, str] = field(default_factory=dict)
    parts: list[bytes] = field(default_factory=list)
    taken: int = 0
    whole: bool = False
    over: asyncio.Event = field(default_factory=asyncio.Event)

    async def receive(self) -> Message:
        if self.body is None:
            await self.over.wait()
            return {"type": "http.disconnect"}
        body, self.body = self.body, None
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            self.headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in message.get("headers", [])}
            return
        part = message.get("body", b"")
        self.taken += len(part)
        if self.taken > self.bytes_max or self.over.is_set():
            self.over.set()
            return
        self.parts.append(part)
        if not message.get("more_body", False):
            self.whole = True
            self.over.set()
