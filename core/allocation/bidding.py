"""A robot's price for a task in seconds that somebody waits, with the breakdown, or the reason why not.

Those until it would be done, and those that all behind it wait longer for it: each task of the queue, and whoever asks a
busy robot next. A free one says when it would be done.
Pure: what the robot knows of itself comes in as a `Condition`, distances through a function.
Source: paper 000, section 7 (cost of distance, queue and abilities); Lagoudakis et al. 2005 (bids for the least mean
waiting time, MiniAve); charge and refill on the way are ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

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
DRIVE_RATIO, TURNING_S = 1.15, 3.0
"""Paths are driven more slowly than at cruising speed, and begin and end with a turn."""
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
    priority: int = 5
    settled: bool = False
    """Nothing may be put before it any more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """What a robot knows of itself when it is asked."""

    robot_id: str
    can: frozenset[str]
    travel: Travel
    unfit: Mapping[TaskKind, str] = field(default_factory=dict)
    """Kinds of tasks that it is fitted for and cannot do for now, and why."""
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
    """What waits, in the order in which it will be done."""
    taps: tuple[str, ...] = ()
    """Docks where water is to be had."""
    chargers: tuple[str, ...] = ()


@dataclass(slots=True)
class _Walk:
    """The robot of the imagination: it walks through the queue and then does the task asked for."""

    me: Condition
    place: str
    docked: bool
    tank_ml: float
    battery_ratio: float

    def copy(self) -> _Walk:
        return _Walk(self.me, self.place, self.docked, self.tank_ml, self.battery_ratio)

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

    def hop_s(self, place: str, dock: str) -> float:
        """Seconds from dock to dock; infinite when there is no way."""
        if place == dock:
            return 0.0
        travel_s = self.me.travel(place, dock)
        return math.inf if travel_s is None else UNDOCKING_S + travel_s + DOCKING_S

    def use(self, seconds: float, watts: float) -> None:
        self.battery_ratio -= seconds * watts / (gardener.PACK_WH * 3600.0)

    def nearest(self, docks: Iterable[str]) -> str | None:
        """The dock that is soonest reached from here."""
        times = {dock: 0.0 if dock == self.place else self.me.travel(self.place, dock) for dock in docks}
        known = {dock: time_s for dock, time_s in times.items() if time_s is not None}
        return min(known, key=lambda dock: (known[dock], dock)) if known else None

    def drink(self, dose_ml: float) -> float | None:
        """Seconds until there is water for a dose: none, or the nearest tap's; None when there is no tap."""
        if dose_ml == 0.0 or dose_ml + TANK_RESERVE_ML <= self.tank_ml:
            return 0.0
        tap = self.nearest(self.me.taps)
        if tap is None or (way_s := self.go(tap)) is None:
            return None
        spent_s = way_s + refill_s(max(0.0, self.tank_ml))
        self.tank_ml = gardener.TANK_ML
        return spent_s

    def serve(self, stop: Stop) -> float | None:
        """Fetch water if need be, go there and do it; the seconds it takes, None when there is no way."""
        water_s = self.drink(stop.dose_ml)
        spent_s = None if water_s is None else self.finish(stop, 0.0)
        return None if water_s is None or spent_s is None else water_s + spent_s

    def finish(self, stop: Stop, done_s: float) -> float | None:
        """Go there and do what is left of it, `done_s` of the work being done; the seconds it takes."""
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


def ride_s(way_m: float) -> float:
    """Seconds on the wheels along a path."""
    return way_m / gardener.CRUISE_MPS * DRIVE_RATIO + TURNING_S


def charge_s(from_ratio: float, to_ratio: float = BATTERY_ENOUGH_RATIO) -> float:
    """Seconds on a dock until the pack reaches `to_ratio`."""
    return max(0.0, to_ratio - from_ratio) * gardener.PACK_WH * 3600.0 / gardener.CHARGE_W


def refill_s(tank_ml: float) -> float:
    return max(0.0, gardener.TANK_ML - tank_ml) / REFILL_MLPS


def price(asked: Announcement, me: Condition) -> Bid:
    """The bid for `asked`: feasible with its breakdown, or cost None and the reason.

    A task that is held already is priced where it stands; any other goes where its price is least.
    """
    return offer(asked, me)[0]


