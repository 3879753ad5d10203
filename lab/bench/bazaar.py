"""`python -m lab.bench.bazaar`: some of a large garden's services in one process, told by a JSON line on standard input.

Pots are the real ones: `plant_service.build` with its disk, journal, market and tokens, on a soil probe that is always wet.
Robots have no body: the machines of a robot's side of the market (`core.allocation`) behind the real HTTP server, and ways
and work that take as long as their bids say. Every service has its own port, connections and token.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from starlette.responses import Response

from core.allocation.bidding import DOCKING_S, UNDOCKING_S, Condition, Stop, insertion, offer, work_s
from core.allocation.queue import Entry, TaskQueue
from core.allocation.reorder import better_order
from core.clock import Clock, WorldClock
from core.errors import GardenError, Overtaken, PeerDown
from core.mesh.auth import Caller, GardenKey
from core.mesh.chassis import allow, body, create_app, serve_direct
from core.mesh.client import Mesh
from core.mesh.events import EventLog
from core.mesh.http import HttpTransport
from core.mesh.node import Node
from core.mesh.peers import Peer, Peers
from core.mesh.server import listen, make_server
from core.wire.documents import NodeCard
from core.wire.fruit import Inventory, Scan
from core.wire.geometry import Point3, Pose2
from core.wire.market import Announcement, Award, Bid, Report, ReportAnswer
from core.wire.robot import QueuedTask
from hw.links import open_link
from hw.ports import LinkStatus
from hw.protocols.vh400 import volts_of
from lab.crowd import KIND, Point, between_s
from lab.quiet import hush
from plant_service.node import build
from plant_service.settings import PlantSettings
from robot_service.brain import OVERTAKEN_FOR_S, queued

KEY = GardenKey.from_seed(9)
REPORT_EVERY_S = 2.0
AGAIN_S = 1.0
FOR_EVER_S = 1e9
WET_RATIO = 0.3


@dataclass(frozen=True, slots=True)
class Plan:
    """One process's share of the garden."""

    kind: str
    """`plant` or `robot`: which of the peers live here."""
    ids: list[str]
    peers: list[dict[str, str]]
    places: dict[str, Point]
    """Of every plant's dock and every robot's start [m]."""
    folder: str
    epoch_s: float
    """When garden time was zero, by the wall's clock."""
    rate: float


class WetProbe:
    """A probe in soil that needs no water."""

    def __init__(self, clock: Clock) -> None:
        self.link = LinkStatus(up=True, why="", since_s=clock.now())

    async def run(self) -> None:
        await asyncio.sleep(FOR_EVER_S)

    async def sample(self, count: int) -> tuple[float, ...]:
        return (volts_of(WET_RATIO),) * count


