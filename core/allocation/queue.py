"""A robot's queue: awards in the order they came, its own errands pushed in front, nothing taken twice.

Pure. An award is known by (task_id, epoch): the same again changes nothing, an older one is refused.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from core.errors import NotFound, Refused
from core.wire.fruit import Pick
from core.wire.market import Announcement, Award, TaskKind
from core.wire.robot import JobRequest

QUEUE_MAX = 32
EPOCHS_KEPT = 1000
Own = Literal["charge", "refill"]


@dataclass(slots=True, kw_only=True)
class Entry:
    """One thing to do: a plant's task, an errand of the robot's own, or an operator's job."""

    task_id: str
    kind: TaskKind | Literal["job"]
    plant_id: str = ""
    epoch: int = 0
    announcement: Announcement | None = None
    job: JobRequest | None = None
    lease_s: float = 0.0
    lease_until_s: float = float("inf")
    """The plant counts on us until then; after it the task is somebody else's."""
    running: bool = False
    committed: bool = False
    """Past the permit: it is finished whatever happens."""
    killed: str = ""
    """Why it was taken away; empty while it is ours."""
    phase: str = ""
    progress: float = 0.0
    since_s: float = float("-inf")
    """When it was promised."""
    picks: list[Pick] = field(default_factory=list)
    """`harvest`: how each fruit's pick ended so far."""


@dataclass(slots=True)
class TaskQueue:
    """What the robot has promised. `entries[0]` is next, or running."""

    entries: list[Entry] = field(default_factory=list)
    may_wait: Callable[[Entry], bool] = lambda entry: False
    """Asked of what is running: whether something else may still come first."""
    _epochs: OrderedDict[str, int] = field(default_factory=OrderedDict)

    def award(self, award: Award, now_s: float, at: int | None = None) -> Entry:
        """Take an award; the same one again returns the entry it made. Raises Refused for a stale epoch or a full queue.

        A new task goes before the one that is number `at` of what has not begun; None: to the end.
        """
        asked = award.announcement
        held = self.find(asked.task_id)
        if held is not None and held.epoch == award.epoch and not held.killed:
            held.lease_until_s = now_s + award.lease_s
            return held
        if award.epoch <= self._epochs.get(asked.task_id, -1):
            raise Refused(f"epoch {award.epoch} of {asked.task_id} is over", hint="award it again under a new epoch")
        if held is not None and held.committed:
            raise Refused(f"{asked.task_id} is being finished under epoch {held.epoch}")
        if held is None and len(self.entries) >= QUEUE_MAX:
            raise Refused(f"the queue is full with {QUEUE_MAX} tasks")
        self._remember(asked.task_id, award.epoch)
        return self._take(held, award, now_s, at)

    def _take(self, held: Entry | None, award: Award, now_s: float, at: int | None = None) -> Entry:
        if held is not None and not held.killed:
            held.epoch, held.lease_s, held.lease_until_s = award.epoch, award.lease_s, now_s + award.lease_s
            return held
        asked = award.announcement
        entry = Entry(
            task_id=asked.task_id,
            kind=asked.kind,
            plant_id=asked.plant.plant_id,
            epoch=award.epoch,
            announcement=asked,
            lease_s=award.lease_s,
            lease_until_s=now_s + award.lease_s,
            since_s=now_s,
        )
        waiting = self.waiting
        waiting.insert(len(waiting) if at is None else at, entry)
        self._line_up(waiting)
        return entry

    def _remember(self, task_id: str, epoch: int) -> None:
        self._epochs[task_id] = epoch
        self._epochs.move_to_end(task_id)
        while len(self._epochs) > EPOCHS_KEPT:
            self._epochs.popitem(last=False)

    def push(self, entry: Entry, *, first: bool = False) -> None:
        """An operator's job at the end, an errand of our own in front of everything that has not begun."""
        if len(self.entries) >= QUEUE_MAX:
            raise Refused(f"the queue is full with {QUEUE_MAX} tasks")
        begun = bool(self.entries) and self.entries[0].running
        self.entries.insert(int(begun) if first else len(self.entries), entry)

    def arrange(self, order: Sequence[int]) -> None:
        """Put what has not begun in this order of its numbers."""
        waiting = self.waiting
        assert sorted(order) == list(range(len(waiting))), "every one of them, once"
        self._line_up([waiting[number] for number in order])

    def _line_up(self, waiting: Sequence[Entry]) -> None:
        """Behind what has begun, wherever that stood: it may just have arrived."""
        begun = self.begun
        self.entries[:] = waiting if begun is None else [begun, *waiting]

    @property
    def running(self) -> Entry | None:
        return next((entry for entry in self.entries if entry.running), None)

    @property
    def begun(self) -> Entry | None:
        """What is running and cannot be put off any more."""
        running = self.running
        return None if running is None or self.may_wait(running) else running

    @property
    def waiting(self) -> list[Entry]:
        """What has not begun, in the order in which it will be done."""
        begun = self.begun
        return [entry for entry in self.entries if entry is not begun]

    def find(self, task_id: str) -> Entry | None:
        return next((entry for entry in self.entries if entry.task_id == task_id), None)

    def get(self, task_id: str) -> Entry:
        if (entry := self.find(task_id)) is None:
            raise NotFound(f"no task {task_id} here", hint="GET /tasks lists the queue")
        return entry

    def drop(self, entry: Entry) -> None:
        if entry in self.entries:
            self.entries.remove(entry)

    def next(self) -> Entry | None:
        return self.entries[0] if self.entries else None

    def has(self, kind: str) -> bool:
        return any(entry.kind == kind for entry in self.entries)

    def rush(self, entry: Entry) -> None:
        """To the front of what has not begun."""
        self.drop(entry)
        self.push(entry, first=True)
