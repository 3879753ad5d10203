"""The console's service: one page, one snapshot, and the operator's few buttons, passed on with the operator's own token."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path as FilePath
from typing import Annotated, TypeVar

from fastapi import FastAPI, Header, Path, Query
from starlette.responses import Response

from console.orders import call_off, order_of, place
from console.snapshot import Snapshot, all_tasks, look
from core.clock import Clock
from core.errors import GardenError, NotFound, PeerDown
from core.mesh.auth import Caller
from core.mesh.chassis import allow, body, create_app, version
from core.mesh.client import Mesh, read
from core.mesh.node import Node
from core.mesh.peers import Peer, Peers
from core.mesh.runtime import Runtime
from core.wire.documents import Document, NodeCard
from core.wire.market import Task, TaskRequest
from core.wire.order import Order, OrderPart, OrderRequest
from core.wire.robot import ResumeAllRequest, ResumeRequest, Stopped, StopRequest

D = TypeVar("D", bound=Document)
PICTURE_WITHIN_S = 20.0
"""The world's first picture takes seconds: it loads its kernels."""
ORDERS_KEPT = 100
FRESH_S = 0.5
"""A snapshot serves everybody who asks within this time."""
PAGE = FilePath(__file__).with_name("page.html")
Name = Annotated[str, Path(max_length=80)]
Token = Annotated[str, Header(alias="authorization", max_length=5000)]
Key = Annotated[str, Header(alias="idempotency-key", max_length=128)]


class Answers(Document):
    """What each robot said; `errors` names those that did not do it."""

    robots: list[Stopped] = []
    errors: dict[str, str] = {}


async def build(runtime: Runtime) -> Node:
    """The console as a node; it is a client like any other: what it forgets, the pots know."""
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
    _add_orders(app, Counter(mesh, peers, runtime.clock))
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
    async def all_robots(path: str, wishes: Mapping[str, Document], token: str) -> Answers:
        async def tell(name: str, wish: Document) -> Stopped | GardenError:
            try:
                return await _pass_on(mesh, _robot(peers, name), path, wish.model_dump_json().encode(), token, Stopped)
            except GardenError as error:
                return error

        answers = await asyncio.gather(*(tell(name, wish) for name, wish in wishes.items()))
        errors = {name: str(a) for name, a in zip(wishes, answers, strict=True) if isinstance(a, GardenError)}
        return Answers(robots=[a for a in answers if isinstance(a, Stopped)], errors=errors)

    @app.post("/api/stop", tags=["buttons"], summary="Stop every robot")
    async def stop(
        authorization: Token = "",
        caller: Caller = allow("plant", "robot", "operator", "viewer"),
        request: StopRequest = body(StopRequest),
    ) -> Answers:
        return await all_robots("/stop", {robot.id: request for robot in peers.of_kind("robot")}, authorization)

    named = "GET /api/garden tells every robot's stop_number; send those that are meant"

    @app.post("/api/resume", tags=["buttons"], summary="Let robots go on from the stops that are named")
    async def resume(
        authorization: Token = "",
        caller: Caller = allow("operator"),
        request: ResumeAllRequest = body(ResumeAllRequest, hint=named),
    ) -> Answers:
        wishes = {stop.robot_id: ResumeRequest(stop_number=stop.stop_number) for stop in request.stops}
        return await all_robots("/resume", wishes, authorization)

    @app.post("/api/plants/{plant_id}/water", tags=["buttons"], summary="Ask a pot to be watered")
    async def water(
        plant_id: Name,
        authorization: Token = "",
        caller: Caller = allow("operator"),
        request: TaskRequest = body(TaskRequest),
        idempotency_key: Key = "",
    ) -> Task:
        pots = peers.of_kind("plant")
        if (pot := next((pot for pot in pots if pot.id == plant_id), None)) is None:
            raise NotFound(f"no plant {plant_id!r}", hint=f"known: {', '.join(pot.id for pot in pots) or 'none'}")
        content = request.model_dump_json().encode()
        return await _pass_on(mesh, pot, "/tasks", content, authorization, Task, key=idempotency_key)


def _robot(peers: Peers, name: str) -> Peer:
    """Raises NotFound."""
    robots = peers.of_kind("robot")
    if (robot := next((robot for robot in robots if robot.id == name), None)) is None:
        raise NotFound(f"no robot {name!r}", hint=f"known: {', '.join(robot.id for robot in robots) or 'none'}")
    return robot


