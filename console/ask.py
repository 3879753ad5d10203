"""The commands that talk to the garden's services."""

from __future__ import annotations

import asyncio
import json
import math
import os
import secrets
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel
from rich.console import Console, RenderableType
from rich.live import Live

from console import tables
from console.diagram import text, write
from console.folder import Folder
from console.orders import TOP_UPS_MAX, Send, call_off, order_of, place, top_up
from console.snapshot import all_tasks, look
from console.story import Story, remembered, tell
from core.allocation.epochs import owner_of
from core.clock import Clock, WallClock
from core.errors import BadRequest, GardenError, NotFound, PeerDown, Unavailable
from core.mesh.client import Mesh
from core.mesh.peers import Peer, PeerKind, Peers
from core.wire.documents import Document, HistoryEntry
from core.wire.market import Task, TaskRequest
from core.wire.order import Order, OrderPart, OrderRequest
from core.wire.plant import PlantState
from core.wire.robot import Job, JobKind, JobRequest, ResumeRequest, RobotState, Stopped, StopRequest

T = TypeVar("T")
WATCH_S = 1.0
POLL_S = 0.5
NOBODY = "is the garden running? `make up` starts it, `garden doctor` looks closer"


@dataclass(frozen=True, slots=True)
class Line:
    """The way to the garden's services."""

    mesh: Mesh
    peers: Peers
    clock: Clock

    def peer(self, name: str, kind: PeerKind) -> Peer:
        peer = self.peers.find(name)
        if peer is None or peer.kind != kind:
            known = ", ".join(peer.id for peer in self.peers.of_kind(kind))
            raise NotFound(f"there is no {kind} {name!r}", hint=f"one of: {known or 'none'}")
        return peer


@asynccontextmanager
async def open_line(data: Path, role: str = "") -> AsyncIterator[Line]:
    """With a `role`, requests carry that role's token. Without one they carry none, or that of `GARDEN_READS_AS`."""
    folder = Folder(data)
    role = role or os.environ.get("GARDEN_READS_AS", "")
    clock, peers = WallClock(), Peers(folder.peers())
    mesh = Mesh(folder.transport(peers), folder.identity(role) if role else None, clock, timeout_s=3.0)
    try:
        yield Line(mesh, peers, clock)
    finally:
        await mesh.aclose()


def _run(data: Path, role: str, ask: Callable[[Line], Awaitable[T]]) -> T:
    async def go() -> T:
        async with open_line(data, role) as line:
            return await ask(line)

    try:
        return asyncio.run(go())
    except PeerDown as error:
        error.hint = error.hint or NOBODY
        raise


def _show(result: Any, as_json: bool, view: Callable[[], RenderableType]) -> None:
    if as_json:
        print(json.dumps(_plain(result), indent=1))
    else:
        Console().print(view())


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    return [_plain(item) for item in value] if isinstance(value, list) else value


async def _states(line: Line, kind: PeerKind, expect: type[T]) -> list[T]:
    """All answers; raises the first error only when nobody answered."""
    answers = await line.mesh.ask_all(line.peers.of_kind(kind), "GET", "/state", expect=expect)
    good = [answer for answer in answers.values() if not isinstance(answer, GardenError)]
    for name, answer in answers.items():
        if isinstance(answer, GardenError):
            if not good:
                raise answer
            print(f"garden: {name}: {answer}", file=sys.stderr)
    return good


def plants(data: Path, as_json: bool) -> None:
    states = _run(data, "", lambda line: _states(line, "plant", PlantState))
    _show(states, as_json, lambda: tables.plants(states))


def robots(data: Path, as_json: bool) -> None:
    states = _run(data, "", lambda line: _states(line, "robot", RobotState))
    _show(states, as_json, lambda: tables.robots(states))


def status(data: Path, watch: bool, as_json: bool) -> None:
    if watch and not as_json:
        try:
            _run(data, "", _watch)
        except KeyboardInterrupt:
            return
    snapshot = _run(data, "", lambda line: look(line.mesh, line.peers))
    if not (snapshot.plants or snapshot.robots) and snapshot.silent:
        raise PeerDown(snapshot.silent[0].why, hint=NOBODY)
    _show(snapshot, as_json, lambda: tables.picture(snapshot))


async def _watch(line: Line) -> None:
    with Live(refresh_per_second=4, screen=True) as live:
        while True:
            live.update(tables.picture(await look(line.mesh, line.peers)))
            await asyncio.sleep(WATCH_S)


def tasks(task_id: str, diagram: bool, out: Path | None, data: Path, as_json: bool) -> None:
    if not task_id and (diagram or out is not None):
        raise BadRequest("a diagram is of one task", hint="`garden tasks` lists them; then `garden tasks ID --diagram`")
    if task_id:
        story = _run(data, "", lambda line: _story(line, task_id))
        if out is not None:
            write(story, out)
        if as_json:
            print(json.dumps(story.task.model_dump(mode="json") | {"story": _plain(story.steps)}, indent=1))
        elif diagram:
            print(text(story), end="")
        elif out is None:
            Console().print(tables.story(story))
        return
    listed = _run(data, "", _all_tasks)
    _show(listed, as_json, lambda: tables.tasks(listed))


