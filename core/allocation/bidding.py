"""A robot's price for a task: seconds until it would be done, with the breakdown, or the reason why not.

Pure: what the robot knows of itself comes in as a `Condition`, distances through a function.
Source: paper 000, section 7 (cost of distance, queue and abilities); charge and refill on the way are ours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from core.robots import gardener
from core.wire.market import Announcement, Bid, Breakdown, TaskKind

BATTERY_FLAT_RATIO = 0.05
BATTERY_FORCED_RATIO = 0.15
"""Below this a robot charges before anything else."""
BATTERY_LOW_RATIO = 0.25
"""Below this it charges once the current task is done."""
BATTERY_ENOUGH_RATIO = 0.40
"""A charging robot leaves for a task from here on."""
BATTERY_FULL_RATIO = 0.90
TANK_RESERVE_ML = 30.0
REFILL_MLPS = 30.0
DOCKING_S = 12.0
UNDOCKING_S = 6.0
ARM_S = 6.0
DRIP_S = 1.5
SCAN_S = 30.0
"""Six poses with their pictures; the paper took 45 s (8.3)."""
PICK_S = 15.0
"""A fruit from its approach to the basket; the paper took 28 s (8.4)."""
OTHER_WORK_S = 30.0
REST_MIN_S = 5.0
"""What is running needs so much more at least: its last report, or what we misjudged."""

Travel = Callable[[str, str], float | None]
"""Seconds from a place to a dock's launch point; places are dock names or "here". None: no way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """One thing to do: where, how much water, how long the work takes."""

    dock: str
    """Empty for the nearest tap or charger."""
    work_s: float = 0.0
    """Of `charge` and `refill` nothing: pack and tank say how long they take."""
    dose_ml: float = 0.0
    task_id: str = ""
    charge: bool = False
    refill: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """What a robot knows of itself when it is asked."""

    robot_id: str
    can: frozenset[str]
    travel: Travel
    stopped_by: str | None = None
    """Who latched the e-stop; None when it is released."""
    down: tuple[str, ...] = ()
    lost: str = ""
    battery_ratio: float = 1.0
    tank_ml: float | None = None
    docked_at: str = ""
    current: Stop | None = None
    """What is running."""
    at_work_s: float = 0.0
    """How long it has stood at the dock of what is running."""
    queue: tuple[Stop, ...] = ()
    taps: tuple[str, ...] = ()
    chargers: tuple[str, ...] = ()


@dataclass(slots=True)
class _Walk:
    """The robot of the imagination: it walks through the queue and then does the task asked for."""

    me: Condition
    place: str
    docked: bool
    tank_ml: float
    battery_ratio: float
    spent: Breakdown = field(default_factory=Breakdown)

    def go(self, dock: str) -> float | None:
        """Drive there and dock; the seconds it takes."""
        if self.docked and self.place == dock:
            return 0.0
        travel_s = self.me.travel(self.place, dock)
        if travel_s is None:
            return None
        self.place, self.docked, undocking_s = dock, True, UNDOCKING_S if self.docked else 0.0
        total_s = undocking_s + travel_s + DOCKING_S
        self.use(total_s, gardener.IDLE_W + gardener.DRIVE_W)
        return total_s

    def use(self, seconds: float, watts: float) -> None:
        self.battery_ratio -= seconds * watts / (gardener.PACK_WH * 3600.0)

    def nearest(self, docks: Iterable[str]) -> str | None:
        """The dock that is soonest reached from here."""
        times = {dock: 0.0 if dock == self.place else self.me.travel(self.place, dock) for dock in docks}
        known = {dock: time_s for dock, time_s in times.items() if time_s is not None}
        return min(known, key=lambda dock: (known[dock], dock)) if known else None

    def serve(self, stop: Stop, done_s: float = 0.0) -> float | None:
        """Go there and do it, `done_s` of the work being done already; the seconds it takes, None when there is no way."""
        me = self.me
        dock = stop.dock or self.nearest(me.taps if stop.refill else me.chargers if stop.charge else ()) or self.place
        travel_s = 0.0 if dock == "here" else self.go(dock)
        if travel_s is None:
            return None
        if stop.refill:
            spent_s, self.tank_ml = refill_s(self.tank_ml), gardener.TANK_ML
        elif stop.charge:
            spent_s = charge_s(self.battery_ratio)
            self.battery_ratio = max(self.battery_ratio, BATTERY_ENOUGH_RATIO)
        else:
            spent_s, self.tank_ml = max(0.0, stop.work_s - done_s), self.tank_ml - stop.dose_ml
            self.use(spent_s, gardener.IDLE_W + gardener.ARM_W)
        return travel_s + spent_s


def work_s(kind: TaskKind, dose_ml: float, count: int = 1) -> float:
    """Seconds of work at the dock: a dose, a scan, or `count` fruit to pick."""
    match kind:
        case "water":
            return 2 * ARM_S + dose_ml / gardener.PUMP_MLPS + DRIP_S
        case "inventory":
            return SCAN_S
        case "harvest":
            return 2 * ARM_S + PICK_S * max(1, count)
        case _:
            return OTHER_WORK_S