class Counter:
    """Where orders are taken. It remembers how many were wanted; all else is in the pots."""

    def __init__(self, mesh: Mesh, peers: Peers, clock: Clock) -> None:
        self._mesh, self._peers, self._clock = mesh, peers, clock
        self._orders: dict[str, Order] = {}
        self._taken = 0

    async def take(self, wish: OrderRequest, by: str, token: str, key: str = "") -> Order:
        """The same under the same `key` is the same order, as long as a pot knows of it.

        Raises NotFound for an unknown plant, Refused when nothing ripe is known.
        """
        pots = self._peers.of_kind("plant")
        asked = [pot for pot in pots if wish.plant_id in ("", pot.id)]
        if not asked:
            raise NotFound(f"no plant {wish.plant_id!r}", hint=f"known: {', '.join(pot.id for pot in pots) or 'none'}")
        self._taken += 1
        now_s = self._clock.now()
        order_id = f"o{int(1000 * now_s)}-{self._taken}"
        if key:
            order_id = "o" + sha256("\0".join((by, key)).encode()).hexdigest()[:16]
            tasks = await all_tasks(self._mesh, self._peers)
            if (before := order_of(order_id, tasks, self._orders.get(order_id))) is not None:
                return before

        async def send(pot: Peer, request: TaskRequest) -> Task:
            content = request.model_dump_json().encode()
            return await _pass_on(self._mesh, pot, "/tasks", content, token, Task, key=f"order {order_id}")

        parts = await place(order_id, wish, asked, self._mesh, send)
        order = Order(
            order_id=order_id, count=wish.count, plant_id=wish.plant_id, asked_by=by, created_s=now_s, updated_s=now_s,
            parts=parts,
        )  # fmt: skip
        self._orders[order_id] = order
        for old in list(self._orders)[:-ORDERS_KEPT]:
            del self._orders[old]
        return await self.order(order_id)

    async def order(self, order_id: str) -> Order:
        """Raises NotFound."""
        found = order_of(order_id, await all_tasks(self._mesh, self._peers), self._orders.get(order_id))
        if found is None:
            raise NotFound(f"no order {order_id!r}", hint="GET /orders lists them")
        if order_id in self._orders:
            self._orders[order_id] = found
        return found

    async def call_off(self, order_id: str, token: str) -> Order:
        """Raises NotFound, or PeerDown when a pot did not answer; the others have been told then."""

        async def cancel(part: OrderPart) -> Task:
            return await _pass_on(
                self._mesh, self._peers.get(part.plant_id), f"/tasks/{part.task_id}", b"", token, Task, "DELETE"
            )

        await call_off(await self.order(order_id), cancel)
        return await self.order(order_id)

    async def orders(self) -> list[Order]:
        """Newest first."""
        tasks = await all_tasks(self._mesh, self._peers)
        names = {*self._orders, *(task.order_id for task in tasks if task.order_id)}
        found = [order_of(name, tasks, self._orders.get(name)) for name in names]
        return sorted((order for order in found if order is not None), key=lambda order: (-order.created_s, order.order_id))


def _add_orders(app: FastAPI, counter: Counter) -> None:
    @app.get("/orders", tags=["orders"], summary="All orders, newest first")
    async def orders() -> list[Order]:
        return await counter.orders()

    @app.get("/orders/{order_id}", tags=["orders"], summary="How far an order is")
    async def order(order_id: Name) -> Order:
        return await counter.order(order_id)

    @app.delete("/orders/{order_id}", tags=["orders"], summary="Call off what has not been picked yet")
    async def cancel(order_id: Name, authorization: Token = "", caller: Caller = allow("operator")) -> Order:
        return await counter.call_off(order_id, authorization)

    @app.post("/orders", tags=["orders"], summary="Order ripe fruit", status_code=201)
    async def take(
        response: Response,
        authorization: Token = "",
        caller: Caller = allow("operator"),
        request: OrderRequest = body(OrderRequest),
        idempotency_key: Key = "",
    ) -> Order:
        taken = await counter.take(request, caller.subject, authorization, idempotency_key)
        response.headers["location"] = f"/orders/{taken.order_id}"
        return taken


async def _pass_on(
    mesh: Mesh, peer: Peer, path: str, content: bytes, token: str, expect: type[D], method: str = "POST", key: str = ""
) -> D:
    """With the caller's own token: the console has no power of its own."""
    answer = await mesh.exchange(peer, method, path, content, headers={"authorization": token}, key=key)
    return read(peer, answer, expect)
