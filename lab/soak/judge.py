"""The invariants I1 to I10 (docs/reliability.md), judged from outside: by the truth, the messages, and what disks hold.

Nothing here is known to the services. Cheap checks run at every message and every act, the others at every look.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from core.allocation.permits import DAY_S
from core.allocation.plant_state import Limits, MarketDocument
from core.allocation.queue import Entry
from core.mesh.client import Answer
from core.wire.body import COMMAND_LIFE_S
from core.wire.fruit import Inventory
from core.wire.market import BID_WINDOW_S, FINAL_STATES, LEASE_S, Bid, BidRound, Task
from lab.soak.faults import Gremlin
from lab.soak.garden import COARSE, SoakGarden
from lab.soak.net import CLEAR, Message
from lab.soak.world import Dose, Truth
from robot_service.planner import TASK_S

LOOK_S = 10.0
SKEW = 1.0005
"""Clocks differ by so much at most."""
STOP_S = COMMAND_LIFE_S + COARSE["robot_service.body.body"]["DT_S"] + 0.05
"""A robot stands so soon after its brain fell silent: a command's life and one turn of the body's loop."""
AGREE_S = 2 * LEASE_S + LOOK_S
DONE_S = 3 * (BID_WINDOW_S + LEASE_S + max(TASK_S["water"], TASK_S["inventory"], TASK_S["harvest"]))
DRAIN_S = 1800.0
OVER_RATIO = 1.02
"""A pump gives so much more than its calibration says."""
BREACHES_MAX = 20


@dataclass(frozen=True, slots=True)
class Breach:
    """One broken invariant."""

    invariant: str
    at_s: float
    what: str
    story: tuple[str, ...] = ()
    """The task's own history, when one is concerned."""


@dataclass(slots=True)
class _Permit:
    permit_id: str
    task_id: str
    robot_id: str
    plant_id: str
    act: str
    epoch: int
    dose_ml: float
    fruit_id: str
    asked_s: float
    issued_s: float
    valid_s: float


@dataclass(slots=True)
class _Seen:
    """The newest of a task that was on disk."""

    epoch: int
    state: str
    touches_before: int
    good_s: float = 0.0
    rounds: int = 0


@dataclass(slots=True)
class _Heard:
    sent_s: float
    heard_s: float
    robot_id: str
    cost_s: float | None


@dataclass(slots=True)
class Tally:
    """What happened, for the report."""

    tasks: int = 0
    done: int = 0
    failed: int = 0
    cancelled: int = 0
    doses: int = 0
    picks: int = 0
    requests: int = 0
    by_kind: dict[str, int] = field(default_factory=dict)


