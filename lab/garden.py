"""The whole garden in one process on virtual time: the process list of `garden up`, over in-memory wires.

Every service is built exactly as its process would be, from the same environment variables. Its URLs lead into memory:
`socket://127.0.0.1:9101` to the emulator that a process would find on that port, HTTP to the app that would answer there.
So a run is a function of its scenario and its seed.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from random import Random
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

import httpx

from console.processes import Place, Process, enrolled, processes
from console.service import build as build_console
from core.clock import Clock, VirtualClock
from core.errors import LinkDown
from core.mesh.auth import Identity, Verifier, make_garden
from core.mesh.client import HttpxTransport
from core.mesh.node import Node
from core.mesh.peers import Peers
from core.mesh.runtime import GardenSettings, Runtime, joining, make_courier
from core.scenario import Scenario, device_ports
from hw.links import ByteLink, MemoryLink, MemoryNet
from lab.mesh import MemoryMesh, MemoryTransport
from plant_service.node import build as build_plant
from plant_service.settings import PlantSettings
from robot_service.body.body import build_body
from robot_service.body.settings import BodySettings
from robot_service.brain import build as build_robot
from robot_service.settings import RobotSettings
from sim.service import make_node
from sim.truth import Truth
from sim.wiring import Rig, assemble, listen
from sim.world import World

Loop = Callable[[], Awaitable[None]]
_SERVICES = ("plant", "station", "body", "robot")


@dataclass(slots=True)
class Running:
    """One process of the garden, alive in memory."""

    process: Process
    transport: MemoryTransport
    links: list[MemoryLink] = field(default_factory=list)
    task: asyncio.Task[None] | None = None
    node: Node | None = None


class Garden:
    """A running garden. Use as `async with Garden(scenario, folder) as garden`, inside `run_virtual`."""

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        *,
        seed: int | None = None,
        without: tuple[str, ...] = (),
        settings: dict[str, dict[str, str]] | None = None,
    ) -> None:
        """`without` names processes not to start; `settings` adds environment variables by process name."""
        self.scenario = scenario
        self.seed = scenario.seed if seed is None else seed
        self.folder = folder
        self.clock: Clock = VirtualClock()
        self.running: dict[str, Running] = {}
        self._without, self._settings = without, settings or {}
        self._crashed: asyncio.Future[None] | None = None

    async def __aenter__(self) -> Garden:
        self._crashed = asyncio.get_running_loop().create_future()
        keys = self.folder / "keys"
        make_garden(keys, enrolled(self.scenario), now_s=0.0)
        self.mesh = MemoryMesh(self.clock, Random(f"{self.seed}/mesh"))
        self.net = MemoryNet(self.clock)
        self.rig: Rig = assemble(self.scenario, self.seed, self.clock)
        listen(self.rig.hosts, self.net)
        self._device_names = {port: name for name, port in device_ports(self.scenario).items()}
        self._processes = {p.name: p for p in processes(self.scenario, self._place(keys))}
        self._start_world()
        for process in self._processes.values():
            if process.kind in _SERVICES and process.name not in self._without:
                self.start(process.name)
        self._identity = Identity.load(keys / "operator")
        return self

    async def __aexit__(self, *_: object) -> None:
        for running in list(self.running.values()):
            await _end(running)

    # ------------------------------------------------------------------ what experiments look at

    @property
    def world(self) -> World:
        return self.rig.world

    def truth(self) -> Truth:
        """What is so, exactly. For judges only."""
        self.rig.clockwork.catch_up()
        return self.world.truth()

    def url(self, name: str) -> str:
        """Where a service answers."""
        return f"http://127.0.0.1:{self._processes[name].port}"

    @asynccontextmanager
    async def operator(self) -> AsyncIterator[httpx.AsyncClient]:
        """An operator's HTTP client in the mesh."""
        headers = {"authorization": f"Bearer {self._identity.token}"}
        async with httpx.AsyncClient(transport=self.mesh.transport("operator"), headers=headers, timeout=5.0) as client:
            yield client

    async def get(self, name: str, path: str) -> Any:
        """A service's answer to GET, as JSON; raises on an error status."""
        async with self.operator() as client:
            return (await client.get(self.url(name) + path)).raise_for_status().json()

    async def post(self, name: str, path: str, body: dict[str, Any]) -> httpx.Response:
        async with self.operator() as client:
            return await client.post(self.url(name) + path, json=body)

    async def until(self, true: Callable[[], Awaitable[bool]], within_s: float, every_s: float = 1.0) -> bool:
        """Wait until `true()`; False when it was not within the time."""
        end_s = self.clock.now() + within_s
        while self.clock.now() < end_s:
            self.check()
            if await true():
                return True
            await self.clock.sleep(every_s)
        return False

    def check(self) -> None:
        """Raises what a service died of, if one did."""
        if self._crashed is not None and self._crashed.done():
            self._crashed.result()

    # ------------------------------------------------------------------ life and death

    def start(self, name: str) -> None:
        """Start a process, or start it again after `kill`."""
        process = self._processes[name]
        running = Running(process, self.mesh.transport(name))
        self.running[name] = running
        running.task = asyncio.create_task(self._live(running), name=name)
        running.task.add_done_callback(self._watch)

    async def open_console(self) -> None:
        """Have the operator's console answer too."""
        running = Running(self._processes["console"], self.mesh.transport("console"))
        with _environment(self._env("console")):
            common = GardenSettings()
        assert common.keys is not None
        identity, verifier = Identity.load(common.keys), Verifier.load(common.keys)
        runtime = Runtime(common, self.clock, (), identity, verifier, Peers(common.peers), HttpxTransport(running.transport))
        running.node = await build_console(runtime)
        self.mesh.attach("console", f"127.0.0.1:{running.process.port}", running.node.app)
        self.running["console"] = running

    async def kill(self, name: str) -> None:
        """SIGKILL: from this instant nothing the process does reaches anybody, and its data stays as it lies on disk."""
        running = self.running.pop(name)
        running.transport.alive = False
        for link in running.links:
            link.cut()
        self._silence(running)
        await _end(running)

    def _silence(self, running: Running) -> None:
        if (port := running.process.port) is not None:
            self.mesh.detach(f"127.0.0.1:{port}")
        if running.process.kind == "body":
            self.net.close(f"{running.process.keys}.body")

    def _watch(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            assert self._crashed is not None
            if not self._crashed.done():
                self._crashed.set_exception(error)

    async def _live(self, running: Running) -> None:
        await _all(self._build(running))

    def _start_world(self) -> None:
        process = self._processes["sim"]
        running = Running(process, self.mesh.transport("sim"))
        running.node = make_node(self.rig, self.clock, Verifier.load(self.folder / "keys" / "sim"))
        self.mesh.attach("sim", f"127.0.0.1:{process.port}", running.node.app)
        running.task = asyncio.create_task(_all(running.node.loops), name="sim")
        running.task.add_done_callback(self._watch)
        self.running["sim"] = running

    # ------------------------------------------------------------------ building services from their environment

    def _build(self, running: Running) -> list[Loop]:
        process = running.process
        with _environment(self._env(process.name)):
            common = GardenSettings()
            if process.kind == "body":
                return self._build_body(running, BodySettings())
            maker: Callable[..., Node] = build_robot if process.kind == "robot" else build_plant
            settings: Any = RobotSettings() if process.kind == "robot" else PlantSettings()
        assert common.keys is not None
        identity, verifier = Identity.load(common.keys), Verifier.load(common.keys)
        peers, transport = Peers(common.peers, common.hops_max), HttpxTransport(running.transport)
        courier = make_courier(common, self.clock, identity, verifier, peers, transport)
        running.node = maker(
            settings,
            self.clock,
            self._opener(running),
            courier or transport,
            Random(f"{self.seed}/{process.name}"),
            identity=identity,
            verifier=verifier,
            peers=peers,
            **({"cameras": running.transport} if process.kind == "robot" else {}),
        )
        self.mesh.attach(process.name, f"127.0.0.1:{process.port}", running.node.app)
        return [*running.node.loops, *joining(courier, identity, running.node)]

    def _build_body(self, running: Running, settings: BodySettings) -> list[Loop]:
        def accepting(name: str, accept: Callable[[ByteLink], None]) -> None:
            def accepted(link: ByteLink) -> None:
                assert isinstance(link, MemoryLink)
                running.links.append(link)
                accept(link)

            self.net.listen(name, accepted)

        return [build_body(settings, self.clock, self._opener(running), accepting).run]

    def _opener(self, running: Running) -> Callable[[str], Awaitable[ByteLink]]:
        async def opener(url: str) -> ByteLink:
            parts = urlsplit(url)
            if parts.scheme == "socket":
                assert parts.port is not None
                url = f"memory://{self._device_names[parts.port]}"
            if not running.transport.alive:
                raise LinkDown(f"cannot open {url}: this process is dead")
            link = await self.net.open(url)
            assert isinstance(link, MemoryLink)
            running.links.append(link)
            return link

        return opener

    def _env(self, name: str) -> dict[str, str]:
        return self._processes[name].env | self._settings.get(name, {})

    def _place(self, keys: Path) -> Place:
        return Place(
            data=lambda name: PurePosixPath(self.folder / name),
            keys=lambda name: PurePosixPath(keys / name),
            socket=lambda robot: f"memory://{robot}.body",
        )


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    with mock.patch.dict(os.environ, variables, clear=True):
        yield


async def _run(loop: Loop) -> None:
    await loop()


async def _all(loops: Iterable[Loop]) -> None:
    async with asyncio.TaskGroup() as group:
        for loop in loops:
            group.create_task(_run(loop))


async def _end(running: Running) -> None:
    if running.task is None or running.task.done():
        return
    running.task.cancel()
    await asyncio.wait([running.task])