def charge_s(from_ratio: float, to_ratio: float = BATTERY_ENOUGH_RATIO) -> float:
    """Seconds on a dock until the pack reaches `to_ratio`."""
    return max(0.0, to_ratio - from_ratio) * gardener.PACK_WH * 3600.0 / gardener.CHARGE_W


def refill_s(tank_ml: float) -> float:
    return max(0.0, gardener.TANK_ML - tank_ml) / REFILL_MLPS


def price(asked: Announcement, me: Condition) -> Bid:
    """The bid for `asked`: feasible with its breakdown, or cost None and the reason."""
    if reason := _unable(asked, me):
        return _no(asked, me, reason)
    walk = _Walk(me, "here", bool(me.docked_at), me.tank_ml or 0.0, me.battery_ratio)
    if me.docked_at:
        walk.place = me.docked_at
    held = me.current is not None and me.current.task_id == asked.task_id
    ahead = _before(asked.task_id, me.queue)
    cost = Breakdown()
    if me.current is not None:
        cost = Breakdown(current_s=max(REST_MIN_S, walk.serve(me.current, me.at_work_s) or 0.0))
    if held:
        return _yes(asked, me, cost)
    for stop in ahead:
        if (spent_s := walk.serve(stop)) is None:
            return _no(asked, me, f"no way to {stop.dock}, which is earlier in the queue")
        cost = cost.model_copy(update={"queue_s": cost.queue_s + spent_s})
    return _finish(asked, me, walk, cost)


def _unable(asked: Announcement, me: Condition) -> str:
    """Why the robot cannot even think of it; empty when it can."""
    if asked.kind not in me.can:
        return f"cannot {asked.kind}: not fitted for it" if asked.kind != "water" else "no pump"
    if me.stopped_by is not None:
        return f"stopped by {me.stopped_by or 'the e-stop'}"
    if me.down:
        return f"device down: {me.down[0]}"
    if me.lost:
        return me.lost
    if me.battery_ratio < BATTERY_FLAT_RATIO and not me.docked_at:
        return f"battery flat at {me.battery_ratio:.0%}"
    if asked.kind == "water" and me.tank_ml is None:
        return "the tank's sensor is silent"
    if asked.dose_ml + TANK_RESERVE_ML > gardener.TANK_ML:
        return f"a dose of {asked.dose_ml:.0f} ml is more than the tank holds"
    return ""


def _before(task_id: str, queue: tuple[Stop, ...]) -> tuple[Stop, ...]:
    """What is done before this task: all of the queue, or what lies ahead of it when it is queued already."""
    for index, stop in enumerate(queue):
        if stop.task_id == task_id:
            return queue[:index]
    return queue


def _finish(asked: Announcement, me: Condition, walk: _Walk, cost: Breakdown) -> Bid:
    """Add refill and charge where needed, then the way and the work."""
    if asked.dose_ml + TANK_RESERVE_ML > walk.tank_ml:
        tap = walk.nearest(me.taps)
        way_s = walk.go(tap) if tap else None
        if way_s is None:
            return _no(asked, me, f"the tank holds {walk.tank_ml:.0f} ml and no tap can be reached")
        cost = cost.model_copy(update={"refill_s": way_s + refill_s(max(0.0, walk.tank_ml))})
    if walk.battery_ratio < BATTERY_FORCED_RATIO:
        charger = walk.nearest(me.chargers)
        way_s = walk.go(charger) if charger else None
        if way_s is None:
            return _no(asked, me, f"battery at {walk.battery_ratio:.0%} and no charging dock can be reached")
        cost = cost.model_copy(update={"charge_s": way_s + charge_s(walk.battery_ratio)})
    travel_s = walk.go(asked.plant.plant_id)
    if travel_s is None:
        return _no(asked, me, f"no way to the dock of {asked.plant.plant_id}")
    work = work_s(asked.kind, asked.dose_ml, asked.count)
    return _yes(asked, me, cost.model_copy(update={"travel_s": travel_s, "work_s": work}))


def total_s(cost: Breakdown) -> float:
    """The bid is the sum of its parts."""
    return cost.current_s + cost.queue_s + cost.travel_s + cost.work_s + cost.charge_s + cost.refill_s


def _yes(asked: Announcement, me: Condition, cost: Breakdown) -> Bid:
    return Bid(task_id=asked.task_id, robot_id=me.robot_id, cost_s=total_s(cost), breakdown=cost)


def _no(asked: Announcement, me: Condition, reason: str) -> Bid:
    return Bid(task_id=asked.task_id, robot_id=me.robot_id, cost_s=None, reason=reason)


def without(me: Condition, task_id: str) -> Condition:
    """The same robot had it never been given this task."""
    return replace(me, queue=tuple(stop for stop in me.queue if stop.task_id != task_id))
