"""A recording is read back with the format's own reader, every message held against the schema it came with."""

from __future__ import annotations

import asyncio
import base64
import builtins
import io
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import httpx
import jsonschema
import pytest
from mcap.reader import make_reader

from console.ask import Line
from console.record import FOXGLOVE, Every, Recorder, Tape, record
from core.clock import VirtualClock
from core.errors import BadRequest, ConfigError
from core.mesh.client import HttpxTransport, Mesh
from core.mesh.peers import Peer, Peers
from core.virtual import run_virtual
from core.wire.documents import HistoryEntry
from core.wire.geometry import Point3, Pose2
from core.wire.market import PlantCard, Task
from core.wire.plant import PlantState, Settings, SoilReading
from core.wire.robot import Position, RobotState

JPEG = b"\xff\xd8\xff\xe0 a picture \xff\xd9"
PEERS = [
    Peer(id="plant-1", kind="plant", url="http://plant-1"),
    Peer(id="robot-1", kind="robot", url="http://robot-1"),
    Peer(id="robot-2", kind="robot", url="http://robot-2"),
    Peer(id="sim", kind="sim", url="http://sim"),
]


class Cardboard:
    """A pot whose task moves on, a robot that drives along x and whose events begin anew, a world; robot-2 is dead."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.born_s = 0.0

    def entries(self, node: str, since: int) -> list[HistoryEntry]:
        count = int(self.clock.now() - self.born_s) + 1
        made = [HistoryEntry(id=i, t_s=self.born_s + i, kind="x", what=f"{node} {i}") for i in range(1, count + 1)]
        return [entry for entry in made if entry.id > since]

    def answer(self, url: httpx.URL) -> Any:
        now_s = self.clock.now()
        point, pose = Point3(x_m=0.0, y_m=0.0, z_m=0.2), Pose2(x_m=0.1 * now_s, y_m=1.0, yaw_rad=0.5)
        match url.host, url.path:
            case _, "/history":
                return self.entries(url.host, int(url.params.get("since", 0)))
            case "plant-1", "/state":
                card = PlantCard(plant_id="plant-1", url="http://x", stem=point, dock=pose, nozzle=point)
                soil = SoilReading(state="good", ratio=0.2, age_s=0.1)
                return PlantState(plant_id="plant-1", now_s=now_s, soil=soil, thirsty=True, settings=Settings(), card=card)
            case "plant-1", "/tasks":
                state = "running" if now_s > 2.5 else "announced"
                times = {"created_s": 0.0, "updated_s": 3.0 if now_s > 2.5 else 0.0}
                return [Task(task_id="plant-1:1:1", kind="water", state=state, plant_id="plant-1", **times)]
            case "robot-1", "/state":
                return RobotState(robot_id="robot-1", now_s=now_s, pose=pose, battery_ratio=0.9, tank_ml=1.0, stopped=False)
            case "robot-1", "/position":
                return Position(robot_id="robot-1", pose=pose, radius_m=0.17, v_mps=0.1, moving=True)
        return None


class Street(httpx.AsyncBaseTransport):
    def __init__(self, there: Cardboard) -> None:
        self.there = there

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        await self.there.clock.sleep(0.001)
        if request.url.host == "robot-2":
            raise httpx.ConnectError("refused")
        if request.url.path.endswith(".jpg"):
            return httpx.Response(200, content=JPEG)
        told = self.there.answer(request.url)
        listed = told if isinstance(told, list) else [told]
        text = ",".join(one.model_dump_json() for one in listed)
        return httpx.Response(200, text=f"[{text}]" if isinstance(told, list) else text)


def read(data: bytes) -> tuple[dict[str, list[tuple[float, Any]]], dict[str, str]]:
    """Messages by topic, with their time [s], each checked against its schema; and the schema's name by topic."""
    messages, schemas = defaultdict(list), {}
    for schema, channel, message in make_reader(io.BytesIO(data)).iter_messages():
        assert schema is not None
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        document = json.loads(message.data)
        jsonschema.validate(document, json.loads(schema.data))
        messages[channel.topic].append((message.log_time / 1e9, document))
        schemas[channel.topic] = schema.name
    return messages, schemas


