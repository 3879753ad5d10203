"""The whole table of who may do what, held against every operation of every service."""

from __future__ import annotations

from pathlib import Path

import jwt
import pytest
from cryptography.hazmat.primitives import serialization
from doors import ENDLESS, SUBJECTS, Doors, Operation, check_problem

from core.mesh.auth import ROLES, GardenKey
from core.mesh.guard import Guard

ANYBODY = "anybody"
OPERATOR, ROBOT, PLANT = {"operator"}, {"robot"}, {"plant", "operator"}
KEEPERS = {"robot", "operator"}
_NODE = ("/", "/healthz", "/readyz", "/metrics")
MAY: dict[tuple[str, str, str], set[str] | str] = {
    **{(kind, "GET", path): ANYBODY for kind in ("plant", "station", "robot", "sim", "console") for path in _NODE},
    **{(kind, "GET", "/events"): ANYBODY for kind in ("plant", "station", "robot", "sim")},
    **{
        ("plant", "GET", path): ANYBODY
        for path in ("/state", "/inventory", "/forecast", "/tasks", "/tasks/{task_id}", "/dock", "/history")
    },
    **{("plant", "GET", path): ANYBODY for path in ("/ledger", "/ledger/{line_id}/{when}.jpg")},
    **{(kind, "GET", path): ANYBODY for kind in ("plant", "station", "robot") for path in ("/peers", "/introduction")},
    **{(kind, "POST", "/parcels"): {"plant", "robot"} for kind in ("plant", "station", "robot")},
    ("plant", "PUT", "/ledger/{line_id}/{when}.jpg"): ROBOT,
    ("plant", "PATCH", "/settings"): OPERATOR,
    ("plant", "POST", "/inventory/fruits"): KEEPERS,
    ("plant", "POST", "/inventory/scans"): KEEPERS,
    ("plant", "DELETE", "/inventory/fruits/{fruit_id}"): KEEPERS,
    ("plant", "POST", "/tasks"): OPERATOR,
    ("plant", "DELETE", "/tasks/{task_id}"): OPERATOR,
    ("plant", "POST", "/tasks/{task_id}/reports"): ROBOT,
    ("plant", "POST", "/tasks/{task_id}/permits"): ROBOT,
    ("plant", "POST", "/dock/reservations"): ROBOT,
    ("plant", "DELETE", "/dock/reservations/{reservation_id}"): KEEPERS,
    **{("station", "GET", path): ANYBODY for path in ("/state", "/dock", "/history")},
    ("station", "POST", "/tap"): ROBOT,
    ("station", "POST", "/dock/reservations"): ROBOT,
    ("station", "DELETE", "/dock/reservations/{reservation_id}"): KEEPERS,
    **{("robot", "GET", path): ANYBODY for path in ("/state", "/position", "/tasks", "/tasks/{task_id}", "/history")},
    **{("robot", "GET", path): ANYBODY for path in ("/jobs", "/jobs/{job_id}", "/camera.jpg", "/camera.mjpg")},
    ("robot", "POST", "/bids"): PLANT,
    ("robot", "POST", "/tasks"): PLANT,
    ("robot", "DELETE", "/tasks/{task_id}"): PLANT,
    ("robot", "POST", "/jobs"): OPERATOR,
    ("robot", "DELETE", "/jobs/{job_id}"): OPERATOR,
    ("robot", "POST", "/stop"): set(ROLES),
    ("robot", "POST", "/resume"): OPERATOR,
    **{("sim", "GET", path): ANYBODY for path in ("/truth", "/overview.jpg")},
    **{("sim", "GET", f"/cameras/{{robot}}/hand.{form}"): ANYBODY for form in ("jpg", "mjpg", "png")},
    **{("sim", "GET", path): ANYBODY for path in ("/clock", "/clock/feed", "/faults")},
    ("sim", "PATCH", "/clock"): OPERATOR,
    ("sim", "POST", "/faults"): OPERATOR,
    ("sim", "DELETE", "/faults/{fault_id}"): OPERATOR,
    **{("console", "GET", path): ANYBODY for path in ("/api/garden", "/overview.jpg", "/orders", "/orders/{order_id}")},
    ("console", "POST", "/orders"): OPERATOR,
    ("console", "DELETE", "/orders/{order_id}"): OPERATOR,
    ("console", "POST", "/api/stop"): set(ROLES),
    ("console", "POST", "/api/resume"): OPERATOR,
    ("console", "POST", "/api/plants/{plant_id}/water"): OPERATOR,
}
PAGE = Path(__file__).parents[2] / "docs" / "security-table.md"
HEAD = """# Who may do what

Every operation of every service, and whose token it takes.
Reading is open while a port is published on loopback only; with `GARDEN_OPEN_READS=false` every read but `/healthz`,
`/readyz` and `/introduction` takes a token of any role.
A plant and a robot act in their own name only: a plant offers and kills its own tasks, a robot reports on, asks permits
for and reserves docks for itself.
`POST /parcels` is there where `GARDEN_FLOOD_HOPS` is set; what is in a parcel meets this table in its author's role.
`tests/api/test_who_may.py` holds this table against the running services, and names the command that writes it anew.
"""


