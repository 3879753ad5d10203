"""A plant's tasks: their rounds of bids, awards, leases and failures (DESIGN, section 6; paper 000, section 7 and fig. 13).

`TaskBook` knows nothing of what a task is for. `plant_side.Market` adds that: what a kind needs before it is asked, what
happens under a permit, and when the work is done.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal
from zlib import crc32

from core.allocation.auction import SILENT, Round, better_than_holder, cheapest, told, worth_s
from core.allocation.epochs import Names, owner_of
from core.allocation.plant_state import Effect, Grant, Keyed, Kill, Live, MarketDocument, Note, Rules, Solicit
from core.errors import Conflict, NotFound, Unprocessable
from core.wire.market import FINAL_STATES, Announcement, Award, Bid, BidRound, PlantCard, Task, TaskEvent

SILENCES_MAX = 3
"""A holder that does not answer is asked again after twice as long each time, up to 2 ** this."""


class TaskBook:
    """One plant's tasks and who holds them. Its runner calls events with the garden time and carries out the effects."""

    def __init__(self, card: PlantCard, before: MarketDocument, now_s: float, rules: Rules | None = None) -> None:
        self.card, self.rules = card, rules or Rules()
        self._names = Names(card.plant_id, before.boot + 1)
        self._tasks = {task.task_id: task for task in before.tasks}
        self._failures = dict(before.failures)
        self._keyed = {each.name: each for each in before.keyed}
        self._live = {task.task_id: Live.revived(task, now_s, self.rules) for task in self.open_tasks()}
        self._rounds = 0
        self._gave_up_s: dict[str, float] = {}
        self._effects: list[Effect] = []
        self.dirty = True

    # What a kind of task decides

    def _blocked_until_s(self, task: Task) -> float:
        """No robot need be asked before then; infinite while something else must happen first."""
        return -math.inf

    def _in_vain(self, task: Task, now_s: float) -> str:
        """Why no robot could do it whoever came, so that it ends; empty otherwise."""
        return ""

    def _permit_due_s(self, task: Task, live: Live) -> float | None:
        """While the holder has a permit: when the plant stops waiting for its word; None without a permit."""
        return None

    def _permit_overdue(self, task: Task, now_s: float) -> None:
        """That time has come."""

    def _silent(self, task: Task, live: Live, now_s: float) -> None:
        """The holder's lease has ended."""
        self._kill(task)
        self._release(task, f"{task.robot_id} fell silent for {self.rules.lease_s:g} s", now_s, failed=False)

    def _too_late(self, task: Task, now_s: float) -> None:
        """Its deadline has come, and nobody has begun it."""
        self._kill(task)
        who = f"{task.robot_id} had it in its queue" if task.robot_id else self._live[task.task_id].told
        why = f"not begun within {(task.deadline_s or now_s) - task.created_s:g} s, its deadline"
        self._finish(task, "missed", f"{why}: {who}" if who else why, now_s)

    def _details(self, task: Task) -> dict[str, Any]:
        """What an announcement tells beside the task itself."""
        return {}

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

    def gave_up_s(self, kind: str) -> float:
        """When such a task last failed at its own work: deadlines say nothing against asking again, nor does what was before
        a restart, for somebody may have mended it. Minus infinity when none did."""
        return self._gave_up_s.get(kind, -math.inf)

    def asked_before(self, asking: Keyed) -> Task | None:
        """The task that this request made when it first came; None for a new request.

        Raises Unprocessable when its key came with another request, Conflict when the task is forgotten.
        """
        if (before := self._keyed.get(asking.name)) is None:
            return None
        if before.request != asking.request:
            raise Unprocessable("this Idempotency-Key came before with another body", hint="take a new key")
        if (task := self._tasks.get(before.task_id)) is None:
            raise Conflict(f"{before.task_id}, asked for under this Idempotency-Key, ended long ago", hint="take a new key")
        return task

    def due_s(self) -> float:
        """When `tick` is next worth calling."""
        return min((self._task_due_s(task) for task in self.open_tasks()), default=math.inf)

    def take_effects(self) -> list[Effect]:
        effects, self._effects = self._effects, []
        return effects

    # Events: robots

    def bid(self, task_id: str, round_number: int, robot_id: str, bid: Bid, now_s: float) -> None:
        """A robot's answer, or `auction.no_bid` for one that could not be reached. Late ones change nothing."""
        live = self._live.get(task_id)
        if live is None or live.round is None or live.round.number != round_number:
            return
        live.round.take(robot_id, bid, task_id)
        if live.round.complete:
            self._close_round(self._tasks[task_id], live.round, now_s)

    def award_answered(self, task_id: str, epoch: int, refused: str, now_s: float, *, overtaken: bool = False) -> None:
        """The robot took the award, or refused it and why. One that did not answer is asked again by `tick`.

        `overtaken`: its bid holds no more, so all are asked again at once. That is nobody's failure.
        """
        task, live = self._tasks.get(task_id), self._live.get(task_id)
        if task is None or live is None or task.epoch != epoch or task.state not in ("awarded", "running"):
            return
        live.resend_s = math.inf
        if overtaken and task.state == "awarded":
            self._declined(task, live, refused, now_s)
        elif refused and task.state == "awarded":
            self._release(task, f"{task.robot_id} refused the award: {refused}", now_s, failed=True)

    # Events: time

    def tick(self, now_s: float, robots: Sequence[str]) -> None:
        """Whatever is due at this time: rounds to open or close, leases that ended, awards to send again."""
        for task in sorted(self.open_tasks(), key=lambda task: -task.priority):
            if self._task_due_s(task) > now_s:
                continue
            live = self._live[task.task_id]
            if now_s >= _begin_by_s(task):
                self._too_late(task, now_s)
            elif live.round is not None and now_s >= live.round.deadline_s:
                self._close_round(task, live.round, now_s)
            elif task.state == "announced" and (why := self._in_vain(task, now_s)):
                self._finish(task, "failed", why, now_s)
            elif task.state == "announced":
                self._open_round(task, "award", robots, now_s)
            else:
                self._watch(task, live, robots, now_s)

    def _watch(self, task: Task, live: Live, robots: Sequence[str], now_s: float) -> None:
        if now_s >= live.lease_until_s:
            self._silent(task, live, now_s)
        elif (overdue_s := self._permit_due_s(task, live)) is not None:
            if now_s >= overdue_s:
                self._permit_overdue(task, now_s)
        elif now_s >= live.running_since_s + self.rules.run_s_max:
            self._kill(task)
            self._release(task, f"{task.robot_id} kept it {self.rules.run_s_max:.0f} s without acting", now_s, failed=True)
        elif now_s >= live.resend_s:
            live.resend_s = now_s + self.rules.resend_s
            self._effects.append(self._grant(task, live.cost_s, now_s))
        elif now_s >= self._reallocate_s(task, live):
            self._open_round(task, "reallocate", robots, now_s)

    def _reallocate_s(self, task: Task, live: Live) -> float:
        """When all are asked again whether they would do it sooner; what runs stays where it is."""
        return max(live.reallocate_s, self._free_s()) if task.state == "awarded" else math.inf

    def _task_due_s(self, task: Task) -> float:
        return min(self._next_s(task), _begin_by_s(task))

    def _next_s(self, task: Task) -> float:
        live = self._live[task.task_id]
        if live.round is not None:
            return min(live.round.deadline_s, math.inf if task.state == "announced" else live.lease_until_s)
        if task.state == "announced":
            return max(live.next_ask_s, self._blocked_until_s(task), self._free_s())
        if (permit_due_s := self._permit_due_s(task, live)) is not None:
            return permit_due_s
        overrun_s = live.running_since_s + self.rules.run_s_max
        return min(live.lease_until_s, live.resend_s, self._reallocate_s(task, live), overrun_s)

    def _free_s(self) -> float:
        """When a further round may open at the latest, as far as is known: as many may be open at once."""
        ends_s = [live.round.deadline_s for live in self._live.values() if live.round is not None]
        return min(ends_s) if len(ends_s) >= self.rules.auctions_max else -math.inf

    # Rounds

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
        self._effects.append(Solicit(self._announcement(task, now_s), self._rounds, tuple(sorted(robots))))

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
        live, own = self._live[task.task_id], next((bid for bid in bids if bid.robot_id == task.robot_id), None)
        if own is None or own.reason == SILENT:
            # Its lease decides. It is gone, or so far behind that more questions would leave it further behind.
            live.silences = min(live.silences + 1, SILENCES_MAX)
            live.reallocate_s = now_s + self.rules.reallocate_s * 2**live.silences
            return
        live.silences = 0
        best = better_than_holder(bids, task.robot_id, self.rules.margin_ratio)
        if best is None:
            return
        if own.cost_s is not None and live.moves >= self.rules.moves_max:
            return
        live.moves += 1
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
        winner = next(bid for bid in bids if bid.robot_id == robot_id)
        patient = live.declines < self.rules.declines_max
        live.at_most_s = worth_s(bids, winner, self.rules.margin_ratio) if patient else None
        self._event(task, f"awarded to {robot_id}, epoch {task.epoch}: {why}", now_s)
        self._effects.append(self._grant(task, cost_s, now_s))

    def _grant(self, task: Task, cost_s: float, now_s: float) -> Grant:
        asked = self._announcement(task, now_s)
        at_most_s, lease_s = self._live[task.task_id].at_most_s, self.rules.lease_s
        award = Award(announcement=asked, epoch=task.epoch, lease_s=lease_s, cost_s=cost_s, at_most_s=at_most_s)
        return Grant(task.robot_id, award)

    def _announcement(self, task: Task, now_s: float) -> Announcement:
        within_s = None if task.deadline_s is None else max(0.0, task.deadline_s - now_s)
        return Announcement(
            task_id=task.task_id, kind=task.kind, plant=self.card, dose_ml=task.dose_ml, priority=task.priority,
            holder=task.robot_id, within_s=within_s, **self._details(task),
        )  # fmt: skip

    # Ends

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

    def _declined(self, task: Task, live: Live, why: str, now_s: float) -> None:
        """Ask again, at a moment of its own: of many plants that were declined, not all again at once."""
        spread = 0.5 + crc32(f"{task.task_id} {task.epoch}".encode()) / 2**32
        next_ask_s = now_s + spread * self.rules.decline_s * 2**live.declines
        self._live[task.task_id] = Live(next_ask_s=next_ask_s, declines=live.declines + 1, moves=live.moves)
        told = f"{task.robot_id} declined the award: {why}"[:500]
        task = self._put(task, now_s, state="announced", robot_id="", reason=told)
        self._event(task, told, now_s)

    def _kill(self, task: Task) -> None:
        if task.robot_id:
            self._effects.append(Kill(task.robot_id, task.task_id, task.epoch))

    def _finish(self, task: Task, end: Literal["done", "failed", "missed", "cancelled"], reason: str, now_s: float) -> Task:
        """`missed`: it failed by its deadline alone."""
        if end == "failed":
            self._gave_up_s[task.kind] = now_s
        state = "failed" if end == "missed" else end
        del self._live[task.task_id]
        task = self._put(task, now_s, state=state, phase="", reason=reason[:500])
        self._event(task, f"{state}: {reason}", now_s)
        ended = [t.task_id for t in self._tasks.values() if t.state in FINAL_STATES]
        for task_id in ended[: -self.rules.finished_kept]:
            del self._tasks[task_id]
        return task

    # Book-keeping

    def _remember(self, asking: Keyed, task: Task) -> None:
        """Keys live as long as their tasks, and the newest somewhat longer."""
        self._keyed[asking.name] = asking.model_copy(update={"task_id": task.task_id})
        forgotten = [name for name, each in self._keyed.items() if each.task_id not in self._tasks]
        for name in forgotten[: -self.rules.forgotten_keys_kept]:
            del self._keyed[name]

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


def _begin_by_s(task: Task) -> float:
    """Its deadline while nobody has begun it, else infinite: what has begun is finished."""
    waits = task.state in ("announced", "awarded")
    return task.deadline_s if waits and task.deadline_s is not None else math.inf