class Judge:
    """Watches one garden. `breaches` is what it found, the first of each kind kept."""

    def __init__(self, truth: Truth, gremlin: Gremlin) -> None:
        self.truth, self.gremlin = truth, gremlin
        self.garden: SoakGarden
        self.breaches: list[Breach] = []
        self.tally = Tally()
        self._permits: dict[str, _Permit] = {}
        self._last_permit: dict[str, _Permit] = {}
        self._awards: dict[tuple[str, int], str] = {}
        self._asked: dict[int, float] = {}
        self._permit_asked: dict[tuple[str, str, str], float] = {}
        self._bids: defaultdict[str, deque[_Heard]] = defaultdict(lambda: deque(maxlen=40))
        self._seen: dict[str, _Seen] = {}
        self._told_gone: defaultdict[str, set[str]] = defaultdict(set)
        self._created: dict[str, float] = {}
        self._settings: defaultdict[str, dict[str, set[Any]]] = defaultdict(dict)
        self._generation: defaultdict[str, int] = defaultdict(int)
        self._boot: defaultdict[str, int] = defaultdict(int)
        self._stopped: set[str] = set()
        self._apart: dict[tuple[str, str, int], float] = {}
        self._documents: dict[str, MarketDocument] = {}
        self._lives: dict[str, object] = {}
        self._rounds: set[tuple[str, int]] = set()
        self._inventories: dict[str, Inventory] = {}
        self._open: defaultdict[str, set[str]] = defaultdict(set)
        """Tasks by plant that were on disk and had not ended."""
        self._limits = Limits()

    def attach(self, garden: SoakGarden) -> None:
        self.garden = garden
        garden.mesh.arrived, garden.mesh.answered, garden.mesh.heard = self._arrived, self._answered, self._heard
        self.gremlin.halted, self.gremlin.crashed = self.halted, self.crashed

    def breach(self, invariant: str, what: str) -> None:
        if len(self.breaches) < BREACHES_MAX and all(b.invariant != invariant or b.what != what for b in self.breaches):
            self.breaches.append(Breach(invariant, self.truth.now(), what, self._story(what)))

    def _story(self, what: str) -> tuple[str, ...]:
        for plant_id in self.garden.names("plant"):
            pot = self.garden.pot(plant_id)
            for task in pot.place.market.tasks() if pot is not None else ():
                if f"{task.task_id} " in f"{what} ":
                    told = [(self._loop_s(plant_id, event.t_s), event) for event in task.events[-12:]]
                    return tuple(f"{at_s:.1f} {event.robot_id} {event.epoch}: {event.what}" for at_s, event in told)
        return ()

    async def watch(self) -> None:
        """Look again and again, until cancelled."""
        while True:
            self.look()
            await asyncio.sleep(LOOK_S)

    # Acts

    def moved(self, robot_id: str) -> None:
        """I8: a base was told to move."""
        if robot_id in self._stopped:
            self.breach("I8", f"{robot_id} was driven while its e-stop is latched")

    def halted(self, robot_id: str) -> None:
        """I8: a brain just died or sleeps; look when the last command's life is over."""
        asyncio.get_running_loop().call_later(STOP_S, self._stands, robot_id, self.garden.running.get(robot_id))

    def _stands(self, robot_id: str, before: object) -> None:
        now = self.garden.running.get(robot_id)
        awake = now is not None and (now is not before or not now.life.stopped)
        body = self.truth.look(robot_id)
        if not awake and (body.moving or body.pumping is not None):
            self.breach("I8", f"{robot_id} still moves or pumps {STOP_S:.2f} s after its brain fell silent")

    def _began(self, dose: Dose) -> None:
        """I1, I2: a pump starts."""
        held = self._permits.get(dose.permit_id)
        if held is None:
            return self.breach("I2", f"{dose.robot_id} pumps at {dose.plant_id} under no permit that was given")
        if held.robot_id != dose.robot_id or held.plant_id != dose.plant_id:
            self.breach("I1", f"{dose.robot_id} pumps at {dose.plant_id} under {held.robot_id}'s permit {held.permit_id}")
        late_s = dose.began_s - held.asked_s - held.valid_s * SKEW
        first = not any(d.permit_id == dose.permit_id for d in self.truth.doses[: dose.number])
        if first and late_s > 1.0:
            self.breach("I2", f"{dose.robot_id} began {late_s:.1f} s after permit {held.permit_id} had run out")
        for other in self.truth.doses[-8:]:
            if other.ended_s is None and other.number != dose.number and other.plant_id == dose.plant_id:
                self.breach("I1", f"{dose.robot_id} and {other.robot_id} pump at {dose.plant_id} at once")
        before = [d for d in self.truth.doses[: dose.number] if d.plant_id == dose.plant_id and d.ml > 1.0]
        if before and before[-1].permit_id != dose.permit_id and not self._measured(before[-1].ended_s, held):
            self.breach("I2", f"second dose at {dose.plant_id} ({held.permit_id}) without a measurement after the first")

    def _measured(self, since_s: float | None, held: _Permit) -> bool:
        """Whether the pot looked at its soil between the end of an act, once soaked in, and the next permit."""
        if since_s is None:
            return False
        soaked_s = since_s + self._limits.soak_s / SKEW - 0.5
        return any(soaked_s <= at_s <= held.issued_s for at_s in self.truth.pots[held.plant_id].samples_s)

    def _ended(self, dose: Dose) -> None:
        """I2: how much has flowed."""
        held = self._permits.get(dose.permit_id)
        ml = sum(d.ml for d in self.truth.doses[-60:] if d.permit_id == dose.permit_id)
        if held is not None and ml > held.dose_ml * OVER_RATIO + 2.0:
            self.breach("I2", f"{ml:.0f} ml flowed under permit {held.permit_id} for {held.dose_ml:.0f} ml")
        day_ml = sum(
            d.ml for d in self.truth.doses if d.plant_id == dose.plant_id and d.began_s > self.truth.now() - DAY_S / SKEW
        )
        if day_ml > self._limits.day_cap_ml * OVER_RATIO:
            self.breach("I2", f"{day_ml:.0f} ml flowed into {dose.plant_id} within a day")

    def picked(self, robot_id: str, permit_id: str) -> None:
        """I1, I3: a hand has closed."""
        held = self._permits.get(permit_id)
        if held is None or held.robot_id != robot_id:
            return self.breach("I1", f"{robot_id} picks under a permit that is not its own: {permit_id}")
        for fruit in self.truth.pots[held.plant_id].fruits[-60:]:
            if len(fruit.taken_by) > 1 and fruit.taken_by[-1] == permit_id:
                self.breach(
                    "I3", f"{robot_id} closed its hand where {fruit.name} was already taken ({', '.join(fruit.taken_by)})"
                )

    # Messages

    def _arrived(self, message: Message) -> None:
        if message.path == "/settings":
            for name, value in json.loads(message.body).items():
                self._settings[message.target].get(name, set()).add(value)
        if message.method == "POST":
            if message.path == "/tasks" and message.target.startswith("robot"):
                self._award(message)
            elif message.path == "/bids":
                self._asked[message.number] = self.truth.now()
            elif message.path == "/resume":
                self._stopped.discard(message.target)
            elif message.path.endswith("/permits"):
                wish = json.loads(message.body)
                key = (message.path, message.source, f"{wish['epoch']}/{wish['fruit_id']}")
                self._permit_asked.setdefault(key, self.truth.now())

    def _award(self, message: Message) -> None:
        """I1, I6: one epoch, one robot."""
        award = json.loads(message.body)
        task_id, epoch = award["announcement"]["task_id"], award["epoch"]
        holder = self._awards.setdefault((task_id, epoch), message.target)
        if holder != message.target:
            self.breach("I1", f"{task_id} epoch {epoch} was awarded to {holder} and to {message.target}")

    def _answered(self, message: Message, answer: Answer) -> None:
        """I4: what left a node as a promise."""
        if answer.status == 500:
            self.breach("I4", f"{message.target} answered 500 to {message.method} {message.path}")
        if answer.status in (400, 405, 422) and message.source != "operator":
            route = f"{message.method} {message.path.partition('?')[0]}"
            why = json.loads(answer.body)["detail"]
            self.breach("I7", f"{message.target} does not understand {route} of {message.source}: {why}")
        if answer.status >= 300 or message.method == "GET":
            return
        if message.target.startswith("plant"):
            self._changed(message.target)
        if message.path.endswith("/permits"):
            self._permit(message, answer)
        elif message.path == "/tasks" and message.target.startswith("plant"):
            self._created[json.loads(answer.body)["task_id"]] = self.truth.now()
        elif message.path == "/settings":
            self._settings[message.target] |= {name: {value} for name, value in json.loads(message.body).items()}
        elif message.path == "/inventory/scans":
            generation = json.loads(answer.body)["generation"]
            self._generation[message.target] = max(self._generation[message.target], generation)
        elif message.path.endswith("/reports") and b'"picked"' in message.body:
            self._picks_told(message)
            self._inventories.pop(message.target, None)
        elif message.path == "/stop":
            self._stopped.add(message.target)

    def _picks_told(self, message: Message) -> None:
        for pick in json.loads(message.body)["picks"]:
            held = self._permits.get(pick["permit_id"])
            if pick["outcome"] == "picked" and held is not None and held.robot_id == message.source:
                self._told_gone[held.plant_id].add(pick["fruit_id"])

    def _permit(self, message: Message, answer: Answer) -> None:
        """I1, I2: a permit leaves its plant."""
        said, wish, now_s = json.loads(answer.body), json.loads(message.body), self.truth.now()
        if said["permit_id"] in self._permits:
            return
        epoch = max((e for task_id, e in self._awards if task_id == said["task_id"]), default=-1)
        if said["epoch"] < epoch or self._awards.get((said["task_id"], epoch)) != message.source:
            holder = self._awards.get((said["task_id"], epoch), "nobody")
            self.breach("I1", f"{said['task_id']} is {holder}'s, epoch {epoch}, and {message.source} got a permit")
        asked_s = self._permit_asked.get((message.path, message.source, f"{wish['epoch']}/{wish['fruit_id']}"), now_s)
        permit = _Permit(
            said["permit_id"], said["task_id"], message.source, message.target, said["act"], said["epoch"], said["dose_ml"],
            said.get("fruit_id", ""), asked_s, now_s, said["valid_for_s"],
        )  # fmt: skip
        self._permits[permit.permit_id] = permit
        if permit.act != "water":
            return
        before, self._last_permit[permit.plant_id] = self._last_permit.get(permit.plant_id), permit
        if before is not None and not self._measured(before.issued_s, permit):
            self.breach("I2", f"{permit.plant_id} gave {permit.permit_id} without a measurement after {before.permit_id}")

    def _heard(self, message: Message, answer: Answer) -> None:
        """I10: a bid has come to its plant."""
        if message.path == "/bids" and answer.status == 200:
            bid = json.loads(answer.body)
            sent_s = self._asked.pop(message.number, self.truth.now())
            self._bids[bid["task_id"]].append(_Heard(sent_s, self.truth.now(), message.target, bid["cost_s"]))

    # Looks

    def look(self) -> None:
        """Whatever is judged by documents and queues."""
        entries = {
            robot_id: [e for e in brain.queue.entries if e.announcement is not None]
            for robot_id in self.garden.names("robot")
            if (brain := self.garden.brain(robot_id)) is not None
        }
        for plant_id in self.garden.names("plant"):
            for task in self._changed(plant_id):
                if task.state not in FINAL_STATES:
                    self._in_time(plant_id, task, self._seen[task.task_id])
                    self._agree(plant_id, task, entries)
        for robot_id, held in entries.items():
            self._queue(robot_id, held)

    def _changed(self, plant_id: str) -> list[Task]:
        """Judge a plant's documents if they are other ones than before; its tasks as they are on disk."""
        pot = self.garden.pot(plant_id)
        if pot is None or (document := pot.place._keeper.durable) is None:
            return []
        if self._documents.get(plant_id) is not document:
            self._documents[plant_id] = document
            self._document(plant_id, document)
            for task in document.tasks:
                self._task(plant_id, task)
        if self._inventories.get(plant_id) is not pot.tending._fruits.machine.inventory:
            self._inventories[plant_id] = pot.tending._fruits.machine.inventory
            self._fruits(plant_id)
        return document.tasks

    def crashed(self, name: str) -> None:
        """I4: judged once it is up again, by the next look."""

    def _document(self, plant_id: str, document: MarketDocument) -> None:
        if document.boot < self._boot[plant_id]:
            self.breach("I4", f"{plant_id} is back at boot {document.boot} after {self._boot[plant_id]}")
        self._boot[plant_id] = document.boot
        known = {task.task_id for task in document.tasks}
        for task_id in self._open[plant_id] - known:
            self._open[plant_id].discard(task_id)
            self.breach("I4", f"{task_id} was on disk and is gone")
        for task_id in [t for t in self._created if t.startswith(f"{plant_id}:")]:
            del self._created[task_id]
            if task_id not in known and task_id not in self._seen:
                self.breach("I4", f"{task_id} was acknowledged and is gone")
        pot = self.garden.pot(plant_id)
        assert pot is not None
        for name, values in self._settings[plant_id].items():
            if getattr(pot.care.machine.settings, name) not in values:
                self.breach("I4", f"{plant_id} forgot that {name} was set to {values}")

    def _fruits(self, plant_id: str) -> None:
        pot = self.garden.pot(plant_id)
        assert pot is not None
        inventory = pot.tending._fruits.machine.inventory
        if inventory.generation < self._generation[plant_id]:
            self.breach("I4", f"{plant_id}'s inventory is back at {inventory.generation}")
        self._generation[plant_id] = max(self._generation[plant_id], inventory.generation)
        for fruit in inventory.fruits:
            if fruit.fruit_id in self._told_gone[plant_id]:
                self.breach("I3", f"{plant_id} lists {fruit.fruit_id}, which was picked and told")
        picked = [line.fruit_id for line in pot.tending.ledger.lines()[-40:] if line.outcome == "picked"]
        if len(picked) != len(set(picked)):
            self.breach("I3", f"{plant_id}'s ledger has a fruit picked twice")

    def _touches(self, plant_id: str) -> int:
        return self.gremlin.touches[plant_id] + sum(self.gremlin.touches[name] for name in self.garden.names("robot"))

    def _task(self, plant_id: str, task: Task) -> None:
        if (seen := self._seen.get(task.task_id)) is None:
            seen = self._seen[task.task_id] = _Seen(task.epoch, task.state, self._touches(plant_id))
            self.tally.tasks += 1
            self.tally.by_kind[task.kind] = self.tally.by_kind.get(task.kind, 0) + 1
        if task.epoch < seen.epoch:
            self.breach("I4", f"{task.task_id} went from epoch {seen.epoch} back to {task.epoch}")
        if seen.state in FINAL_STATES and task.state != seen.state:
            self.breach("I4", f"{task.task_id} was {seen.state} and is {task.state}")
        touched = self._touches(plant_id) - seen.touches_before
        if task.epoch > seen.epoch and self._trouble(plant_id):
            seen.touches_before -= task.epoch - seen.epoch
        elif task.epoch > seen.epoch and task.epoch - 1 > 1 + touched:
            self.breach("I6", f"{task.task_id} is at epoch {task.epoch} with {touched} faults about it")
        if task.state in FINAL_STATES and seen.state not in FINAL_STATES:
            setattr(self.tally, task.state, getattr(self.tally, task.state) + 1)
        for entry in task.rounds:
            if entry.winner and (task.task_id, entry.epoch) not in self._rounds:
                self._rounds.add((task.task_id, entry.epoch))
                self._round(plant_id, task, entry)
        seen.epoch, seen.state = task.epoch, task.state
        (self._open[plant_id].discard if task.state in FINAL_STATES else self._open[plant_id].add)(task.task_id)

    def _in_time(self, plant_id: str, task: Task, seen: _Seen) -> None:
        """I5: time in which a capable robot could have done it."""
        if self._able(plant_id):
            seen.good_s += LOOK_S
        else:
            seen.good_s = 0.0
        if seen.good_s > DONE_S:
            seen.good_s = -math.inf
            self.breach(
                "I5", f"{task.task_id} ({task.kind}) is {task.state} after {DONE_S:.0f} quiet seconds: {task.reason}"
            )

    def _able(self, plant_id: str) -> bool:
        """Nothing has met the plant for a while, and some robot is well and has been."""
        quiet_s = self.truth.now() - 2 * LEASE_S
        if self.gremlin.touched_s[plant_id] > quiet_s or self.gremlin.touched_s["station"] > quiet_s:
            return False
        if self.garden.mesh.cut or self.truth.pots[plant_id].probe_silent:
            return False
        for robot_id in self.garden.names("robot"):
            body = self.truth.robots[robot_id]
            well = body.battery_ratio > 0.3 and not body.pump_broken and robot_id not in self._stopped
            if well and self.gremlin.touched_s[robot_id] < quiet_s and robot_id in self.garden.running:
                return True
        return False

    def _trouble(self, plant_id: str) -> bool:
        """A fault lasts that may well meet the plant's tasks."""
        if self.garden.mesh.cut or self.garden.mesh.weather is not CLEAR or self.truth.water_out:
            return True
        down = any(self.truth.robots[name].pump_broken or self._away(name) for name in self.garden.names("robot"))
        return down or bool(self._stopped) or self._away(plant_id) or self._away("station")

    def _away(self, name: str) -> bool:
        """Dead, or asleep."""
        running = self.garden.running.get(name)
        return running is None or running.life.stopped

    # Agreement

    def _agree(self, plant_id: str, task: Task, entries: dict[str, list[Entry]]) -> None:
        """I7: the plant says that a robot holds it; the robot should say so too."""
        key = (task.task_id, task.robot_id, task.epoch)
        held = task.state in ("awarded", "running") and task.robot_id in entries
        theirs = any((e.task_id, e.epoch) == (task.task_id, task.epoch) for e in entries.get(task.robot_id, ()))
        waits = bool(task.permit_id) or "soaking" in task.phase
        self._disagree(key, held and not theirs and not waits, plant_id, task.robot_id, "the plant says so alone")

    def _queue(self, robot_id: str, held: list[Entry]) -> None:
        """I1: nothing twice in a queue. I7: the robot says that it holds a task; its plant should say so too."""
        names = [entry.task_id for entry in held]
        for task_id in {name for name in names if names.count(name) > 1}:
            self.breach("I1", f"{robot_id} has {task_id} in its queue twice")
        for entry in held:
            pot = self.garden.pot(entry.plant_id)
            if pot is None:
                continue
            task = next((t for t in pot.place.market.tasks() if t.task_id == entry.task_id), None)
            mine = task is not None and task.state in ("awarded", "running")
            mine = mine and task is not None and (task.robot_id, task.epoch) == (robot_id, entry.epoch)
            apart = not mine and not entry.committed
            self._disagree(
                (entry.task_id, f"{robot_id}?", entry.epoch), apart, entry.plant_id, robot_id, "the robot says so alone"
            )

    def _disagree(self, key: tuple[str, str, int], apart: bool, plant_id: str, robot_id: str, how: str) -> None:
        if not apart or self._away(plant_id) or self._away(robot_id):
            self._apart.pop(key, None)
            return
        now_s = self.truth.now()
        since_s = max(self._apart.setdefault(key, now_s), self.gremlin.touched_s[plant_id], self.gremlin.touched_s[robot_id])
        if now_s - since_s > AGREE_S and not self.garden.mesh.cut:
            self._apart[key] = math.inf
            self.breach("I7", f"{robot_id} holds {key[0]} epoch {key[2]} for {AGREE_S:.0f} s: {how}")

    # Awards

    def _round(self, plant_id: str, task: Task, entry: BidRound) -> None:
        """I10: the cheapest won, of those in the round and of those that came."""
        offers = [bid for bid in entry.bids if bid.cost_s is not None]
        won = next((bid for bid in offers if bid.robot_id == entry.winner), None)
        if not self._same_life(plant_id):
            return  # its times are those of a clock that is gone
        if won is None or won.cost_s is None:
            return self.breach("I10", f"{task.task_id} went to {entry.winner}, which offered nothing")
        best = min(offers, key=_price)
        if _price(best) < _price(won):
            self.breach("I10", f"{task.task_id} went to {entry.winner} at {won.cost_s:.1f} s, not to {best.robot_id}")
        closed_s = self._loop_s(plant_id, entry.t_s)
        sent = [h for h in self._bids[task.task_id] if closed_s - BID_WINDOW_S - 0.1 <= h.sent_s <= closed_s]
        if not sent:
            return
        newest_s = max(h.sent_s for h in sent)
        came = [h for h in sent if h.sent_s >= newest_s - 1.0 and h.heard_s <= closed_s - 0.005 and h.cost_s is not None]
        for heard in came:
            assert heard.cost_s is not None
            if (heard.cost_s, heard.robot_id) < _price(won) and heard.robot_id not in {bid.robot_id for bid in offers}:
                self.breach(
                    "I10", f"{task.task_id} went to {entry.winner}, though {heard.robot_id} offered {heard.cost_s:.1f} s"
                )

    def _same_life(self, plant_id: str) -> bool:
        life = self.garden.running[plant_id].life
        before = self._lives.setdefault(plant_id, life)
        self._lives[plant_id] = life
        return before is life

    def _loop_s(self, plant_id: str, garden_s: float) -> float:
        clock = self.garden.running[plant_id].life.clock
        return (garden_s - clock.offset_s) / clock.rate

    # Ends

    def drained(self) -> None:
        """I9: a calm has lasted; nothing old may be left."""
        now_s = self.truth.now()
        for plant_id in self.garden.names("plant"):
            pot = self.garden.pot(plant_id)
            if pot is None:
                self.breach("I9", f"{plant_id} did not come back")
                continue
            for task in pot.place.market.open_tasks():
                age_s = now_s - self._loop_s(plant_id, task.created_s)
                if age_s > DRAIN_S and not self.truth.pots[plant_id].probe_silent:
                    self.breach(
                        "I9", f"{task.task_id} ({task.kind}) is still {task.state} after a calm: {task.reason or task.phase}"
                    )
        for robot_id in self.garden.names("robot"):
            brain = self.garden.brain(robot_id)
            if brain is None:
                self.breach("I9", f"{robot_id} did not come back")
            elif len(brain.reporter._finals) > 0:
                stale = [f for f in brain.reporter._finals if brain.clock.now() - f.since_s > 60.0]
                if stale:
                    self.breach("I9", f"{robot_id} cannot get rid of its report about {stale[0].entry.task_id}")


def _price(bid: Bid) -> tuple[float, str]:
    return (math.inf if bid.cost_s is None else bid.cost_s, bid.robot_id)


def of_kind(breaches: list[Breach], invariant: str) -> Iterator[Breach]:
    return (breach for breach in breaches if breach.invariant == invariant)
