"""What a plant's documents say (I3, I4, I6): nothing that was acknowledged regresses, nothing changes hands for nothing."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from core.allocation.plant_state import MarketDocument
from core.mesh.client import Answer
from core.wire.fruit import Inventory
from core.wire.market import FINAL_STATES, Task
from lab.soak.case import Case
from lab.soak.net import Message
from plant_service.pot import Pot


@dataclass(slots=True)
class _Seen:
    """The newest of a task that was on disk."""

    epoch: int
    state: str
    faults_before: int


class Papers:
    """Reads a plant's documents whenever they have changed."""

    def __init__(self, case: Case, read: Callable[[str, Task], None], settled: Callable[[str], None]) -> None:
        """`read` is called with every task of a new document, `settled` with every permit to water that it closes."""
        self._case, self._read, self._settled = case, read, settled
        self._seen: dict[str, _Seen] = {}
        self._open: defaultdict[str, set[str]] = defaultdict(set)
        """Tasks by plant that were on disk and had not ended."""
        self._created: defaultdict[str, set[str]] = defaultdict(set)
        """Tasks by plant that were acknowledged and not yet looked for on disk."""
        self._boot: defaultdict[str, int] = defaultdict(int)
        self._met_before: defaultdict[str, int] = defaultdict(int)
        """Faults when a plant's tasks were last looked at: what is new then may have met all since."""
        self._documents: dict[str, MarketDocument] = {}
        self._inventories: dict[str, Inventory] = {}
        self._generation: defaultdict[str, int] = defaultdict(int)
        self._told_gone: defaultdict[str, set[str]] = defaultdict(set)
        self._settings: defaultdict[str, dict[str, set[Any]]] = defaultdict(dict)

    # What was promised

    def arrived(self, message: Message) -> None:
        """A change of settings may hold from now on, acknowledged or not."""
        if message.path == "/settings":
            for name, value in json.loads(message.body).items():
                self._settings[message.target].get(name, set()).add(value)

    def answered(self, message: Message, answer: Answer) -> None:
        """A plant has acknowledged something."""
        if message.path == "/tasks":
            self._created[message.target].add(json.loads(answer.body)["task_id"])
        elif message.path == "/settings":
            self._settings[message.target] |= {name: {value} for name, value in json.loads(message.body).items()}
        elif message.path == "/inventory/scans":
            generation = json.loads(answer.body)["generation"]
            self._generation[message.target] = max(self._generation[message.target], generation)
        elif message.path.endswith("/reports") and b'"picked"' in message.body:
            self._picks_told(message)

    def _picks_told(self, message: Message) -> None:
        for pick in json.loads(message.body)["picks"]:
            held = self._case.permits.get(pick["permit_id"])
            if pick["outcome"] == "picked" and held is not None and held.robot_id == message.source:
                self._told_gone[held.plant_id].add(pick["fruit_id"])
        self._inventories.pop(message.target, None)

    # What is on disk

    def look(self, plant_id: str) -> list[Task]:
        """Judge a plant's documents if they are other ones than before; its tasks as they are on disk."""
        pot = self._case.garden.pot(plant_id)
        if pot is None or (document := pot.place._keeper.durable) is None:
            return []
        before = self._documents.get(plant_id)
        if before is not document:
            self._documents[plant_id] = document
            self._market(plant_id, pot, document)
            if before is not None and (closed := _open_permit(before)) != _open_permit(document):
                self._settled(closed)
        self._met_before[plant_id] = self._faults(plant_id)
        stored = pot.tending._fruits.durable
        if stored is not None and self._inventories.get(plant_id) is not stored.inventory:
            self._inventories[plant_id] = stored.inventory
            self._fruits(plant_id, pot, stored.inventory)
        return document.tasks

    def _market(self, plant_id: str, pot: Pot, document: MarketDocument) -> None:
        if document.boot < self._boot[plant_id]:
            self._case.breach("I4", f"{plant_id} is back at boot {document.boot} after {self._boot[plant_id]}")
        self._boot[plant_id] = document.boot
        known = {task.task_id for task in document.tasks}
        for task_id in self._open[plant_id] - known:
            self._open[plant_id].discard(task_id)
            self._case.breach("I4", f"{task_id} was on disk and is gone")
        for task_id in self._created.pop(plant_id, set()) - known - set(self._seen):
            self._case.breach("I4", f"{task_id} was acknowledged and is gone")
        for name, values in self._settings[plant_id].items():
            if getattr(pot.care.machine.settings, name) not in values:
                self._case.breach("I4", f"{plant_id} forgot that {name} was set to {values}")
        for task in document.tasks:
            self._task(plant_id, task)
            self._read(plant_id, task)

    def _task(self, plant_id: str, task: Task) -> None:
        case = self._case
        if (seen := self._seen.get(task.task_id)) is None:
            seen = self._seen[task.task_id] = _Seen(0, "announced", self._met_before[plant_id])
            case.born_s[task.task_id] = case.truth.now()
            case.tally.tasks += 1
            case.tally.by_kind[task.kind] = case.tally.by_kind.get(task.kind, 0) + 1
        if task.epoch < seen.epoch:
            case.breach("I4", f"{task.task_id} went from epoch {seen.epoch} back to {task.epoch}")
        if seen.state in FINAL_STATES and task.state != seen.state:
            case.breach("I4", f"{task.task_id} was {seen.state} and is {task.state}")
        self._changed_hands(plant_id, task, seen)
        if task.state in FINAL_STATES and seen.state not in FINAL_STATES:
            setattr(case.tally, task.state, getattr(case.tally, task.state) + 1)
        seen.epoch, seen.state = task.epoch, task.state
        (self._open[plant_id].discard if task.state in FINAL_STATES else self._open[plant_id].add)(task.task_id)

    def _changed_hands(self, plant_id: str, task: Task, seen: _Seen) -> None:
        """I6: taken once, once more for a better price, and once more for every fault that met it."""
        case = self._case
        if task.epoch <= seen.epoch:
            return
        if self._lasting(plant_id):
            seen.faults_before -= task.epoch - seen.epoch
        faults = self._faults(plant_id, task.task_id) - seen.faults_before
        declined = sum(task_id == task.task_id for task_id, _ in case.declined)
        if task.epoch - 1 > 1 + faults + declined:
            told = f"{faults} faults about it and {declined} awards declined"
            case.breach("I6", f"{task.task_id} is at epoch {task.epoch} with {told}")

    def _faults(self, plant_id: str, task_id: str = "") -> int:
        """Those that met a task's plant, the station, any robot, or a message about it, its dock or where a robot is."""
        gremlin = self._case.gremlin
        nodes = (plant_id, "station", *self._case.garden.names("robot"))
        about = {task_id, plant_id, "station", ""}
        return sum(gremlin.touches[name] for name in nodes) + sum(gremlin.crossed[name] for name in about)

    def _lasting(self, plant_id: str) -> bool:
        """Something is broken that may fail every robot that comes."""
        case = self._case
        robots = case.garden.names("robot")
        broken = any(case.truth.robots[name].pump_broken or case.away(name) for name in robots)
        broken = broken or case.truth.pots[plant_id].probe_silent or case.truth.water_out
        return broken or bool(case.stopped) or case.away(plant_id) or case.away("station")

    def _fruits(self, plant_id: str, pot: Pot, inventory: Inventory) -> None:
        if inventory.generation < self._generation[plant_id]:
            self._case.breach("I4", f"{plant_id}'s inventory is back at {inventory.generation}")
        self._generation[plant_id] = max(self._generation[plant_id], inventory.generation)
        for fruit in inventory.fruits:
            if fruit.fruit_id in self._told_gone[plant_id]:
                self._case.breach("I3", f"{plant_id} lists {fruit.fruit_id}, which was picked and told")
        picked = [line.fruit_id for line in pot.tending.ledger.lines()[-40:] if line.outcome == "picked"]
        if len(picked) != len(set(picked)):
            self._case.breach("I3", f"{plant_id}'s ledger has a fruit picked twice")


def _open_permit(document: MarketDocument) -> str:
    return "" if document.open_permit is None else document.open_permit.permit.permit_id
