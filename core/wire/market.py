"""The market's documents (DESIGN, section 6): announcement, bid, award, report, permit, task, reservation."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from core.wire.documents import Document, Identifier, Millilitres, Ratio, Seconds, Sentence
from core.wire.fruit import Fruit, Pick
from core.wire.geometry import Point3, Pose2

TaskKind = Literal["water", "inventory", "harvest", "probe", "scan", "survey", "spray", "charge", "refill"]
TaskState = Literal["announced", "awarded", "running", "done", "failed", "cancelled"]
FINAL_STATES = ("done", "failed", "cancelled")
Epoch = Annotated[int, Field(ge=0, le=2**53)]
OrderId = Annotated[str, Field(max_length=80)]
"""Whose order a harvest belongs to; empty: the plant's own wish."""
Within = Annotated[float, Field(gt=0, le=1e7)]
"""A deadline as people give it [s]."""
ANNOUNCED_FRUITS_MAX = 64
PICKS_MAX = 64

BID_WINDOW_S = 2.0
REALLOCATE_S = 10.0
REALLOCATE_MARGIN_RATIO = 0.2
LEASE_S = 8.0
"""A robot reports at least every LEASE_S / 4; silence this long loses the task."""


class PlantCard(Document):
    """What a robot needs to serve a plant."""

    plant_id: Identifier
    url: Annotated[str, Field(max_length=200)]
    stem: Point3
    """Centre of the soil's surface, world frame."""
    dock: Pose2
    """Base pose of a docked robot, world frame."""
    nozzle: Point3
    """Where water should leave, in the plant frame (x towards the dock)."""


class Announcement(Document):
    """`POST /bids` at a robot: a task looking for a robot."""

    task_id: Identifier
    kind: TaskKind
    plant: PlantCard
    dose_ml: Annotated[float, Field(ge=0, le=500)] = 0.0
    priority: Annotated[int, Field(ge=0, le=9)] = 5
    holder: Annotated[str, Field(max_length=80)] = ""
    """The robot that has the task now, when the plant asks again."""
    fruits: Annotated[list[Fruit], Field(max_length=ANNOUNCED_FRUITS_MAX)] = []
    """`harvest`: those to pick, in this order. `inventory`: what is known, to be looked for again."""
    count: Annotated[int, Field(ge=0, le=ANNOUNCED_FRUITS_MAX)] = 0
    """`harvest`: how many of them are wanted; the rest are there to choose from."""
    order_id: OrderId = ""
    within_s: Seconds | None = None
    """From now to its deadline; null: it has none."""


class Breakdown(Document):
    """Why a bid costs what it costs, in seconds."""

    current_s: Seconds = 0.0
    queue_s: Seconds = 0.0
    travel_s: Seconds = 0.0
    work_s: Seconds = 0.0
    charge_s: Seconds = 0.0
    refill_s: Seconds = 0.0
    delay_s: Seconds = 0.0
    """What others wait longer, added up: each task behind it in the queue, and whatever a busy robot is asked for next."""


class Bid(Document):
    """A robot's answer: the seconds that are waited for it, or None with the reason. All but `delay_s`: until it is done."""

    task_id: Identifier
    robot_id: Identifier
    cost_s: Seconds | None
    reason: Sentence = ""
    breakdown: Breakdown = Breakdown()


class Award(Document):
    """`POST /tasks` at a robot. Idempotent by (task_id, epoch)."""

    announcement: Announcement
    epoch: Epoch
    lease_s: Seconds
    cost_s: Seconds
    at_most_s: Seconds | None = None
    """A robot that would bid more than this by now declines (409, "Overtaken"); null: it takes the task anyway."""


class Report(Document):
    """`POST /tasks/{id}/reports` at a plant: a robot's progress; renews the lease."""

    robot_id: Identifier
    epoch: Epoch
    state: Literal["awarded", "running", "done", "failed"]
    phase: Sentence = ""
    """The job under way: undock, navigate, dock, act, or the one-line reason for waiting."""
    progress: Ratio = 0.0
    reason: Sentence = ""
    delivered_ml: Millilitres | None = None
    picks: Annotated[list[Pick], Field(max_length=PICKS_MAX)] = []
    """`harvest`: every pick of this task and epoch that has ended, in every report: the plant may have missed one."""


class ReportAnswer(Document):
    """`keep` false means: this task is no longer yours, drop it."""

    keep: bool
    reason: Sentence = ""
    lease_s: Seconds = LEASE_S


