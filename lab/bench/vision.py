"""`garden bench vision`: how soon a robot answers bids, and how evenly its body turns, while it scans and picks.

Real processes on loopback, at the speed of life: the world, a pot, one robot's brain and its body. The stream between brain
and body runs through us: the body tells its state at every turn of its control loop, so that what arrives tells its turns
(and our own delay with them). A client asks for bids all the while. What counts is the time in which the robot acts at the
plant's dock: pictures, detection, fusing, ways of the hand, servo.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from console import toml
from console.folder import Folder
from console.ports import on_free_ports
from console.processes import Process, World, processes
from console.runner import Runner
from core.clock import WallClock
from core.errors import ConfigError, GardenError
from core.mesh.chassis import Readiness
from core.mesh.client import Mesh
from core.mesh.http import HttpTransport
from core.mesh.peers import Peer
from core.wire.body import BodyState, LineBuffer, decode
from core.wire.market import Announcement, Bid, Task, TaskRequest
from core.wire.plant import PlantState
from core.wire.robot import RobotState
from lab.days import garden_of

SPEED = 1.0
SECONDS_EACH = 10.0
"""Of acting, watched for each of the `n` rounds [s]."""
BIDS_EVERY_S, LOOK_EVERY = 0.02, 10
"""Between a bid's answer and the next question; the robot's state is looked at after so many."""
WITHIN_S = 240.0
ANSWER_S_MAX = 20.0
BID_MS_MAX, JITTER_MS_MAX = 50.0, 20.0
TURN_MS = 20.0
"""50 Hz."""
SEED = 7
ROBOT, PLANT = "robot-1", "plant-1"
READ_BYTES = 65536

Row = dict[str, Any]
T = TypeVar("T")


@dataclass(slots=True)
class Watched:
    """What was measured while the robot acted."""

    bids_ms: list[float] = field(default_factory=list)
    turns_ms: list[float] = field(default_factory=list)
    """Between two states of the body."""
    acted_s: float = 0.0
    jobs: set[str] = field(default_factory=set)
    """Kinds of tasks that the robot acted for."""


def bench_vision(n: int = 5) -> list[Row]:
    """Rows `{name, ours, peer, ratio, unit, n, target, ok}`; `n` times ten seconds of a robot at work are watched."""
    with tempfile.TemporaryDirectory() as folder:
        watched = asyncio.run(_watch(Path(folder), n * SECONDS_EACH))
    jitter_ms = np.abs(np.array(watched.turns_ms) - TURN_MS)
    bid_ms = float(np.percentile(watched.bids_ms, 99))
    rows = [
        _row("bid_p99", bid_ms, len(watched.bids_ms), BID_MS_MAX),
        _row("body_jitter_p99", float(np.percentile(jitter_ms, 99)), len(jitter_ms), JITTER_MS_MAX),
    ]
    rate_hz = 1e3 / float(np.mean(watched.turns_ms))
    return [*rows, _row("body_rate", rate_hz, len(jitter_ms), None) | {"unit": "Hz"}]


def _row(name: str, ours: float, n: int, most: float | None) -> Row:
    row: Row = {"name": f"vision.{name}", "ours": ours, "peer": None, "ratio": None, "unit": "ms", "n": n}
    return row if most is None else row | {"target": f"ours <= {most:g}", "ok": ours <= most}


async def _watch(root: Path, seconds: float) -> Watched:
    folder, watched = Folder(root), Watched()
    scenario = on_free_ports(garden_of(), folder.place(), 2000 + os.getpid() % 400 * 30)
    folder.scenario_file.write_text(toml.dump(scenario))
    folder.enrol(scenario)
    listed = [p for p in processes(scenario, folder.place(), World(seed=SEED, speed=SPEED)) if p.kind != "console"]
    tap = _Tap(root / "tap.sock", folder.socket_path(ROBOT))
    for process in listed:
        (root / process.name).mkdir(exist_ok=True)
    runner = Runner([_through(process, tap.path) for process in listed], folder.logs, lambda name, what: None)
    identity = folder.identity()
    async with tap.listening():
        running = asyncio.create_task(runner.run())
        mesh = Mesh(HttpTransport(), identity, WallClock())
        try:
            await _asked(mesh, {p.name: p for p in listed}, seconds, tap, watched)
        finally:
            await mesh.aclose()
            running.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running
    return watched


def _through(process: Process, tap: Path) -> Process:
    """The brain meets its body through the tap."""
    return replace(process, env=process.env | {"ROBOT_BODY_URL": f"unix://{tap}"}) if process.name == ROBOT else process


async def _asked(mesh: Mesh, listed: dict[str, Process], seconds: float, tap: _Tap, watched: Watched) -> None:
    """Ask for bids until the robot has acted for so long; raises ConfigError when it does not come to that."""
    robot = Peer(id=ROBOT, kind="robot", url=f"http://127.0.0.1:{listed[ROBOT].port}")
    plant = Peer(id=PLANT, kind="plant", url=f"http://127.0.0.1:{listed[PLANT].port}")
    card = (await _patiently(lambda: mesh.call(plant, "GET", "/state", expect=PlantState))).card
    asked = Announcement(task_id=f"{PLANT}:bench:1", kind="inventory", plant=card)
    await _patiently(lambda: mesh.call(robot, "GET", "/readyz", expect=Readiness))
    ends_s = time.monotonic() + WITHIN_S
    while watched.acted_s < seconds:
        await _keep_busy(mesh, plant)
        if time.monotonic() > ends_s:
            raise ConfigError(f"the robot acted only {watched.acted_s:.0f} s of {seconds:g}", hint="look at its log")
        before, began_s = await _job(mesh, robot), time.monotonic()
        tap.heard_s.clear()
        bids_ms = [await _bid_ms(mesh, robot, asked) for _ in range(LOOK_EVERY)]
        heard_s = list(tap.heard_s)
        if before == await _job(mesh, robot) and before.startswith("act"):
            watched.acted_s += time.monotonic() - began_s
            watched.jobs.add(before)
            watched.bids_ms += bids_ms
            watched.turns_ms += [1e3 * (b - a) for a, b in pairwise(heard_s)]


async def _keep_busy(mesh: Mesh, plant: Peer) -> None:
    """An operator wants all ripe fruit, and the plant looked at again; refused while that is under way."""
    for wish in (TaskRequest(kind="harvest"), TaskRequest(kind="inventory")):
        with contextlib.suppress(GardenError):
            await mesh.call(plant, "POST", "/tasks", wish, expect=Task)


async def _patiently(ask: Callable[[], Awaitable[T]]) -> T:
    """Ask until there is an answer."""
    ends_s = time.monotonic() + WITHIN_S
    while True:
        try:
            return await ask()
        except GardenError:
            if time.monotonic() > ends_s:
                raise
            await asyncio.sleep(0.2)


async def _job(mesh: Mesh, robot: Peer) -> str:
    """What it does, and for which task."""
    state = await _patiently(lambda: mesh.call(robot, "GET", "/state", expect=RobotState))
    return f"{state.job} {state.queue[0].kind}" if state.queue else state.job


async def _bid_ms(mesh: Mesh, robot: Peer, asked: Announcement) -> float:
    began_s = time.perf_counter()
    await mesh.call(robot, "POST", "/bids", asked, expect=Bid, timeout_s=ANSWER_S_MAX)
    taken_ms = 1e3 * (time.perf_counter() - began_s)
    await asyncio.sleep(BIDS_EVERY_S)
    return taken_ms


class _Tap:
    """Carries the stream between brain and body, and keeps when the body told a state."""

    def __init__(self, path: Path, body: Path) -> None:
        self.path, self._body = path, body
        self.heard_s: list[float] = []

    @asynccontextmanager
    async def listening(self) -> AsyncIterator[None]:
        server = await asyncio.start_unix_server(self._carry, self.path)
        try:
            yield
        finally:
            server.close()

    async def _carry(self, brain: asyncio.StreamReader, to_brain: asyncio.StreamWriter) -> None:
        """One brain's connection, until either end closes."""
        try:
            body, to_body = await asyncio.open_unix_connection(self._body)
        except OSError:
            to_brain.close()
            return
        ends = [
            asyncio.create_task(work) for work in (self._copy(brain, to_body), self._copy(body, to_brain, self._heard()))
        ]
        try:
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for end in ends:
                end.cancel()
            to_body.close()
            to_brain.close()

    async def _copy(
        self, source: asyncio.StreamReader, to: asyncio.StreamWriter, hear: Callable[[bytes], None] | None = None
    ) -> None:
        while data := await source.read(READ_BYTES):
            to.write(data)
            if hear is not None:
                hear(data)

    def _heard(self) -> Callable[[bytes], None]:
        lines = LineBuffer()

        def hear(data: bytes) -> None:
            states = [line for line in lines.feed(data) if isinstance(decode(line), BodyState)]
            self.heard_s += [time.monotonic()] * len(states)

        return hear