def recorded(seconds: float) -> bytes:
    async def run() -> bytes:
        clock = VirtualClock()
        there = Cardboard(clock)
        stream = io.BytesIO()
        tape = Tape(stream)
        line = Line(Mesh(HttpxTransport(Street(there)), None, clock), Peers(PEERS), clock)
        running = asyncio.create_task(Recorder(line, clock, tape, Every()).run())
        await clock.sleep(seconds / 2)
        there.born_s = clock.now()  # the nodes start anew: their ids begin at 1
        await clock.sleep(seconds / 2)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        tape.finish()
        return stream.getvalue()

    return run_virtual(run())


def test_a_recording_holds_states_tasks_events_positions_and_pictures_under_their_schemas() -> None:
    messages, schemas = read(recorded(10.0))
    assert schemas == {
        "/log": "foxglove.Log",
        "/overview": "foxglove.CompressedImage",
        "/plant-1/events": "garden.HistoryEntry",
        "/plant-1/state": "garden.PlantState",
        "/plant-1/tasks": "garden.Task",
        "/robot-1/camera": "foxglove.CompressedImage",
        "/robot-1/events": "garden.HistoryEntry",
        "/robot-1/pose": "foxglove.PoseInFrame",
        "/robot-1/position": "garden.Position",
        "/robot-1/state": "garden.RobotState",
        "/tf": "foxglove.FrameTransform",
    }
    assert len(messages["/robot-1/state"]) in (9, 10)
    assert len(messages["/robot-1/pose"]) >= 45
    for t_s, pose in messages["/robot-1/pose"]:
        assert pose["frame_id"] == "world"
        assert abs(pose["pose"]["position"]["x"] - 0.1 * t_s) < 0.01
        assert abs(pose["timestamp"]["sec"] + pose["timestamp"]["nsec"] / 1e9 - t_s) < 1e-9
        turn = pose["pose"]["orientation"]
        assert abs(turn["z"] ** 2 + turn["w"] ** 2 - 1.0) < 1e-12
    assert [task["state"] for _, task in messages["/plant-1/tasks"]] == ["announced", "running"]
    assert base64.b64decode(messages["/robot-1/camera"][0][1]["data"]) == JPEG


def test_no_event_is_written_twice_or_left_out_even_when_a_nodes_ids_begin_anew() -> None:
    messages, _ = read(recorded(10.0))
    ids = [event["id"] for _, event in messages["/robot-1/events"]]
    anew = ids.index(1, 1)
    assert ids[:anew] == list(range(1, anew + 1))
    assert ids[anew:] == list(range(1, len(ids) - anew + 1))
    assert len(messages["/log"]) == len(ids) + len(messages["/plant-1/events"])


def test_every_schema_of_foxgloves_is_one_and_names_its_time() -> None:
    for schema in FOXGLOVE.values():
        jsonschema.Draft202012Validator.check_schema(schema)
        assert set(schema["properties"]["timestamp"]["properties"]) == {"sec", "nsec"}


def test_without_the_package_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def missing(name: str, *rest: Any, **more: Any) -> Any:
        if name.startswith("mcap"):
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ConfigError, match="mcap") as refused:
        Tape(io.BytesIO())
    assert "robot-garden[record]" in refused.value.hint


def test_a_file_that_is_no_recording_is_refused_and_an_empty_garden_gives_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(BadRequest, match=r"no \.mcap"):
        record(tmp_path / "run.bag", 0.1, Every(), tmp_path, True)
    monkeypatch.setenv("GARDEN_PEERS", "[]")
    record(tmp_path / "run.mcap", 0.1, Every(), tmp_path, True)
    assert json.loads(capsys.readouterr().out)["messages"] == {}
    assert read((tmp_path / "run.mcap").read_bytes()) == ({}, {})
