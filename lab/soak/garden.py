"""A garden of real services on kinematic bodies: built, crashed and started again by name.

Pots, station and brains are built by the `build` of their own service; a body is the real one (gate, dose ledger, stop
latch, stream to its brain) on devices without bytes. Control loops turn more seldom than in life (`COARSE`).
"""

from __future__ import annotations

import asyncio
import os
import random
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any
from unittest import mock

from console.processes import Place, Process, peers_of, processes
from core.errors import GardenError
from core.geometry.pinhole import from_fov
from core.mesh.auth import GardenKey, Identity
from core.mesh.peers import Peers
from core.robots.garden_map import map_of
from core.robots.markers import ceiling_markers
from core.scenario import Scenario
from hw.links import ByteLink, MemoryLink, MemoryNet
from lab.soak.devices import KinematicBase, KinematicMarkers, KinematicServos, SoakProbe, SoakValve
from lab.soak.disk import Platter, SoakDisk
from lab.soak.hands import SoakHand
from lab.soak.life import Life, NodeClock
from lab.soak.net import SoakMesh, SoakTransport
from lab.soak.routes import forget_the_dead, routes_read_once
from lab.soak.world import Dose, Truth
from plant_service.node import build as build_plant
from plant_service.pot import Pot
from plant_service.settings import PlantSettings
from robot_service.body.body import BodyNode, Drivers, build_body
from robot_service.body.settings import BodySettings
from robot_service.brain import Brain
from robot_service.brain import build as build_robot
from robot_service.eye import Eye
from robot_service.settings import RobotSettings

COARSE = {
    "robot_service.robot": {"TICK_S": 0.2},
    "robot_service.body.body": {"DT_S": 0.2, "LONG_REST_S": 10.0, "LONG_REST_DT_S": 60.0},
    "robot_service.docks": {"REST_FOR_S": 240.0, "RENEW_RESTING_S": 180.0},
    "robot_service.neighbours": {"MOVING_EVERY_S": 2.0, "NEAR_EVERY_S": 1.0, "STILL_EVERY_S": 15.0, "IDLE_EVERY_S": 120.0},
    "robot_service.navigator": {"LOOK_S": 1.0},
}
"""Periods [s] stretched in a soak. Control loops turn five times a second instead of 50 and 25: bodies without physics need
no more, and the gate's life of a command still holds. What only tells that nothing happens is told more seldom."""
PROBE_EVERY_S = 120.0
"""A soil that dries over hours is measured every other minute."""
SECRET = "a secret that both halves know"
HOST = "127.0.0.1"
_KEY = GardenKey.from_seed(4)


@lru_cache(maxsize=64)
def _identity(name: str, role: str) -> Identity:
    return _KEY.issue(name, role, 0.0)


@dataclass(eq=False)
class Running:
    """One process, alive."""

    process: Process
    life: Life
    transport: SoakTransport
    disk: SoakDisk
    links: list[MemoryLink] = field(default_factory=list)
    task: asyncio.Task[None] | None = None
    app: Any = None
    body: BodyNode | None = None


@dataclass(eq=False, kw_only=True)
class Hooks:
    """Where faults and judges take part."""

    disk: Callable[[Running, str, Path], None] = lambda running, operation, path: None
    poured: Callable[[Dose], None] = lambda dose: None
    picked: Callable[[str, str], None] = lambda robot_id, permit_id: None
    moved: Callable[[str], None] = lambda robot_id: None
    died: Callable[[str, BaseException], None] = lambda name, error: None
    clock: Callable[[str], NodeClock] = lambda name: NodeClock()


class Pictures:
    """A camera that nobody looks through: it says that there is one."""

    async def fresh(self, after_s: float) -> Any:
        raise GardenError("this camera takes no pictures")


