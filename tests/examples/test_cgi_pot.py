"""examples/cgi-pot by itself: lighttpd and CGI for real, robots and a soil probe of a few lines, time set by hand."""

from __future__ import annotations

import json
import random
import re
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import Any

import httpx
import jwt
import pytest

from core.mesh.auth import Enrolled, GardenKey, make_garden
from core.scenario import load
from core.wire.documents import NodeCard, Problem
from core.wire.market import Announcement, Award, Permit, ReportAnswer, Reservation, Task
from core.wire.plant import DockState, PlantState
from hw.protocols.vh400 import code_of, volts_of

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "cgi-pot"
PATH = "/usr/sbin:/usr/bin:/bin:/usr/local/bin"
MISSING = [tool for tool in ("lighttpd", "php", "php-cgi", "curl", "flock") if shutil.which(tool, path=PATH) is None]
pytestmark = pytest.mark.skipif(
    bool(MISSING), reason=f"the example needs {', '.join(MISSING)}: see examples/cgi-pot/README.md"
)
TASK = "plant-5:1:1"


@dataclass
class Outside:
    """What a pot sees of the world: the time, its soil, and two robots that answer what they are told to."""

    now_s: float = 100.0
    ratio: float = 0.15
    costs: dict[str, float | None] = field(default_factory=lambda: {"robot-1": 30.0, "robot-2": 40.0})
    heard: list[tuple[str, str, str, dict[str, Any]]] = field(default_factory=list)
    """Robot, method, path, document."""


