"""What schemathesis makes of our own descriptions, good and bad, is answered as they say, and never with an accident."""

from __future__ import annotations

import hashlib
import math
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
ROUNDS_MAX = 12
"""What hypothesis tells apart may be the same on the wire, so it is asked again with another seed."""
DRAWN = {"/overview.jpg"}
"""A picture of the whole garden costs a tenth of a second: tried elsewhere."""
NOT_NOW = {502, 503}
"""Says that somebody else does not answer, or not yet: a robot whose world was paused, a console whose robot is stopped."""
NOT_SENT = {"authorization", "x-schemathesis-testcaseid"}
Mode = schemathesis.GenerationMode


def try_all(doors: Doors, kind: str, examples: int) -> int:
    """Ask every operation `examples` times with data that fits and as often with data that does not, no two alike."""
    schema = schemathesis.openapi.from_dict(doors.apps[kind].openapi())
    schema.config.generation.update(with_security_parameters=False)  # `send` has a token of its own
    asked = 0
    for found in schema.get_all_operations():
        operation = found.ok()
        for mode in modes(operation):
            tried = try_one(doors, kind, operation, mode, examples)
            assert tried >= min(examples, possible(operation, mode)), (operation.label, mode.name, tried)
            asked += tried
    return asked


def modes(operation: Any) -> list[Any]:
    """Good data, and bad data wherever a schema can be missed: any text is a good id."""
    if operation.path in ENDLESS | DRAWN:
        return []
    return [Mode.POSITIVE, Mode.NEGATIVE] if operation.body or operation.query else [Mode.POSITIVE]


def possible(operation: Any, mode: Any) -> float:
    """How many different requests there are: one where nothing can be chosen, few where only words of a list can."""
    headers = [header for header in operation.headers if header.name.lower() not in NOT_SENT]
    if mode is Mode.NEGATIVE or operation.body or operation.path_parameters or headers:
        return math.inf
    lists = [parameter.definition["schema"].get("enum") for parameter in operation.query]
    return math.prod(math.inf if words is None else 1 + len(words) for words in lists)


def try_one(doors: Doors, kind: str, operation: Any, mode: Any, examples: int) -> int:
    """How many different requests were answered. A robot asks in its own name, as anything else is answered 403 at once."""
    asked: set[bytes] = set()
    roles = document_roles(operation)
    token = doors.token("operator" if "operator" in (roles or ["operator"]) else "robot")

    def answered(case: Any) -> None:
        if isinstance(case.body, dict) and isinstance(case.body.get("robot_id"), str):
            case.body["robot_id"] = "robot-1"
        answer = send(doors, kind, case, token)
        asked.add(fingerprint(answer.request))
        if answer.status_code in NOT_NOW:
            assert answer.json()["hint"], answer.text
            return
        case.validate_response(answer, checks=CHECKS)
        if answer.status_code >= 400:
            assert answer.headers["content-type"] == "application/problem+json"
            assert answer.json()["hint"], answer.text

    strategy = operation.as_strategy(generation_mode=mode)
    told = settings(
        max_examples=examples,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    for number in range(ROUNDS_MAX):
        if len(asked) >= min(examples, possible(operation, mode)):
            break
        seed(SEED + number)(told(given(case=strategy)(answered)))()
    return len(asked)


def fingerprint(request: Any) -> bytes:
    """The request as it went out."""
    raw = repr((str(request.url), sorted(request.headers.items()), request.content))
    return hashlib.sha256(raw.encode("utf-8", "surrogatepass")).digest()


def document_roles(operation: Any) -> list[str]:
    return list(operation.definition.raw.get("x-roles", []))


def send(doors: Doors, kind: str, case: Any, token: str) -> Any:
    sent = case.as_transport_kwargs(base_url="http://127.0.0.1")
    headers = {name: value for name, value in dict(sent["headers"]).items() if name.lower() not in NOT_SENT}
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
    assert asked_of(kind, tmp_path, 500) > 4000
