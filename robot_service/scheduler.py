"""Keeps the queue moving: what is next, who is told, what is taken away, and what to do when there is nothing to do."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any, Literal

from core.allocation.bidding import (
    BATTERY_FORCED_RATIO,
    BATTERY_LOW_RATIO,
    TANK_RESERVE_ML,
)
from core.allocation.queue import Entry, TaskQueue
from core.allocation.right_of_way import RANK_IDLE, in_the_way_of
from core.geometry.planar import distance_m
from core.wire.market import Report
from robot_service.docks import RENEW_S, Docks
from robot_service.fitness import PUMP
from robot_service.planner import Planner
from robot_service.reporter import Reporter
from robot_service.robot import RANK_BUSY, Halted, Robot, SkillFailed, reason_of, tuple_of
from robot_service.skills.dock import dock_at, insist
from robot_service.skills.drive import drive_to, undock
from robot_service.spread import EVERY_S, FAILED_S, Spread

IDLE_LOOK_S = 2.0
HOME_LOOK_S = 10.0
"""At home or on a dock, where only a neighbour changes anything."""
HOME_M = 0.25
AFTER_FAILURE_S = 5.0
OWN_RETRY_S = 60.0
"""An errand of our own that failed is not tried again sooner."""


@dataclass(slots=True)
class Scheduler:
    robot: Robot
    docks: Docks
    planner: Planner
    queue: TaskQueue
    reporter: Reporter
    spread: Spread
    began_s: float = 0.0
    _work: asyncio.Task[Any] | None = None
    _idling: bool = False
    _changed: asyncio.Event = field(default_factory=asyncio.Event)
    _own_after_s: float = 0.0
    _own_number: int = 0
    _sent: bool = False
    """An operator sent it where it stands: it stays until it is needed elsewhere, or in somebody's way."""

    def __post_init__(self) -> None:
        self.queue.may_wait = self._may_wait

    # ------------------------------------------------------------------ what others do to the queue
    def changed(self) -> None:
        """Something was added: leave idleness, a charge that is enough, or the way to what comes later now."""
        self._changed.set()
        head, running = self.queue.next(), self.queue.running
        if self._work is not None and (self._idling or (running is not None and running is not head)):
            self._work.cancel()
        if head is not None and head.running and head.kind == "charge" and len(self.queue.entries) > 1:
            head.killed = head.killed or "a task waits"

    def _may_wait(self, entry: Entry) -> bool:
        """The robot is only on its way there, and no deadline counts on that."""
        asked = entry.announcement
        free = asked is not None and asked.within_s is None and not entry.killed and not entry.committed
        return free and self.robot.activity.job == "navigate"

    def kill(self, entry: Entry, why: str) -> None:
        """Take an entry away: at once before the permit, after the dose beyond it."""
        entry.killed = why
        if not entry.running:
            self.queue.drop(entry)
            self.robot.note("kill", f"{entry.kind} dropped: {why}", task_id=entry.task_id)
        elif not entry.committed and self._work is not None:
            self._work.cancel()

    def halt(self, why: str) -> None:
        """The e-stop: what waits in the queue is given back; what runs ends by itself at its next look."""
        for entry in list(self.queue.entries):
            if not entry.running:
                self._give_back(entry, why)

    def _give_back(self, entry: Entry, why: str) -> None:
        """The plant asks others."""
        self.queue.drop(entry)
        if entry.announcement is not None:
            self.robot.note("kill", f"{entry.kind} given back: {why}", task_id=entry.task_id)
            self.reporter.finish(entry, _gave_up(self.robot.settings.id, entry, why))

    def cannot(self, part: str, why: str) -> None:
        """Something was found broken beside the work: what waits for it is given back."""
        self.robot.fitness.failed(part, why)
        self._give_back_undoable()

    def _give_back_undoable(self) -> None:
        """What waits and asks for a pump that failed, or for water that is nowhere to be had."""
        robot, state = self.robot, self.robot.body.state
        broken, dry = robot.fitness.why_not(PUMP), self._no_water()
        left_ml = math.inf if state is None or state.tank_ml is None else state.tank_ml
        for entry in list(self.queue.waiting):
            if entry.announcement is None or entry.kind != "water" or entry.running:
                continue
            left_ml -= entry.announcement.dose_ml
            if broken or (dry and left_ml < TANK_RESERVE_ML):
                self._give_back(entry, broken or dry)

    def _no_water(self) -> str:
        """Why no tap gives water; empty when one may."""
        dry = self.robot.taps().values()
        return "; ".join(dry) if all(dry) else ""

    # ------------------------------------------------------------------ the loop
    async def run(self) -> None:
        while True:
            self._changed.clear()
            entry = self._choose()
            if entry is None:
                await self._idle_until_changed()
            else:
                await self._execute(entry)

    def _choose(self) -> Entry | None:
        """The next entry, a needed errand of our own before it."""
        if self._stopped():
            return None
        head = self.queue.next()
        own = self._own_errand(head)
        if own is not None and not self.queue.has(own) and self.robot.clock.now() >= self._own_after_s:
            self._own_number += 1
            task_id = f"{self.robot.settings.id}:{own}:{self._own_number}"
            self.queue.push(Entry(task_id=task_id, kind=own), first=True)
        return self.queue.next()

    def _stopped(self) -> bool:
        state = self.robot.body.state
        return state is None or bool(self.robot.body.down) or state.stopped

    def _own_errand(self, head: Entry | None) -> Literal["charge", "refill"] | None:
        state = self.robot.body.state
        if state is None or (head is not None and head.kind in ("charge", "refill", "job")):
            return None
        limit_ratio = BATTERY_FORCED_RATIO if head is not None else BATTERY_LOW_RATIO
        resting = bool(self.robot.where.docked_at)
        if state.battery_ratio < limit_ratio and (head is not None or not resting):
            return "charge"
        dose_ml = head.announcement.dose_ml if head is not None and head.announcement is not None else 0.0
        if state.tank_ml is not None and head is not None and state.tank_ml < dose_ml + TANK_RESERVE_ML:
            return None if self._no_water() else "refill"
        return None

    async def _execute(self, entry: Entry) -> None:
        entry.running, self.began_s = True, self.robot.clock.now()
        self.spread.later()
        self.robot.note("task", f"begins {entry.kind} {entry.plant_id}".strip(), task_id=entry.task_id)
        report, cut = await self._worked(self.planner.run(entry))
        if cut and not entry.killed:
            self._put_off(entry)
            return
        self.queue.drop(entry)
        self._rest()
        if report is None:
            report = _gave_up(self.robot.settings.id, entry, entry.killed)
        outcome = f"{entry.kind} {report.state}" + (f": {report.reason}" if report.reason else "")
        self.robot.note("task", outcome, task_id=entry.task_id, delivered_ml=report.delivered_ml)
        if entry.announcement is not None and not cut:
            self.reporter.finish(entry, report)
        if entry.announcement is None and report.state == "failed":
            self._own_after_s = self.robot.clock.now() + OWN_RETRY_S
        self.reporter.jobs_ended(entry, report)
        self._give_back_undoable()
        self._sent = entry.job is not None and entry.job.kind in ("goto", "undock") and report.state == "done"
        if cut and self.robot.where.docked_at and not self._stopped():
            await self._worked(self._leave())

    def _put_off(self, entry: Entry) -> None:
        """Something that lies nearer comes first."""
        entry.running, head = False, self.queue.next()
        self._rest()
        before = head.plant_id or head.kind if head is not None else ""
        self.robot.note("task", f"puts {entry.kind} {entry.plant_id} off: {before} comes first", task_id=entry.task_id)

    async def _worked(self, work: Coroutine[Any, Any, Any]) -> tuple[Any, bool]:
        """Run it as a task of its own that `kill` can cancel. Returns (result, cut short)."""
        self._work = asyncio.create_task(work)
        try:
            await asyncio.wait({self._work})
            if self._work.cancelled():
                return None, True
            return self._work.result(), False
        finally:
            if not self._work.done():
                self._work.cancel()
            self._work = None

    async def _leave(self) -> None:
        try:
            await undock(self.robot, self.docks)
        except SkillFailed as error:
            self.robot.note("undock", reason_of(error))

    def _rest(self) -> None:
        activity = self.robot.activity
        activity.job, activity.waiting, activity.route = "idle", "", []
        activity.rank = RANK_BUSY if self.robot.where.docked_at else RANK_IDLE

    # ------------------------------------------------------------------ idleness
    async def _idle_until_changed(self) -> None:
        if self.queue.entries and not self._stopped():
            return
        self._idling = True
        try:
            await self._worked(self._idle())
        finally:
            self._idling = False

    async def _idle(self) -> None:
        """One round of what an idle robot does; returns so that the queue is looked at again."""
        self._rest()
        try:
            if self._stopped():
                await self._dwell()
            elif not self._sent and (place := await self.spread.place()):
                await self._wait_at(place)
            elif self.robot.where.docked_at:
                await self._rest_on_dock(self.robot.where.docked_at)
            else:
                await self._stand_by()
        except Halted:
            await self.robot.clock.sleep(IDLE_LOOK_S)
        except SkillFailed as error:
            self.robot.activity.waiting = reason_of(error)
            self.robot.note("idle", reason_of(error))
            self.robot.body.want("stop")
            await self.robot.clock.sleep(AFTER_FAILURE_S)

    async def _dwell(self) -> None:
        state = self.robot.body.state
        self.robot.activity.job = "stopped" if state is not None and state.stopped else "idle"
        self.robot.activity.waiting = self.robot.body.down or (
            f"stopped by {state.stopped_by or 'the e-stop'}" if state else ""
        )
        self.robot.body.rest(True)
        await self.robot.clock.sleep(1.0)

    async def _rest_on_dock(self, name: str) -> None:
        """Stay and charge until somebody wants the dock."""
        hold = self.docks.holds.get(name)
        if hold is None or not hold.yielding or hold.lost:
            await insist(self.robot, self.docks, self.robot.dock(name), yielding=True)
            hold = self.docks.holds.get(name)
        if hold is not None and (hold.wanted_by or hold.lost):
            self.robot.note("yield", f"leaves {name} to {hold.wanted_by or 'its owner'}")
            self.spread.later()
            await undock(self.robot, self.docks)
            await self._go_home()
            return
        self.robot.body.rest(True)
        await self.robot.clock.sleep(IDLE_LOOK_S)
        if hold is not None and not (hold.wanted_by or hold.lost):
            await self.docks.news(HOME_LOOK_S - IDLE_LOOK_S)

    async def _wait_at(self, name: str) -> None:
        """Go and rest on another dock, unless its owner or somebody else wants otherwise meanwhile."""
        dock = self.robot.dock(name)
        if await self.docks.ask(dock, yielding=True):
            return
        self.robot.note("spread", f"goes to wait at {name}, nearer to what may come")
        self.spread.later(FAILED_S)
        going = asyncio.ensure_future(dock_at(self.robot, self.docks, name, yielding=True, rank=RANK_IDLE))
        try:
            while not going.done() and not self._is_wanted(name):
                news = asyncio.ensure_future(self.docks.news(RENEW_S))
                await asyncio.wait({going, news}, return_when=asyncio.FIRST_COMPLETED)
                news.cancel()
                if not going.done():
                    await self.docks.ask(dock, yielding=True)
            if going.done():
                going.result()
                self.spread.later(EVERY_S)
        finally:
            going.cancel()
            await asyncio.gather(going, return_exceptions=True)

    def _is_wanted(self, name: str) -> bool:
        """The dock that we go to rest on is somebody's to work at."""
        hold = self.docks.holds.get(name)
        return hold is None or bool(hold.lost or hold.wanted_by)

    async def _stand_by(self) -> None:
        await self.docks.release_others()
        home = tuple_of(self.robot.settings.home)
        pose = self.robot.where.pose
        if pose is None:
            self.robot.activity.waiting = self.robot.where.lost
            self.robot.body.rest(False)
            await self.robot.clock.sleep(IDLE_LOOK_S)
            return
        me = (RANK_IDLE, self.robot.settings.id)
        away = distance_m(pose, home) > HOME_M and not self._sent
        if away or in_the_way_of(me, pose, self.robot.neighbours.others()):
            self._sent = False
            await self._go_home()
            return
        self.robot.body.rest(True)
        await self.robot.clock.sleep(IDLE_LOOK_S)
        await self.robot.neighbours.stir(HOME_LOOK_S - IDLE_LOOK_S)

    async def _go_home(self) -> None:
        self.robot.activity.job = "home"
        await drive_to(self.robot, tuple_of(self.robot.settings.home), rank=RANK_IDLE)


def _gave_up(robot_id: str, entry: Entry, why: str) -> Report:
    return Report(robot_id=robot_id, epoch=entry.epoch, state="failed", phase=entry.phase, reason=why[:500])
