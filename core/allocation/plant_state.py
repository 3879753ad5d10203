"""What a plant's market is made of: its rules, its durable document, its effects on the world, and what it may forget."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any

from core.allocation import permits
from core.allocation.auction import Round
from core.allocation.permits import Dose, OpenPermit
from core.allocation.picking import OpenPick
from core.wire.documents import Document
from core.wire.market import (
    BID_WINDOW_S,
    FINAL_STATES,
    LEASE_S,
    REALLOCATE_MARGIN_RATIO,
    REALLOCATE_S,
    Announcement,
    Award,
    Task,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """The market's times and bounds."""

    bid_window_s: float = BID_WINDOW_S
    lease_s: float = LEASE_S
    reallocate_s: float = REALLOCATE_S
    margin_ratio: float = REALLOCATE_MARGIN_RATIO
    moves_max: int = 1
    """How often a task moves for a better price before it ends or its holder fails."""
    declines_max: int = 6
    """How often robots may decline an award in a row because others were quicker; then one takes it at any price."""
    decline_s: float = 0.05
    """After the first decline the plant asks again about so much later, after each further one twice as much."""
    permit_valid_s: float = permits.PERMIT_VALID_S
    backoff_s_min: float = 1.0
    backoff_s_max: float = 30.0
    """After failures."""
    ask_again_s_max: float = 8.0
    """While nobody can: robots that just started are heard of soon, and a question costs little."""
    resend_s: float = 1.0
    """An award that nobody acknowledged is sent again this often until the lease ends."""
    run_s_max: float = 900.0
    """A robot that keeps a task this long without a permit loses it."""
    doses_max: int = 3
    """Doses without a rise of the soil's water content before a task fails."""
    failures_max: int = 8
    rounds_kept: int = 6
    events_kept: int = 40
    finished_kept: int = 20
    forgotten_keys_kept: int = 100
    """Idempotency-Keys whose tasks are forgotten and that are refused still."""
    open_max: int = 16
    auctions_max: int = 4
    """Rounds of bids that are open at the same time; further tasks wait, the more urgent first."""


@dataclass(slots=True, kw_only=True)
class Limits:
    """What the operator may change at run time."""

    soak_s: float = 60.0
    day_cap_ml: float = 1500.0
    target_ratio: float = 0.24


class Keyed(Document):
    """A person's request under an Idempotency-Key, in digests: whoever sends it again gets the same task again."""

    name: str
    """Of the asker and the key."""
    request: str
    task_id: str = ""

    @classmethod
    def of(cls, by: str, key: str, request: bytes) -> Keyed:
        return cls(name=_digest(f"{by}\0{key}".encode()), request=_digest(request))


def _digest(words: bytes) -> str:
    return sha256(words).hexdigest()[:32]


class MarketDocument(Document):
    """What survives a restart."""

    boot: int = 0
    tasks: list[Task] = []
    failures: dict[str, int] = {}
    open_permit: OpenPermit | None = None
    """Of a dose."""
    doses: list[Dose] = []
    doses_at_s: float | None = None
    """The garden time as of which the doses are told."""
    open_pick: OpenPick | None = None
    doubts: list[OpenPick] = []
    """Picks that were permitted and that nobody told the end of."""
    scanned: dict[str, str] = {}
    """Inventory tasks whose scan has come, and its id."""
    keyed: list[Keyed] = []

    def by_clock(self, now_s: float) -> MarketDocument:
        """What another process left, in the time of this one's clock, which may have begun anew.

        An act nobody told the end of has its whole time again from `now_s`; the day's doses are as old as they were.
        """
        return self.model_copy(
            update={
                "tasks": [task if task.state in FINAL_STATES else _in_new_time(task, now_s) for task in self.tasks],
                "open_permit": self.open_permit and self.open_permit.model_copy(update={"issued_s": now_s}),
                "doses": permits.revived(self.doses, self.doses_at_s, now_s),
                "doses_at_s": now_s,
                "open_pick": self.open_pick and self.open_pick.model_copy(update={"issued_s": now_s}),
                "doubts": [doubt.model_copy(update={"issued_s": now_s}) for doubt in self.doubts],
            }
        )


def _in_new_time(task: Task, now_s: float) -> Task:
    """A task of before the restart. When the clock began anew, its deadline is as far away as when it was asked for."""
    if task.deadline_s is None or task.created_s <= now_s:
        return task
    return task.model_copy(update={"created_s": now_s, "deadline_s": now_s + task.deadline_s - task.created_s})


@dataclass(frozen=True, slots=True)
class Solicit:
    """Ask these robots for bids; answers go to `bid` with the round's number."""

    announcement: Announcement
    round_number: int
    robots: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Grant:
    """Send an award; then `award_answered`."""

    robot_id: str
    award: Award


@dataclass(frozen=True, slots=True)
class Kill:
    """Tell a robot that a task is no longer its own; best effort."""

    robot_id: str
    task_id: str
    epoch: int


@dataclass(frozen=True, slots=True)
class Note:
    """Something for the history."""

    kind: str
    what: str
    task_id: str
    robot_id: str
    data: dict[str, Any] = field(default_factory=dict)


Effect = Solicit | Grant | Kill | Note


@dataclass(slots=True, kw_only=True)
class Live:
    """What a task forgets in a restart."""

    next_ask_s: float = math.inf
    backoff_s: float = 0.0
    lease_until_s: float = math.inf
    reallocate_s: float = math.inf
    resend_s: float = math.inf
    cost_s: float = 0.0
    running_since_s: float = math.inf
    round: Round | None = None
    at_most_s: float | None = None
    """Above this price the holder of an award declines it."""
    declines: int = 0
    """How often that happened in a row."""
    moves: int = 0
    """How often it went to a better price since it was last announced."""
    silences: int = 0
    """How many re-allocation rounds in a row its holder did not answer."""
    silent: bool = False
    """The lease ended while a permit was open."""
    told: str = ""
    """Why nobody took it, as last said."""

    @classmethod
    def revived(cls, task: Task, now_s: float, rules: Rules) -> Live:
        """After a restart: a holder gets a whole lease anew."""
        if task.state == "announced":
            return cls(next_ask_s=now_s)
        return cls(
            lease_until_s=now_s + rules.lease_s,
            reallocate_s=now_s + rules.reallocate_s if task.state == "awarded" else math.inf,
            resend_s=now_s,  # the award may never have left; a robot knows the (task, epoch) it has
            running_since_s=now_s if task.state == "running" else math.inf,
        )


@dataclass(frozen=True, slots=True)
class Soil:
    ratio: float | None
    why: str
    stamp_s: float