@dataclass(slots=True)
class Hawker:
    """A robot's side of the market, without a body."""

    id: str
    here: Point
    places: dict[str, Point]
    peers: Peers
    clock: Clock
    mesh: Mesh
    queue: TaskQueue = field(default_factory=TaskQueue)
    docked: str = ""
    arrives_s: float = 0.0
    work: asyncio.Task[None] | None = None
    served: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def condition(self) -> Condition:
        """What it knows of itself now."""
        running, now_s = self.queue.running, self.clock.now()
        return Condition(
            robot_id=self.id, can=frozenset({KIND}), travel=self.travel_s,
            docked_at=self.docked, current=None if running is None else self._stop(running),
            at_work_s=0.0 if running is None else max(0.0, now_s - self.arrives_s),
            queue=tuple(self._stop(entry) for entry in self.queue.waiting),
        )  # fmt: skip

    def travel_s(self, place: str, dock: str) -> float:
        return between_s(self.here if place == "here" else self.places[place], self.places[dock])

    def _stop(self, entry: Entry) -> Stop:
        settled = self.clock.now() - entry.since_s > OVERTAKEN_FOR_S
        return Stop(dock=entry.plant_id, work_s=work_s(KIND, 0.0), task_id=entry.task_id, settled=settled)

    def award(self, award: Award) -> Entry:
        """As a brain does it; raises Overtaken, Refused."""
        self.counts["awards"] += 1
        asked, me = award.announcement, self.condition()
        if award.at_most_s is not None and self.queue.find(asked.task_id) is None:
            now_s = offer(asked, me)[0].cost_s
            if now_s is None or now_s > award.at_most_s:
                self.counts["declined"] += 1
                raise Overtaken(f"bid {award.cost_s:.0f} s, another price by now")
        entry = self.queue.award(award, self.clock.now(), insertion(asked, me))
        self.queue.arrange(better_order(self.condition()))
        self.changed.set()
        return entry

    def kill(self, entry: Entry) -> None:
        self.counts["kills"] += 1
        self.queue.drop(entry)
        if entry.running and self.work is not None:
            self.work.cancel()

    async def run(self) -> None:
        """Serve what is next, for ever."""
        while True:
            self.changed.clear()
            if (entry := self.queue.next()) is None:
                await self.changed.wait()
                continue
            self.work = asyncio.create_task(self._serve(entry))
            await asyncio.wait({self.work})
            if not self.work.cancelled():
                self.work.result()

    async def _serve(self, entry: Entry) -> None:
        entry.running = True
        spent_s = UNDOCKING_S if self.docked else 0.0
        spent_s += self.travel_s("here", entry.plant_id) + DOCKING_S if self.docked != entry.plant_id else 0.0
        self.arrives_s, self.docked = self.clock.now() + spent_s, ""
        await self._report(entry, "running")
        await self.clock.sleep(self.arrives_s - self.clock.now())
        self.here, self.docked = self.places[entry.plant_id], entry.plant_id
        await self.clock.sleep(work_s(KIND, 0.0))
        scan = Scan(scan_id=f"{self.id}:{entry.task_id}:{entry.epoch}", task_id=entry.task_id, robot_id=self.id)
        while not await self._scanned(entry, scan):
            await self.clock.sleep(AGAIN_S)
        self.served.append(entry.task_id)
        while not await self._report(entry, "done"):
            await self.clock.sleep(AGAIN_S)
        self.queue.drop(entry)

    async def _scanned(self, entry: Entry, scan: Scan) -> bool:
        """Whether the plant has it, or wants it no longer."""
        self.counts["scans"] += 1
        try:
            await self.mesh.call(self.peers.get(entry.plant_id), "POST", "/inventory/scans", scan, expect=Inventory)
        except PeerDown:
            self.counts["unheard"] += 1
            return False
        return True

    async def report(self) -> None:
        """Renew the leases of all it holds, for ever."""
        while True:
            await self.clock.sleep(REPORT_EVERY_S)
            await asyncio.gather(*(self._report(e, "running" if e.running else "awarded") for e in self.queue.entries))

    async def _report(self, entry: Entry, state: Any) -> bool:
        """Whether the plant has heard it; drops what is no longer its own."""
        said = Report(robot_id=self.id, epoch=entry.epoch, state=state)
        plant = self.peers.get(entry.plant_id)
        self.counts["reports"] += 1
        try:
            answer = await self.mesh.call(plant, "POST", f"/tasks/{entry.task_id}/reports", said, expect=ReportAnswer)
        except GardenError:
            self.counts["unheard"] += 1
            return False
        if not answer.keep and entry in self.queue.entries and not entry.running:
            self.queue.drop(entry)
        return True


