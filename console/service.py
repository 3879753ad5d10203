"""The console's service: one page, one snapshot, and the operator's few buttons, passed on with the operator's own token."""

from __future__ import annotations

import asyncio
from pathlib import Path as FilePath
from typing import Annotated, TypeVar

from fastapi import FastAPI, Header, Path, Query
from starlette.responses import Response

from console.snapshot import Snapshot, look
from core.errors import GardenError, NotFound, PeerDown
from core.mesh.auth import Caller
from core.mesh.chassis import allow, body, create_app, version
from core.mesh.client import Mesh, read
from core.mesh.node import Node
from core.mesh.peers import Peer, Peers
from core.mesh.runtime import Runtime
from core.wire.documents import Document, NodeCard
from core.wire.market import Task, TaskRequest
from core.wire.robot import Stopped, StopRequest

D = TypeVar("D", bound=Document)
PICTURE_WITHIN_S = 20.0
"""The world's first picture takes seconds: it loads its kernels."""
FRESH_S = 0.5
"""A snapshot serves everybody who asks within this time."""
PAGE = FilePath(__file__).with_name("page.html")
Name = Annotated[str, Path(max_length=80)]
Token = Annotated[str, Header(alias="authorization", max_length=5000)]


class Answers(Document):
    """What each robot said; `errors` names those that did not do it."""

    robots: list[Stopped] = []
    errors: dict[str, str] = {}


async def build(runtime: Runtime) -> Node:
    """The console as a node; it is a client like any other and holds no state."""
    mesh, peers = runtime.mesh(), runtime.peers
    card = NodeCard(
        id="console",
        kind="console",
        capabilities=["overview", "snapshot"],
        links={peer.id: peer.url for peer in peers.all()},
        version=version(),
    )
    app = create_app(
        card=lambda: card,
        clock=runtime.clock,
        verifier=runtime.verifier,
        ready=lambda: [],
        open_reads=runtime.settings.open_reads,
        page=PAGE.read_text(),
    )
    _add_reads(app, mesh, peers)
    _add_buttons(app, mesh, peers)
    return Node("console", "console", app)


class Glance:
    """The newest snapshot, gathered at most every FRESH_S however many ask."""

    def __init__(self, mesh: Mesh, peers: Peers) -> None:
        self._mesh, self._peers = mesh, peers
        self._lock = asyncio.Lock()
        self._newest = Snapshot()
        self._taken_s = float("-inf")

    async def now(self) -> Snapshot:
        loop = asyncio.get_running_loop()
        async with self._lock:
            if loop.time() - self._taken_s > FRESH_S:
                self._newest = await look(self._mesh, self._peers)
                self._taken_s = loop.time()
            return self._newest


def _add_reads(app: FastAPI, mesh: Mesh, peers: Peers) -> None:
    glance = Glance(mesh, peers)

    @app.get("/api/garden", tags=["garden"], summary="Everything at once")
    async def garden() -> Snapshot:
        return await glance.now()

    @app.get("/overview.jpg", tags=["garden"], summary="The simulated world from above", response_class=Response)
    async def overview(t: Annotated[int, Query(ge=0, le=2**53, description="makes the address a new one")] = 0) -> Response:
        worlds = peers.of_kind("sim")
        if not worlds:
            raise NotFound("a real garden has no simulated world", hint="look out of the window")
        answer = await mesh.exchange(worlds[0], "GET", "/overview.jpg", timeout_s=PICTURE_WITHIN_S)
        if answer.status != 200:
            raise PeerDown(f"{worlds[0].id} gave no picture (status {answer.status})")
        return Response(answer.body, media_type="image/jpeg", headers={"cache-control": "no-store"})


def _add_buttons(app: FastAPI, mesh: Mesh, peers: Peers) -> None:
    async def all_robots(path: str, content: bytes, token: str) -> Answers:
        async def tell(robot: Peer) -> Stopped | GardenError:
            try:
                return await _pass_on(mesh, robot, path, content, token, Stopped)
            except GardenError as error:
                return error

        robots = peers.of_kind("robot")
        answers = await asyncio.gather(*(tell(robot) for robot in robots))
        errors = {robot.id: str(a) for robot, a in zip(robots, answers, strict=True) if isinstance(a, GardenError)}
        return Answers(robots=[a for a in answers if isinstance(a, Stopped)], errors=errors)

    @app.post("/api/stop", tags=["buttons"], summary="Stop every robot")
    async def stop(
        authorization: Token = "",
        caller: Caller = allow("plant", "robot", "operator", "viewer"),
        request: StopRequest = body(StopRequest),
    ) -> Answers:
        return await all_robots("/stop", request.model_dump_json().encode(), authorization)

    @app.post("/api/resume", tags=["buttons"], summary="Let every robot go on")
    async def resume(authorization: Token = "", caller: Caller = allow("operator")) -> Answers:
        return await all_robots("/resume", b"", authorization)

    @app.post("/api/plants/{plant_id}/water", tags=["buttons"], summary="Ask a pot to be watered")
    async def water(
        plant_id: Name,
        authorization: Token = "",
        caller: Caller = allow("operator"),
        request: TaskRequest = body(TaskRequest),
    ) -> Task:
        pots = peers.of_kind("plant")
        if (pot := next((pot for pot in pots if pot.id == plant_id), None)) is None:
            raise NotFound(f"no plant {plant_id!r}", hint=f"known: {', '.join(pot.id for pot in pots) or 'none'}")
        content = request.model_dump_json().encode()
        return await _pass_on(mesh, pot, "/tasks", content, authorization, Task)


async def _pass_on(mesh: Mesh, peer: Peer, path: str, content: bytes, token: str, expect: type[D]) -> D:
    """With the caller's own token: the console has no power of its own."""
    answer = await mesh.exchange(peer, "POST", path, content, headers={"authorization": token})
    return read(peer, answer, expect)
