"""A plant's side of the market (DESIGN, section 6; paper 000, section 7 and fig. 13) as a pure state machine.

Whoever runs it calls an event (`ask`, `bid`, `report`, `permit`, `soil`, `fruits`, `cancel`, `tick` ...) with the garden
time, makes `document()` durable when `dirty`, and only then carries out `take_effects()` and answers. Nothing here waits.
A task lives through announced, awarded, running and ends done, failed or cancelled. Moving to another robot adds to its
epoch. After a restart `Market(..., document.by_clock(now_s))` goes on: holders get a fresh lease, an open permit its whole
waiting time. Tasks, rounds and leases are in `tasks`; what a dose needs in `watering`, what a pick needs in `picking`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from core.allocation.picking import Picking, picked, settles, told
from core.allocation.plant_state import Keyed, Limits, Live, MarketDocument, Note, Rules, Soil
from core.allocation.tasks import TaskBook
from core.allocation.watering import Measured, Watering
from core.errors import Conflict, Refused
from core.wire.fruit import Fruit, Pick
from core.wire.market import FINAL_STATES, Permit, PermitRequest, PlantCard, Report, ReportAnswer, Task, TaskKind


class Market(TaskBook):
    """One plant's tasks, their holders and the permits. See the module's text for the order of calls."""

    def __init__(
        self,
        card: PlantCard,
        document: MarketDocument | None,
        now_s: float,
        rules: Rules | None = None,
        limits: Limits | None = None,
    ) -> None:
        """Goes on from `document`, whose times are of this clock (`MarketDocument.by_clock`)."""
        before = document or MarketDocument()
        super().__init__(card, before, now_s, rules)
        self.limits = limits or Limits()
        self._water = Watering(before.open_permit, before.doses, now_s, self.limits)
        self._picks = Picking(before.open_pick, before.doubts)
        self._scanned = dict(before.scanned)
        if (held := self._water.open) is not None:
            task = self._tasks.get(held.permit.task_id)
            self._water.revive(now_s, task_open=task is not None and task.state not in FINAL_STATES)
        if (pick := self._picks.open) is not None and not self._is_live(pick.permit.task_id):
            self._picks.doubt()

    # What others read

    def given_ml(self, now_s: float) -> float:
        """Millilitres debited in the past 24 hours."""
        return self._water.given_ml(now_s)

    def left_ml(self, now_s: float) -> float:
        return self._water.left_ml(now_s)

    @property
    def permit_open(self) -> bool:
        """Of a dose."""
        return self._water.open is not None

    @property
    def soaking(self) -> bool:
        """A measurement is awaited: look more often."""
        return self._water.settle_at_s < math.inf

    @property
    def doubts(self) -> list[str]:
        """Fruit whose permitted pick nobody told the end of: a scan comes before anything else is picked."""
        return list(self._picks.doubts)

    def undecided(self, now_s: float) -> list[str]:
        """Fruit whose pick may still be under way: a scan settles nothing about them."""
        return self._picks.undecided(now_s)

    def open_of(self, kind: TaskKind) -> Task | None:
        return next((task for task in self.open_tasks() if task.kind == kind), None)

    def waiting(self, now_s: float) -> str:
        """Why nothing happens although something is wanted; empty when nothing is amiss."""
        if why := self._water.waiting(now_s):
            return why
        for task in self.open_tasks():
            if task.state == "announced" and (why := self._live[task.task_id].told):
                return f"nobody can take {task.task_id}: {why}"[:500]
        return ""

    def document(self) -> MarketDocument:
        """What must be durable before effects and answers leave."""
        return MarketDocument(
            boot=self._names.boot, tasks=list(self._tasks.values()),
            failures={k: v for k, v in self._failures.items() if k in self._tasks}, open_permit=self._water.open,
            doses=list(self._water.doses), doses_at_s=self._water.at_s, open_pick=self._picks.open,
            doubts=list(self._picks.doubts.values()),
            scanned={k: v for k, v in self._scanned.items() if k in self._tasks}, keyed=list(self._keyed.values()),
        )  # fmt: skip

    # Events: people and the plant

    def ask(
        self,
        kind: TaskKind,
        dose_ml: float,
        by: str,
        why: str,
        now_s: float,
        priority: int = 5,
        *,
        within_s: float | None = None,
        fruit_ids: Sequence[str] = (),
        count: int = 0,
        order_id: str = "",
        asking: Keyed | None = None,
    ) -> Task:
        """A new task, remembered as what `asking` made.

        Raises Conflict while another of its kind (or, of a harvest, for one of its fruit) is open.
        Raises Refused when it could not be served safely.
        """
        for task in self.open_tasks():
            if task.kind == kind and (kind != "harvest" or set(fruit_ids) & set(task.fruit_ids)):
                raise Conflict(f"{task.task_id} already asks for {kind}", hint="look at it, or cancel it first")
        if len(self.open_tasks()) >= self.rules.open_max:
            raise Conflict(f"{self.card.plant_id} has {self.rules.open_max} open tasks", hint="wait, or cancel one")
        if kind == "water":
            self._water.check(now_s)
        if kind == "harvest" and not fruit_ids:
            raise Refused("no fruit to pick was named", hint="GET /inventory?colour=red lists what is ripe")
        task_id = self._names.next()
        task = Task(
            task_id=task_id, kind=kind, state="announced", plant_id=self.card.plant_id, created_s=now_s, updated_s=now_s,
            asked_by=by, why=why[:500], dose_ml=dose_ml, priority=priority, fruit_ids=list(fruit_ids), count=count,
            order_id=order_id, deadline_s=None if within_s is None else now_s + within_s,
        )  # fmt: skip
        self._tasks[task_id] = task
        self._live[task_id] = Live(next_ask_s=now_s)
        if asking is not None:
            self._remember(asking, task)
        self._event(task, f"asked for by {by}: {why}", now_s)
        return self._tasks[task_id]

    def cancel(self, task_id: str, by: str, why: str, now_s: float) -> Task:
        """An operator, or the plant, no longer wants it. Idempotent; raises Conflict for one that ended otherwise."""
        task = self.task(task_id)
        if task.state == "cancelled":
            return task
        if task.state in FINAL_STATES:
            raise Conflict(f"{task_id} is {task.state} already", hint="nothing is left to cancel")
        self._kill(task)
        self._water.expect_settling(task_id, now_s)
        self._doubt_pick_of(task, now_s)
        return self._finish(task, "cancelled", f"cancelled by {by}: {why}" if why else f"cancelled by {by}", now_s)

    def soil(self, ratio: float | None, why: str, now_s: float, stamp_s: float | None = None) -> None:
        """A judged reading: the water content, or None and why. Settles an open permit when its time has come.

        `stamp_s` is when it was taken [garden s], None for now: what stood before a dose cannot tell whether it arrived.
        Tells of water that no dose explains.
        """
        reading = Soil(ratio, why, now_s if stamp_s is None else stamp_s)
        if (measured := self._water.measured(reading, now_s)) is not None:
            self._settle_dose(measured, now_s)
        if told := self._water.unasked():
            self._effects.append(Note("unasked", told, "", ""))

    def fruits(self, fruits: Iterable[Fruit], now_s: float) -> None:
        """The inventory as it is now; a harvest that nobody has begun ends when none of its fruit is left to pick."""
        self._picks.know(fruits)
        for task in self.open_tasks():
            if task.kind == "harvest" and task.state == "announced" and not self._picks.doubts:
                self._end_if_over(task, "", now_s)

    def scanned(self, task_id: str, robot_id: str, scan_id: str, now_s: float) -> None:
        """A scan came for this task, whatever its kind; raises Refused unless its holder sent it."""
        task = self.check_scan(task_id, robot_id)
        if task.kind == "inventory" and task_id not in self._scanned:
            self._scanned[task_id] = scan_id
            self._event(task, f"{robot_id} has scanned", now_s)

    def check_scan(self, task_id: str, robot_id: str) -> Task:
        """The task a scan is for; raises Refused unless the robot holds it: what it saw may be long past."""
        task = self.task(task_id)
        if task.robot_id != robot_id or not self._is_live(task_id):
            holder = f"held by {task.robot_id or 'nobody'}, {task.state}"
            raise Refused(f"{task_id} is {holder}: its scan is too late", hint="the plant asks for another if need be")
        return task

    def settle(self, decided: Mapping[str, bool], now_s: float) -> None:
        """A scan decided about fruit in doubt: whether each still hangs there."""
        for fruit_id, hanging in decided.items():
            if (held := self._picks.doubts.get(fruit_id)) is None:
                continue
            self._picks.close(held)
            seen = "still hanging" if hanging else "gone"
            self._effects.append(Note("settled", f"a scan finds {fruit_id} {seen}", held.permit.task_id, held.robot_id))
            self.dirty = True
            task = self._tasks.get(held.permit.task_id)
            if task is not None and not hanging and all(pick.fruit_id != fruit_id for pick in task.picks):
                self._note_pick(task, _found_gone(fruit_id, held.permit.permit_id), now_s)
            if task is not None and task.kind == "harvest" and task.state == "announced" and not self._picks.doubts:
                self._end_if_over(self._tasks[task.task_id], "", now_s)

    # Events: robots

    def report(self, task_id: str, report: Report, now_s: float) -> ReportAnswer:
        """A robot's progress. Renews the lease of the one live epoch; anybody else is told to drop it. Idempotent."""
        task = self.task(task_id)
        if self._water.holds(task_id, report.robot_id, report.epoch) and report.state in ("done", "failed"):
            self.dirty |= self._water.acted(report.delivered_ml, now_s)
        if task.kind == "harvest":
            task = self._take_picks(task, report, now_s)
            if task.state == "announced" and not self._picks.doubts and self._end_if_over(task, "", now_s):
                task = self._tasks[task_id]
        if task.state in FINAL_STATES:
            same = report.robot_id == task.robot_id and report.epoch == task.epoch and report.state == task.state
            return ReportAnswer(keep=same, reason=f"{task_id} is {task.state}", lease_s=self.rules.lease_s)
        if report.robot_id != task.robot_id or report.epoch != task.epoch:
            who = f"held by {task.robot_id} under epoch {task.epoch}" if task.robot_id else "being announced"
            return ReportAnswer(keep=False, reason=f"{task_id} is {who}", lease_s=self.rules.lease_s)
        self._heard(task, report, now_s)
        return ReportAnswer(keep=True, lease_s=self.rules.lease_s)

    def verdicts(self, task_id: str, report: Report) -> list[Pick]:
        """The picks of a report that `report` would believe: what the inventory must show before they are acknowledged."""
        task, picks = self.task(task_id), self._picks
        known = {(pick.fruit_id, pick.permit_id) for pick in task.picks}
        new = [pick for pick in report.picks if (pick.fruit_id, pick.permit_id) not in known]
        settled = [p for p in new if settles(picks.held(p.permit_id, report.robot_id), p, picks.open)]
        return settled + [p for p in new if p not in settled and self._untouched(task, report, p)]

    def permit(self, task_id: str, request: PermitRequest, key: str, now_s: float) -> Permit:
        """A one-shot permit, or Refused and why. The same Idempotency-Key gets the same permit, never a second one."""
        task = self.task(task_id)
        who = (task_id, request.robot_id, request.epoch)
        for held in (self._water.open, self._picks.open):
            mine = held is not None and (held.permit.task_id, held.robot_id, held.permit.epoch) == who
            if held is not None and mine and key and key == held.key:
                return held.again(now_s)
        self._check_permit(task, request, now_s)
        permit = self._dose(task, request, key, now_s) if request.act == "water" else self._pick(task, request, key, now_s)
        self._live[task_id].lease_until_s = now_s + self.rules.lease_s
        return permit

    # Permits

    def _check_permit(self, task: Task, request: PermitRequest, now_s: float) -> None:
        if task.robot_id != request.robot_id or task.epoch != request.epoch or task.state not in ("awarded", "running"):
            holder = f"held by {task.robot_id or 'nobody'} under epoch {task.epoch}, {task.state}"
            raise Refused(f"{task.task_id} is {holder}", hint="drop it; the plant will announce it again if need be")
        if now_s > self._live[task.task_id].lease_until_s:
            raise Refused(f"the lease on {task.task_id} has ended", hint="report at least every two seconds")
        if {"water": "water", "harvest": "pick"}.get(task.kind) != request.act:
            raise Refused(f"a task of kind {task.kind} does not {request.act}", hint="ask for the act the task is for")
        if request.act == "pick":
            self._picks.check(task, request.fruit_id)
            return
        if self._water.open is not None:
            raise Refused(
                f"permit {self._water.open.permit.permit_id} is not settled: the plant must measure again first",
                hint="a permit is for one act; wait for the plant",
            )
        self._water.check(now_s)

    def _dose(self, task: Task, request: PermitRequest, key: str, now_s: float) -> Permit:
        dose_ml = min(request.amount_ml or task.dose_ml, task.dose_ml, self.left_ml(now_s))
        permit = self._new_permit(task, request, dose_ml=dose_ml)
        self._water.issue(permit, task.robot_id, key, now_s)
        self._permitted(task, permit, f"{dose_ml:.0f} ml", now_s)
        return permit

    def _pick(self, task: Task, request: PermitRequest, key: str, now_s: float) -> Permit:
        permit = self._new_permit(task, request, fruit_id=request.fruit_id)
        self._picks.issue(permit, task.robot_id, key, now_s)
        self._permitted(task, permit, request.fruit_id, now_s)
        return permit

    def _new_permit(self, task: Task, request: PermitRequest, **what: Any) -> Permit:
        return Permit(
            permit_id=self._names.next("p"), task_id=task.task_id, epoch=task.epoch, act=request.act,
            valid_for_s=self.rules.permit_valid_s, **what,
        )  # fmt: skip

    def _permitted(self, task: Task, permit: Permit, what: str, now_s: float) -> None:
        task = self._put(task, now_s, state="running", permit_id=permit.permit_id, permits=task.permits + 1)
        self._event(task, f"permit {permit.permit_id} for {what}", now_s)

    # What the task book asks

    def _blocked_until_s(self, task: Task) -> float:
        """While a permit is open, or the soil cannot be measured, no robot need come: it could not act.

        A doubt is settled by a scan before anything. One harvest after the other: there is one dock, and two robots would be
        in each other's way.
        """
        if task.kind == "water" and (self._water.open is not None or self._water.soil.ratio is None):
            return math.inf
        if task.kind == "harvest" and (self._picks.doubts or self._picks.open is not None or self._being_harvested()):
            return math.inf
        return self._picks.clear_s() if task.kind == "inventory" else -math.inf

    def _in_vain(self, task: Task, now_s: float) -> str:
        return self._water.spent(now_s) if task.kind == "water" else ""

    def _permit_due_s(self, task: Task, live: Live) -> float | None:
        if self._water.holds(task.task_id, task.robot_id, task.epoch):
            finished = self._water.open is not None and self._water.open.finished
            return math.inf if live.silent or finished else live.lease_until_s
        if self._picks.open is not None and self._picks.holds(task.task_id, task.robot_id, task.epoch):
            return min(live.lease_until_s, self._picks.open.act_over_s())
        return None

    def _permit_overdue(self, task: Task, now_s: float) -> None:
        self._kill(task)
        self._doubt_pick_of(task, now_s)
        self._release(task, f"{task.robot_id} did not tell how its pick ended", now_s, failed=True)

    def _silent(self, task: Task, live: Live, now_s: float) -> None:
        if self._water.holds(task.task_id, task.robot_id, task.epoch):
            live.silent = True
            self._water.expect_settling(task.task_id, now_s)
            self._event(task, f"{task.robot_id} fell silent under a permit: measuring before anything else", now_s)
            self._kill(task)
            return
        if task.task_id in self._scanned:
            self._kill(task)
            self._finish(task, "done", "scanned", now_s)
            return
        self._doubt_pick_of(task, now_s)
        super()._silent(self._tasks[task.task_id], live, now_s)

    def _too_late(self, task: Task, now_s: float) -> None:
        if task.task_id in self._scanned:
            self._finish(task, "done", "scanned", now_s)
        else:
            super()._too_late(task, now_s)

    def _details(self, task: Task) -> dict[str, Any]:
        if task.kind == "harvest":
            count = min(task.count - picked(task), 64)
            return {"fruits": self._picks.left(task)[:64], "count": max(0, count), "order_id": task.order_id}
        return {"fruits": list(self._picks.fruits.values())[:64]} if task.kind == "inventory" else {}

    # Holders

    def _heard(self, task: Task, report: Report, now_s: float) -> None:
        live = self._live[task.task_id]
        live.lease_until_s, live.silent, live.resend_s = now_s + self.rules.lease_s, False, math.inf
        if report.state in ("done", "failed"):
            {"harvest": self._harvest_ended, "inventory": self._inventory_ended}.get(task.kind, self._water_ended)(
                task, report, now_s
            )
        elif report.state != task.state and task.permit_id == "" and not (task.kind == "harvest" and task.permits):
            live.running_since_s = now_s if report.state == "running" else math.inf
            task = self._put(task, now_s, state=report.state, phase=report.phase, progress=report.progress)
            self._event(task, report.phase or report.state, now_s)
        else:
            self._put_soft(task, now_s, phase=report.phase, progress=report.progress)

    def _water_ended(self, task: Task, report: Report, now_s: float) -> None:
        if self._water.holds(task.task_id, report.robot_id, report.epoch):
            phase = "soaking: the plant measures whether the dose arrived"
            if task.phase != phase:
                task = self._put(task, now_s, phase=phase, progress=1.0, reason=report.reason)
                self._event(task, f"{report.robot_id} reports {report.state}: {report.reason or 'no remark'}", now_s)
        elif report.state == "done":
            self._release(task, f"{report.robot_id} reports done but took no permit", now_s, failed=True)
        else:
            self._release(task, _failed(report), now_s, failed=True)

    def _inventory_ended(self, task: Task, report: Report, now_s: float) -> None:
        if task.task_id in self._scanned:
            self._finish(task, "done", report.reason or "scanned", now_s)
        elif report.state == "done":
            self._release(task, f"{report.robot_id} reports done but sent no scan", now_s, failed=True)
        else:
            self._release(task, _failed(report), now_s, failed=True)

    def _settle_dose(self, measured: Measured, now_s: float) -> None:
        held, seen = measured.held, measured.told
        task = self._tasks.get(held.permit.task_id)
        self.dirty = True
        self._effects.append(Note("measured", seen, held.permit.task_id, held.robot_id, {"rise_ratio": measured.rise}))
        if task is None or task.state in FINAL_STATES:
            return
        task = self._put(task, now_s, permit_id="", delivered_ml=held.delivered_ml)
        if measured.arrived:
            if held.delivered_ml is None:
                self._put(task, now_s, delivered_ml=held.permit.dose_ml)
            self._finish(self._tasks[task.task_id], "done", seen, now_s)
        elif measured.ratio >= self.limits.target_ratio:
            self._finish(task, "done", f"{seen}: no rise, but wet enough", now_s)
        elif task.permits >= self.rules.doses_max:
            self._finish(task, "failed", f"{seen} after {task.permits} doses: look at nozzle, tank and probe", now_s)
        else:
            self._release(task, f"{seen}: the dose did not arrive, asking again", now_s, failed=False)

    # Harvests

    def _take_picks(self, task: Task, report: Report, now_s: float) -> Task:
        """What a report tells about picks, whoever holds the task now: a permit's end is the truth, late or not."""
        for pick in self.verdicts(task.task_id, report):
            held = self._picks.held(pick.permit_id, report.robot_id)
            if held is not None:
                self._picks.close(held)
            task = self._note_pick(task, pick, now_s)
        return task

    def _untouched(self, task: Task, report: Report, pick: Pick) -> bool:
        """The holder says that it could not even try: no permit was taken."""
        held_by = (task.robot_id, task.epoch) == (report.robot_id, report.epoch) and self._is_live(task.task_id)
        asked = pick.fruit_id in task.fruit_ids and pick.fruit_id not in self._picks.doubts
        return held_by and asked and not pick.permit_id and pick.outcome != "picked"

    def _note_pick(self, task: Task, pick: Pick, now_s: float) -> Task:
        others = [p for p in task.picks if p.fruit_id != pick.fruit_id]
        permit_id = "" if task.permit_id == pick.permit_id else task.permit_id
        task = self._put(task, now_s, picks=[*others, pick], permit_id=permit_id)
        if (live := self._live.get(task.task_id)) is not None and live.running_since_s < math.inf:
            live.running_since_s = now_s
        self._event(task, f"{pick.fruit_id} {pick.outcome}" + (f": {pick.reason}" if pick.reason else ""), now_s)
        return self._tasks[task.task_id]

    def _doubt_pick_of(self, task: Task, now_s: float) -> None:
        """Nobody is left to tell how this task's open pick ended."""
        if self._picks.open is None or self._picks.open.permit.task_id != task.task_id:
            return
        fruit_id = self._picks.doubt()
        task = self._put(task, now_s, permit_id="")
        self._event(task, f"nobody told how the pick of {fruit_id} ended: a scan comes first", now_s)

    def _harvest_ended(self, task: Task, report: Report, now_s: float) -> None:
        self._doubt_pick_of(task, now_s)
        task = self._tasks[task.task_id]
        if self._picks.doubts:
            self._release(task, f"{report.robot_id} ended without telling how a pick ended", now_s, failed=False)
        elif not self._end_if_over(task, report.reason, now_s):
            why = _failed(report) if report.state == "failed" else f"{report.robot_id} left {told(task)}"
            self._release(task, why, now_s, failed=True)

    def _end_if_over(self, task: Task, reason: str, now_s: float) -> bool:
        """Ends a harvest that has what was wanted, or that has nothing left to try."""
        if picked(task) < task.count and self._picks.left(task):
            return False
        why = told(task) if task.picks else "none of its fruit is left to pick"
        self._finish(task, "done" if picked(task) else "failed", f"{why}; {reason}" if reason else why, now_s)
        return True

    def _being_harvested(self) -> bool:
        return any(task.kind == "harvest" and self._is_live(task.task_id) for task in self.open_tasks())

    def _is_live(self, task_id: str) -> bool:
        task = self._tasks.get(task_id)
        return task is not None and task.state in ("awarded", "running")


def _failed(report: Report) -> str:
    return f"{report.robot_id} failed: {report.reason or 'no reason given'}"


def _found_gone(fruit_id: str, permit_id: str) -> Pick:
    return Pick(fruit_id=fruit_id, outcome="picked", reason="nobody told; a scan found it gone", permit_id=permit_id)
