"""What every service refuses, and how it says so."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from core.clock import VirtualClock
from core.errors import Refused
from core.mesh.auth import Caller, GardenKey
from core.mesh.chassis import allow, body, create_app
from core.mesh.describe import unguarded
from core.mesh.events import EventLog
from core.virtual import run_virtual
from core.wire.documents import Document, NodeCard

GARDEN = GardenKey.from_seed(1)
OPERATOR = GARDEN.issue("ann", "operator", 0.0)
VIEWER = GARDEN.issue("vic", "viewer", 0.0)


class Dose(Document):
    dose_ml: float
    names: tuple[str, ...] = ()
    more: dict[str, Any] = {}


class Poured(Document):
    by: str
    count: int


def make_app(**more: Any) -> FastAPI:
    clock = VirtualClock()
    card = NodeCard(id="pot", kind="plant")
    events = EventLog(clock)
    app = create_app(card=lambda: card, clock=clock, verifier=GARDEN.verifier(), ready=lambda: [], events=events, **more)
    poured: list[float] = []
    app.state.poured = poured

    @app.post("/pour", status_code=201)
    async def pour(request: Dose = body(Dose), caller: Caller = allow("operator", "robot")) -> Poured:
        if request.dose_ml > 100:
            raise Refused("too much", hint="take less")
        poured.append(request.dose_ml)
        return Poured(by=caller.subject, count=len(poured))

    @app.get("/broken")
    async def broken() -> Poured:
        raise ZeroDivisionError

    return app


@asynccontextmanager
async def client_of(app: FastAPI, token: str = OPERATOR.token) -> AsyncIterator[httpx.AsyncClient]:
    transport = httpx.ASGITransport(app)
    headers = {"authorization": f"Bearer {token}"} if token else {}
    async with httpx.AsyncClient(transport=transport, base_url="http://pot", headers=headers) as client:
        yield client


def ask(method: str, path: str, *, token: str = OPERATOR.token, app: FastAPI | None = None, **more: Any) -> httpx.Response:
    async def go() -> httpx.Response:
        async with client_of(app or make_app(), token) as client:
            return await client.request(method, path, **more)

    return run_virtual(go())


def refusal(response: httpx.Response, status: int) -> dict[str, Any]:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = response.json()
    assert problem["status"] == status
    assert problem["title"]
    assert problem["detail"]
    return problem


def test_a_good_request_names_its_caller() -> None:
    response = ask("POST", "/pour", content=b'{"dose_ml": 5, "names": ["a"]}')
    assert response.status_code == 201
    assert response.json() == {"by": "ann", "count": 1}


BAD_BODIES = {
    "nothing": (b"", 400),
    "not json": (b"{", 400),
    "not utf-8": (b'{"dose_ml": 1, "names": ["\xff"]}', 400),
    "nan": (b'{"dose_ml": NaN}', 422),
    "infinity": (b'{"dose_ml": -Infinity}', 422),
    "infinity by size": (b'{"dose_ml": 1e999}', 422),
    "infinity in a free field": (b'{"dose_ml": 1, "more": {"a": 1e999}}', 422),
    "infinity of many digits in a free field": (b'{"dose_ml": 1, "more": {"a": ' + b"9" * 400 + b"}}", 422),
    "doubled key": (b'{"dose_ml": 1, "dose_ml": 2}', 400),
    "text for number": (b'{"dose_ml": "1"}', 422),
    "true for number": (b'{"dose_ml": true}', 422),
    "unknown field": (b'{"dose_ml": 1, "doze": 2}', 422),
    "missing field": (b"{}", 422),
    "a list": (b"[]", 422),
    "null": (b"null", 422),
    "lone surrogate": (b'{"dose_ml": 1, "names": ["\\ud800"]}', 422),
    "endless integer": (b'{"dose_ml": ' + b"9" * 5000 + b"}", 422),
    "deep": (b'{"dose_ml": 1, "more": ' + b'{"a":' * 40 + b"1" + b"}" * 41, 400),
    "bottomless": (b"[" * 60000, 400),
    "too long": (b'{"dose_ml": 1}' + b" " * 70000, 413),
}


@pytest.mark.parametrize("name", BAD_BODIES)
def test_a_bad_body_is_refused_and_changes_nothing(name: str) -> None:
    content, status = BAD_BODIES[name]
    app = make_app()
    refusal(ask("POST", "/pour", app=app, content=content), status)
    assert app.state.poured == []


def test_a_long_body_without_a_length_is_refused() -> None:
    async def chunks() -> AsyncIterator[bytes]:
        for _ in range(20):
            yield b" " * 8000

    refusal(ask("POST", "/pour", content=chunks()), 413)


def test_both_lengths_at_once_are_refused() -> None:
    headers = {"transfer-encoding": "chunked", "content-length": "2"}
    refusal(ask("POST", "/pour", content=b"{}", headers=headers), 400)


def test_a_rule_that_refuses_says_why_and_what_would_do() -> None:
    problem = refusal(ask("POST", "/pour", json={"dose_ml": 200.0}), 409)
    assert (problem["title"], problem["detail"], problem["hint"]) == ("Refused", "too much", "take less")
    assert problem["instance"] == "/pour"


def test_unknown_paths_and_methods_are_problems_too() -> None:
    refusal(ask("GET", "/nowhere"), 404)
    refusal(ask("PUT", "/pour"), 405)
    refusal(ask("GET", "/events?after=minus"), 422)


def test_our_own_mistakes_are_problems_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    problem = refusal(ask("GET", "/broken"), 500)
    assert "ZeroDivision" not in str(problem)
    assert "ZeroDivision" in "".join(capsys.readouterr())


def test_changes_need_a_token_of_the_right_role() -> None:
    problem = refusal(ask("POST", "/pour", token="", json={"dose_ml": 1.0}), 401)
    assert "garden token" in problem["hint"]
    refusal(ask("POST", "/pour", token=VIEWER.token, json={"dose_ml": 1.0}), 403)


def test_a_bad_token_comes_before_a_bad_body() -> None:
    refusal(ask("POST", "/pour", token="x", content=b"{"), 401)


def test_reads_can_be_closed_but_health_stays_open() -> None:
    app = make_app(open_reads=False)
    refusal(ask("GET", "/", app=app, token=""), 401)
    assert ask("GET", "/", app=app, token=VIEWER.token).status_code == 200
    assert ask("GET", "/healthz", app=app, token="").status_code == 200


def test_the_same_key_gets_the_same_answer_and_acts_once() -> None:
    app = make_app()

    async def go() -> list[httpx.Response]:
        async with client_of(app) as client:
            key = {"idempotency-key": "k1"}
            return [await client.post("/pour", json={"dose_ml": 1.0}, headers=key) for _ in range(3)]

    answers = run_virtual(go())
    assert [a.text for a in answers] == [answers[0].text] * 3
    assert app.state.poured == [1.0]


def test_a_key_with_another_body_is_refused_and_a_refused_key_may_be_used_again() -> None:
    app = make_app()

    async def go() -> list[int]:
        async with client_of(app) as client:
            key = {"idempotency-key": "k1"}
            doses = (200.0, 5.0, 6.0)
            return [(await client.post("/pour", json={"dose_ml": d}, headers=key)).status_code for d in doses]

    assert run_virtual(go()) == [409, 201, 422]
    assert app.state.poured == [5.0]


def test_every_change_asks_for_a_role() -> None:
    app = make_app()
    assert unguarded(app) == []

    @app.delete("/pour")
    async def forgotten() -> Poured:
        return Poured(by="", count=0)

    assert unguarded(app) == ["DELETE /pour"]


def test_the_description_tells_bodies_roles_and_refusals() -> None:
    operation = make_app().openapi()["paths"]["/pour"]["post"]
    assert operation["requestBody"]["content"]["application/json"]["schema"]["$ref"].endswith("/Dose")
    assert operation["x-roles"] == ["operator", "robot"]
    assert "Dose" in make_app().openapi()["components"]["schemas"]
    assert "application/problem+json" in operation["responses"]["default"]["content"]


def test_docs_and_metrics_and_card_are_there() -> None:
    app = make_app()
    assert "/pour" in ask("GET", "/docs", app=app).text
    assert "http" not in ask("GET", "/docs", app=app).text.replace("/openapi", "")
    assert ask("GET", "/", app=app).json()["id"] == "pot"
    told = ask("GET", "/metrics", app=app).text
    assert 'garden_http_requests_total{method="GET",route="/docs",status="200"} 2.0' in told
    assert "garden_uptime_seconds" in told


def test_events_are_replayed_from_where_the_listener_was() -> None:
    app = make_app()

    async def go() -> str:
        for number in range(4):
            app.state.events.add("test", f"event {number}", task_id="t1", extra=number)
        async with client_of(app) as client:
            return (await client.get("/events?follow=false", headers={"last-event-id": "2"})).text

    told = run_virtual(go())
    assert [line for line in told.splitlines() if line.startswith("id:")] == ["id: 3", "id: 4"]
    assert '"extra":3' in told
