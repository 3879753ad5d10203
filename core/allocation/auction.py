"""One round of bids, and who wins it. Pure: the plant's market (`plant_side`) opens and closes rounds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

from core.wire.market import Bid

SILENT = "did not answer"


@dataclass(slots=True, kw_only=True)
class Round:
    """A question to all known robots, open until all answered or the window is over."""

    number: int
    asked: frozenset[str]
    deadline_s: float
    purpose: Literal["award", "reallocate"] = "award"
    answers: dict[str, Bid] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        return self.answers.keys() >= self.asked

    def take(self, robot_id: str, bid: Bid, task_id: str) -> None:
        """Note an answer; the first one of a robot counts, and one for another task or name is no bid."""
        if robot_id not in self.asked or robot_id in self.answers:
            return
        if bid.robot_id != robot_id or bid.task_id != task_id:
            bid = no_bid(task_id, robot_id, "answered for another robot or task")
        self.answers[robot_id] = bid

    def bids(self, task_id: str) -> list[Bid]:
        """Every asked robot's answer in order of id; the silent ones say so."""
        asked = sorted(self.asked)
        return [self.answers.get(name) or no_bid(task_id, name, SILENT) for name in asked]


def no_bid(task_id: str, robot_id: str, reason: str) -> Bid:
    return Bid(task_id=task_id, robot_id=robot_id, cost_s=None, reason=reason[:500])


def cheapest(bids: Iterable[Bid]) -> Bid | None:
    """The feasible bid of least cost, ties by id; None when nobody can."""
    able = [bid for bid in bids if bid.cost_s is not None]
    return min(able, key=lambda bid: (bid.cost_s, bid.robot_id), default=None)


def worth_s(bids: Iterable[Bid], winner: Bid, margin_ratio: float) -> float | None:
    """Up to what price the winner stays the one to have: the next cheapest bid, at least a margin above its own.

    None when nobody else can.
    """
    if (next_best := cheapest(bid for bid in bids if bid.robot_id != winner.robot_id)) is None:
        return None
    return max(next_best.cost_s or 0.0, (winner.cost_s or 0.0) * (1.0 + margin_ratio))


def better_than_holder(bids: Iterable[Bid], holder: str, margin_ratio: float) -> Bid | None:
    """The bid a task should move to: cheaper than the holder's own by more than the margin, or any when it cannot any more.

    A holder that did not answer keeps the task: its lease decides.
    """
    by_robot = {bid.robot_id: bid for bid in bids}
    own = by_robot.pop(holder, None)
    best = cheapest(by_robot.values())
    if own is None or own.reason == SILENT or best is None:
        return None
    if own.cost_s is None:
        return best
    return best if best.cost_s is not None and best.cost_s < own.cost_s * (1.0 - margin_ratio) else None


def told(bids: Iterable[Bid]) -> str:
    """Why nobody can, robot by robot."""
    reasons = [f"{bid.robot_id}: {bid.reason or 'no reason given'}" for bid in bids if bid.cost_s is None]
    return "; ".join(reasons) or "no robot is known"
