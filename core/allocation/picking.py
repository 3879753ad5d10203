"""Picks: one permit for one fruit, settled by the robot's word or, when that is lost, by a scan. Pure, no tasks in here.

A fruit is picked once. While a permit for it is open no other pick is permitted on the plant; when nobody tells how it
ended the fruit is in doubt: it is not permitted again until a scan, taken after the act must be over, has settled it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from core.errors import Refused
from core.wire.documents import Document, Identifier
from core.wire.fruit import Fruit, Pick
from core.wire.market import Permit, Task

PICK_S_MAX = 60.0
"""The longest a pick may take once begun: grasp, pull, look, basket."""
RIPE_CONFIDENCE_MIN = 0.6
SIGMA_M_MAX = 0.03
"""A hand finds no fruit that is known less well than this: one view alone saw it, and often it is none."""


def may_be_picked(fruit: Fruit) -> bool:
    """Whether a hand may be sent for it, by what its plant knows; its colour is not asked."""
    sure = fruit.confidence >= RIPE_CONFIDENCE_MIN and fruit.sigma_m <= SIGMA_M_MAX
    return sure and not (fruit.unreachable or fruit.failed or fruit.in_doubt)


class OpenPick(Document):
    """A permit for one fruit whose end nobody has told yet."""

    permit: Permit
    robot_id: Identifier
    key: str = ""
    """The request's Idempotency-Key: the same question gets the same permit."""
    issued_s: float

    def act_over_s(self) -> float:
        """When the act is over at the latest [garden s]."""
        return self.issued_s + self.permit.valid_for_s + PICK_S_MAX

    def again(self, now_s: float) -> Permit:
        """The same permit for a repeated request; its validity still counts from the first."""
        left_s = max(0.0, self.permit.valid_for_s - max(0.0, now_s - self.issued_s))
        return self.permit.model_copy(update={"valid_for_s": left_s})


class Picking:
    """The fruit as the plant knows them, the open pick, and the fruit in doubt."""

    def __init__(self, open_pick: OpenPick | None, doubts: Sequence[OpenPick]) -> None:
        self.open = open_pick
        self.doubts = {doubt.permit.fruit_id: doubt for doubt in doubts}
        self.fruits: dict[str, Fruit] = {}

    def know(self, fruits: Iterable[Fruit]) -> None:
        """The inventory as it is now."""
        self.fruits = {fruit.fruit_id: fruit for fruit in fruits}

    def holds(self, task_id: str, robot_id: str, epoch: int) -> bool:
        held = self.open
        return held is not None and (held.permit.task_id, held.robot_id, held.permit.epoch) == (task_id, robot_id, epoch)

    def held(self, permit_id: str, robot_id: str) -> OpenPick | None:
        """The pick of this permit that nobody has told the end of, if it is this robot's."""
        unsettled = [*([self.open] if self.open else []), *self.doubts.values()]
        return next((p for p in unsettled if (p.permit.permit_id, p.robot_id) == (permit_id, robot_id) and permit_id), None)

    def left(self, task: Task) -> list[Fruit]:
        """The task's fruit that may still be tried, in its order."""
        tried = {pick.fruit_id for pick in task.picks}
        names = [name for name in task.fruit_ids if name not in tried and name not in self.doubts and name in self.fruits]
        return [self.fruits[name] for name in names if not self.fruits[name].unreachable]

    def check(self, task: Task, fruit_id: str) -> None:
        """Raises Refused unless this fruit may be picked now."""
        if self.open is not None:
            raise Refused(
                f"permit {self.open.permit.permit_id} for {self.open.permit.fruit_id} is not settled",
                hint="report how that pick ended first",
            )
        if fruit_id in self.doubts:
            raise Refused(f"nobody told how the last pick of {fruit_id} ended", hint="a scan comes first")
        if fruit_id not in self.fruits:
            raise Refused(f"{fruit_id or 'a fruit without a name'} is not in the inventory", hint="name one of the task's")
        if picked(task) >= task.count:
            raise Refused(f"{task.count} fruit are wanted, and picked", hint="report done")
        if all(fruit.fruit_id != fruit_id for fruit in self.left(task)):
            raise Refused(f"{fruit_id} is not for {task.task_id} to pick any more", hint="take another of its fruit")

    def issue(self, permit: Permit, robot_id: str, key: str, now_s: float) -> None:
        self.open = OpenPick(permit=permit, robot_id=robot_id, key=key, issued_s=now_s)

    def doubt(self) -> str:
        """Nobody will tell how the open pick ended; returns the fruit's id."""
        assert self.open is not None
        fruit_id, self.doubts[self.open.permit.fruit_id] = self.open.permit.fruit_id, self.open
        self.open = None
        return fruit_id

    def close(self, held: OpenPick) -> None:
        """It is known how this pick ended."""
        if self.open is not None and self.open.permit.permit_id == held.permit.permit_id:
            self.open = None
        else:
            del self.doubts[held.permit.fruit_id]

    def undecided(self, now_s: float) -> list[str]:
        """Fruit whose pick may be under way: a scan tells nothing about them yet."""
        busy = [d.permit.fruit_id for d in self.doubts.values() if now_s < d.act_over_s()]
        return [*busy, *([self.open.permit.fruit_id] if self.open else [])]

    def clear_s(self) -> float:
        """When every act in doubt must be over [garden s]."""
        return max((doubt.act_over_s() for doubt in self.doubts.values()), default=0.0)


def picked(task: Task) -> int:
    return sum(pick.outcome == "picked" for pick in task.picks)


def settles(held: OpenPick | None, pick: Pick, open_pick: OpenPick | None) -> bool:
    """Whether the robot's word ends this permit: any word in time; of a fruit in doubt only that it has it."""
    if held is None or held.permit.fruit_id != pick.fruit_id:
        return False
    in_time = open_pick is not None and open_pick.permit.permit_id == held.permit.permit_id
    return in_time or pick.outcome == "picked"


def told(task: Task) -> str:
    """How a harvest went, in a sentence."""
    failed = [f"{p.fruit_id} {p.outcome}: {p.reason or 'no reason given'}" for p in task.picks if p.outcome != "picked"]
    return "; ".join([f"{picked(task)} of {task.count} picked", *failed])[:500]
