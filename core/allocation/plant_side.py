"""A plant's side of the market (DESIGN, section 6; paper 000, section 7 and fig. 13) as a pure state machine.

Whoever runs it calls an event (`ask`, `bid`, `report`, `permit`, `soil`, `cancel`, `tick` ...) with the garden time, makes
`document()` durable when `dirty`, and only then carries out `take_effects()` and answers. Nothing here waits.
A task lives through announced, awarded, running and ends done, failed or cancelled. Moving to another robot adds to its
epoch. After a restart `Market(..., document)` goes on: holders get a fresh lease, an open permit its whole waiting time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from core.allocation import permits
from core.allocation.auction import Round, better_than_holder, cheapest, told
from core.allocation.epochs import Names, owner_of
from core.allocation.permits import Dose, OpenPermit
from core.allocation.plant_state import Effect, Grant, Kill, Limits, Live, MarketDocument, Note, Rules, Soil, Solicit
from core.errors import Conflict, NotFound, Refused
from core.wire.market import (
    FINAL_STATES,
    Announcement,
    Award,
    Bid,
    BidRound,
    Permit,
    PermitRequest,
    PlantCard,
    Report,
    ReportAnswer,
    Task,
    TaskEvent,
    TaskKind,
)


class Market:
    """One plant's tasks, their holders and the permit. See the module's text for the order of calls."""

    def __init__(
        self,
        card: PlantCard,
        document: MarketDocument | None,
        now_s: float,
        rules: Rules | None = None,
        limits: Limits | None = None,
    ) -> None:
        self.card, self.rules, self.limits = card, rules or Rules(), limits or Limits()
        before = document or MarketDocument()
        self._names = Names(card.plant_id, before.boot + 1)
        self._tasks = {task.task_id: task for task in before.tasks}
        self._failures = dict(before.failures)
        self._doses = permits.recent(before.doses, now_s)
        self._live = {task.task_id: Live.revived(task, now_s, self.rules) for task in self.open_tasks()}
        self._permit = before.open_permit
        self._settle_at_s = math.inf
        self._soil = Soil(None, "not measured yet", -math.inf)
        self._rounds = 0
        self._effects: list[Effect] = []
        self.dirty = True
        self._restart_permit(now_s)

    # What others read

    def tasks(self) -> list[Task]:
        """All known tasks, oldest first; finished ones are forgotten after a while."""
        return list(self._tasks.values())

    def open_tasks(self) -> list[Task]:
        return [task for task in self._tasks.values() if task.state not in FINAL_STATES]

    def task(self, task_id: str) -> Task:
        """Raises NotFound, with a hint when the id is another plant's."""
        if (task := self._tasks.get(task_id)) is not None:
            return task
        owner = owner_of(task_id)
        mine = owner in ("", self.card.plant_id)
        hint = "GET /tasks lists what is known here" if mine else f"ids tell their plant: ask {owner}"
        raise NotFound(f"{self.card.plant_id} has no task {task_id}", hint=hint)

    def given_ml(self, now_s: float) -> float:
        """Millilitres debited in the past 24 hours."""
        return permits.given_ml(self._doses, now_s)

    def left_ml(self, now_s: float) -> float:
        return max(0.0, self.limits.day_cap_ml - self.given_ml(now_s))

    @property
    def permit_open(self) -> bool:
        return self._permit is not None

    @property
    def soaking(self) -> bool:
        """A measurement is awaited: look more often."""
        return self._settle_at_s < math.inf

    def waiting(self, now_s: float) -> str:
        """Why nothing happens although something is wanted; empty when nothing is amiss."""
        if self._permit is not None and now_s >= self._settle_at_s and self._soil.ratio is None:
            return f"cannot tell whether the last dose arrived: the soil probe is {self._soil.why}"
        if self._permit is not None and now_s < self._settle_at_s < math.inf:
            return f"measuring again in {self._settle_at_s - now_s:.0f} s, when the last dose has soaked in"
        for task in self.open_tasks():
            if task.state == "announced" and (why := self._live[task.task_id].told):
                return f"nobody can take {task.task_id}: {why}"[:500]
        return ""

    def document(self) -> MarketDocument:
        """What must be durable before effects and answers leave."""
        return MarketDocument(
            boot=self._names.boot,
            tasks=list(self._tasks.values()),
            failures={k: v for k, v in self._failures.items() if k in self._tasks},
            open_permit=self._permit,
            doses=list(self._doses),
        )

    def take_effects(self) -> list[Effect]:
        effects, self._effects = self._effects, []
        return effects

    def due_s(self) -> float:
        """When `tick` is next worth calling."""
        return min((self._task_due_s(task) for task in self.open_tasks()), default=math.inf)

    # Events: people and the plant

    def ask(self, kind: TaskKind, dose_ml: float, by: str, why: str, now_s: float, priority: int = 5) -> Task:
        """A new task; raises Conflict while another of its kind is open, Refused when it could not be served safely."""
        for task in self.open_tasks():
            if task.kind == kind:
                raise Conflict(f"{task.task_id} already asks for {kind}", hint="look at it, or cancel it first")
        if len(self.open_tasks()) >= self.rules.open_max:
            raise Conflict(f"{self.card.plant_id} has {self.rules.open_max} open tasks", hint="wait, or cancel one")
        if kind == "water":
            self._check_dose(now_s)
        task_id = self._names.next()
        task = Task(
            task_id=task_id, kind=kind, state="announced", plant_id=self.card.plant_id, created_s=now_s, updated_s=now_s,
            asked_by=by, why=why[:500], dose_ml=dose_ml, priority=priority,
        )  # fmt: skip
        self._tasks[task_id] = task
        self._live[task_id] = Live(next_ask_s=now_s)
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
        self._expect_settling(task, now_s)
        return self._finish(task, "cancelled", f"cancelled by {by}: {why}" if why else f"cancelled by {by}", now_s)

    def soil(self, ratio: float | None, why: str, now_s: float) -> None:
        """A judged reading: the water content, or None and why. Settles an open permit when its time has come."""
        self._soil = Soil(ratio, why, now_s)
        if self._permit is None or ratio is None or now_s < self._settle_at_s:
            return
        self._settle(self._permit, ratio, now_s)

    # Events: robots

    def bid(self, task_id: str, round_number: int, robot_id: str, bid: Bid, now_s: float) -> None:
        """A robot's answer, or `auction.no_bid` for one that could not be reached. Late ones change nothing."""
        live = self._live.get(task_id)
        if live is None or live.round is None or live.round.number != round_number:
            return
        live.round.take(robot_id, bid, task_id)
        if live.round.complete:
            self._close_round(self._tasks[task_id], live.round, now_s)

    def award_answered(self, task_id: str, epoch: int, refused: str, now_s: float) -> None:
        """The robot took the award, or refused it and why. One that did not answer is asked again by `tick`."""
        task, live = self._tasks.get(task_id), self._live.get(task_id)
        if task is None or live is None or task.epoch != epoch or task.state not in ("awarded", "running"):
            return
        live.resend_s = math.inf
        if refused and task.state == "awarded":
            self._release(task, f"{task.robot_id} refused the award: {refused}", now_s, failed=True)

    def report(self, task_id: str, report: Report, now_s: float) -> ReportAnswer:
        """A robot's progress. Renews the lease of the one live epoch; anybody else is told to drop it. Idempotent."""
        task = self.task(task_id)
        if self._holds_permit(task_id, report.robot_id, report.epoch) and report.state in ("done", "failed"):
            self._acted(report, now_s)
        if task.state in FINAL_STATES:
            same = report.robot_id == task.robot_id and report.epoch == task.epoch and report.state == task.state
            return ReportAnswer(keep=same, reason=f"{task_id} is {task.state}", lease_s=self.rules.lease_s)
        if report.robot_id != task.robot_id or report.epoch != task.epoch:
            who = f"held by {task.robot_id} under epoch {task.epoch}" if task.robot_id else "being announced"
            return ReportAnswer(keep=False, reason=f"{task_id} is {who}", lease_s=self.rules.lease_s)
        self._heard(task, report, now_s)
        return ReportAnswer(keep=True, lease_s=self.rules.lease_s)

    def permit(self, task_id: str, request: PermitRequest, key: str, now_s: float) -> Permit:
        """A one-shot permit, or Refused and why. The same Idempotency-Key gets the same permit, never a second one."""
        task = self.task(task_id)
        held = self._permit
        if held is not None and self._holds_permit(task_id, request.robot_id, request.epoch) and key and key == held.key:
            return held.again(now_s)
        self._check_permit(task, request, now_s)
        dose_ml = min(request.amount_ml or task.dose_ml, task.dose_ml, self.left_ml(now_s))
        permit = Permit(
            permit_id=self._names.next("p"), task_id=task_id, epoch=task.epoch, act=request.act, dose_ml=dose_ml,
            valid_for_s=self.rules.permit_valid_s,
        )  # fmt: skip
        before = self._soil.ratio if self._soil.ratio is not None else 0.0
        self._permit = OpenPermit(permit=permit, robot_id=task.robot_id, key=key, issued_s=now_s, before_ratio=before)
        self._settle_at_s = math.inf
        self._doses = [*permits.recent(self._doses, now_s), Dose(permit_id=permit.permit_id, t_s=now_s, ml=dose_ml)]
        self._live[task_id].lease_until_s = now_s + self.rules.lease_s
        task = self._put(task, now_s, state="running", permit_id=permit.permit_id, permits=task.permits + 1)
        self._event(task, f"permit {permit.permit_id} for {dose_ml:.0f} ml", now_s)
        return permit

    # Events: time

    def tick(self, now_s: float, robots: Sequence[str]) -> None:
        """Whatever is due at this time: rounds to open or close, leases that ended, awards to send again."""
        for task in self.open_tasks():
            if self._task_due_s(task) > now_s:
                continue
            live = self._live[task.task_id]
            if live.round is not None and now_s >= live.round.deadline_s:
                self._close_round(task, live.round, now_s)
            elif task.state == "announced":
                self._open_round(task, "award", robots, now_s)
            else:
                self._watch(task, live, robots, now_s)

    def _watch(self, task: Task, live: Live, robots: Sequence[str], now_s: float) -> None:
        if now_s >= live.lease_until_s:
            self._fell_silent(task, live, now_s)
        elif now_s >= live.running_since_s + self.rules.run_s_max:
            self._kill(task)
            self._release(task, f"{task.robot_id} kept it {self.rules.run_s_max:.0f} s without acting", now_s, failed=True)
        elif now_s >= live.resend_s:
            live.resend_s = now_s + self.rules.resend_s
            self._effects.append(self._grant(task, live.cost_s))
        elif now_s >= live.reallocate_s:
            self._open_round(task, "reallocate", robots, now_s)

    def _task_due_s(self, task: Task) -> float:
        live = self._live[task.task_id]
        if live.round is not None:
            return min(live.round.deadline_s, math.inf if task.state == "announced" else live.lease_until_s)
        if task.state == "announced":
            return math.inf if self._blocked(task) else live.next_ask_s
        if self._holds_permit(task.task_id, task.robot_id, task.epoch):
            finished = self._permit is not None and self._permit.finished
            return math.inf if live.silent or finished else live.lease_until_s
        overrun_s = live.running_since_s + self.rules.run_s_max
        return min(live.lease_until_s, live.resend_s, live.reallocate_s, overrun_s)

    # Rounds

    def _blocked(self, task: Task) -> bool:
        """While a permit is open no robot need come: it could not act."""
        return task.kind == "water" and self._permit is not None

    def _open_round(self, task: Task, purpose: Literal["award", "reallocate"], robots: Sequence[str], now_s: float) -> None:
        live = self._live[task.task_id]
        live.reallocate_s = now_s + self.rules.reallocate_s if purpose == "reallocate" else math.inf
        if purpose == "reallocate" and not set(robots) - {task.robot_id}:
            return
        self._rounds += 1
        live.round = Round(
            number=self._rounds, asked=frozenset(robots), deadline_s=now_s + self.rules.bid_window_s, purpose=purpose
        )
        if not robots:
            self._close_round(task, live.round, now_s)
            return
        self._effects.append(Solicit(self._announcement(task), self._rounds, tuple(sorted(robots))))

    def _close_round(self, task: Task, closed: Round, now_s: float) -> None:
        live = self._live[task.task_id]
        live.round = None
        bids = closed.bids(task.task_id)
        if closed.purpose == "reallocate":
            self._close_reallocation(task, bids, now_s)
        elif task.state == "announced":
            self._close_award(task, live, bids, now_s)

    def _close_award(self, task: Task, live: Live, bids: list[Bid], now_s: float) -> None:
        if (best := cheapest(bids)) is None:
            return self._nobody(task, live, bids, now_s)
        live.told, live.backoff_s = "", 0.0
        cost_s = best.cost_s or 0.0
        self._award(task, best.robot_id, cost_s, bids, f"cheapest of {len(bids)}: {cost_s:.1f} s", now_s)

    def _nobody(self, task: Task, live: Live, bids: list[Bid], now_s: float) -> None:
        live.backoff_s = min(max(self.rules.backoff_s_min, 2.0 * live.backoff_s), self.rules.ask_again_s_max)
        live.next_ask_s = now_s + live.backoff_s
        why = told(bids)[:400]
        if why != live.told:
            live.told = why
            task = self._with_round(task, bids, "", why, now_s)
            self._event(task, f"nobody can take it: {why}", now_s)

    def _close_reallocation(self, task: Task, bids: list[Bid], now_s: float) -> None:
        if task.state != "awarded":
            return
        best = better_than_holder(bids, task.robot_id, self.rules.margin_ratio)
        if best is None:
            return
        own = next(bid for bid in bids if bid.robot_id == task.robot_id)
        was = f"{own.cost_s:.1f} s" if own.cost_s is not None else f"no bid ({own.reason})"
        cost_s = best.cost_s or 0.0
        why = f"moved from {task.robot_id}, now {was}, to {best.robot_id} at {cost_s:.1f} s"
        self._kill(task)
        self._award(task, best.robot_id, cost_s, bids, why[:500], now_s)

    def _award(self, task: Task, robot_id: str, cost_s: float, bids: list[Bid], why: str, now_s: float) -> None:
        live = self._live[task.task_id]
        task = self._put(task, now_s, state="awarded", robot_id=robot_id, epoch=task.epoch + 1, phase="", progress=0.0)
        task = self._with_round(task, bids, robot_id, why, now_s)
        live.lease_until_s = now_s + self.rules.lease_s
        live.reallocate_s = now_s + self.rules.reallocate_s
        live.resend_s = now_s + self.rules.resend_s
        live.running_since_s = math.inf
        live.cost_s = cost_s
        self._event(task, f"awarded to {robot_id}, epoch {task.epoch}: {why}", now_s)
        self._effects.append(self._grant(task, cost_s))

    def _grant(self, task: Task, cost_s: float) -> Grant:
        award = Award(announcement=self._announcement(task), epoch=task.epoch, lease_s=self.rules.lease_s, cost_s=cost_s)
        return Grant(task.robot_id, award)

    def _announcement(self, task: Task) -> Announcement:
        return Announcement(
            task_id=task.task_id, kind=task.kind, plant=self.card, dose_ml=task.dose_ml, priority=task.priority,
            holder=task.robot_id,
        )  # fmt: skip

    # Holders

    def _heard(self, task: Task, report: Report, now_s: float) -> None:
        live = self._live[task.task_id]
        live.lease_until_s, live.silent, live.resend_s = now_s + self.rules.lease_s, False, math.inf
        if report.state in ("done", "failed"):
            self._ended(task, report, now_s)
        elif report.state != task.state and task.permit_id == "":
            live.running_since_s = now_s if report.state == "running" else math.inf
            task = self._put(task, now_s, state=report.state, phase=report.phase, progress=report.progress)
            self._event(task, report.phase or report.state, now_s)
        else:
            self._put_soft(task, now_s, phase=report.phase, progress=report.progress)

    def _ended(self, task: Task, report: Report, now_s: float) -> None:
        if self._holds_permit(task.task_id, report.robot_id, report.epoch):
            phase = "soaking: the plant measures whether the dose arrived"
            if task.phase != phase:
                task = self._put(task, now_s, phase=phase, progress=1.0, reason=report.reason)
                self._event(task, f"{report.robot_id} reports {report.state}: {report.reason or 'no remark'}", now_s)
        elif report.state == "done":
            self._release(task, f"{report.robot_id} reports done but took no permit", now_s, failed=True)
        else:
            self._release(task, f"{report.robot_id} failed: {report.reason or 'no reason given'}", now_s, failed=True)

    def _fell_silent(self, task: Task, live: Live, now_s: float) -> None:
        if self._holds_permit(task.task_id, task.robot_id, task.epoch):
            live.silent = True
            self._expect_settling(task, now_s)
            self._event(task, f"{task.robot_id} fell silent under a permit: measuring before anything else", now_s)
            self._kill(task)
            return
        self._kill(task)
        self._release(task, f"{task.robot_id} fell silent for {self.rules.lease_s:g} s", now_s, failed=False)

    def _release(self, task: Task, why: str, now_s: float, *, failed: bool) -> None:
        """Back to the market, or failed for good after too many failures."""
        failures = self._failures.get(task.task_id, 0) + (1 if failed else 0)
        self._failures[task.task_id] = failures
        if failures >= self.rules.failures_max:
            self._finish(task, "failed", f"{why} ({failures} failures)", now_s)
            return
        wait_s = min(self.rules.backoff_s_min * 2 ** (failures - 1), self.rules.backoff_s_max) if failures else 0.0
        self._live[task.task_id] = Live(next_ask_s=now_s + wait_s, backoff_s=wait_s)
        task = self._put(task, now_s, state="announced", robot_id="", phase="", progress=0.0, reason=why[:500])
        self._event(task, why, now_s)

    def _kill(self, task: Task) -> None:
        if task.robot_id:
            self._effects.append(Kill(task.robot_id, task.task_id, task.epoch))

    def _finish(self, task: Task, state: str, reason: str, now_s: float) -> Task:
        del self._live[task.task_id]
        task = self._put(task, now_s, state=state, phase="", reason=reason[:500])
        self._event(task, f"{state}: {reason}", now_s)
        ended = [t.task_id for t in self._tasks.values() if t.state in FINAL_STATES]
        for task_id in ended[: -self.rules.finished_kept]:
            del self._tasks[task_id]
        return task

    # The permit

    def _check_dose(self, now_s: float) -> None:
        if self._soil.ratio is None:
            raise Refused(f"the soil probe is {self._soil.why}: a dose could not be verified", hint="mend the probe first")
        if self.left_ml(now_s) < permits.DOSE_ML_MIN:
            raise Refused(f"the day's {self.limits.day_cap_ml:.0f} ml are given", hint="wait, or raise day_cap_ml")

    def _check_permit(self, task: Task, request: PermitRequest, now_s: float) -> None:
        if task.robot_id != request.robot_id or task.epoch != request.epoch or task.state not in ("awarded", "running"):
            holder = f"held by {task.robot_id or 'nobody'} under epoch {task.epoch}, {task.state}"
            raise Refused(f"{task.task_id} is {holder}", hint="drop it; the plant will announce it again if need be")
        if now_s > self._live[task.task_id].lease_until_s:
            raise Refused(f"the lease on {task.task_id} has ended", hint="report at least every two seconds")
        if (request.act == "water") != (task.kind == "water"):
            raise Refused(f"a task of kind {task.kind} does not {request.act}", hint="ask for the act the task is for")
        if self._permit is not None:
            raise Refused(
                f"permit {self._permit.permit.permit_id} is not settled: the plant must measure again first",
                hint="a permit is for one act; wait for the plant",
            )
        if request.act == "water":
            self._check_dose(now_s)

    def _holds_permit(self, task_id: str, robot_id: str, epoch: int) -> bool:
        held = self._permit
        return held is not None and (held.permit.task_id, held.robot_id, held.permit.epoch) == (task_id, robot_id, epoch)

    def _acted(self, report: Report, now_s: float) -> None:
        """The permit's holder says that its act is over: note what it gave and when to measure."""
        held = self._permit
        if held is None or held.finished:
            return
        if report.delivered_ml is not None:
            self._doses = permits.corrected(self._doses, held.permit.permit_id, report.delivered_ml)
        self._permit = held.model_copy(update={"finished": True, "delivered_ml": report.delivered_ml})
        # Whatever it says, nothing can begin after the permit's validity.
        self._settle_at_s = max(now_s, held.valid_until_s()) + self.limits.soak_s
        self.dirty = True

    def _expect_settling(self, task: Task, now_s: float) -> None:
        """Nobody will tell about this permit's act: measure when it must be over and soaked in."""
        if self._permit is None or self._permit.permit.task_id != task.task_id or self._permit.finished:
            return
        self._settle_at_s = max(now_s, self._permit.act_over_s()) + self.limits.soak_s

    def _settle(self, held: OpenPermit, ratio: float, now_s: float) -> None:
        task = self._tasks.get(held.permit.task_id)
        self._permit, self._settle_at_s, self.dirty = None, math.inf, True
        rise = ratio - held.before_ratio
        seen = f"soil went from {held.before_ratio:.3f} to {ratio:.3f}"
        self._effects.append(Note("measured", seen, held.permit.task_id, held.robot_id, {"rise_ratio": rise}))
        if task is None or task.state in FINAL_STATES:
            return
        task = self._put(task, now_s, permit_id="", delivered_ml=held.delivered_ml)
        if rise >= permits.rise_needed(held.permit.dose_ml):
            if held.delivered_ml is None:
                self._put(task, now_s, delivered_ml=held.permit.dose_ml)
            self._finish(self._tasks[task.task_id], "done", seen, now_s)
        elif ratio >= self.limits.target_ratio:
            self._finish(task, "done", f"{seen}: no rise, but wet enough", now_s)
        elif task.permits >= self.rules.doses_max:
            self._finish(task, "failed", f"{seen} after {task.permits} doses: look at nozzle, tank and probe", now_s)
        else:
            self._release(task, f"{seen}: the dose did not arrive, asking again", now_s, failed=False)

    # After a restart

    def _restart_permit(self, now_s: float) -> None:
        """The clock of before may not be this one: an open permit waits its whole time anew."""
        if self._permit is None:
            return
        self._permit = self._permit.model_copy(update={"issued_s": now_s})
        task = self._tasks.get(self._permit.permit.task_id)
        if self._permit.finished:
            self._settle_at_s = self._permit.valid_until_s() + self.limits.soak_s
        elif task is None or task.state in FINAL_STATES:
            self._settle_at_s = self._permit.act_over_s() + self.limits.soak_s

    # Book-keeping

    def _put(self, task: Task, now_s: float, **changes: Any) -> Task:
        self.dirty = True
        return self._put_soft(task, now_s, **changes)

    def _put_soft(self, task: Task, now_s: float, **changes: Any) -> Task:
        """A change that may be lost with the process."""
        task = task.model_copy(update={"updated_s": now_s, **changes})
        self._tasks[task.task_id] = task
        return task

    def _with_round(self, task: Task, bids: list[Bid], winner: str, why: str, now_s: float) -> Task:
        entry = BidRound(t_s=now_s, epoch=task.epoch, bids=bids, winner=winner, why=why[:500])
        return self._put(task, now_s, rounds=[*task.rounds, entry][-self.rules.rounds_kept :])

    def _event(self, task: Task, what: str, now_s: float) -> None:
        """In the task's own story, and in the plant's history."""
        task = self._tasks[task.task_id]
        entry = TaskEvent(t_s=now_s, what=what[:500], robot_id=task.robot_id, epoch=task.epoch)
        self._put(task, now_s, events=[*task.events, entry][-self.rules.events_kept :])
        self._effects.append(Note(task.state, what[:500], task.task_id, task.robot_id))
