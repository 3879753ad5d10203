"""`garden record`: a run as an MCAP file, for Foxglove and whatever else reads the format.

Every channel is JSON with its JSON Schema: the services' own documents, and Foxglove's well-known ones for what its panels
draw (poses, transforms, log lines, pictures). The file's time is the garden's.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import math
import signal
import ssl
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from pydantic import BaseModel, TypeAdapter

from console.ask import Line, open_line
from console.folder import Folder
from core.clock import Clock, WallClock, WorldClock
from core.errors import BadRequest, ConfigError, GardenError
from core.mesh import worldclock
from core.mesh.peers import Peer, PeerKind
from core.wire.documents import HistoryEntry
from core.wire.market import Task
from core.wire.plant import PlantState, StationState
from core.wire.robot import Position, RobotState

if TYPE_CHECKING:
    from mcap.writer import Writer

CHUNK_BYTES = 256 * 1024
"""What a crash may lose at the end."""
STATES: dict[PeerKind, Any] = {"plant": PlantState, "robot": RobotState, "station": StationState}
ALARMS = frozenset({"alarm", "failed", "stop", "lost"})
FIRST_TIME_S = 5.0


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_TIME = _object(sec={"type": "integer"}, nsec={"type": "integer"})
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_TURN = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_BYTES = {"type": "string", "contentEncoding": "base64"}
FOXGLOVE = {
    "foxglove.CompressedImage": _object(timestamp=_TIME, frame_id=_TEXT, data=_BYTES, format=_TEXT),
    "foxglove.PoseInFrame": _object(timestamp=_TIME, frame_id=_TEXT, pose=_object(position=_VECTOR, orientation=_TURN)),
    "foxglove.FrameTransform": _object(
        timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_TURN
    ),
    "foxglove.Log": _object(timestamp=_TIME, level={"type": "integer"}, message=_TEXT, name=_TEXT, file=_TEXT, line=_NUMBER),
}
"""The parts that are used of Foxglove's schemas, by their well-known names."""


@dataclass(frozen=True, slots=True)
class Every:
    """How often things are asked for [s of the machine]; 0: never."""

    state_s: float = 1.0
    position_s: float = 0.2
    camera_s: float = 2.0


class Tape:
    """An MCAP file being written; a channel is made when its first message comes."""

    def __init__(self, stream: IO[bytes]) -> None:
        """Raises ConfigError when the extra is not installed."""
        try:
            from mcap.writer import Writer
        except ImportError:
            raise ConfigError(
                "recording needs the package mcap", hint="pip install 'robot-garden[record]', or uv sync --extra record"
            ) from None
        self._writer: Writer = Writer(stream, chunk_size=CHUNK_BYTES)
        self._writer.start(library="robot-garden")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.counts: Counter[str] = Counter()
        """Messages by topic."""

    def write(self, topic: str, schema: str, definition: Mapping[str, Any], t_s: float, document: Any) -> None:
        """One message at garden time `t_s`."""
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(schema, "jsonschema", json.dumps(definition).encode())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[schema])
        t_ns = max(0, round(t_s * 1e9))
        data = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], t_ns, data, t_ns, self.counts[topic])
        self.counts[topic] += 1

    def put(self, topic: str, t_s: float, document: BaseModel) -> None:
        """A document of ours, under its own schema."""
        model = type(document)
        self.write(topic, f"garden.{model.__name__}", _schema(model), t_s, document.model_dump(mode="json"))

    def show(self, topic: str, schema: str, t_s: float, **fields: Any) -> None:
        """One of Foxglove's."""
        self.write(topic, schema, FOXGLOVE[schema], t_s, {"timestamp": _timestamp(t_s), **fields})

    def finish(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call, unused-ignore]


def _schema(model: type[BaseModel]) -> dict[str, Any]:
    return TypeAdapter(model).json_schema(mode="serialization")


def _timestamp(t_s: float) -> dict[str, int]:
    sec, rest = divmod(max(0, round(t_s * 1e9)), 10**9)
    return {"sec": sec, "nsec": rest}


