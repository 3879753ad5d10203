"""A market of many plants and robots without bodies or bytes: the real machines of both sides on a heap of events.

Plants are `core.allocation.plant_side.Market`s, robots queue with `core.allocation.queue.TaskQueue` and bid with
`core.allocation.bidding.price`; words take milliseconds, ways and work take the seconds that bids say. What bodies,
networks and disks may do is the soak's business (`lab.soak`): here nothing fails, so that costs can be compared.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from core.allocation.bidding import DOCKING_S, UNDOCKING_S, Condition, Stop, insertion, price, ride_s, work_s
from core.allocation.plant_side import Market
from core.allocation.plant_state import Effect, Grant, Kill, Rules, Solicit
from core.allocation.queue import Entry, TaskQueue
from core.allocation.reorder import better_order
from core.errors import Overtaken, Refused
from core.wire.geometry import Point3, Pose2
from core.wire.market import Announcement, Award, Bid, PlantCard, Report, TaskKind
from robot_service.brain import OVERTAKEN_FOR_S

Point = tuple[float, float]
Price = Callable[[Announcement, Condition], Bid]
KIND: TaskKind = "inventory"
"""A scan: work at a dock that takes no water."""
M2_A_PLANT = 3.0
"""As in the garden of the paper: four pots on 3 m by 4 m."""
WORD_S = (0.002, 0.02)
TOGETHER_S = 20.0
"""Everybody asks within so long."""
RULES = Rules(lease_s=1e6)
"""Nobody falls silent here."""


def between_s(a: Point, b: Point) -> float:
    """Seconds on the wheels from place to place, straight on."""
    return ride_s(math.dist(a, b)) if a != b else 0.0


@dataclass(frozen=True, slots=True)
class Instance:
    """Where robots start, and where plants with one task each stand."""

    starts: tuple[Point, ...]
    plants: tuple[Point, ...]

    @classmethod
    def drawn(cls, robots: int, plants: int, rng: Random) -> Instance:
        side_m = math.sqrt(M2_A_PLANT * plants)
        places = [(rng.uniform(0.0, side_m), rng.uniform(0.0, side_m)) for _ in range(robots + plants)]
        return cls(tuple(places[:robots]), tuple(places[robots:]))

    def leg_s(self, before: Point, docked: bool, plant: int) -> float:
        """Undock, ride, dock and work."""
        undocking_s = UNDOCKING_S if docked else 0.0
        return undocking_s + between_s(before, self.plants[plant]) + DOCKING_S + work_s(KIND, 0.0)

    def route_s(self, robot: int, plants: list[int]) -> float:
        """How long a robot is busy with these, in this order."""
        total_s, here, docked = 0.0, self.starts[robot], False
        for plant in plants:
            total_s += self.leg_s(here, docked, plant)
            here, docked = self.plants[plant], True
        return total_s


@dataclass(slots=True)
class Worker:
    """One robot."""

    id: str
    here: Point
    """Where it stands, or is on its way to."""
    queue: TaskQueue = field(default_factory=TaskQueue)
    docked: str = ""
    came: Point = (0.0, 0.0)
    """Where it set out from."""
    sets_out_s: float = 0.0
    """When it is off its dock."""
    arrives_s: float = 0.0
    """Docked, and at work."""
    ends_s: float = 0.0
    busy_s: float = 0.0
    served: list[int] = field(default_factory=list)

    def at(self, now_s: float) -> Point:
        """On its way, straight on."""
        way_s = self.arrives_s - DOCKING_S - self.sets_out_s
        share = min(1.0, max(0.0, (now_s - self.sets_out_s) / way_s)) if way_s > 0.0 else 1.0
        return self.came[0] + share * (self.here[0] - self.came[0]), self.came[1] + share * (self.here[1] - self.came[1])

    def drives(self, now_s: float) -> bool:
        return self.sets_out_s <= now_s < self.arrives_s - DOCKING_S


@dataclass(slots=True)
class Outcome:
    """What came of it."""

    routes: list[list[int]]
    """By robot: the plants it served, in order."""
    busy_s: list[float]
    makespan_s: float
    moves: int
    """Tasks that were taken away from one robot and given to another."""
    declines: int
    """Awards that were not taken."""
    messages: int
    award_s: list[float]
    """From each wish until a robot has taken it."""


class Crowd:
    """Runs one instance to its end. `bid` prices a task; all plants ask within `together_s`."""

    def __init__(
        self, instance: Instance, rng: Random, bid: Price = price, together_s: float = TOGETHER_S, rules: Rules = RULES
    ) -> None:
        self._instance, self._rng, self._bid, self._together_s, self._rules = instance, rng, bid, together_s, rules
        self._plants = [self._market(n) for n in range(len(instance.plants))]
        self._docks = {f"plant-{number}": at for number, at in enumerate(instance.plants)}
        self._workers = {f"robot-{n:03}": self._worker(f"robot-{n:03}", at) for n, at in enumerate(instance.starts)}
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._number = itertools.count()
        self.now_s = 0.0
        self._ticks = [math.inf] * len(self._plants)
        self._asked_s = [math.inf] * len(self._plants)
        self._out = Outcome([], [], 0.0, 0, 0, 0, [])

    def _worker(self, robot_id: str, at: Point) -> Worker:
        worker = Worker(robot_id, at)
        worker.queue.may_wait = lambda entry: worker.drives(self.now_s)
        return worker

    def _market(self, number: int) -> Market:
        x_m, y_m = self._instance.plants[number]
        card = PlantCard(
            plant_id=f"plant-{number}", url="http://plant", stem=Point3(x_m=x_m, y_m=y_m, z_m=0.25),
            dock=Pose2(x_m=x_m, y_m=y_m, yaw_rad=0.0), nozzle=Point3(x_m=0.0, y_m=0.0, z_m=0.0),
        )  # fmt: skip
        return Market(card, None, 0.0, self._rules)

    def run(self) -> Outcome:
        for number in range(len(self._plants)):
            self._later(self._rng.uniform(0.0, self._together_s), lambda n=number: self._wish(n))  # type: ignore[misc]
        while self._heap:
            self.now_s, _, call = heapq.heappop(self._heap)
            call()
        workers = list(self._workers.values())
        self._out.routes, self._out.busy_s = [w.served for w in workers], [w.busy_s for w in workers]
        return self._out

    def _later(self, delay_s: float, call: Callable[[], None]) -> None:
        heapq.heappush(self._heap, (self.now_s + delay_s, next(self._number), call))

    def _word(self, call: Callable[[], None]) -> None:
        self._out.messages += 1
        self._later(self._rng.uniform(*WORD_S), call)

    # Plants

    def _wish(self, number: int) -> None:
        self._asked_s[number] = self.now_s
        self._plants[number].ask(KIND, 0.0, "soil", "due", self.now_s)
        self._tick(number)

    def _tick(self, number: int) -> None:
        market = self._plants[number]
        market.tick(self.now_s, list(self._workers))
        self._carry_out(number)

    def _carry_out(self, number: int) -> None:
        market = self._plants[number]
        for effect in market.take_effects():
            self._effect(number, effect)
        due_s = market.due_s()
        if due_s < self._ticks[number] or self._ticks[number] <= self.now_s:
            self._ticks[number] = due_s
            if due_s < math.inf:
                self._later(max(0.0, due_s - self.now_s), lambda: self._due(number, due_s))

    def _due(self, number: int, due_s: float) -> None:
        if self._ticks[number] == due_s:
            self._ticks[number] = -math.inf
            self._tick(number)

    def _effect(self, number: int, effect: Effect) -> None:
        match effect:
            case Solicit():
                for robot_id in effect.robots:
                    self._word(lambda r=robot_id: self._asked(number, effect, self._workers[r]))  # type: ignore[misc]
            case Grant():
                self._word(lambda: self._awarded(number, effect.award, self._workers[effect.robot_id]))
            case Kill():
                self._word(lambda: self._killed(effect, self._workers[effect.robot_id]))

    # Robots

    def _asked(self, number: int, ask: Solicit, worker: Worker) -> None:
        bid = self._bid(ask.announcement, self.condition(worker))
        self._word(lambda: self._heard(number, ask, worker.id, bid))

    def _heard(self, number: int, ask: Solicit, robot_id: str, bid: Bid) -> None:
        self._plants[number].bid(ask.announcement.task_id, ask.round_number, robot_id, bid, self.now_s)
        self._carry_out(number)

    def _awarded(self, number: int, award: Award, worker: Worker) -> None:
        refused, overtaken = "", False
        try:
            self._check_price(award, worker)
            worker.queue.award(award, self.now_s, insertion(award.announcement, self.condition(worker)))
            worker.queue.arrange(better_order(self.condition(worker)))
            if self._asked_s[number] < math.inf:
                self._out.award_s.append(self.now_s - self._asked_s[number])
                self._asked_s[number] = math.inf
        except Refused as error:
            refused, overtaken = str(error), isinstance(error, Overtaken)
            self._out.declines += 1
        self._word(lambda: self._answered(number, award, refused, overtaken))
        self._begin(worker)

    def _check_price(self, award: Award, worker: Worker) -> None:
        if award.at_most_s is None:
            return
        bid = self._bid(award.announcement, self.condition(worker))
        if bid.cost_s is None or bid.cost_s > award.at_most_s:
            raise Overtaken("another was taken since")

    def _answered(self, number: int, award: Award, refused: str, overtaken: bool) -> None:
        task_id = award.announcement.task_id
        self._plants[number].award_answered(task_id, award.epoch, refused, self.now_s, overtaken=overtaken)
        self._carry_out(number)

    def _killed(self, kill: Kill, worker: Worker) -> None:
        entry = worker.queue.find(kill.task_id)
        if entry is not None and entry.epoch == kill.epoch and not entry.running:
            worker.queue.drop(entry)
            self._out.moves += 1

    def _begin(self, worker: Worker) -> None:
        entry, running = worker.queue.next(), worker.queue.running
        if entry is None or entry is running:
            return
        if running is not None:
            self._put_off(worker, running)
        entry.running, number = True, _number(entry)
        spent_s = self._instance.leg_s(worker.here, bool(worker.docked), number)
        worker.sets_out_s = self.now_s + (UNDOCKING_S if worker.docked else 0.0)
        worker.arrives_s, worker.ends_s = self.now_s + spent_s - work_s(KIND, 0.0), self.now_s + spent_s
        worker.busy_s += spent_s
        worker.came, worker.here, worker.docked = worker.here, self._instance.plants[number], ""
        self._report(number, worker, entry, "running")
        self._later(spent_s, lambda: self._done(number, worker, entry))

    def _put_off(self, worker: Worker, running: Entry) -> None:
        """Something that lies nearer comes first."""
        running.running = False
        worker.here, worker.busy_s = worker.at(self.now_s), worker.busy_s - (worker.ends_s - self.now_s)
        self._report(_number(running), worker, running, "awarded")

    def _done(self, number: int, worker: Worker, entry: Entry) -> None:
        if not entry.running or self.now_s < worker.ends_s:
            return  # it was put off since
        worker.docked = entry.plant_id
        worker.served.append(number)
        worker.queue.drop(entry)
        self._out.makespan_s = self.now_s
        self._report(number, worker, entry, "done")
        self._begin(worker)

    def _report(self, number: int, worker: Worker, entry: Entry, state: str) -> None:
        def heard() -> None:
            market = self._plants[number]
            if state == "done":
                market.scanned(entry.task_id, worker.id, f"scan-{number}", self.now_s)
            report = Report(robot_id=worker.id, epoch=entry.epoch, state=state)  # type: ignore[arg-type]
            market.report(entry.task_id, report, self.now_s)
            self._carry_out(number)

        self._word(heard)

    def condition(self, worker: Worker) -> Condition:
        """What the robot knows of itself now."""
        begun, running = worker.queue.begun, worker.queue.running
        at_work_s = max(0.0, self.now_s - worker.arrives_s)
        here = worker.here if running is None else worker.at(self.now_s)

        def travel(place: str, dock: str) -> float:
            if place == "here" and begun is not None and dock == begun.plant_id:
                return max(0.0, worker.arrives_s - DOCKING_S - self.now_s)
            return between_s(here if place == "here" else self._docks[place], self._docks[dock])

        return Condition(
            robot_id=worker.id,
            can=frozenset({KIND}),
            travel=travel,
            docked_at=begun.plant_id if begun is not None and at_work_s > 0.0 else worker.docked,
            current=None if begun is None else self._stop(begun),
            at_work_s=at_work_s if begun is not None else 0.0,
            queue=tuple(self._stop(entry) for entry in worker.queue.waiting),
        )

    def _stop(self, entry: Entry) -> Stop:
        settled = self.now_s - entry.since_s > OVERTAKEN_FOR_S
        return Stop(dock=entry.plant_id, work_s=work_s(KIND, 0.0), task_id=entry.task_id, settled=settled)


def _number(entry: Entry) -> int:
    """Of its plant."""
    return int(entry.plant_id.removeprefix("plant-"))
