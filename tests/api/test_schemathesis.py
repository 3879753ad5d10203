"""What schemathesis makes of our own descriptions, good and bad, is answered as they say, and never with an accident."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import schemathesis
from doors import ENDLESS, KINDS, Doors, open_doors
from hypothesis import HealthCheck, Phase, given, seed, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import content_type_conformance, response_schema_conformance

SEED = 7
CHECKS = [not_a_server_error, content_type_conformance, response_schema_conformance]
DRAWN = {"/overview.jpg", "/cameras/{robot}/hand.jpg", "/cameras/{robot}/hand.png"}
"""Pictures cost a tenth of a second each: tried elsewhere."""
NOT_NOW = {502, 503}
"""Says that somebody else does not answer, or not yet: a robot whose world was paused, a console whose robot is stopped."""


def try_all(doors: Doors, kind: str, examples: int) -> int:
    """Ask every operation `examples` times with data that fits and as often with data that does not."""
    document = doors.apps[kind].openapi()
    asked = 0
    for found in schemathesis.openapi.from_dict(document).get_all_operations():
        operation = found.ok()
        if operation.path in ENDLESS | DRAWN:
            continue
        for mode in schemathesis.GenerationMode:
            if mode is schemathesis.GenerationMode.NEGATIVE and not (operation.body or operation.query):
                continue
            asked += try_one(doors, kind, operation, mode, examples)
    return asked


def try_one(doors: Doors, kind: str, operation: Any, mode: Any, examples: int) -> int:
    """A robot asks in its own name, as anything else is answered 403 at once."""
    asked = 0
    roles = document_roles(operation)
    token = doors.token("operator" if "operator" in (roles or ["operator"]) else "robot")

    @seed(SEED)
    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(generation_mode=mode))
    def answered(case: Any) -> None:
        nonlocal asked
        asked += 1
        if isinstance(case.body, dict) and isinstance(case.body.get("robot_id"), str):
            case.body["robot_id"] = "robot-1"
        answer = send(doors, kind, case, token)
        if answer.status_code in NOT_NOW:
            assert answer.json()["hint"], answer.text
            return
        case.validate_response(answer, checks=CHECKS)
        if answer.status_code >= 400:
            assert answer.headers["content-type"] == "application/problem+json"
            assert answer.json()["hint"], answer.text

    answered()
    return asked


def document_roles(operation: Any) -> list[str]:
    return list(operation.definition.raw.get("x-roles", []))


def send(doors: Doors, kind: str, case: Any, token: str) -> Any:
    sent = case.as_transport_kwargs(base_url="http://127.0.0.1")
    headers = {name: value for name, value in dict(sent["headers"]).items() if name.lower() != "authorization"}
    more = {name: sent[name] for name in ("params", "json") if sent.get(name) is not None}
    if sent.get("data") is not None:
        more["content"] = sent["data"]
    return doors.ask(kind, sent["method"], sent["url"], token=token, headers=headers, **more)


def asked_of(kind: str, folder: Path, examples: int) -> int:
    print(f"seed {SEED}")
    with open_doors(folder) as doors:
        asked = try_all(doors, kind, examples)
        print(kind, asked, doors.statuses)
    return asked


@pytest.mark.parametrize("kind", KINDS)
def test_no_service_has_an_accident(tmp_path: Path, kind: str) -> None:
    assert asked_of(kind, tmp_path, 6) >= 30


@pytest.mark.soak
@pytest.mark.parametrize("kind", KINDS)
def test_no_service_has_an_accident_in_the_long_run(tmp_path: Path, kind: str) -> None:
    assert asked_of(kind, tmp_path, 300) > 1000