def test_the_table_names_every_operation_and_no_other(doors: Doors) -> None:
    assert {each.key for each in doors.operations()} == set(MAY)


def test_what_changes_something_is_nobodys_by_default(doors: Doors) -> None:
    for each in doors.operations():
        assert (MAY[each.key] == ANYBODY) == (not each.changing), each.name


def test_the_description_tells_the_same(doors: Doors) -> None:
    for each in doors.operations():
        described = doors.apps[each.kind].openapi()["paths"][each.path][each.method.lower()]
        told = set(described["x-roles"]) if "x-roles" in described else ANYBODY
        assert told == MAY[each.key], each.name


def test_every_role_may_what_the_table_says(doors: Doors) -> None:
    """Asked with a body that is refused for itself: only who may is told so."""
    before = doors.standing()
    for each in doors.changing():
        for role in ROLES:
            body = b"[]" if each.takes_body or each.method == "POST" else b""
            answer = doors.ask(each.kind, each.method, each.url(), token=doors.token(role), content=body)
            problem = check_problem(answer, (each.name, role))
            assert (problem["status"] == 403) == (role not in MAY[each.key]), (each.name, role, problem)
            assert problem["status"] != 401, (each.name, role)
    assert doors.standing() == before


def tokens(doors: Doors) -> dict[str, str]:
    """Tokens that are not whole, ours and alive."""
    good = doors.token("operator")
    head, claims, signature = good.split(".")
    stranger = GardenKey.generate()
    public_pem = doors.key.public().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    robots = doors.token("robot").split(".")[1]
    return {
        "none": "",
        "nonsense": "nonsense",
        "another's claims": f"{head}.{robots}.{signature}",
        "a bent signature": f"{head}.{claims}.{'A' * len(signature)}",
        "no signature": f"{head}.{claims}.",
        "another garden's": stranger.issue("operator", "operator", 0.0).token,
        "a stranger's in our name": doors.forged(stranger.key, "EdDSA"),
        "for another audience": doors.forged(doors.key.key, "EdDSA", aud="garden-0000"),
        "for no audience": doors.forged(doors.key.key, "EdDSA", aud=None),
        "alg none": doors.forged(None, "none"),
        "our public key as a secret": _hmac_by(public_pem, doors),
        "expired": doors.key.issue("operator", "operator", -100.0, 50.0).token,
        "no end": doors.forged(doors.key.key, "EdDSA", exp=None),
        "an unknown role": doors.forged(doors.key.key, "EdDSA", role="gardener"),
        "no role": doors.forged(doors.key.key, "EdDSA", role=None),
        "roles as a list": doors.forged(doors.key.key, "EdDSA", role=["operator"]),
        "no subject": doors.forged(doors.key.key, "EdDSA", sub=None),
        "too long": doors.forged(doors.key.key, "EdDSA", more="x" * 5000),
        "not ASCII": "é" * 20,
    }