def serve_http(outside: Outside) -> ThreadingHTTPServer:
    """`/ROBOT/bids`, `/ROBOT/tasks` and `/clock`."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._say(200, {"garden_s": outside.now_s})

        def do_POST(self) -> None:
            robot, path, body = self._heard()
            if path == "/bids":
                reason = "" if outside.costs[robot] is not None else "no water"
                self._say(
                    200, {"task_id": body["task_id"], "robot_id": robot, "cost_s": outside.costs[robot], "reason": reason}
                )
            else:
                self._say(201, {})

        def do_DELETE(self) -> None:
            self._heard()
            self._say(200, {})

        def _heard(self) -> tuple[str, str, dict[str, Any]]:
            robot, _, path = self.path[1:].partition("/")
            body = json.loads(self.rfile.read(int(self.headers.get("content-length", 0))) or "{}")
            outside.heard.append((robot, self.command, f"/{path}", body))
            assert self.headers["authorization"].startswith("Bearer ")
            return robot, f"/{path}", body

        def _say(self, status: int, document: dict[str, Any]) -> None:
            self.send_response(status)
            self.end_headers()
            self.wfile.write(json.dumps(document).encode())

        def log_message(self, *_: Any) -> None:
            return

    return _started(ThreadingHTTPServer(("127.0.0.1", 0), Handler))


def serve_probe(outside: Outside) -> ThreadingTCPServer:
    """StandardFirmata, as far as one analog channel goes: each "report this channel" is answered with a conversion."""

    class Handler(BaseRequestHandler):
        def handle(self) -> None:
            while asked := self.request.recv(64):
                for _ in range(asked.count(b"\xc0\x01")):
                    outside_code = code_of(volts_of(outside.ratio))
                    self.request.sendall(bytes((0xE0, outside_code & 0x7F, outside_code >> 7)))

    return _started(ThreadingTCPServer(("127.0.0.1", 0), Handler))


def _started(server: Any) -> Any:
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    return server


class Pot:
    """The example's files, run as they are."""

    def __init__(self, folder: Path, outside: Outside, web: int, probe: int) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.folder, self.outside = folder, outside
        nodes = [Enrolled("plant-5", "plant"), Enrolled("plant-1", "plant")]
        nodes += [Enrolled(name, "robot") for name in outside.costs]
        make_garden(folder / "keys", nodes, 0.0)
        peers = [{"id": name, "kind": "robot", "url": f"http://127.0.0.1:{web}/{name}"} for name in outside.costs]
        (folder / "peers.json").write_text(json.dumps(peers))
        ours = {
            "port": self.port,
            "data": f'"{folder}/plant-5"',
            "keys": f'"{folder}/keys/plant-5"',
            "peers": f'"{folder}/peers.json"',
            "clock": f'"http://127.0.0.1:{web}"',
            "probe": f'"socket://127.0.0.1:{probe}?pin=0"',
        }
        text = (EXAMPLE / "pot.ini").read_text()
        for name, value in ours.items():
            text = re.sub(rf"^{name} = .*", f"{name} = {value}", text, flags=re.MULTILINE)
        (folder / "pot.ini").write_text(text)
        self.environment = {"POT_INI": str(folder / "pot.ini"), "PATH": PATH}
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=5.0)

    def tick(self) -> None:
        done = subprocess.run([str(EXAMPLE / "tick")], env=self.environment, capture_output=True, timeout=20, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stderr == b""

    def token(self, name: str) -> dict[str, str]:
        return {"authorization": "Bearer " + (self.folder / "keys" / name / "token").read_text()}

    def post(self, who: str, path: str, document: dict[str, Any], key: str = "") -> httpx.Response:
        headers = self.token(who) | ({"idempotency-key": key} if key else {})
        return self.http.post(path, json=document, headers=headers)

    def report(self, robot: str, epoch: int, state: str, **more: Any) -> ReportAnswer:
        told = {"robot_id": robot, "epoch": epoch, "state": state, **more}
        return ReportAnswer.model_validate_json(self.post(robot, f"/tasks/{TASK}/reports", told).raise_for_status().content)

    def permit(self, robot: str, epoch: int, key: str, **more: Any) -> httpx.Response:
        wish = {"robot_id": robot, "epoch": epoch, "act": "water", "amount_ml": 150.0, **more}
        return self.post(robot, f"/tasks/{TASK}/permits", wish, key)

    def task(self) -> Task:
        return Task.model_validate_json(self.http.get(f"/tasks/{TASK}").raise_for_status().content)

    def state(self) -> PlantState:
        return PlantState.model_validate_json(self.http.get("/state").raise_for_status().content)


@pytest.fixture
def pot(tmp_path: Path) -> Iterator[Pot]:
    outside = Outside()
    web, probe = serve_http(outside), serve_probe(outside)
    made = Pot(tmp_path, outside, web.server_address[1], probe.server_address[1])
    with (tmp_path / "out").open("wb") as out:
        server = subprocess.Popen([str(EXAMPLE / "run"), "--serve"], env=made.environment, stdout=out, stderr=out)
    try:
        _until_it_answers(made)
        yield made
    finally:
        server.terminate()
        server.wait(10)
        made.http.close()
        for other in (web, probe):
            other.shutdown()
            other.server_close()
        print((tmp_path / "out").read_text())


def _until_it_answers(made: Pot) -> None:
    end_s = time.monotonic() + 20.0
    while time.monotonic() < end_s:
        try:
            made.http.get("/healthz").raise_for_status()
        except httpx.TransportError:
            continue
        return
    raise AssertionError("lighttpd does not answer")


def test_a_dry_pot_asks_awards_permits_once_measures_and_is_done(pot: Pot) -> None:
    outside = pot.outside
    assert pot.http.get("/readyz").status_code == 503
    pot.tick()
    assert pot.http.get("/readyz").json() == {"ready": True}
    assert NodeCard.model_validate_json(pot.http.get("/").content).capabilities == ["water"]
    asked = [Announcement.model_validate(body) for _, _, path, body in outside.heard if path == "/bids"]
    assert [one.task_id for one in asked] == [TASK, TASK]
    robot, _, _, body = outside.heard[-1]
    award = Award.model_validate(body)
    assert (robot, award.epoch, award.announcement.task_id) == ("robot-1", 1, TASK)
    assert award.announcement.plant == pot.state().card

    assert pot.report("robot-1", 1, "running", phase="navigate").keep
    assert not pot.report("robot-2", 1, "running").keep
    assert pot.permit("robot-2", 1, "k").status_code == 409
    dock = {"robot_id": "robot-1", "for_s": 30.0}
    held = Reservation.model_validate_json(pot.post("robot-1", "/dock/reservations", dock).raise_for_status().content)
    refused = pot.post("robot-2", "/dock/reservations", dock | {"robot_id": "robot-2"})
    assert "held by robot-1" in Problem.model_validate_json(refused.content).detail
    first = Permit.model_validate_json(pot.permit("robot-1", 1, "k").raise_for_status().content)
    assert (first.dose_ml, first.valid_for_s) == (150.0, 15.0)
    outside.now_s += 2.0
    again = Permit.model_validate_json(pot.permit("robot-1", 1, "k").raise_for_status().content)
    assert (again.permit_id, again.valid_for_s) == (first.permit_id, 13.0)
    assert "not settled" in Problem.model_validate_json(pot.permit("robot-1", 1, "other").content).detail
    assert pot.state().watered_today_ml == 150.0

    outside.now_s += 20.0
    outside.ratio = 0.25
    assert pot.report("robot-1", 1, "done", delivered_ml=149.0).keep
    gone = pot.http.delete(f"/dock/reservations/{held.reservation_id}", headers=pot.token("robot-1"))
    assert gone.status_code == 204
    pot.tick()
    assert pot.task().state == "running"
    outside.now_s += 61.0
    pot.tick()
    ended = pot.task()
    print("\n".join(event.what for event in ended.events))
    assert (ended.state, ended.epoch, ended.permits, ended.delivered_ml) == ("done", 1, 1, 149.0)
    assert pot.report("robot-1", 1, "done", delivered_ml=149.0).keep
    assert pot.state().watered_today_ml == 149.0
    assert DockState.model_validate(pot.http.get("/dock").json()[0]).holder == ""
    assert [path for _, _, path, _ in outside.heard].count("/tasks") == 1


def test_a_robot_that_falls_silent_loses_the_task_and_the_next_award_has_a_higher_epoch(pot: Pot) -> None:
    outside = pot.outside
    pot.tick()
    outside.now_s += 9.0
    outside.costs["robot-1"] = None
    pot.tick()
    killed = [(robot, path) for robot, method, path, _ in outside.heard if method == "DELETE"]
    assert killed == [("robot-1", f"/tasks/{TASK}?epoch=1")]
    assert (pot.task().robot_id, pot.task().epoch) == ("robot-2", 2)
    late = pot.report("robot-1", 1, "running")
    assert not late.keep
    assert "held by robot-2 under epoch 2" in late.reason
    assert pot.permit("robot-1", 1, "k").status_code == 409

    # It pours, dies, and nobody tells: nothing is permitted until the pot has measured, then the task is done.
    assert pot.permit("robot-2", 2, "k").status_code == 200
    outside.now_s += 30.0
    outside.ratio = 0.25
    pot.tick()
    assert pot.task().state == "running"
    outside.now_s += 15.0 + 150.0 / 5.0 + 5.0 + 60.0 - 30.0
    pot.tick()
    assert (pot.task().state, pot.task().permits) == ("done", 1)


def test_a_silent_probe_is_no_reason_to_water_and_a_dose_that_did_not_arrive_is_asked_for_again(pot: Pot) -> None:
    outside = pot.outside
    outside.ratio = 0.0
    pot.tick()
    assert pot.state().soil.state == "good"  # 0.1 V: bone dry
    for epoch in (1, 2, 3):
        assert pot.report("robot-1", epoch, "running").keep
        assert pot.permit("robot-1", epoch, f"k{epoch}").status_code == 200
        pot.report("robot-1", epoch, "done", delivered_ml=150.0)
        outside.now_s += 76.0
        pot.tick()
    assert pot.task().state == "failed"
    assert "three doses" in pot.task().reason
    tasks = pot.http.get("/tasks").json()
    outside.now_s += 60.0
    pot.tick()
    assert pot.http.get("/tasks").json() == tasks


def test_what_was_answered_survives_kill_9_and_the_state_is_never_unreadable(pot: Pot) -> None:
    """Writers are killed at random moments, most of them while they work; a permit given before is there after each."""
    rng = random.Random(5)
    pot.tick()
    given = Permit.model_validate_json(pot.permit("robot-1", 1, "k").raise_for_status().content)
    state = pot.folder / "plant-5" / "state.json"
    killed = 0
    for i in range(30):
        pot.outside.now_s += 0.1
        look = subprocess.Popen(["php", "-n", "tick.php", "look"], cwd=EXAMPLE, env=pot.environment, stdin=subprocess.PIPE,
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
        assert look.stdin is not None
        look.stdin.write(b"1.2%02d\n" % i)
        look.stdin.close()
        try:
            look.wait(rng.uniform(0.0, 0.06))
        except subprocess.TimeoutExpired:
            look.kill()
            killed += look.wait(10) != 0
        told = json.loads(state.read_text())
        assert told["permit"]["document"]["permit_id"] == given.permit_id
        assert told["task"]["epoch"] == 1
    print(f"{killed} of 30 killed at work")
    assert killed >= 3
    again = Permit.model_validate_json(pot.permit("robot-1", 1, "k").raise_for_status().content)
    assert again.permit_id == given.permit_id
    assert pot.permit("robot-1", 1, "other").status_code == 409


def test_nobody_gets_in_without_a_token_of_this_garden_and_the_right_role(pot: Pot) -> None:
    pot.tick()
    told = {"robot_id": "robot-1", "epoch": 1, "state": "running"}
    path = f"/tasks/{TASK}/reports"
    good = (pot.folder / "keys" / "robot-1" / "token").read_text()
    head, claims, signature = good.split(".")
    stranger = GardenKey.from_seed(4).issue("robot-1", "robot", 0.0).token
    own = GardenKey.load(pot.folder / "keys" / "garden.key")
    old = own.issue("robot-1", "robot", 0.0, life_s=50.0).token
    other = jwt.encode({"sub": "robot-1", "role": "robot", "aud": "garden-0", "iat": 0, "exp": 10**9}, own.key, "EdDSA")
    none = jwt.encode(jwt.decode(good, options={"verify_signature": False}), None, "none")
    bad = [
        stranger,
        old,
        other,
        none,
        f"{head}.{claims}.",
        f"{head}.{claims}",
        f"{claims}.{claims}.{signature}",
        "a.b.c",
    ]
    for token in bad:
        answer = pot.http.post(path, json=told, headers={"authorization": f"Bearer {token}"})
        assert (answer.status_code, Problem.model_validate_json(answer.content).status) == (401, 401), token
    assert pot.http.post(path, json=told).status_code == 401
    for who in ("plant-1", "operator", "viewer"):
        assert pot.post(who, path, told).status_code == 403
    assert pot.post("robot-2", path, told).status_code == 403
    assert pot.post("robot-1", "/tasks", {"kind": "water"}).status_code == 403
    assert pot.http.put("/state", json={}).status_code == 401
    assert pot.post("robot-1", path, told).json()["keep"]


def test_a_document_that_is_not_the_protocols_is_refused_and_changes_nothing(pot: Pot) -> None:
    pot.tick()
    path = f"/tasks/{TASK}/reports"
    before = pot.task()
    good = {"robot_id": "robot-1", "epoch": 1, "state": "running"}
    bodies = {422: ["[]", "{}", '"x"', *({**good, **wrong} for wrong in (
        {"more": 1}, {"epoch": "1"}, {"epoch": True}, {"state": "asleep"}, {"progress": 2}, {"phase": "x" * 501})),
        "NaN", '{"robot_id": NaN}', '{"epoch": [-Infinity]}', json.dumps(good)[:-1] + ', "progress": 1e999}'],
        400: ["", "{", "{}{}", "\xff"], 413: ["[" + "0," * 40000 + "0]"]}  # fmt: skip
    for status, wrong in bodies.items():
        for body in wrong:
            content = body.encode("latin-1") if isinstance(body, str) else json.dumps(body).encode()
            answer = pot.http.post(path, content=content, headers=pot.token("robot-1"))
            assert answer.status_code == status, body
    assert pot.task() == before


def test_the_places_in_pot_ini_are_the_scenarios() -> None:
    plant = load(EXAMPLE / "garden.toml").plants[-1]
    text = (EXAMPLE / "pot.ini").read_text()
    dock = [float(part) for part in re.findall(r'^dock = "(.*)"', text, re.MULTILINE)[0].split()]
    assert plant.external
    assert (plant.id, plant.dock.x_m, plant.dock.y_m) == ("plant-5", dock[0], dock[1])
    assert abs(plant.dock.yaw_rad - dock[2]) < 1e-9
    for key in ("threshold_ratio", "target_ratio", "dose_ml"):
        assert float(re.findall(rf"^{key} = (\S+)", text, re.MULTILINE)[0]) == getattr(plant, key)
