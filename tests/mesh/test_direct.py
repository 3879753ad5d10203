"""A route that is run directly answers everything as FastAPI would."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from starlette.responses import Response

from core.clock import VirtualClock
from core.errors import Refused
from core.mesh.auth import Caller, GardenKey
from core.mesh.chassis import allow, body, create_app, serve_direct
from core.virtual import run_virtual
from core.wire.documents import Document, NodeCard

GARDEN = GardenKey.from_seed(1)
OPERATOR = GARDEN.issue("ann", "operator", 0.0).token
VIEWER = GARDEN.issue("vic", "viewer", 0.0).token
GOOD = b'{"dose_ml":5.0}'


class Dose(Document):
    dose_ml: float


def make_app(direct: bool) -> FastAPI:
    card = NodeCard(id="pot", kind="plant")
    app = create_app(card=lambda: card, clock=VirtualClock(), verifier=GARDEN.verifier(), ready=lambda: [])
    poured: list[float] = []

    @app.post("/pour", status_code=201, response_model=Dose)
    async def pour(caller: Caller = allow("operator"), dose: Dose = body(Dose)) -> Response:
        if dose.dose_ml > 100:
            raise Refused("too much", hint="take less")
        if dose.dose_ml < 0:
            raise ZeroDivisionError
        poured.append(dose.dose_ml)
        return Response(f'{{"by":"{caller.subject}","sum":{sum(poured)}}}', 201, media_type="application/json")

    @app.post("/drain/{name}")
    async def drain(name: str, caller: Caller = allow("operator"), dose: Dose = body(Dose)) -> Response:
        return Response()

    if direct:
        serve_direct(app, "POST", "/pour")
    return app


ASKED: tuple[tuple[str, str, str, bytes, dict[str, str]], ...] = (
    ("POST", "/pour", OPERATOR, GOOD, {}),
    ("POST", "/pour", OPERATOR, GOOD, {"idempotency-key": "a"}),
    ("POST", "/pour", OPERATOR, GOOD, {"idempotency-key": "a"}),
    ("POST", "/pour", OPERATOR, b'{"dose_ml":6.0}', {"idempotency-key": "a"}),
    ("POST", "/pour", VIEWER, GOOD, {}),
    ("POST", "/pour", VIEWER, b"{", {}),
    ("POST", "/pour", "", GOOD, {}),
    ("POST", "/pour", "nonsense", GOOD, {}),
    ("POST", "/pour?much=1", OPERATOR, GOOD, {}),
    ("POST", "/pour?", OPERATOR, GOOD, {}),
    ("POST", "/pour/", OPERATOR, GOOD, {}),
    ("PUT", "/pour", OPERATOR, GOOD, {}),
    ("POST", "/pour", OPERATOR, b"", {}),
    ("POST", "/pour", OPERATOR, b'{"dose_ml":NaN}', {}),
    ("POST", "/pour", OPERATOR, b'{"dose_ml":"5"}', {}),
    ("POST", "/pour", OPERATOR, b'{"dose_ml":5.0,"dose_ml":5.0}', {}),
    ("POST", "/pour", OPERATOR, b'{"dose_ml":5.0,"more":1}', {}),
    ("POST", "/pour", OPERATOR, b'{"dose_ml":500.0}', {}),
    ("POST", "/pour", OPERATOR, b'{"dose_ml":-1.0}', {}),
    ("POST", "/pour", OPERATOR, b" " * 70000, {}),
)


def all_answers(app: FastAPI) -> list[tuple[int, dict[str, str], bytes]]:
    async def main() -> list[tuple[int, dict[str, str], bytes]]:
        answers = []
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://pot") as client:
            for method, path, token, content, more in ASKED:
                headers = more | ({"authorization": f"Bearer {token}"} if token else {})
                answer = await client.request(method, path, content=content, headers=headers)
                answers.append((answer.status_code, dict(answer.headers), answer.content))
            told = await client.get("/metrics")
            counted = [line for line in told.text.splitlines() if line.startswith("garden_http_requests_total")]
            answers.append((0, {}, "\n".join(sorted(counted)).encode()))
        return answers

    return run_virtual(main())


def test_every_answer_is_that_of_the_careful_way() -> None:
    careful, direct = all_answers(make_app(direct=False)), all_answers(make_app(direct=True))
    for asked, slow, fast in zip((*ASKED, "metrics"), careful, direct, strict=True):
        assert fast == slow, asked
    statuses = [status for status, *_ in direct[:-1]]
    expected = [201, 201, 201, 422, 403, 403, 401, 401, 422, 201, 404, 405, 400, 422, 422, 400, 422, 409, 500, 413]
    assert statuses == expected


def test_the_description_is_the_same() -> None:
    assert make_app(direct=True).openapi() == make_app(direct=False).openapi()


@pytest.mark.parametrize(("path", "error"), [("/drain/{name}", ValueError), ("/nowhere", LookupError)])
def test_a_route_that_takes_more_is_not_run_directly(path: str, error: type[Exception]) -> None:
    app: Any = make_app(direct=False)
    with pytest.raises(error):
        serve_direct(app, "POST", path)