async def _all_tasks(line: Line) -> list[Task]:
    await _states(line, "plant", PlantState)  # raises when no pot answers at all
    return await all_tasks(line.mesh, line.peers)


async def _find_task(line: Line, task_id: str) -> Task:
    """Only the pot that owns a task knows it, so all are asked."""
    answers = await line.mesh.ask_all(line.peers.of_kind("plant"), "GET", f"/tasks/{task_id}", expect=Task)
    for answer in answers.values():
        if isinstance(answer, Task):
            return answer
    down = [answer for answer in answers.values() if isinstance(answer, PeerDown)]
    if down and len(down) == len(answers):
        raise down[0]
    raise NotFound(f"no pot knows a task {task_id!r}", hint="`garden tasks` lists them")


async def _story(line: Line, task_id: str) -> Story:
    """The task and what everybody who knows of it remembers; who does not answer is left out."""
    plants = [peer for peer in line.peers.of_kind("plant") if peer.id == owner_of(task_id)]
    noted = await line.mesh.ask_all(plants, "GET", f"/history?task_id={task_id}&limit=5000", expect=list[HistoryEntry])
    own = [entry for answer in noted.values() if not isinstance(answer, GardenError) for entry in answer]
    try:
        task = await _find_task(line, task_id)
    except NotFound:
        if (forgotten := remembered(task_id, own)) is None:
            raise
        task = forgotten
    told = await line.mesh.ask_all(line.peers.of_kind("robot"), "GET", "/history", expect=list[HistoryEntry])
    heard = {name: answer for name, answer in told.items() if not isinstance(answer, GardenError)}
    return tell(task, own, heard)


def water(plant: str, ml: float | None, within_s: float | None, priority: int, data: Path, as_json: bool) -> None:
    request = _request(TaskRequest, kind="water", dose_ml=ml, within_s=within_s, priority=priority)

    async def ask(line: Line) -> Task:
        return await line.mesh.call(line.peer(plant, "plant"), "POST", "/tasks", request, expect=Task, key=_key())

    task = _run(data, "operator", ask)
    _show(task, as_json, lambda: f"{task.task_id}: {plant} asks for {task.dose_ml:g} ml; `garden tasks {task.task_id}`")


def harvest(count: int, plant: str, wait: bool, within_s: float | None, priority: int, data: Path, as_json: bool) -> None:
    """Order ripe fruit and tell how it goes; ends with status 1 unless all of it came."""
    wish = _request(OrderRequest, count=count, plant_id=plant, within_s=within_s, priority=priority)

    async def ask(line: Line) -> Order:
        pots = [line.peer(plant, "plant")] if plant else line.peers.of_kind("plant")
        order = await _order(line, wish, pots)
        told, top_ups = "", 0
        while wait:
            if order.state != "running":
                more = await top_up(order, wish, pots, line.mesh, _sender(line)) if top_ups < TOP_UPS_MAX else None
                if more is None:
                    break
                order, top_ups = more, top_ups + 1
            if not as_json and (now := tables.progress(order)) != told:
                told = now
                print(told, flush=True)
            await asyncio.sleep(POLL_S)
            order = order_of(order.order_id, await all_tasks(line.mesh, line.peers), order) or order
        return order

    ended = _run(data, "operator", ask)
    _show(ended, as_json, lambda: tables.order(ended))
    if ended.state not in ("running", "done"):
        sys.exit(1)


def cancel(name: str, data: Path, as_json: bool) -> None:
    """A task, or an order with all its tasks; the same again changes nothing."""

    async def off(line: Line, plant_id: str, task_id: str) -> Task:
        return await line.mesh.call(line.peer(plant_id, "plant"), "DELETE", f"/tasks/{task_id}", expect=Task)

    async def ask(line: Line) -> Task | Order:
        if owner := owner_of(name):
            return await off(line, owner, name)
        if (order := order_of(name, await all_tasks(line.mesh, line.peers))) is None:
            raise NotFound(f"nobody knows a task or an order {name!r}", hint="`garden tasks` lists the tasks")

        async def part_off(part: OrderPart) -> Task:
            return await off(line, part.plant_id, part.task_id)

        await call_off(order, part_off)
        return order_of(name, await all_tasks(line.mesh, line.peers), order) or order

    ended = _run(data, "operator", ask)
    told = f"{ended.task_id}: {ended.state}" if isinstance(ended, Task) else ""
    _show(ended, as_json, lambda: tables.order(ended) if isinstance(ended, Order) else told)


def _sender(line: Line) -> Send:
    async def send(pot: Peer, request: TaskRequest) -> Task:
        return await line.mesh.call(pot, "POST", "/tasks", request, expect=Task, key=_key())

    return send