@dataclass(slots=True)
class Recorder:
    """Asks everybody, each thing at its own pace, and writes the answers down."""

    line: Line
    clock: Clock
    """The garden's."""
    tape: Tape
    every: Every
    _heard: dict[str, int] = field(default_factory=dict)
    """The newest event of each node's history that is written."""
    _tasks: dict[str, Task] = field(default_factory=dict)

    async def run(self) -> None:
        """For ever."""
        async with asyncio.TaskGroup() as group:
            for kind in STATES:
                for peer in self.line.peers.of_kind(kind):
                    group.create_task(self._repeat(self.every.state_s, self._state, peer))
            for robot in self.line.peers.of_kind("robot"):
                group.create_task(self._repeat(self.every.position_s, self._position, robot))
                group.create_task(self._repeat(self.every.camera_s, self._camera, robot))
            for sim in self.line.peers.of_kind("sim"):
                group.create_task(self._repeat(self.every.camera_s, self._overview, sim))

    async def _repeat(self, every_s: float, ask: Callable[[Peer], Awaitable[None]], peer: Peer) -> None:
        if every_s <= 0:
            return
        while True:
            with contextlib.suppress(GardenError):  # whoever is silent has nothing to write down
                await ask(peer)
            await asyncio.sleep(every_s)

    async def _state(self, peer: Peer) -> None:
        """Its state, what it noted since last asked, and of a plant the tasks that have changed."""
        state: PlantState | RobotState | StationState
        state = await self.line.mesh.call(peer, "GET", "/state", expect=STATES[peer.kind])
        self.tape.put(f"/{peer.id}/state", state.now_s, state)
        if peer.kind == "plant":
            for task in await self.line.mesh.call(peer, "GET", "/tasks", expect=list[Task]):
                if self._tasks.get(task.task_id) != task:
                    self._tasks[task.task_id] = task
                    self.tape.put(f"/{peer.id}/tasks", task.updated_s, task)
        await self._events(peer)

    async def _events(self, peer: Peer) -> None:
        """One overlaps, so that a node whose ids began anew is noticed."""
        heard = self._heard.get(peer.id, 0)
        path = f"/history?since={max(0, heard - 1)}"
        entries = await self.line.mesh.call(peer, "GET", path, expect=list[HistoryEntry])
        if heard and not entries:
            entries, heard = await self.line.mesh.call(peer, "GET", "/history", expect=list[HistoryEntry]), 0
        for entry in entries:
            if entry.id <= heard:
                continue
            self._heard[peer.id] = entry.id
            self.tape.put(f"/{peer.id}/events", entry.t_s, entry)
            level = 3 if entry.kind in ALARMS else 2
            source = {"name": peer.id, "file": entry.kind, "line": entry.id}
            self.tape.show("/log", "foxglove.Log", entry.t_s, level=level, message=entry.what, **source)

    async def _position(self, robot: Peer) -> None:
        said = await self.line.mesh.call(robot, "GET", "/position", expect=Position)
        t_s, pose = self.clock.now(), said.pose
        place = {"x": pose.x_m, "y": pose.y_m, "z": 0.0}
        turn = {"x": 0.0, "y": 0.0, "z": math.sin(pose.yaw_rad / 2), "w": math.cos(pose.yaw_rad / 2)}
        self.tape.put(f"/{robot.id}/position", t_s, said)
        shown = {"position": place, "orientation": turn}
        self.tape.show(f"/{robot.id}/pose", "foxglove.PoseInFrame", t_s, frame_id="world", pose=shown)
        frames = {"parent_frame_id": "world", "child_frame_id": robot.id, "translation": place, "rotation": turn}
        self.tape.show("/tf", "foxglove.FrameTransform", t_s, **frames)

    async def _camera(self, robot: Peer) -> None:
        await self._picture(robot, "/camera.jpg", f"/{robot.id}/camera", f"{robot.id}/camera")

    async def _overview(self, sim: Peer) -> None:
        await self._picture(sim, "/overview.jpg", "/overview", "overview")

    async def _picture(self, peer: Peer, path: str, topic: str, frame_id: str) -> None:
        answer = await self.line.mesh.exchange(peer, "GET", path, timeout_s=10.0)
        if answer.status != 200:
            return
        data = base64.b64encode(answer.body).decode()
        self.tape.show(topic, "foxglove.CompressedImage", self.clock.now(), frame_id=frame_id, data=data, format="jpeg")


@contextlib.asynccontextmanager
async def garden_time(line: Line, tls: ssl.SSLContext | None = None) -> AsyncIterator[Clock]:
    """A simulated garden's clock, or the wall's where there is no world."""
    worlds = line.peers.of_kind("sim")
    if not worlds:
        yield WallClock()
        return
    clock = WorldClock()
    following = asyncio.create_task(worldclock.follow(clock, worlds[0].url, tls=tls))
    try:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FIRST_TIME_S):
                while clock.now() == 0.0:  # noqa: ASYNC110 (the clock has no event for its first word)
                    await asyncio.sleep(0.02)
        yield clock
    finally:
        following.cancel()


def record(path: Path, for_s: float | None, every: Every, data: Path, as_json: bool) -> None:
    """Write the garden's run to `path` until Ctrl-C, or for so many seconds of the machine."""
    if path.suffix != ".mcap":
        raise BadRequest(f"{path} is no .mcap file", hint="name it run.mcap, say")
    try:
        stream = path.open("wb")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
    with stream:
        tape = Tape(stream)
        try:
            asyncio.run(_record(tape, for_s, every, data))
        finally:
            tape.finish()
    told = {"file": str(path), "bytes": path.stat().st_size, "messages": dict(sorted(tape.counts.items()))}
    if as_json:
        print(json.dumps(told))
        return
    for topic, count in sorted(tape.counts.items()):
        print(f"{count:7d}  {topic}")
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB; Foxglove opens it")


async def _record(tape: Tape, for_s: float | None, every: Every, data: Path) -> None:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    async with open_line(data) as line, garden_time(line, Folder(data).trusted()) as clock:
        running = asyncio.create_task(Recorder(line, clock, tape, every).run())
        waiting = asyncio.create_task(ended.wait())
        try:
            await asyncio.wait({running, waiting}, timeout=for_s, return_when=asyncio.FIRST_COMPLETED)
            if running.done():
                running.result()
        finally:
            for task in (running, waiting):
                task.cancel()
            await asyncio.gather(running, waiting, return_exceptions=True)