class PermitRequest(Document):
    """`POST /tasks/{id}/permits`: may I do the irreversible act now?"""

    robot_id: Identifier
    epoch: Epoch
    act: Literal["water", "pick"]
    amount_ml: Annotated[float, Field(ge=0, le=500)] = 0.0
    fruit_id: Annotated[str, Field(max_length=80)] = ""
    """`pick`: the one fruit."""


class Permit(Document):
    """One shot. Counted from the robot's request; nothing may begin after `valid_for_s`."""

    permit_id: Identifier
    task_id: Identifier
    epoch: Epoch
    act: Literal["water", "pick"]
    dose_ml: Millilitres = 0.0
    fruit_id: Annotated[str, Field(max_length=80)] = ""
    valid_for_s: Seconds


class TaskEvent(Document):
    t_s: float
    what: Sentence
    robot_id: str = ""
    epoch: Epoch = 0


class BidRound(Document):
    """One auction: who was asked, who answered what, who won and why."""

    t_s: float
    epoch: Epoch
    bids: list[Bid]
    winner: str = ""
    why: Sentence = ""


class Task(Document):
    """A plant's task document; `GET /tasks/{id}`."""

    task_id: Identifier
    kind: TaskKind
    state: TaskState
    plant_id: Identifier
    robot_id: str = ""
    epoch: Epoch = 0
    created_s: float
    updated_s: float
    asked_by: str = ""
    """`soil`, or the subject of the token that asked."""
    why: Sentence = ""
    priority: Annotated[int, Field(ge=0, le=9)] = 5
    deadline_s: float | None = None
    """When it fails unless a robot has begun it."""
    dose_ml: Millilitres = 0.0
    delivered_ml: Millilitres | None = None
    phase: Sentence = ""
    progress: Ratio = 0.0
    fruit_ids: list[Identifier] = []
    """`harvest`: those that may be picked, in this order."""
    count: Annotated[int, Field(ge=0)] = 0
    """`harvest`: how many are wanted."""
    order_id: OrderId = ""
    picks: list[Pick] = []
    """`harvest`: how each fruit's pick ended."""
    reason: Sentence = ""
    permit_id: str = ""
    permits: int = 0
    rounds: list[BidRound] = []
    events: list[TaskEvent] = []


class TaskRequest(Document):
    """`POST /tasks` at a plant, by an operator."""

    kind: Literal["water", "inventory", "harvest"]
    dose_ml: Annotated[float, Field(gt=0, le=500)] | None = None
    """`water` only; the pot's own dose if not given."""
    count: Annotated[int, Field(ge=1, le=ANNOUNCED_FRUITS_MAX)] | None = None
    """`harvest` only: how many ripe fruit; all of them if not given."""
    fruit_ids: Annotated[list[Identifier], Field(max_length=ANNOUNCED_FRUITS_MAX)] = []
    """`harvest` only: just these."""
    order_id: OrderId = ""
    """`harvest` only."""
    priority: Annotated[int, Field(ge=0, le=9)] = 5
    within_s: Within | None = None
    """It fails unless a robot has begun it within this time; whatever cannot be done by then is not begun."""

    @model_validator(mode="after")
    def _fits_its_kind(self) -> TaskRequest:
        if self.kind != "water" and self.dose_ml is not None:
            raise ValueError(f"dose_ml means nothing to {self.kind}")
        if self.kind != "harvest" and (self.count is not None or self.fruit_ids or self.order_id):
            raise ValueError(f"count, fruit_ids and order_id mean nothing to {self.kind}")
        return self


class ReservationRequest(Document):
    """`POST /dock/reservations` at a plant or station. Asking again renews. `dock_id` names a station's dock."""

    robot_id: Identifier
    dock_id: Annotated[str, Field(max_length=80)] = ""
    for_s: Annotated[float, Field(gt=0, le=600)] = 30.0
    yielding: bool = False
    """The holder only rests here: it leaves when somebody else asks."""


class Reservation(Document):
    """Granted: the dock is yours until `valid_for_s` passes. Refused with 409 and a Problem naming the holder."""

    reservation_id: Identifier
    dock_id: str
    robot_id: Identifier
    epoch: Epoch
    valid_for_s: Seconds
    wanted_by: str = ""
    """Somebody waits: a yielding holder goes now."""
