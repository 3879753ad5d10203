"""Paths, methods, ids, query parameters and headers that lead nowhere: problems with a hint, and nothing is changed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from doors import KINDS, Doors, Operation, check_problem

NOWHERE = (
    "/nothing", "/state/", "/tasks/", "/STATE",
    "/%2e%2e/%2e%2e/etc/passwd", "/..%2F..%2Fetc%2Fpasswd",
    "/state%00", "/state%0d%0aset-cookie:x", "/%ff%fe", "/" + "a" * 5000, "/state;v=1", "/.env", "/admin", "/docs/../keys",
    "/redoc", "/openapi.yaml", "/static/../../keys/token", "/%F0%9F%8C%B1",
)  # fmt: skip
STRANGE_IDS = (
    "..%2F..%2Fetc%2Fpasswd", "%2e%2e%2f", "%00", "a%0d%0ab", "x" * 81, "x" * 4000, "%ff", "%22%27%3b--", "-1", "1e400",
    "NaN", "plant-2:1:1", "plant-1:0:0", "plant-1:1:99999", "plant-1%3A1%3A1%2Freports", "nobody", "%F0%9F%8C%B1", "*",
    "%25", "null",
)  # fmt: skip
WRONG_NUMBERS = (
    "nan",
    "NaN",
    "inf",
    "-inf",
    "-1",
    "1e400",
    "9" * 40,
    "-" + "9" * 40,
    "x",
    "",
    "true",
    "0x10",
    "1;2",
    "%00",
    "1.5e",
    "[]",
    "1,2",
)
WRONG_TEXTS = ("x" * 5000,)
METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE", "HEAD", "OPTIONS", "TRACE", "BREW", "get")


@pytest.mark.parametrize("kind", KINDS)
def test_unknown_paths_are_404_for_everybody(doors: Doors, kind: str) -> None:
    before = doors.standing()
    for path in NOWHERE:
        for method in ("GET", "POST", "DELETE"):
            check_problem(doors.ask(kind, method, path), (kind, method, path[:80]), 404, 405)
    assert doors.standing() == before


@pytest.mark.parametrize("kind", KINDS)
def test_other_methods_are_405_and_name_the_right_ones(doors: Doors, kind: str) -> None:
    before = doors.standing()
    known: dict[str, set[str]] = {}
    for each in doors.operations():
        if each.kind == kind:
            known.setdefault(each.url().partition("?")[0], set()).add(each.method)
    for path, methods in known.items():
        for method in METHODS:
            if method.upper() in methods:
                continue
            answer = doors.ask(kind, method, path, content=b"{}" if method not in ("GET", "HEAD") else b"")
            if method == "HEAD":
                assert answer.status_code == 405, (kind, path)
                continue
            check_problem(answer, (kind, method, path), 405)
            assert answer.headers["allow"], (kind, path)
    assert doors.standing() == before


def test_strange_ids_are_refused_wherever_one_is_taken(doors: Doors) -> None:
    before = doors.standing()
    taking = [each for each in doors.operations() if "{" in each.path]
    assert len(taking) >= 10
    for each in taking:
        head, _, tail = each.path.partition("{")
        for strange in STRANGE_IDS:
            path = head + strange + tail.partition("}")[2]
            answer = doors.ask(each.kind, each.method, path, token=token_for(doors, each), content=body_for(each))
            check_problem(answer, (each.name, strange[:40]))
    assert doors.standing() == before


def token_for(doors: Doors, each: Operation) -> str:
    return doors.token("operator" if "operator" in (each.roles or ("operator",)) else "robot")


def body_for(each: Operation) -> bytes:
    bodies: dict[str, Any] = {
        "reports": {"robot_id": "robot-1", "epoch": 1, "state": "running"},
        "permits": {"robot_id": "robot-1", "epoch": 1, "act": "water"},
        "water": {"kind": "water"},
    }
    return json.dumps(bodies[each.path.rpartition("/")[2]]).encode() if each.takes_body else b""


def wrong_queries(parameter: dict[str, Any]) -> Iterator[str]:
    """Values that a query parameter does not take."""
    schema = parameter["schema"]
    kinds = [part for part in schema.get("anyOf", [schema]) if part.get("type") != "null"]
    kind = kinds[0]
    if kind["type"] in ("integer", "number"):
        yield from (value for value in WRONG_NUMBERS if not (value == "-1" and "minimum" not in kind))
        yield from ("1.5",) if kind["type"] == "integer" else ()
    elif kind["type"] == "boolean":
        yield from ("2", "maybe", "nan", "", "%00")
    elif "enum" in kind or "pattern" in kind:
        yield from ("x", "", "JSON", "json%00", "json%0a", *WRONG_TEXTS)
    else:
        yield from WRONG_TEXTS


def test_wrong_query_parameters_are_refused(doors: Doors) -> None:
    asked = 0
    for each in doors.operations():
        for parameter in each.query:
            for value in wrong_queries(parameter):
                path = each.url().partition("?")[0]
                answer = doors.ask(each.kind, each.method, f"{path}?{parameter['name']}={value}")
                check_problem(answer, (each.name, parameter["name"], value[:40]), 422)
                asked += 1
    assert asked > 100


def test_unknown_query_parameters_are_refused_and_the_known_ones_named(doors: Doors) -> None:
    before = doors.standing()
    for each in doors.operations():
        path = each.url().partition("?")[0]
        problem = check_problem(
            doors.ask(each.kind, each.method, f"{path}?surprise=1", token=token_for(doors, each)), each.name, 422
        )
        assert "surprise" in problem["detail"], each.name
        for parameter in each.query:
            assert parameter["name"] in problem["hint"], each.name
    assert doors.standing() == before


def test_broken_query_strings_are_no_accident(doors: Doors) -> None:
    for each in [each for each in doors.operations() if not each.changing]:
        path = each.url().partition("?")[0]
        for query in ("%", "a=%ff", "%00=1", "a" * 5000, ";", "surprise[]=1", "after=1&x", "=", "=&surprise=1"):
            check_problem(doors.ask(each.kind, each.method, f"{path}?{query}"), (each.name, query[:20]), 422)


@pytest.mark.parametrize("value", ["x" * 5000, '"0"', "W/", "'", ",", "\\"])
def test_wrong_etags_change_nothing(doors: Doors, value: str) -> None:
    before = doors.standing()
    answer = doors.ask("plant", "DELETE", "/inventory/fruits/f1", headers={"if-match": value})
    check_problem(answer, value[:20], 404, 412, 422)
    assert doors.ask("plant", "GET", "/inventory", headers={"if-none-match": value}).status_code in (200, 304, 422)
    assert doors.standing() == before


def test_strange_event_ids_do_no_harm(doors: Doors) -> None:
    for kind in ("plant", "station", "robot", "sim"):
        for value in ("x", "-1", "9" * 20, "²", "1e9", "NaN"):
            headers = {"last-event-id": value.encode()}
            assert doors.ask(kind, "GET", "/events?follow=false", headers=headers).status_code == 200
        check_problem(doors.ask(kind, "GET", "/events?follow=false", headers={"last-event-id": "9" * 21}), kind, 422)


def test_a_picture_of_nobody_is_404(doors: Doors) -> None:
    for name in ("nobody", "plant-1", "x" * 41, "..%2F..%2Fhand"):
        for form in ("jpg", "mjpg", "png"):
            check_problem(doors.ask("sim", "GET", f"/cameras/{name}/hand.{form}"), name, 404, 422)
