"""Bodies that are not what the endpoint takes: refused with a hint by every service, and nothing is changed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from doors import Doors, Operation, check_problem, open_doors

from core.errors import BadRequest, GardenError, PeerDown, Unprocessable
from core.mesh.auth import Identity
from core.mesh.client import Answer, read
from core.mesh.parcels import EVERYBODY, sealed
from core.mesh.peers import Peer
from core.mesh.presence import introducer
from core.mesh.strict import parse
from core.wire.market import Bid

POSE = {"x_m": 0.1, "y_m": 0.2, "yaw_rad": 0.3}
CARD = {
    "plant_id": "plant-1",
    "url": "http://127.0.0.1:8101",
    "stem": {"x_m": 0.0, "y_m": 0.0, "z_m": 0.3},
    "dock": POSE,
    "nozzle": {"x_m": 0.05, "y_m": 0.0, "z_m": 0.1},
}
ANNOUNCED = {
    "task_id": "plant-1:9:9", "kind": "water", "plant": CARD, "dose_ml": 50.0, "priority": 3, "holder": "robot-1",
    "fruits": [], "count": 0, "order_id": "", "within_s": 60.0,
}  # fmt: skip
FRUIT = {
    "colour": "red", "confidence": 0.8, "x_m": 0.1, "y_m": 0.0, "z_m": 0.3, "radius_m": 0.014, "robot_pose": POSE,
    "image_x_px": 3.0, "image_y_px": 4.0, "sigma_m": 0.01, "ripeness": 0.9,
}  # fmt: skip
SEEN = FRUIT | {
    "fruit_id": "s1", "first_seen_s": 0.0, "last_seen_s": 1.0, "seen_count": 1, "missed_count": 0, "unreachable": "",
    "failed": "", "in_doubt": False,
}  # fmt: skip
VIEW = {
    "x_m": 0.4, "y_m": 0.0, "z_m": 0.3, "look": {"x": -1.0, "y": 0.0, "z": 0.0}, "up": {"x": 0.0, "y": 0.0, "z": 1.0},
    "fov_x_rad": 0.9, "fov_y_rad": 0.7, "range_m_min": 0.1, "range_m_max": 1.0,
}  # fmt: skip
SCAN = {
    "scan_id": "scan-1", "task_id": "", "robot_id": "robot-1", "views": [VIEW], "sightings": [FRUIT | {"views": [0]}],
    "detector": {"recall": 0.8, "precision": 0.9}, "fruits": [SEEN],
}  # fmt: skip
PICK = {
    "fruit_id": "f1", "outcome": "failed", "reason": "slipped", "permit_id": "", "took_s": 9.0,
}  # fmt: skip
REPORT = {
    "robot_id": "robot-1", "epoch": 1, "state": "running", "phase": "drive", "progress": 0.5, "reason": "",
    "delivered_ml": 1.0, "picks": [PICK],
}  # fmt: skip
TASK = {
    "kind": "water", "dose_ml": 40.0, "count": None, "fruit_ids": [], "order_id": "", "priority": 5, "within_s": 60.0,
}  # fmt: skip
PARCEL = {
    "seal": "e30.e30.eA", "body": "", "via": ["robot-1"], "way": ["plant-2"], "hops_left": 1, "within_s": 1.0,
}  # fmt: skip
RESERVE = {"robot_id": "robot-1", "dock_id": "", "for_s": 3.0, "yielding": True}
GOOD: dict[tuple[str, str, str], dict[str, Any]] = {
    **{(kind, "POST", "/parcels"): PARCEL for kind in ("plant", "station", "robot")},
    ("plant", "PATCH", "/settings"): {
        "threshold_ratio": 0.2, "target_ratio": 0.24, "dose_ml": 100.0, "day_cap_ml": 900.0, "probe_every_s": 9.0,
        "soak_s": 5.0, "inventory_every_s": 9000.0, "uncertainty_max": 1.0, "inventory": False, "harvest": False,
    },
    ("plant", "POST", "/inventory/fruits"): FRUIT,
    ("plant", "POST", "/inventory/scans"): SCAN,
    ("plant", "POST", "/tasks"): TASK,
    ("plant", "POST", "/tasks/{task_id}/reports"): REPORT,
    ("plant", "POST", "/tasks/{task_id}/permits"): {
        "robot_id": "robot-1", "epoch": 1, "act": "water", "amount_ml": 50.0, "fruit_id": "",
    },
    ("plant", "POST", "/dock/reservations"): RESERVE,
    ("station", "POST", "/dock/reservations"): RESERVE | {"dock_id": "tap"},
    ("station", "POST", "/tap"): {"robot_id": "robot-1", "open_s": 2.0},
    ("robot", "POST", "/bids"): ANNOUNCED,
    ("robot", "POST", "/tasks"): {"announcement": ANNOUNCED, "epoch": 1, "lease_s": 8.0, "cost_s": 20.0, "at_most_s": 500.0},
    ("robot", "POST", "/jobs"): {"kind": "goto", "x_m": -1.5, "y_m": 0.4, "yaw_rad": 1.0, "at": ""},
    ("robot", "POST", "/stop"): {"reason": "a test"},
    ("robot", "POST", "/resume"): {"stop_number": 7},
    ("sim", "PATCH", "/clock"): {"speed": 3.0, "paused": False},
    ("sim", "POST", "/faults"): {"kind": "wheel_slip", "target": "robot-1", "duration_s": 1.0, "strength": 2.0},
    ("console", "POST", "/api/stop"): {"reason": "a test"},
    ("console", "POST", "/api/resume"): {"stops": [{"robot_id": "robot-1", "stop_number": 7}]},
    ("console", "POST", "/orders"): {"count": 3, "plant_id": "", "within_s": 60.0, "priority": 5},
    ("console", "POST", "/api/plants/{plant_id}/water"): TASK,
}  # fmt: skip
"""A body that each endpoint takes, with every field it knows: the bad ones are this one, changed in one place."""
BIG = 5_000_000
WRONG_NUMBERS = (
    "NaN", "Infinity", "-Infinity", "1e400", "-1e300", "1e300", "-" + "9" * 30, "9" * 30, "9" * 5000,
    '"1"', '"NaN"', "true", "[]",
    "{}", "[1]", "0x10", "1_000", "01", "+1", ".5", "1.", "--1", "1,",
)  # fmt: skip
WRONG_TEXTS = ("1", "true", "[]", '["x"]', "{}", '"' + "x" * 600 + '"', r'"\ud800"', '"\x01"', r'"\x"', "'x'", "x")
WRONG_FLAGS = ('"true"', "1", "0", "[]", "{}", "True", '"yes"')
WRONG_INSIDES = ("1", '"x"', "true", "[[]]", "[null]", "[1]")


def leaves(value: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Every part of a document with the way to it, the document itself left out."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*way, key), inner
        yield from leaves(inner, (*way, key))


def wrong_values(value: Any) -> tuple[str, ...]:
    if isinstance(value, bool):
        return WRONG_FLAGS
    if isinstance(value, int | float):
        return WRONG_NUMBERS + (("1.5",) if isinstance(value, int) else ())
    return WRONG_TEXTS if isinstance(value, str) else WRONG_INSIDES


def put(document: Any, way: tuple[Any, ...], raw: str) -> str:
    """The document as text, with the raw text at the end of the way."""
    mark = "\u0001here"
    copy = json.loads(json.dumps(document))
    inner = copy
    for key in way[:-1]:
        inner = inner[key]
    inner[way[-1]] = mark
    return json.dumps(copy).replace(json.dumps(mark), raw)


def one_place_wrong(good: dict[str, Any]) -> Iterator[str]:
    """The good body with one value of a wrong type or beyond its bounds."""
    for way, value in leaves(good):
        for raw in wrong_values(value):
            yield put(good, way, raw)


def one_field_wrong(good: dict[str, Any]) -> Iterator[str]:
    """Unknown fields and doubled ones, at every depth."""
    for way, value in [((), good), *leaves(good)]:
        if isinstance(value, dict):
            text, more = json.dumps(value), json.dumps({"surprise": 1})
            first = json.dumps(dict([next(iter(value.items()))]))
            for longer in (text[:-1] + "," + more[1:], text[:-1] + "," + first[1:]):
                yield put(good, way, longer) if way else longer


def not_documents(good: dict[str, Any]) -> Iterator[bytes]:
    """What is no JSON object at all, or too much of one."""
    text = json.dumps(good)
    yield from (b"", b" ", b"null", b"true", b"1", b'"x"', b"[]", b"{", b"}", b"NaN", b"\x00", b"\xff\xfe{}", b"hello")
    yield from (
        b"[" + text.encode() + b"]",
        text.encode() * 2,
        text.encode()[:-1],
        text.encode() + b",",
        b"\xef\xbb\xbf" + text.encode(),
    )
    yield from (text.encode("utf-16"), b"a=1&b=2", b"<xml/>", json.dumps(text).encode())
    yield text.replace('"', "'").encode()
    yield text[:-1].encode() + b', "\xc3\x28": 1}'
    yield from (b"[" * 100, b"[" * 50_000, b'{"a":' * 10_000, b'{"a":' * 40 + b"1" + b"}" * 40)


def too_long(good: dict[str, Any]) -> Iterator[bytes]:
    for size in (70 * 1024, BIG):
        yield b" " * size + json.dumps(good).encode()
        yield json.dumps(good | {"surprise": "x" * size}).encode()


def takers(doors: Doors) -> list[Operation]:
    return [each for each in doors.operations() if each.takes_body]


def caller(doors: Doors, each: Operation) -> str:
    """A token that may use the operation, the best-placed to do harm with it."""
    assert each.roles
    role = "operator" if "operator" in each.roles else "robot"
    return doors.token(role)


def refused(doors: Doors, each: Operation, bodies: Any, *statuses: int, **more: Any) -> None:
    """All of them are refused, and the garden stands as it stood."""
    before, token = doors.standing(), caller(doors, each)
    for body in bodies:
        answer = doors.ask(each.kind, each.method, each.url(), token=token, content=body, **more)
        check_problem(answer, (each.name, body[:120], body[-120:]), *statuses)
    assert doors.standing() == before, each.name


def test_every_taker_of_a_body_has_a_good_one_here(doors: Doors) -> None:
    assert {each.key for each in takers(doors)} == set(GOOD)


def test_the_good_bodies_name_every_field(doors: Doors) -> None:
    for each in takers(doors):
        document = doors.apps[each.kind].openapi()
        operation = document["paths"][each.path][each.method.lower()]
        name = operation["requestBody"]["content"]["application/json"]["schema"]["$ref"].rpartition("/")[2]
        assert set(document["components"]["schemas"][name]["properties"]) == set(GOOD[each.key]), each.name


def test_one_wrong_value_anywhere_is_refused(doors: Doors) -> None:
    for each in takers(doors):
        refused(doors, each, one_place_wrong(GOOD[each.key]), 400, 422)


def test_unknown_and_doubled_fields_are_refused_at_every_depth(doors: Doors) -> None:
    for each in takers(doors):
        refused(doors, each, one_field_wrong(GOOD[each.key]), 400, 422)


def test_a_missing_field_is_refused(doors: Doors) -> None:
    for each in takers(doors):
        document = doors.apps[each.kind].openapi()
        name = type_name(document, each)
        required = document["components"]["schemas"][name].get("required", [])
        bodies = [json.dumps({k: v for k, v in GOOD[each.key].items() if k != missing}) for missing in required]
        refused(doors, each, bodies, 422)


def type_name(document: dict[str, Any], each: Operation) -> str:
    operation = document["paths"][each.path][each.method.lower()]
    return str(operation["requestBody"]["content"]["application/json"]["schema"]["$ref"]).rpartition("/")[2]


def test_what_is_no_json_object_is_refused(doors: Doors) -> None:
    for each in takers(doors):
        refused(doors, each, not_documents(GOOD[each.key]), 400, 422)


def test_long_bodies_are_refused_as_too_long(doors: Doors) -> None:
    for each in takers(doors):
        refused(doors, each, too_long(GOOD[each.key]), 413)


def test_long_bodies_in_pieces_are_refused_as_too_long(doors: Doors) -> None:
    """Without a length to go by."""

    def pieces() -> Any:
        async def stream() -> Any:
            for _ in range(40):
                yield b" " * 4096

        return stream()

    for each in doors.changing():
        if each.takes_body or each.method == "POST":
            before = doors.standing()
            answer = doors.ask(each.kind, each.method, each.url(), token=caller(doors, each), content=pieces())
            check_problem(answer, each.name, 413)
            assert doors.standing() == before


def test_a_body_where_none_is_taken_is_refused(doors: Doors) -> None:
    bodiless = [each for each in doors.changing() if not each.takes_body]
    assert bodiless
    for each in bodiless:
        refused(doors, each, [b"[]", b"x", b'{"a": 1}', b"null", b"\xff", b"{" * 1000], 400)
        refused(doors, each, [b" " * BIG], 413)


@pytest.mark.parametrize("key", ["x" * 129, "x" * 10_000])
def test_a_long_idempotency_key_is_refused(doors: Doors, key: str) -> None:
    before = doors.standing()
    for each in [each for each in doors.changing() if each.method == "POST"]:
        content = json.dumps(GOOD[each.key]) if each.takes_body else b""
        headers = {"idempotency-key": key}
        answer = doors.ask(each.kind, "POST", each.url(), token=caller(doors, each), headers=headers, content=content)
        check_problem(answer, each.name, 422)
    assert doors.standing() == before


@pytest.mark.parametrize("length", ["-1", "1e3", "+5", "0x10", "five", "9" * 40, "², "])
def test_a_length_that_is_no_number_or_too_large_is_refused(doors: Doors, length: str) -> None:
    before = doors.standing()
    for each in doors.changing():
        headers = {"content-length": length.encode()}
        answer = doors.ask(each.kind, each.method, each.url(), token=caller(doors, each), headers=headers)
        check_problem(answer, (each.name, length), 400, 413)
    assert doors.standing() == before


def test_two_ways_to_tell_the_length_are_refused(doors: Doors) -> None:
    before = doors.standing()
    for each in doors.changing():
        headers = {"content-length": "2", "transfer-encoding": "chunked"}
        answer = doors.ask(each.kind, each.method, each.url(), token=caller(doors, each), headers=headers)
        check_problem(answer, each.name, 400)
    assert doors.standing() == before


RULES = [
    ("plant", "PATCH", "/settings", {"threshold_ratio": 0.5}),
    ("plant", "PATCH", "/settings", {"target_ratio": 0.01}),
    ("plant", "PATCH", "/settings", {"dose_ml": 0}),
    ("plant", "PATCH", "/settings", {"dose_ml": -5.0}),
    ("plant", "POST", "/tasks", {"kind": "water", "dose_ml": -5.0}),
    ("plant", "POST", "/tasks", {"kind": "water", "dose_ml": -0.0}),
    ("plant", "POST", "/tasks", {"kind": "water", "dose_ml": 500.001}),
    ("plant", "POST", "/tasks", {"kind": "harvest"}),
    ("plant", "POST", "/tasks/{task_id}/permits", {"robot_id": "robot-1", "epoch": 1, "act": "water", "amount_ml": -1.0}),
    ("station", "POST", "/tap", {"robot_id": "robot-1", "open_s": 0}),
    ("station", "POST", "/tap", {"robot_id": "robot-1", "open_s": 61}),
    ("station", "POST", "/tap", {"robot_id": "robot-1", "open_s": 5.0}),
    ("station", "POST", "/dock/reservations", RESERVE),
    ("station", "POST", "/dock/reservations", RESERVE | {"dock_id": "../tap"}),
    ("robot", "POST", "/tasks", {"announcement": ANNOUNCED | {"dose_ml": -1.0}, "epoch": 1, "lease_s": 8.0, "cost_s": 2.0}),
    (
        "robot",
        "POST",
        "/tasks",
        {"announcement": ANNOUNCED | {"kind": "probe"}, "epoch": 1, "lease_s": 8.0, "cost_s": 2.0},
    ),
    ("robot", "POST", "/jobs", {"kind": "goto"}),
    ("robot", "POST", "/jobs", {"kind": "goto", "x_m": 1.0}),
    ("robot", "POST", "/jobs", {"kind": "goto", "x_m": 50.0, "y_m": 0.0}),
    ("robot", "POST", "/jobs", {"kind": "dock", "at": "plant-77"}),
    ("robot", "POST", "/jobs", {"kind": "dance"}),
    ("sim", "PATCH", "/clock", {}),
    ("sim", "PATCH", "/clock", {"speed": 0}),
    ("sim", "PATCH", "/clock", {"speed": 5e-324}),
    ("sim", "PATCH", "/clock", {"speed": 101}),
    ("sim", "POST", "/faults", {"kind": "earthquake", "target": "robot-1"}),
    ("sim", "POST", "/faults", {"kind": "wheel_slip", "target": "plant-1"}),
    ("sim", "POST", "/faults", {"kind": "soil_stuck", "target": "plant-1", "strength": 1.0}),
    ("sim", "POST", "/faults", {"kind": "pump_stuck", "target": "robot-1", "strength": 2.0}),
    ("console", "POST", "/api/plants/robot-1/water", {"kind": "water"}),
    ("console", "POST", "/api/plants/nobody/water", {"kind": "water"}),
    ("console", "POST", "/api/plants/plant-1/water", {"kind": "water", "dose_ml": -1.0}),
]


@pytest.mark.parametrize(("kind", "method", "path", "body"), RULES)
def test_what_makes_no_sense_here_is_refused(doors: Doors, kind: str, method: str, path: str, body: Any) -> None:
    role = "robot" if kind == "station" or path.endswith("/permits") else "operator"
    before = doors.standing()
    answer = doors.ask(kind, method, path.replace("{task_id}", "plant-1:1:1"), token=doors.token(role), json=body)
    check_problem(answer, (path, body))
    assert doors.standing() == before


def seal_of(doors: Doors) -> str:
    """A seal under which the robot asks everybody for a sign of life."""
    me = introducer(Identity.load(doors.garden.folder / "keys" / "robot-1"), "robot", doors.garden.url("robot-1"))
    assert me is not None
    now_s = doors.runner.run(_now(doors))
    return sealed(me, "1", EVERYBODY, "GET", "/healthz", {}, b"", now_s)


async def _now(doors: Doors) -> float:
    return doors.garden.clock.now()


def test_the_good_bodies_are_taken_and_change_something(tmp_path: Path) -> None:
    """So that it is the one wrong place for which the others were refused. In a garden of its own."""
    with open_doors(tmp_path) as doors:
        before = doors.standing()
        for each in takers(doors):
            good = GOOD[each.key] | ({"seal": seal_of(doors)} if each.path == "/parcels" else {})
            answer = doors.ask(each.kind, each.method, each.url(), token=caller(doors, each), json=good)
            assert answer.status_code in (200, 201, 202, 204, 404, 409), (each.name, answer.text)
        after = doors.standing()
        changed = {name for name in after if after[name] != before[name]}
        assert changed >= {
            "plant/settings-of-state",
            "plant/inventory",
            "plant/dock",
            "station/state",
            "robot/jobs",
            "sim/faults",
        }


BID = {
    "task_id": "plant-1:9:9", "robot_id": "robot-1", "cost_s": 30.5, "reason": "", "breakdown": {
        "current_s": 0.0, "queue_s": 1.0, "travel_s": 9.5, "work_s": 20.0, "charge_s": 0.0, "refill_s": 0.0, "delay_s": 0.0,
    },
}  # fmt: skip


def test_what_is_refused_as_a_request_is_refused_as_an_answer() -> None:
    robot = Peer(id="robot-1", kind="robot", url="http://robot-1")
    assert read(robot, Answer(200, json.dumps(BID).encode()), Bid).cost_s == 30.5
    texts = [*one_place_wrong(BID), *one_field_wrong(BID), '{"cost_s": 9, "cost_s": 1}']
    bodies = [text.encode() for text in texts] + list(not_documents(BID))
    assert len(bodies) > 150
    for body in bodies:
        with pytest.raises((BadRequest, Unprocessable)):
            parse(Bid, body)
        with pytest.raises(PeerDown):
            read(robot, Answer(200, body), Bid)
        with pytest.raises(GardenError, match="without saying why"):
            read(robot, Answer(409, body), Bid)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e400", "-1e400", "9" * 400, "-" + "9" * 5000])
def test_a_number_that_no_float_holds_is_422(doors: Doors, number: str) -> None:
    for each in takers(doors):
        good = GOOD[each.key]
        ways = [way for way, value in leaves(good) if isinstance(value, int | float) and not isinstance(value, bool)]
        refused(doors, each, [number, *(put(good, way, number) for way in ways)], 422)