def _key() -> str:
    """A new Idempotency-Key: what was recorded on the way is, said again, the same request and not another one."""
    return secrets.token_hex(16)


async def _order(line: Line, wish: OrderRequest, pots: list[Peer]) -> Order:
    now_s = line.clock.now()
    order_id = f"o{int(1000 * now_s)}"

    parts = await place(order_id, wish, pots, line.mesh, _sender(line))
    return Order(
        order_id=order_id, count=wish.count, plant_id=wish.plant_id, asked_by="operator", created_s=now_s, updated_s=now_s,
        parts=parts, delivered=0,
    )  # fmt: skip


D = TypeVar("D", bound=Document)


def _request(model: type[D], **fields: Any) -> D:
    """A request from command-line values; raises BadRequest in plain words."""
    try:
        return model(**fields)
    except ValueError as error:
        told = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in getattr(error, "errors", list)())
        raise BadRequest(told or str(error)) from error


async def _each(line: Line, robot: str, what: str, tell: Callable[[Peer], Awaitable[Stopped]]) -> list[Stopped]:
    """At one robot or at all; all are told even when some do not answer, then the first error is raised."""

    async def told(peer: Peer) -> Stopped | GardenError:
        try:
            return await tell(peer)
        except GardenError as error:
            print(f"garden: {peer.id} did NOT {what}: {error}", file=sys.stderr)
            return error

    asked = [line.peer(robot, "robot")] if robot else line.peers.of_kind("robot")
    answers = await asyncio.gather(*map(told, asked))
    if failed := [answer for answer in answers if isinstance(answer, GardenError)]:
        raise failed[0]
    return [answer for answer in answers if isinstance(answer, Stopped)]


async def _resume(line: Line, peer: Peer, stop_number: int) -> Stopped:
    """Release the stop of this number, or the one that is latched when 0; a robot that is not stopped is left alone."""
    if not stop_number:
        state = await line.mesh.call(peer, "GET", "/state", expect=RobotState)
        if not state.stopped:
            return Stopped(robot_id=peer.id, stopped=False)
        if not state.stop_number:
            raise Unavailable(f"the stop of {peer.id} is not written down", hint="look at its disk, then stop it again")
        stop_number = state.stop_number
    wish = _request(ResumeRequest, stop_number=stop_number)
    return await line.mesh.call(peer, "POST", "/resume", wish, expect=Stopped)


def _told_stopped(listed: list[Stopped]) -> str:
    return "\n".join(
        f"{one.robot_id}: {f'stopped by {one.by} (stop {one.stop_number})' if one.stopped else 'goes on'}" for one in listed
    )


def stop(robot: str, reason: str, data: Path, as_json: bool) -> None:
    request = _request(StopRequest, reason=reason)

    def run(line: Line) -> Awaitable[list[Stopped]]:
        return _each(line, robot, "stop", lambda peer: line.mesh.call(peer, "POST", "/stop", request, expect=Stopped))

    stopped = _run(data, "operator", run)
    _show(stopped, as_json, lambda: _told_stopped(stopped))


def resume(robot: str, stop_number: int, data: Path, as_json: bool) -> None:
    if stop_number and not robot:
        raise BadRequest("which robot's stop is that?", hint=f"garden resume ROBOT --stop {stop_number}")
    stopped = _run(data, "operator", lambda line: _each(line, robot, "go on", lambda peer: _resume(line, peer, stop_number)))
    _show(stopped, as_json, lambda: _told_stopped(stopped))


def goto(robot: str, x_m: float, y_m: float, yaw_deg: float | None, wait: bool, data: Path, as_json: bool) -> None:
    yaw_rad = None if yaw_deg is None else math.radians(yaw_deg)
    _send_job(robot, _request(JobRequest, kind="goto", x_m=x_m, y_m=y_m, yaw_rad=yaw_rad), wait, data, as_json)


def job(robot: str, kind: JobKind, where: str, wait: bool, data: Path, as_json: bool) -> None:
    _send_job(robot, _request(JobRequest, kind=kind, at=where), wait, data, as_json)


def _send_job(robot: str, request: JobRequest, wait: bool, data: Path, as_json: bool) -> None:
    async def send(line: Line) -> Job:
        peer = line.peer(robot, "robot")
        sent = await line.mesh.call(peer, "POST", "/jobs", request, expect=Job, key=_key())
        while wait and sent.state in ("queued", "running"):
            await asyncio.sleep(POLL_S)
            sent = await line.mesh.call(peer, "GET", f"/jobs/{sent.job_id}", expect=Job)
        return sent

    ended = _run(data, "operator", send)
    told = f"{ended.job_id}: {ended.kind} {ended.state}" + (f" ({ended.reason})" if ended.reason else "")
    _show(ended, as_json, lambda: told)
    if ended.state in ("failed", "cancelled"):
        sys.exit(1)
