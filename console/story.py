"""One task's story, put together from the plant's and the robots' own histories.

Nobody keeps it whole: the plant knows its rounds, awards, permits and what robots reported; a robot knows what it did and
what it dropped. All their times are the garden's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from typing import get_args

from core.allocation.auction import SILENT
from core.allocation.epochs import owner_of
from core.wire.documents import Document, HistoryEntry
from core.wire.market import FINAL_STATES, Bid, BidRound, Task, TaskEvent, TaskKind, TaskState

_ENDED = re.compile(rf"({'|'.join(FINAL_STATES)}): ")
_REPORTED = re.compile(r"(\S+) (?:reports (done|failed)|(failed))\b:? ?(.*)")
_SILENT = re.compile(r"(\S+) fell silent")
OF_ROUNDS = ("awarded to ", "nobody can take it: ")
"""Events that the rounds tell better."""

NOTED_WITHIN_S = 2.0
STATES: dict[str, TaskState] = {state: state for state in get_args(TaskState)}
KINDS: dict[TaskKind, re.Pattern[str]] = {
    "water": re.compile(r"^permit \S+ for \d+ ml|^asked for by \S+: water content"),
    "inventory": re.compile(
        r"has scanned$|^asked for by \S+: (this plant was|the last scan|what is known|nobody told|.*looked at)"
    ),
    "harvest": re.compile(r"^permit \S+ for \S+$|^asked for by \S+: (\d+ ripe fruit|order )"),
}
"""A history does not say of what kind a task was; its words do."""
_AWARDED = re.compile(r"awarded to (\S+), epoch (\d+): ")
_ASKED = re.compile(r"asked for by (\S+): (.*)")


class Step(Document):
    """A message from one to another, or, without a `target`, something that happened at the source."""

    t_s: float
    source: str
    target: str = ""
    what: str

    @property
    def who(self) -> str:
        return f"{self.source} -> {self.target}" if self.target else self.source


class Story(Document):
    """A task and its steps in order of time."""

    task: Task
    steps: list[Step]

    def parties(self) -> list[str]:
        """Robots in order of their first word, the plant after the first of them."""
        robots = dict.fromkeys(name for step in self.steps for name in (step.source, step.target) if name)
        robots.pop(self.task.plant_id, None)
        first, *others = robots or ("",)
        return [name for name in (first, self.task.plant_id, *others) if name]


def tell(task: Task, plant: Sequence[HistoryEntry], robots: Mapping[str, Sequence[HistoryEntry]]) -> Story:
    """The story of `task`; histories may hold other things as well, and may be missing."""
    steps = [*_by_plant(task), *_noted(task, plant)]
    for name, entries in robots.items():
        steps += _by_robot(task, name, entries, steps)
    return Story(task=task, steps=sorted(steps, key=attrgetter("t_s")))


def remembered(task_id: str, entries: Sequence[HistoryEntry]) -> Task | None:
    """A task that its plant has forgotten, as far as the plant's history still tells; None when it does not tell enough."""
    told = [entry for entry in entries if entry.task_id == task_id and entry.kind in STATES]
    kind = next((kind for kind, words in KINDS.items() if any(words.search(entry.what) for entry in told)), None)
    if kind is None:
        return None
    events, holder, epoch = list[TaskEvent](), "", 0
    for entry in told:
        if won := _AWARDED.match(entry.what):
            holder, epoch = won[1], int(won[2])
        events.append(TaskEvent(t_s=entry.t_s, what=entry.what, robot_id=holder, epoch=epoch))
        holder = "" if entry.kind == "announced" else holder
    asked = _ASKED.match(told[0].what)
    return Task(
        task_id=task_id, kind=kind, state=STATES[told[-1].kind], plant_id=owner_of(task_id), robot_id=holder, epoch=epoch,
        created_s=told[0].t_s, updated_s=told[-1].t_s, asked_by=asked[1] if asked else "", why=asked[2] if asked else "",
        reason="the pot keeps only its history of this task", events=events,
    )  # fmt: skip


def _by_plant(task: Task) -> Iterator[Step]:
    rounds = {(round_.t_s, round_.epoch if round_.winner else -1): round_ for round_ in task.rounds}
    told: set[int] = set()
    holder = ""
    for event in task.events:
        if event.what.startswith(OF_ROUNDS):
            won = event.what.startswith(OF_ROUNDS[0])
            found = rounds.get((event.t_s, event.epoch if won else -1))
            if found is not None and id(found) not in told:
                told.add(id(found))
                yield from _round(task, found)
            if won:
                yield from _awarded(task, event, holder)
                holder = event.robot_id
        else:
            yield from _happened(task, event)
            holder = "" if _SILENT.match(event.what) or not event.robot_id else holder
    for round_ in rounds.values():
        if id(round_) not in told:
            yield from _round(task, round_)