def robot(plan: Plan, id: str, clock: Clock) -> tuple[Node, Hawker]:
    """A robot's node: three routes over its machines."""
    mesh = Mesh(HttpTransport(), KEY.issue(id, "robot", 0.0, FOR_EVER_S), clock)
    peers = Peers(Peer.model_validate(peer) for peer in plan.peers)
    hawker = Hawker(id, plan.places[id], plan.places, peers, clock, mesh)
    app = create_app(
        card=lambda: NodeCard(id=id, kind="robot"), clock=clock, verifier=KEY.verifier(), ready=lambda: [],
        events=EventLog(clock), open_reads=True,
    )  # fmt: skip

    @app.post("/bids", response_model=Bid)
    async def bid(caller: Caller = allow("plant"), asked: Announcement = body(Announcement)) -> Response:
        hawker.counts["bids"] += 1
        return Response(offer(asked, hawker.condition())[0].model_dump_json(), media_type="application/json")

    serve_direct(app, "POST", "/bids")

    @app.post("/tasks", status_code=201)
    async def award(caller: Caller = allow("plant"), award: Award = body(Award)) -> QueuedTask:
        return queued(hawker.award(award))

    @app.delete("/tasks/{task_id:path}")
    async def kill(task_id: str, epoch: int, caller: Caller = allow("plant")) -> QueuedTask:
        entry = hawker.queue.get(task_id)
        if entry.epoch == epoch:
            hawker.kill(entry)
        return queued(entry)

    return Node(id, "robot", app, (hawker.run, hawker.report)), hawker


def pot(plan: Plan, id: str, clock: Clock) -> Node:
    """A pot as it is, that asks for nothing by itself."""
    x_m, y_m = plan.places[id]
    settings = PlantSettings(
        id=id, url=_url(plan, id), data=Path(plan.folder) / id, stem=Point3(x_m=x_m, y_m=y_m, z_m=0.25),
        dock=Pose2(x_m=x_m, y_m=y_m, yaw_rad=0.0), probe_url="none://", probe_every_s=600.0, inventory=False, harvest=False,
    )  # fmt: skip
    return build(
        settings, clock, open_link, HttpTransport(), Random(0), identity=KEY.issue(id, "plant", 0.0, FOR_EVER_S),
        verifier=KEY.verifier(), peers=Peers(Peer.model_validate(peer) for peer in plan.peers),
        probes=lambda url, opener, clock: WetProbe(clock),
    )  # fmt: skip


def _url(plan: Plan, id: str) -> str:
    return next(peer["url"] for peer in plan.peers if peer["id"] == id)


async def _serve(plan: Plan) -> dict[str, Any]:
    """Until standard input ends; what there is to tell."""
    clock = WorldClock(FOR_EVER_S)
    clock.steer((time.time() - plan.epoch_s) * plan.rate, plan.rate)
    hawkers: list[Hawker] = []
    async with asyncio.TaskGroup() as group:
        jobs = []
        for id in plan.ids:
            if plan.kind == "robot":
                node, hawker = robot(plan, id, clock)
                hawkers.append(hawker)
            else:
                node = pot(plan, id, clock)
            sock = listen("127.0.0.1", int(_url(plan, id).rpartition(":")[2]))
            jobs.append(group.create_task(make_server(node.app).serve(sockets=[sock])))
            jobs += [group.create_task(_forever(loop)) for loop in node.loops]
            await asyncio.sleep(0)
        began_cpu_s = time.process_time()
        print(json.dumps({"ready": len(plan.ids)}), flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        cpu_s = time.process_time() - began_cpu_s
        for job in jobs:
            job.cancel()
    counts = sum((hawker.counts for hawker in hawkers), Counter[str]())
    return {
        "cpu_s": cpu_s,
        "counts": dict(counts),
        "served": [task_id for hawker in hawkers for task_id in hawker.served],
    }


async def _forever(loop: Any) -> None:
    await loop()


def shares(ids: Sequence[str], size: int) -> list[list[str]]:
    """In as many even parts as are needed for no part to have more than `size`."""
    count = math.ceil(len(ids) / size)
    return [list(ids[part::count]) for part in range(count)]


def main() -> None:
    hush()
    plan = Plan(**json.loads(sys.stdin.readline()))
    print(json.dumps(asyncio.run(_serve(plan))), flush=True)


if __name__ == "__main__":
    main()