def insertion(asked: Announcement, me: Condition) -> int:
    """Where in the queue `price` saw the task: what stands there, and all behind it, moves back."""
    return offer(asked, me)[1]


def offer(asked: Announcement, me: Condition) -> tuple[Bid, int]:
    """The bid, and where in the queue it sees the task."""
    if reason := _unable(asked, me):
        return _no(asked, me, reason), len(me.queue)
    walk, current_s = _begun(me)
    if me.current is not None and me.current.task_id == asked.task_id:
        return _bid(asked, me, _Parts(current_s=current_s)), 0
    for index, stop in enumerate(me.queue):
        if stop.task_id == asked.task_id:
            others = _Route(walk, (*me.queue[:index], *me.queue[index + 1 :]))
            return _bid(asked, me, _inserted(asked, others, index, current_s)), index
    route = _Route(walk, me.queue)
    tried = [(_inserted(asked, route, index, current_s), index) for index in _places(asked.priority, me.queue)]
    best, at = min(tried, key=lambda each: (*_rank(each[0]), -each[1]))
    return _bid(asked, me, best), at


def queue_s(me: Condition, queue: Iterable[Stop]) -> float | None:
    """Seconds until all of a queue would be done; None when something in it cannot be reached."""
    walk, total_s = _begun(me)
    for stop in queue:
        if (spent_s := walk.serve(stop)) is None:
            return None
        total_s += spent_s
    return total_s


def _places(priority: int, queue: tuple[Stop, ...]) -> range:
    """Where a task may be put in: behind all that is more urgent or settled, before all that is less urgent."""
    first = max((i + 1 for i, stop in enumerate(queue) if stop.settled or stop.priority > priority), default=0)
    last = next((i for i in range(first, len(queue)) if queue[i].priority < priority), len(queue))
    return range(first, last + 1)


class _Parts(NamedTuple):
    """A breakdown in the making [s]."""

    current_s: float = 0.0
    queue_s: float = 0.0
    travel_s: float = 0.0
    work_s: float = 0.0
    charge_s: float = 0.0
    refill_s: float = 0.0
    delay_s: float = 0.0


def _rank(parts: _Parts | str) -> tuple[bool, float]:
    """Those that can come first, the soonest of them before all."""
    return (True, 0.0) if isinstance(parts, str) else (False, sum(parts))


def _begun(me: Condition) -> tuple[_Walk, float]:
    """The robot of the imagination once it is done with what is running, and the seconds until then."""
    walk = _Walk(me, me.docked_at or "here", bool(me.docked_at), me.tank_ml or 0.0, me.battery_ratio)
    if me.current is None:
        return walk, 0.0
    return walk, max(REST_MIN_S, walk.finish(me.current, me.at_work_s) or 0.0)


class _Route:
    """A queue walked through once: what every place of a further task is reckoned from."""

    def __init__(self, walk: _Walk, queue: tuple[Stop, ...]) -> None:
        self.queue, self.barred = queue, ""
        """The first dock of it that cannot be reached."""
        self._walks, self._spent_s = [walk], [0.0]
        for stop in queue:
            walk = walk.copy()
            if (spent_s := walk.serve(stop)) is None:
                self.barred = stop.dock
                break
            self._walks.append(walk)
            self._spent_s.append(self._spent_s[-1] + spent_s)
        self._dry_s, self._doses_ml = [0.0] * (len(queue) + 1), [0.0] * (len(queue) + 1)
        for i in range(len(queue) - 1, -1, -1):
            self._look_behind(i)

    def _look_behind(self, i: int) -> None:
        """Seconds for stop `i` and all behind it from the stop before, while the tank lasts; and what that takes."""
        stop, before = self.queue[i], self.queue[i - 1].dock if i else ""
        plain = stop.dock and not stop.charge and not stop.refill
        self._doses_ml[i] = self._doses_ml[i + 1] + stop.dose_ml if plain else math.inf
        hop_s = self._walks[0].hop_s(before, stop.dock) if plain and before else 0.0
        self._dry_s[i] = hop_s + stop.work_s + self._dry_s[i + 1]

    def before(self, index: int) -> tuple[_Walk, float]:
        """The robot when it comes to this stop, and the seconds until then."""
        return self._walks[index].copy(), self._spent_s[index]

    def later_s(self, walk: _Walk, now_s: float, index: int) -> float | None:
        """By how many seconds its end moves back for a robot that comes to this stop after `now_s`, from a task put in."""
        if (behind_s := self._behind_s(walk, index)) is None:
            return None
        return max(0.0, now_s + behind_s - self._spent_s[-1])

    def _behind_s(self, walk: _Walk, index: int) -> float | None:
        """Seconds for this stop and all behind it."""
        if index == len(self.queue):
            return 0.0
        if (doses_ml := self._doses_ml[index]) == 0.0 or doses_ml + TANK_RESERVE_ML <= walk.tank_ml:
            first = self.queue[index]
            total_s = walk.hop_s(walk.place, first.dock) + first.work_s + self._dry_s[index + 1]
            return None if total_s == math.inf else total_s
        spent_s = [walk.serve(stop) for stop in self.queue[index:]]
        return None if None in spent_s else sum(filter(None, spent_s))