class SoakGarden:
    """Use inside a `SoakLoop`; `start_all`, then let time pass."""

    def __init__(
        self, scenario: Scenario, seed: int, folder: Path, truth: Truth, hooks: Hooks, faults: Counter[str]
    ) -> None:
        self.scenario, self.seed, self.truth, self.hooks = scenario, seed, truth, hooks
        self.mesh = SoakMesh(random.Random(f"{seed}/mesh"), faults)
        self.net = MemoryNet(NodeClock())
        self.running: dict[str, Running] = {}
        self.platters: dict[str, Platter] = {}
        self._folder, self._verifier = folder, _KEY.verifier()
        place = Place(
            data=lambda name: PurePosixPath(folder / name),
            keys=lambda name: PurePosixPath(folder / "keys"),
            socket=lambda robot: f"memory://{robot}.body",
        )
        listed = processes(scenario, place)
        self.processes = {p.name: p for p in listed if p.kind in ("plant", "station", "body", "robot")}
        for plant in self.names("plant"):
            self.processes[plant].env["PLANT_PROBE_EVERY_S"] = f"{PROBE_EVERY_S:g}"
        self.peers = [peer for peer in peers_of(scenario, lambda name: HOST) if peer.kind in ("plant", "station", "robot")]
        self.urls = {peer.id: peer.url for peer in self.peers}
        self._markers = {n: (p.x_m, p.y_m, p.yaw_rad) for n, p in ceiling_markers(map_of(scenario).arena).items()}
        self._boots: Counter[str] = Counter()
        self._dying: dict[str, asyncio.Task[None]] = {}

    def names(self, kind: str) -> list[str]:
        return [process.name for process in self.processes.values() if process.kind == kind]

    def brain(self, robot_id: str) -> Brain | None:
        """The running brain, for judges only."""
        running = self.running.get(robot_id)
        return None if running is None or running.app is None else running.app.state.brain

    def pot(self, plant_id: str) -> Pot | None:
        """The running pot, for judges only."""
        running = self.running.get(plant_id)
        return None if running is None or running.app is None else running.app.state.pot

    # Life and death

    def start_all(self) -> None:
        for name in self.processes:
            self.start(name)

    def start(self, name: str) -> None:
        """Start a process on what its disk holds. A service that refuses to start is reported as dead."""
        process = self.processes[name]
        forget_the_dead()
        self._boots[name] += 1
        life = Life(name, self.hooks.clock(name))
        platter = self.platters.setdefault(name, Platter())
        running = Running(
            process, life, self.mesh.transport(life), SoakDisk(platter, lambda op, path: self._hook(running, op, path))
        )
        self.running[name] = running
        running.task = life.start(self._live(running))
        running.task.add_done_callback(lambda task: self._ended(name, running, task))

    def _hook(self, running: Running, operation: str, path: Path) -> None:
        self.hooks.disk(running, operation, path)

    def kill(self, name: str) -> None:
        """SIGKILL; its disk stays as it is."""
        running = self.running.pop(name, None)
        if running is None:
            return
        running.disk.dead = True
        if running.task is not None:
            self._dying[name] = running.task
        for link in running.links:
            link.cut()
        if running.process.kind == "body":
            self.net.close(f"{running.process.keys}.body")
            self.truth.command(running.process.keys, "stop")
            self.truth.pump(running.process.keys, False)
        running.life.kill()

    def _ended(self, name: str, running: Running, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None and running.life.alive:
            self.kill(name)
            self.hooks.died(name, error)

    async def _live(self, running: Running) -> None:
        await self._buried(running.process.name)
        async with asyncio.TaskGroup() as group:
            for loop in self._build(running):
                group.create_task(_run(loop))

    async def _buried(self, name: str) -> None:
        """The system takes a dead process's locks away at once; here its last tasks must have ended."""
        if (before := self._dying.pop(name, None)) is not None:
            await asyncio.wait([before])

    # Building

    def _build(self, running: Running) -> list[Callable[[], Awaitable[None]]]:
        process = running.process
        with _environment(process.env):
            if process.kind == "body":
                return self._build_body(running)
            node = self._build_brain(running) if process.kind == "robot" else self._build_plant(running)
        running.app = node.app
        self.mesh.attach(process.name, f"{HOST}:{process.port}", running.life, node.app)
        return list(node.loops)

    def _build_plant(self, running: Running) -> Any:
        name, clock = running.process.name, running.life.clock
        settings = PlantSettings()
        return build_plant(
            settings,
            clock,
            self.net.open,
            running.transport,
            self._rng(name),
            identity=_identity(name, "plant"),
            verifier=self._verifier,
            peers=Peers(self.peers),
            disk=running.disk,
            probes=lambda url, opener, clock: SoakProbe(name, self.truth, running.life.clock, self._rng(f"{name}/probe")),
            valves=lambda url, opener, clock: SoakValve(self.truth, running.life.clock),
        )

    def _build_brain(self, running: Running) -> Any:
        name, clock = running.process.name, running.life.clock
        env = {"ROBOT_BODY_SECRET": SECRET, "ROBOT_BODY_SECRET_FILE": "", "ROBOT_CAMERA_URL": ""}
        with _environment({k: v for k, v in (running.process.env | env).items() if v}):
            settings = RobotSettings()
        lens = from_fov(640, 480, 1.0)
        return build_robot(
            settings,
            clock,
            self._opener(running),
            running.transport,
            self._rng(name),
            identity=_identity(name, "robot"),
            verifier=self._verifier,
            peers=Peers(self.peers),
            eye=Eye(Pictures(), "none", lens, clock),
            hand=SoakHand(name, self.truth, self._rng(f"{name}/hand"), self.hooks.picked).skills(),
        )

    def _build_body(self, running: Running) -> list[Callable[[], Awaitable[None]]]:
        env = {"BODY_SECRET": SECRET, "BODY_SECRET_FILE": ""}
        with _environment({k: v for k, v in (running.process.env | env).items() if v}):
            settings = BodySettings()
        robot_id, clock = running.process.keys, running.life.clock
        drivers = Drivers(
            base=KinematicBase(robot_id, self.truth, clock, self.hooks.moved),
            servos=KinematicServos(robot_id, self.truth, clock, lambda: _permit(running), self.hooks.poured),
            localizer=KinematicMarkers(robot_id, self.truth, clock, self._markers),
        )

        def accepting(name: str, accept: Callable[[ByteLink], None]) -> None:
            def accepted(link: ByteLink) -> None:
                assert isinstance(link, MemoryLink)
                running.links.append(link)
                running.life.run(lambda: accept(link))

            self.net.listen(name, accepted)

        running.body = build_body(settings, clock, self.net.open, accepting, drivers, running.disk)
        return [running.body.run]

    def _opener(self, running: Running) -> Callable[[str], Awaitable[ByteLink]]:
        async def opener(url: str) -> ByteLink:
            link = await self.net.open(url)
            assert isinstance(link, MemoryLink)
            running.links = [*[known for known in running.links if not known._closed], link]
            return link

        return opener

    def _rng(self, name: str) -> random.Random:
        return random.Random(f"{self.seed}/{name}/{self._boots[name.partition('/')[0]]}")


def _permit(running: Running) -> str:
    return "" if running.body is None else running.body.doser.permit_id


async def _run(loop: Callable[[], Awaitable[None]]) -> None:
    await loop()


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    with mock.patch.dict(os.environ, variables, clear=True):
        yield


@contextmanager
def coarse() -> Iterator[None]:
    """While in it, loops turn at `COARSE`, and routes are read once."""
    with routes_read_once(), ExitStack() as stack:
        for module, periods in COARSE.items():
            for name, seconds in periods.items():
                stack.enter_context(mock.patch(f"{module}.{name}", seconds))
        yield