def _round(task: Task, round_: BidRound) -> Iterator[Step]:
    for bid in round_.bids:
        yield Step(t_s=round_.t_s, source=task.plant_id, target=bid.robot_id, what=f"{task.kind}: your bid?")
        if bid.reason == SILENT:
            yield Step(t_s=round_.t_s, source=task.plant_id, what=f"{bid.robot_id} {SILENT}")
        else:
            yield Step(t_s=round_.t_s, source=bid.robot_id, target=task.plant_id, what=_said(bid))
    if not round_.winner:
        yield Step(t_s=round_.t_s, source=task.plant_id, what="nobody can take it")


def _said(bid: Bid) -> str:
    return f"{bid.cost_s:.1f} s" if bid.cost_s is not None else f"no: {bid.reason}"


def _awarded(task: Task, event: TaskEvent, holder: str) -> Iterator[Step]:
    if holder and holder != event.robot_id:
        yield Step(t_s=event.t_s, source=task.plant_id, target=holder, what=f"kill task, epoch {event.epoch - 1}")
    yield Step(t_s=event.t_s, source=task.plant_id, target=event.robot_id, what=f"award, epoch {event.epoch}")


def _happened(task: Task, event: TaskEvent) -> Iterator[Step]:
    """An event of the plant's as messages, or as something of its own."""
    t_s, plant, robot, what = event.t_s, task.plant_id, event.robot_id, event.what
    if what.startswith("permit ") and robot:
        yield Step(t_s=t_s, source=robot, target=plant, what="may I?")
        yield Step(t_s=t_s, source=plant, target=robot, what=what)
    elif silent := _SILENT.match(what):
        yield Step(t_s=t_s, source=plant, what=what)
        yield Step(t_s=t_s, source=plant, target=silent[1], what=f"kill task, epoch {event.epoch}")
    elif said := _REPORTED.match(what):
        reason = f": {said[4]}" if said[4] and said[4] != "no remark" else ""
        yield Step(t_s=t_s, source=said[1], target=plant, what=f"{said[2] or said[3]}{reason}")
    elif robot and not _ENDED.match(what) and not what.startswith(("asked for by ", f"{robot} ")):
        yield Step(t_s=t_s, source=robot, target=plant, what=what)
    else:
        yield Step(t_s=t_s, source=plant, what=what)
        if robot and what.startswith("cancelled"):
            yield Step(t_s=t_s, source=plant, target=robot, what=f"kill task, epoch {event.epoch}")


def _noted(task: Task, entries: Sequence[HistoryEntry]) -> Iterator[Step]:
    """What only the plant's history tells of this task: measurements, what a scan settled."""
    for entry in entries:
        if entry.task_id == task.task_id and not any(_same(entry, event) for event in task.events):
            yield Step(t_s=entry.t_s, source=task.plant_id, what=entry.what)


def _same(entry: HistoryEntry, event: TaskEvent) -> bool:
    """The history has most of a task's events again, written a moment later."""
    return event.what.endswith(entry.what) and abs(entry.t_s - event.t_s) < NOTED_WITHIN_S


def _by_robot(task: Task, name: str, entries: Sequence[HistoryEntry], steps: Sequence[Step]) -> Iterator[Step]:
    """What the robot did for this task, and what befell it while it had it."""
    holds = list(_holds(task, name, steps))
    for entry in entries:
        mine = entry.task_id == task.task_id and entry.kind != "award"
        meanwhile = not entry.task_id and any(since_s <= entry.t_s <= until_s for since_s, until_s in holds)
        if mine or meanwhile:
            yield Step(t_s=entry.t_s, source=name, what=entry.what)


def _holds(task: Task, name: str, steps: Sequence[Step]) -> Iterator[tuple[float, float]]:
    """From each award to its end [garden s]."""
    since_s = None
    for step in steps:
        if step.target == name and step.what.startswith("award, "):
            since_s = step.t_s
        elif since_s is not None and _ends(step, name):
            yield since_s, step.t_s
            since_s = None
    if since_s is not None:
        yield since_s, task.updated_s


def _ends(step: Step, name: str) -> bool:
    return step.what.startswith("kill task") if step.target == name else step.what.startswith(("done", "failed"))