def _inserted(asked: Announcement, route: _Route, index: int, current_s: float) -> _Parts | str:
    """The bid's parts with the task at this place of the queue, or why not."""
    if route.barred:
        return f"no way to {route.barred}, which is in the queue"
    walk, before_s = route.before(index)
    own = _own(asked, walk)
    if isinstance(own, str):
        return own
    refill, charging, travel, work = own
    later_s = route.later_s(walk, before_s + refill + charging + travel + work, index)
    if later_s is None:
        return "no way to what is later in the queue"
    busy = current_s > 0.0 or bool(route.queue)
    put_off = len(route.queue) - index + int(busy)
    return _Parts(current_s, before_s, travel, work, charging, refill, put_off * later_s)


def _unable(asked: Announcement, me: Condition) -> str:
    """Why the robot cannot even think of it; empty when it can."""
    if asked.kind not in me.can:
        return f"cannot {asked.kind}: not fitted for it" if asked.kind != "water" else "no pump"
    if asked.kind in me.unfit:
        return me.unfit[asked.kind]
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


def _own(asked: Announcement, walk: _Walk) -> tuple[float, float, float, float] | str:
    """What the task itself takes: refill and charge where needed, then the way and the work [s]; or why it cannot be."""
    if (water_s := walk.drink(asked.dose_ml)) is None:
        return f"the tank holds {walk.tank_ml:.0f} ml and there is no tap to fill it at"
    charging_s = 0.0
    if walk.battery_ratio < BATTERY_FORCED_RATIO:
        charger = walk.nearest(walk.me.chargers)
        way_s = walk.go(charger) if charger else None
        if way_s is None:
            return f"battery at {walk.battery_ratio:.0%} and no charging dock can be reached"
        charging_s = way_s + charge_s(walk.battery_ratio)
    travel_s = walk.go(asked.plant.plant_id)
    if travel_s is None:
        return f"no way to the dock of {asked.plant.plant_id}"
    walk.tank_ml -= asked.dose_ml
    return water_s, charging_s, travel_s, work_s(asked.kind, asked.dose_ml, asked.count)


def done_s(cost: Breakdown) -> float:
    """Seconds until the task itself would be done."""
    return cost.current_s + cost.queue_s + cost.travel_s + cost.work_s + cost.charge_s + cost.refill_s


def total_s(cost: Breakdown) -> float:
    """The bid is the sum of its parts."""
    return done_s(cost) + cost.delay_s


def _bid(asked: Announcement, me: Condition, parts: _Parts | str) -> Bid:
    if isinstance(parts, str):
        return _no(asked, me, parts)
    cost = Breakdown(**parts._asdict())
    return Bid(task_id=asked.task_id, robot_id=me.robot_id, cost_s=total_s(cost), breakdown=cost)


def _no(asked: Announcement, me: Condition, reason: str) -> Bid:
    return Bid(task_id=asked.task_id, robot_id=me.robot_id, cost_s=None, reason=reason)
