"""The commands that ask services, against pots and robots of cardboard."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from typer.testing import CliRunner, Result

from console import cli
from console import folder as folder_module
from console.folder import Folder
from console.service import build
from console.snapshot import Snapshot
from core import scenario as scenarios
from core.clock import WallClock
from core.errors import GardenError, NotFound, Refused
from core.mesh.auth import Caller, Identity, Verifier
from core.mesh.chassis import allow, body, create_app
from core.mesh.client import HttpxTransport
from core.mesh.describe import unguarded
from core.mesh.peers import Peers
from core.mesh.runtime import GardenSettings, Runtime
from core.wire.documents import NodeCard
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, BidRound, Breakdown, PlantCard, Task, TaskEvent, TaskRequest
from core.wire.plant import PlantState, Settings, SoilReading
from core.wire.robot import Job, JobRequest, ResumeRequest, RobotState, Stopped, StopRequest

ORIGIN = Point3(x_m=0.0, y_m=0.0, z_m=0.0)
POSE = Pose2(x_m=0.5, y_m=-0.25, yaw_rad=0.0)
LOSER = Bid(task_id="plant-1:1:1", robot_id="robot-1", cost_s=None, reason="no water")
WINNER = Bid(task_id="plant-1:1:1", robot_id="robot-2", cost_s=42.0, breakdown=Breakdown(travel_s=12.0, work_s=30.0))
TASK = Task(
    task_id="plant-1:1:1",
    kind="water",
    state="running",
    plant_id="plant-1",
    robot_id="robot-2",
    epoch=1,
    created_s=10.0,
    updated_s=12.0,
    asked_by="soil",
    why="water content 0.150 is below 0.200",
    dose_ml=150.0,
    rounds=[BidRound(t_s=12.0, epoch=1, bids=[LOSER, WINNER], winner="robot-2", why="cheapest of 1: 42.0 s")],
    events=[TaskEvent(t_s=12.0, what="awarded", robot_id="robot-2", epoch=1)],
)


def pot(name: str, verifier: Verifier) -> FastAPI:
    app = app_of(name, "plant", verifier)
    card = PlantCard(plant_id=name, url="http://x", stem=ORIGIN, dock=POSE, nozzle=ORIGIN)
    soil = SoilReading(state="good", ratio=0.151, age_s=1.0)
    state = PlantState(plant_id=name, now_s=12.0, soil=soil, thirsty=True, settings=Settings(), card=card)
    app.state.listed = listed = [TASK] if name == "plant-1" else []

    @app.get("/state")
    async def told() -> PlantState:
        return state

    @app.get("/tasks")
    async def tasks() -> list[Task]:
        return listed

    @app.get("/tasks/{task_id}")
    async def task(task_id: str) -> Task:
        if not any(one.task_id == task_id for one in listed):
            raise NotFound("no such task")
        return TASK

    @app.delete("/tasks/{task_id}")
    async def cancel(task_id: str, caller: Caller = allow("operator")) -> Task:
        for i, one in enumerate(listed):
            if one.task_id == task_id:
                listed[i] = one.model_copy(update={"state": "cancelled", "reason": f"cancelled by {caller.subject}"})
                return listed[i]
        raise NotFound("no such task")

    @app.post("/tasks", status_code=201)
    async def water(request: TaskRequest = body(TaskRequest), caller: Caller = allow("operator")) -> Task:
        wanted = {"dose_ml": request.dose_ml or 150.0, "priority": request.priority}
        deadline_s = None if request.within_s is None else TASK.created_s + request.within_s
        return TASK.model_copy(update={"asked_by": caller.subject, "plant_id": name, "deadline_s": deadline_s} | wanted)

    return app


def robot(name: str, verifier: Verifier) -> FastAPI:
    app = app_of(name, "robot", verifier)
    app.state.stopped, app.state.stop_number, app.state.job = False, 0, None

    @app.get("/state")
    async def told() -> RobotState:
        stopped, number = app.state.stopped, app.state.stop_number
        return RobotState(
            robot_id=name, now_s=1.0, pose=POSE, battery_ratio=0.9, tank_ml=1000.0, stopped=stopped,
            stop_number=number if stopped else 0,
        )  # fmt: skip

    @app.post("/stop")
    async def stop(request: StopRequest = body(StopRequest), caller: Caller = allow("operator", "viewer")) -> Stopped:
        app.state.stopped = True
        app.state.stop_number += 1
        return Stopped(robot_id=name, stopped=True, by=caller.subject, stop_number=app.state.stop_number)

    @app.post("/resume")
    async def resume(request: ResumeRequest = body(ResumeRequest), caller: Caller = allow("operator")) -> Stopped:
        if request.stop_number != app.state.stop_number:
            raise Refused(f"stop {app.state.stop_number} is latched")
        app.state.stopped = False
        return Stopped(robot_id=name, stopped=False)

    @app.post("/jobs", status_code=202)
    async def job(request: JobRequest = body(JobRequest), caller: Caller = allow("operator")) -> Job:
        app.state.job = request
        return Job(job_id="job-1", kind=request.kind, state="queued")

    @app.get("/jobs/{job_id}")
    async def watch(job_id: str) -> Job:
        return Job(job_id=job_id, kind="goto", state="failed", reason="a pot stands there")

    return app


def app_of(name: str, kind: str, verifier: Verifier) -> FastAPI:
    card = NodeCard(id=name, kind=kind)
    return create_app(card=lambda: card, clock=WallClock(), verifier=verifier, ready=lambda: [])


class Street(httpx.AsyncBaseTransport):
    """Apps by their port; nobody lives elsewhere."""

    def __init__(self, apps: dict[int, FastAPI]) -> None:
        self.apps = apps

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        app = self.apps.get(request.url.port or 80)
        if app is None:
            raise httpx.ConnectError("refused")
        return await httpx.ASGITransport(app).handle_async_request(request)


@pytest.fixture
def street(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Street:
    """The default garden's pots and robots, without world, station and console."""
    for name in ("GARDEN_TOKEN", "GARDEN_PEERS", "GARDEN_DATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    garden = scenarios.find("garden")
    folder = Folder(tmp_path)
    folder.enrol(garden)
    folder.remember(garden)
    verifier = Verifier.load(folder.keys)
    apps = {peer.url: pot(peer.id, verifier) for peer in folder.peers() if peer.kind == "plant"}
    apps |= {peer.url: robot(peer.id, verifier) for peer in folder.peers() if peer.kind == "robot"}
    there = Street({int(url.rpartition(":")[2]): app for url, app in apps.items()})
    monkeypatch.setattr(folder_module, "HttpTransport", lambda: HttpxTransport(there))
    return there


def garden(folder: Path, *words: str) -> Result:
    return CliRunner().invoke(cli.app, [*words, "--data", str(folder)])


def asked(folder: Path, *words: str) -> Any:
    result = garden(folder, *words, "--json")
    assert result.exit_code == 0, (result.output, result.exception)
    return json.loads(result.stdout)


def refused(folder: Path, *words: str) -> GardenError:
    result = garden(folder, *words)
    assert isinstance(result.exception, GardenError), result
    return result.exception


def test_pots_and_robots_are_listed(street: Street, tmp_path: Path) -> None:
    assert [one["plant_id"] for one in asked(tmp_path, "plants")] == ["plant-1", "plant-2", "plant-3", "plant-4"]
    assert [one["robot_id"] for one in asked(tmp_path, "robots")] == ["robot-1", "robot-2"]
    assert "0.151" in garden(tmp_path, "plants").stdout
    assert "+0.50 -0.25" in garden(tmp_path, "robots").stdout


def test_tasks_are_a_list_with_the_promised_fields(street: Street, tmp_path: Path) -> None:
    listed = asked(tmp_path, "tasks")
    assert [{key: task[key] for key in ("task_id", "kind", "state", "plant_id", "robot_id")} for task in listed] == [
        {"task_id": "plant-1:1:1", "kind": "water", "state": "running", "plant_id": "plant-1", "robot_id": "robot-2"}
    ]


def test_a_tasks_story_tells_who_bid_what_who_won_and_why(street: Street, tmp_path: Path) -> None:
    told = garden(tmp_path, "tasks", "plant-1:1:1").stdout
    for part in ("robot-2 won", "cheapest of 1", "42.0", "robot-1", "no water", "awarded", "is below 0.200"):
        assert part in told
    assert asked(tmp_path, "tasks", "plant-1:1:1")["rounds"][0]["winner"] == "robot-2"
    assert "garden tasks" in refused(tmp_path, "tasks", "plant-9:9:9").hint


def test_a_tasks_story_can_be_drawn_and_read_by_programs(street: Street, tmp_path: Path) -> None:
    drawn = garden(tmp_path, "tasks", "plant-1:1:1", "--diagram").stdout
    assert all(word in drawn for word in ("robot-1", "plant-1", "robot-2", "->|"))
    assert asked(tmp_path, "tasks", "plant-1:1:1")["story"][0].keys() == {"t_s", "source", "target", "what"}
    garden(tmp_path, "tasks", "plant-1:1:1", "--out", str(tmp_path / "story.svg"))
    assert (tmp_path / "story.svg").read_text().startswith("<svg")
    assert "ID --diagram" in refused(tmp_path, "tasks", "--diagram").hint


def test_status_tells_who_is_silent(street: Street, tmp_path: Path) -> None:
    told = asked(tmp_path, "status")
    assert (len(told["plants"]), len(told["robots"])) == (4, 2)
    assert [one["id"] for one in told["silent"]] == ["station"]
    assert "No answer" in garden(tmp_path, "status").stdout


def test_water_is_asked_for_with_the_operators_token(street: Street, tmp_path: Path) -> None:
    task = asked(tmp_path, "water", "plant-3", "--ml", "80")
    assert (task["plant_id"], task["dose_ml"], task["asked_by"]) == ("plant-3", 80.0, "operator")
    assert "plant-1, plant-2" in refused(tmp_path, "water", "plant-9").hint
    assert "dose_ml" in str(refused(tmp_path, "water", "plant-3", "--ml", "9000"))
    soon = asked(tmp_path, "water", "plant-2", "--within", "600", "--priority", "9")
    assert (soon["deadline_s"] - soon["created_s"], soon["priority"]) == (600.0, 9)
    assert "within_s" in str(refused(tmp_path, "water", "plant-1", "--within", "0"))


def test_a_task_or_an_order_is_called_off_by_its_id(street: Street, tmp_path: Path) -> None:
    ended = asked(tmp_path, "cancel", "plant-1:1:1")
    assert (ended["state"], ended["reason"]) == ("cancelled", "cancelled by operator")
    harvest = TASK.model_copy(update={"kind": "harvest", "order_id": "o7", "count": 2})
    for number, name in enumerate(("plant-2", "plant-3")):
        url = next(peer.url for peer in Folder(tmp_path).peers() if peer.id == name)
        pot_app = street.apps[int(url.rpartition(":")[2])]
        pot_app.state.listed.append(harvest.model_copy(update={"task_id": f"{name}:1:{number}", "plant_id": name}))
    for _ in range(2):
        order = asked(tmp_path, "cancel", "o7")
        assert (order["state"], [part["state"] for part in order["parts"]]) == ("cancelled", ["cancelled"] * 2)
    assert "nobody knows" in str(refused(tmp_path, "cancel", "o8"))


def test_stop_stops_all_and_resume_needs_the_operator(street: Street, tmp_path: Path) -> None:
    assert [one["stopped"] for one in asked(tmp_path, "stop")] == [True, True]
    assert "STOPPED" in garden(tmp_path, "robots").stdout
    assert [one["robot_id"] for one in asked(tmp_path, "resume", "robot-2")] == ["robot-2"]
    assert [one["stopped"] for one in asked(tmp_path, "robots")] == [True, False]
    assert [one["robot_id"] for one in asked(tmp_path, "resume")] == ["robot-1", "robot-2"]
    assert [one["stopped"] for one in asked(tmp_path, "robots")] == [False, False]


def test_resume_releases_the_stop_that_is_named(street: Street, tmp_path: Path) -> None:
    for _ in range(2):
        asked(tmp_path, "stop", "robot-1")
    assert "(stop 2)" in garden(tmp_path, "stop", "robot-2").stdout.replace("(stop 1)", "(stop 2)")
    assert "stop 2 is latched" in str(refused(tmp_path, "resume", "robot-1", "--stop", "1"))
    assert "ROBOT --stop" in refused(tmp_path, "resume", "--stop", "2").hint
    assert street.apps[8201].state.stopped
    assert [one["stopped"] for one in asked(tmp_path, "resume", "robot-1", "--stop", "2")] == [False]


def test_stop_reaches_the_others_when_one_does_not_answer(street: Street, tmp_path: Path) -> None:
    dead = street.apps.pop(8201)
    result = garden(tmp_path, "stop")
    assert isinstance(result.exception, GardenError)
    assert "robot-1 did NOT stop" in result.stderr
    assert street.apps[8202].state.stopped is True
    assert dead.state.stopped is False


def test_goto_takes_degrees_and_negative_places(street: Street, tmp_path: Path) -> None:
    job = asked(tmp_path, "goto", "robot-1", "-0.5", "0.25", "-90")
    assert job["state"] == "queued"
    sent = street.apps[8201].state.job
    assert (sent.x_m, sent.y_m, round(sent.yaw_rad, 3)) == (-0.5, 0.25, -1.571)
    assert asked(tmp_path, "dock", "robot-2", "station/tap")["kind"] == "dock"
    assert street.apps[8202].state.job.at == "station/tap"


def test_a_job_waited_for_that_fails_is_a_failure(street: Street, tmp_path: Path) -> None:
    result = garden(tmp_path, "goto", "robot-1", "0", "0", "--wait")
    assert result.exit_code == 1
    assert "a pot stands there" in result.stdout


def test_a_garden_that_does_not_run_is_said_in_one_line(street: Street, tmp_path: Path) -> None:
    street.apps.clear()
    for command in ("plants", "robots", "tasks", "status"):
        assert "make up" in refused(tmp_path, command).hint


def test_the_token_is_the_operators(street: Street, tmp_path: Path) -> None:
    token = garden(tmp_path, "token").stdout.strip()
    assert Verifier.load(tmp_path / "keys").verify(token, 0.0).role == "operator"
    assert asked(tmp_path, "token", "--role", "viewer")["role"] == "viewer"
    assert "garden init" in refused(tmp_path / "nowhere", "token").hint


@pytest.fixture
def console(street: Street, tmp_path: Path) -> httpx.AsyncClient:
    """The console's own service before the same street."""
    folder = Folder(tmp_path)
    keys = folder.keys / "console"
    identity, verifier, peers = Identity.load(keys), Verifier.load(keys), Peers(folder.peers())
    runtime = Runtime(GardenSettings(), WallClock(), (), identity, verifier, peers, HttpxTransport(street))
    app = asyncio.run(build(runtime)).app
    assert unguarded(app) == []
    return httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://console")


def test_the_console_shows_and_stops_with_the_callers_own_token(console: httpx.AsyncClient, tmp_path: Path) -> None:
    def bearer(role: str) -> dict[str, str]:
        return {"authorization": f"Bearer {Folder(tmp_path).identity(role).token}"}

    async def story() -> None:
        async with console:
            page = await console.get("/", headers={"accept": "text/html"})
            assert "STOP" in page.text
            assert "http:" not in page.text
            assert "https:" not in page.text
            assert (await console.get("/")).json()["id"] == "console"
            seen = Snapshot.model_validate_json((await console.get("/api/garden")).content)
            assert len(seen.plants) == 4
            assert (await console.post("/api/stop", json={})).status_code == 401
            stopped = await console.post("/api/stop", json={"reason": "test"}, headers=bearer("viewer"))
            assert [one["by"] for one in stopped.json()["robots"]] == ["viewer", "viewer"]
            shown = [{"robot_id": one["robot_id"], "stop_number": one["stop_number"]} for one in stopped.json()["robots"]]
            release = {"stops": shown}
            assert (await console.post("/api/resume", json=release, headers=bearer("viewer"))).status_code == 403
            nameless = await console.post("/api/resume", headers=bearer("operator"))
            assert (nameless.status_code, "stop_number" in nameless.json()["hint"]) == (422, True)
            await console.post("/api/stop", json={}, headers=bearer("viewer"))
            late = (await console.post("/api/resume", json=release, headers=bearer("operator"))).json()
            assert late["errors"] == dict.fromkeys(("robot-1", "robot-2"), "stop 2 is latched")
            again = {"stops": [{"robot_id": name, "stop_number": 2} for name in ("robot-1", "robot-2", "robot-9")]}
            done = (await console.post("/api/resume", json=again, headers=bearer("operator"))).json()
            assert [one["stopped"] for one in done["robots"]] == [False, False]
            assert list(done["errors"]) == ["robot-9"]
            task = await console.post("/api/plants/plant-2/water", json={"kind": "water"}, headers=bearer("operator"))
            assert (task.json()["plant_id"], task.json()["asked_by"]) == ("plant-2", "operator")
            assert (await console.get("/overview.jpg")).status_code == 502

    asyncio.run(story())


def test_the_console_calls_an_order_off_with_the_callers_own_token(
    console: httpx.AsyncClient, street: Street, tmp_path: Path
) -> None:
    url = next(peer.url for peer in Folder(tmp_path).peers() if peer.id == "plant-2")
    more = {"kind": "harvest", "order_id": "o7", "task_id": "plant-2:1:1", "plant_id": "plant-2", "count": 2}
    street.apps[int(url.rpartition(":")[2])].state.listed.append(TASK.model_copy(update=more))
    operator, viewer = (
        {"authorization": f"Bearer {Folder(tmp_path).identity(role).token}"} for role in ("operator", "viewer")
    )

    async def story() -> None:
        async with console:
            assert (await console.delete("/orders/o7", headers=viewer)).status_code == 403
            assert (await console.get("/orders/o7")).json()["state"] == "running"
            for _ in range(2):
                ended = (await console.delete("/orders/o7", headers=operator)).json()
                assert (ended["state"], ended["parts"][0]["reason"]) == ("cancelled", "cancelled by operator")
            assert (await console.delete("/orders/o8", headers=operator)).status_code == 404

    asyncio.run(story())
