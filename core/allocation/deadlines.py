"""What deadlines change in a robot's bid: it takes nothing that it could not finish in time, and lets nothing that it has
promised come too late for something else.

Pure, on top of `bidding`, which prices and places. Tasks are tried in three ways: where they add least; before whatever is
not more urgent; behind all that has a deadline. Rejecting what would be late is admission control of real-time scheduling
(Buttazzo, Hard Real-Time Computing Systems).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from core.allocation.bidding import Condition, Stop, done_s, insertion, price, work_s
from core.wire.market import Announcement, Bid


def offer(asked: Announcement, me: Condition, promised: Sequence[Announcement] = ()) -> Bid:
    """The bid for `asked`, or None and by how much it would be late.

    `promised`: what waits in the queue and has a deadline, `within_s` counted from now.
    """
    chosen = _chosen(asked, me, promised)
    bid = price(asked, chosen)
    if bid.cost_s is None or asked.within_s is None or _is_current(asked, me):
        return bid
    would_s = _done_s(asked, chosen, insertion(asked, chosen))
    if would_s is not None and would_s <= asked.within_s:
        return bid
    late = f"done in {would_s or bid.cost_s:.0f} s, the deadline is in {asked.within_s:.0f} s"
    return Bid(task_id=asked.task_id, robot_id=me.robot_id, cost_s=None, reason=late)


def place(asked: Announcement, me: Condition, promised: Sequence[Announcement] = ()) -> int:
    """Where in the queue `offer` saw the task."""
    return insertion(asked, _chosen(asked, me, promised))


def _chosen(asked: Announcement, me: Condition, promised: Sequence[Announcement]) -> Condition:
    """The robot as `bidding` should see it, so that it puts the task where nobody is late; as it is when that is nowhere."""
    others = [task for task in promised if task.task_id != asked.task_id]
    if _is_held(asked, me) or (asked.within_s is None and not others):
        return me
    fixed = frozenset(task.task_id for task in others)
    guarded = replace(me, queue=tuple(replace(s, settled=s.settled or s.task_id in fixed) for s in me.queue))
    ways = [me, _hurried(asked, me), guarded] if asked.within_s is not None else [me, guarded]
    return next((way for way in ways if _in_time(asked, way, others)), guarded)


def _hurried(asked: Announcement, me: Condition) -> Condition:
    """As if what is equally urgent were less so: the task goes before it."""
    behind = asked.priority - 1
    queue = tuple(replace(s, priority=behind) if s.priority == asked.priority else s for s in me.queue)
    return replace(me, queue=queue)


def _in_time(asked: Announcement, me: Condition, promised: Sequence[Announcement]) -> bool:
    """Put where `bidding` puts it, the task meets its deadline and makes no other miss one that would have been met."""
    at = insertion(asked, me)
    would_s = _done_s(asked, me, at)
    if would_s is None or (asked.within_s is not None and would_s > asked.within_s):
        return False
    labour_s = work_s(asked.kind, asked.dose_ml, asked.count)
    new = Stop(dock=asked.plant.plant_id, work_s=labour_s, dose_ml=asked.dose_ml, task_id=asked.task_id)
    then = replace(me, queue=(*me.queue[:at], new, *me.queue[at:]))
    behind = {stop.task_id for stop in me.queue[at:]}
    return not any(_meets(task, me) and not _meets(task, then) for task in promised if task.task_id in behind)


def _meets(task: Announcement, me: Condition) -> bool:
    at = next(i for i, stop in enumerate(me.queue) if stop.task_id == task.task_id)
    would_s = _done_s(task, me, at)
    return would_s is not None and would_s <= (task.within_s or 0.0)


def _done_s(task: Announcement, me: Condition, at: int) -> float | None:
    """Seconds until this one task is done as number `at` of the queue, whatever comes after it."""
    before = tuple(replace(stop, settled=True) for stop in me.queue[:at])
    bid = price(task, replace(me, queue=before))
    return None if bid.cost_s is None else done_s(bid.breakdown)


def _is_current(asked: Announcement, me: Condition) -> bool:
    return me.current is not None and me.current.task_id == asked.task_id


def _is_held(asked: Announcement, me: Condition) -> bool:
    return _is_current(asked, me) or any(stop.task_id == asked.task_id for stop in me.queue)
