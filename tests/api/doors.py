"""Every HTTP door of a garden, knocked at directly: the real apps in one process, on virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import httpx
import jwt
from fastapi import FastAPI

from console.service import build as build_console
from core.mesh.auth import GardenKey, Identity, Verifier, audience
from core.mesh.client import HttpxTransport
from core.mesh.describe import CHANGING, roles_of, routes
from core.mesh.peers import Peer, Peers
from core.mesh.runtime import GardenSettings, Runtime
from core.mesh.strict import readers
from core.virtual import VirtualLoop
from lab import story
from lab.garden import Garden
from lab.mesh import MemoryMesh

SUBJECTS = {"plant": "plant-1", "robot": "robot-1", "operator": "operator", "viewer": "viewer"}
KINDS = {"plant": "plant-1", "station": "station", "robot": "robot-1", "sim": "sim", "console": "console"}
"""Every kind of service, and the node of this garden that is one."""
LOOKED_AT = {
    "plant": ("/settings-of-state", "/inventory", "/tasks", "/dock"),
    "station": ("/state", "/dock"),
    "robot": ("/tasks", "/jobs", "/stopped-of-state"),
    "sim": ("/faults", "/clock"),
    "console": ("/orders",),
}
FLOODING = {"GARDEN_FLOOD_HOPS": "3"}
"""So that nodes have a door for it."""
ENDLESS = {"/events", "/clock/feed", "/cameras/{robot}/hand.mjpg", "/camera.mjpg"}
"""They stream for ever: only asked for with something wrong."""


@dataclass(frozen=True, slots=True)
class Operation:
    """One method at one path of one kind of service."""

    kind: str
    method: str
    path: str
    roles: tuple[str, ...] | None
    takes_body: bool
    query: tuple[dict[str, Any], ...] = ()

    @property
    def name(self) -> str:
        return f"{self.kind} {self.method} {self.path}"

    @property
    def key(self) -> tuple[str, str, str]:
        return self.kind, self.method, self.path

    @property
    def changing(self) -> bool:
        return self.method in CHANGING

    def url(self, **ids: str) -> str:
        """The path with every id filled in, by names that nobody has."""
        filled = self.path.replace("{robot}", "robot-1").replace("{plant_id}", ids.get("plant_id", "plant-1"))
        filled = filled.replace("{when}", "before")
        for name in ("task_id", "fruit_id", "line_id", "order_id", "job_id", "fault_id", "reservation_id"):
            filled = filled.replace(f"{{{name}}}", ids.get(name, "nobody:1:1"))
        asked = {"/introduction": "?nonce=0123456789abcdef"}
        return filled + ("?w=32&h=24" if filled.endswith("hand.jpg") else asked.get(filled, ""))


@dataclass
class Doors:
    """The garden, its apps by kind, and a token of every role. Calls are plain functions: the loop runs inside them."""

    runner: asyncio.Runner
    garden: Garden
    apps: dict[str, FastAPI]
    key: GardenKey
    mesh: MemoryMesh
    """Another way to the same apps, by kind: in half the time, as there is no client."""
    asked: int = 0
    statuses: dict[int, int] = field(default_factory=dict)

    def operations(self) -> list[Operation]:
        """What every OpenAPI document lists."""
        found = []
        for kind, app in self.apps.items():
            paths = app.openapi()["paths"]
            for method, path, route in routes(app):
                if (described := paths.get(path, {}).get(method.lower())) is not None:
                    query = tuple(p for p in described.get("parameters", ()) if p["in"] == "query")
                    takes_body = bool(readers(route.dependant))
                    found.append(Operation(kind, method, path, roles_of(route), takes_body, query))
        return found

    def changing(self) -> list[Operation]:
        return [each for each in self.operations() if each.changing]

    def token(self, role: str, subject: str = "", **more: Any) -> str:
        return self.key.issue(subject or SUBJECTS[role], role, 0.0, **more).token

    def forged(self, key: Any, algorithm: str, **changes: Any) -> str:
        """A token with our claims, but for `changes`, signed by somebody else."""
        claims = {"sub": "operator", "role": "operator", "aud": audience(self.key.public()), "iat": 0, "exp": 2**31}
        claims = {name: value for name, value in (claims | changes).items() if value is not None}
        return jwt.encode(claims, key, algorithm=algorithm)

    def ask(
        self, kind: str, method: str, path: str, *, token: str | None = None, headers: Any = None, **more: Any
    ) -> httpx.Response:
        """One request; the operator's token unless another (or "" for none) is given."""
        sent = httpx.Headers(headers or {})
        token = self.token("operator") if token is None else token
        if token:
            sent["authorization"] = f"Bearer {token}"
        return self.runner.run(self._ask(kind, method, path, sent, more))

    async def _ask(self, kind: str, method: str, path: str, headers: httpx.Headers, more: dict[str, Any]) -> httpx.Response:
        transport = httpx.ASGITransport(self.apps[kind], raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            async with asyncio.timeout(30):
                answer = await client.request(method, path, headers=headers, **more)
        return self._counted(answer)

    async def knock(self, kind: str, method: str, path: str, headers: Any, content: bytes) -> httpx.Response:
        """One request as it is, without a token of ours. For the loop's own coroutines."""
        request = httpx.Request(method, f"http://{kind}{path}", headers=headers, content=content)
        async with asyncio.timeout(30):
            return self._counted(await self.mesh.carry("door", request))

    def _counted(self, answer: httpx.Response) -> httpx.Response:
        self.asked += 1
        self.statuses[answer.status_code] = self.statuses.get(answer.status_code, 0) + 1
        self.garden.check()
        return answer

    def wait(self, seconds: float) -> None:
        """Let garden time pass."""
        self.runner.run(self.garden.clock.sleep(seconds))

    def standing(self) -> dict[str, Any]:
        """What requests can change, of every service."""
        return {f"{kind}{path}": self._standing(kind, path) for kind, paths in LOOKED_AT.items() for path in paths}

    def _standing(self, kind: str, path: str) -> Any:
        if path == "/settings-of-state":
            state = self._read(kind, "/state")
            return {name: state[name] for name in ("settings", "open_tasks", "watered_today_ml", "dock_holder", "thirsty")}
        if path == "/stopped-of-state":
            state = self._read(kind, "/state")
            return {name: state[name] for name in ("stopped", "stopped_by", "stop_number", "queue", "down")}
        if path == "/clock":
            return {name: self._read(kind, path)[name] for name in ("speed", "paused")}
        document = self._read(kind, path)
        return {k: v for k, v in document.items() if k != "now_s"} if isinstance(document, dict) else document

    def _read(self, kind: str, path: str) -> Any:
        answer = self.ask(kind, "GET", path, token="")
        assert answer.status_code == 200, (kind, path, answer.text)
        return answer.json()


def check_problem(answer: httpx.Response, asked: Any, *statuses: int) -> dict[str, Any]:
    """A refusal as RFC 9457 has it, with a hint; of one of `statuses` if any are given. Returns the problem."""
    assert 400 <= answer.status_code < 500, (asked, answer.status_code, answer.text[:300])
    assert not statuses or answer.status_code in statuses, (asked, answer.status_code, answer.text[:300])
    assert answer.headers["content-type"] == "application/problem+json", (asked, answer.headers)
    problem: dict[str, Any] = answer.json()
    assert problem["status"] == answer.status_code, asked
    for part in ("title", "detail", "hint"):
        assert problem[part], (asked, part, problem)
    assert len(answer.content) < 3000, (asked, len(answer.content))
    return problem


@contextmanager
def open_doors(folder: Path) -> Iterator[Doors]:
    """A garden of two moist pots, a robot that stands near them and a station; all of it localised and at rest."""
    scenario = story.garden_of((), ("plant-1", "plant-2"), (story.near_robot(),))
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        pots = {plant.id: story.WATER_ONLY | FLOODING for plant in scenario.plants}
        nodes = {robot.id: FLOODING for robot in scenario.robots} | {scenario.station.id: FLOODING}
        garden = runner.run(Garden(scenario, folder, settings=pots | nodes).__aenter__())
        try:
            runner.run(garden.clock.sleep(6.0))
            apps = {kind: _app(garden, name) for kind, name in KINDS.items() if kind != "console"}
            apps["console"] = runner.run(_console(garden))
            mesh = MemoryMesh(garden.clock, Random(0), latency_s=0.0)
            for kind, app in apps.items():
                mesh.attach(kind, kind, app)
            yield Doors(runner, garden, apps, GardenKey.load(folder / "keys" / "garden.key"), mesh)
        finally:
            runner.run(garden.__aexit__(None, None, None))


def _app(garden: Garden, name: str) -> FastAPI:
    node = garden.running[name].node
    assert node is not None
    return node.app


async def _console(garden: Garden) -> FastAPI:
    peers = Peers(Peer(id=name, kind=kind, url=garden.url(name)) for kind, name in KINDS.items() if kind != "console")  # type: ignore[arg-type]
    keys = garden.folder / "keys" / "operator"
    runtime = Runtime(
        settings=GardenSettings(),
        clock=garden.clock,
        clock_loops=(),
        identity=Identity.load(keys),
        verifier=Verifier.load(keys),
        peers=peers,
        transport=HttpxTransport(garden.mesh.transport("console")),
    )
    return (await build_console(runtime)).app