def _hmac_by(public_pem: bytes, doors: Doors) -> str:
    """HS256 with the public key for a secret: put together by hand, as the library refuses to."""
    import base64
    import hashlib
    import hmac
    import json

    claims = jwt.decode(doors.token("operator"), options={"verify_signature": False})
    parts = [base64.urlsafe_b64encode(json.dumps(p).encode()).rstrip(b"=") for p in ({"alg": "HS256", "typ": "JWT"}, claims)]
    signed = b".".join(parts)
    signature = base64.urlsafe_b64encode(hmac.new(public_pem, signed, hashlib.sha256).digest()).rstrip(b"=")
    return (signed + b"." + signature).decode()


def test_no_change_without_a_whole_token_that_is_ours_and_alive(doors: Doors) -> None:
    before = doors.standing()
    for name, token in tokens(doors).items():
        for each in doors.changing():
            headers = {"authorization": f"Bearer {token}".encode()} if token else {}
            answer = doors.ask(each.kind, each.method, each.url(), token="", headers=headers, content=b"{}")
            check_problem(answer, (each.name, name), 401)
            assert answer.headers["www-authenticate"] == "Bearer", each.name
    assert doors.standing() == before


@pytest.mark.parametrize("scheme", ["Basic {}", "Token {}", "{}", "Bearer", "Bearer\t{}", "Bearer {} {}"])
def test_only_the_bearer_scheme_is_known(doors: Doors, scheme: str) -> None:
    headers = {"authorization": scheme.replace("{}", doors.token("operator"))}
    for kind, method, path in (("plant", "POST", "/tasks"), ("robot", "POST", "/resume"), ("sim", "PATCH", "/clock")):
        check_problem(doors.ask(kind, method, path, token="", headers=headers, content=b"{}"), (kind, scheme), 401)


def test_reading_is_open_whatever_the_token(doors: Doors) -> None:
    for each in finite_reads(doors):
        for token in ("", "nonsense", doors.token("viewer")):
            answer = doors.ask(each.kind, each.method, each.url(), token=token)
            assert answer.status_code in (200, 404), (each.name, answer.text)


def test_closed_reads_take_a_token_of_any_role_but_health_none(doors: Doors, monkeypatch: pytest.MonkeyPatch) -> None:
    for app in doors.apps.values():
        layer = app.middleware_stack
        while not isinstance(layer, Guard):
            layer = layer.app  # type: ignore[union-attr]
        monkeypatch.setattr(layer, "_open_reads", False)
    for each in finite_reads(doors):
        bare = doors.ask(each.kind, each.method, each.url(), token="")
        if each.path in ("/healthz", "/readyz", "/introduction"):
            assert bare.status_code in (200, 404), each.name
            continue
        check_problem(bare, each.name, 401)
        answers = {role: doors.ask(each.kind, each.method, each.url(), token=doors.token(role)) for role in ROLES}
        assert {answer.status_code for answer in answers.values()} <= {200, 404}, each.name


def finite_reads(doors: Doors) -> list[Operation]:
    return [
        each
        for each in doors.operations()
        if not each.changing and each.path not in ENDLESS and each.path != "/overview.jpg"
    ]


def written(doors: Doors) -> str:
    """The page as Markdown."""
    lines = [HEAD]
    for kind in doors.apps:
        lines += [
            f"## {kind}\n",
            "| operation | anybody | " + " | ".join(SUBJECTS) + " |",
            "|---|---|" + "---|" * len(SUBJECTS),
        ]
        for each in sorted((e for e in doors.operations() if e.kind == kind), key=lambda e: (e.path, e.method)):
            may = MAY[each.key]
            marks = ["yes" if may == ANYBODY or role in may else "" for role in SUBJECTS]
            lines.append(f"| `{each.method} {each.path}` | {'yes' if may == ANYBODY else ''} | {' | '.join(marks)} |")
        lines.append("")
    return "\n".join(lines)


def test_the_page_in_docs_shows_this_table(doors: Doors, request: pytest.FixtureRequest) -> None:
    """`SECURITY_TABLE=write .venv/bin/pytest tests/api -k docs` writes it anew."""
    import os

    if os.environ.get("SECURITY_TABLE") == "write":
        PAGE.write_text(written(doors))
    assert PAGE.read_text() == written(doors)
