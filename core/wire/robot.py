"""A robot's own documents."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from core.wire.documents import Document, Identifier, Millilitres, Ratio, Seconds, Sentence
from core.wire.geometry import Point2, Pose2
from core.wire.market import Breakdown, TaskKind

JobKind = Literal["goto", "dock", "undock", "home"]
StopNumber = Annotated[int, Field(ge=0, le=2**53)]
"""Every `POST /stop` takes the next one, for as long as the robot's body has its files."""


class Position(Document):
    """`GET /position`: cheap, polled at 1 Hz by 1-hop neighbours."""

    robot_id: Identifier
    pose: Pose2
    radius_m: float
    v_mps: float
    moving: bool
    docked_at: str = ""
    route: list[Point2] = []
    """The next metres it means to drive."""
    rank: int = 0
    """Who goes first: lower goes first, ties by id."""


class QueuedTask(Document):
    task_id: Identifier
    kind: TaskKind
    plant_id: str
    epoch: int
    state: Literal["queued", "running"]
    phase: Sentence = ""
    progress: Ratio = 0.0


class RobotState(Document):
    """`GET /state` of a robot."""

    robot_id: Identifier
    now_s: float
    pose: Pose2 | None
    """None until the robot knows where it is."""
    position_sigma_m: float | None = None
    docked_at: str = ""
    battery_ratio: Ratio
    tank_ml: Millilitres | None
    job: Sentence = ""
    """What it does now, in a word: idle, undock, navigate, dock, act, charge, refill, stopped."""
    waiting: Sentence = ""
    """The one-line reason for waiting; empty when it does not wait."""
    stopped: bool
    stopped_by: str = ""
    stop_number: StopNumber = 0
    """Names the stop that `POST /resume` releases; 0 while it is not stopped, or the stop is not written down yet."""
    down: list[str] = []
    queue: list[QueuedTask] = []
    route: list[Point2] = []


class JobRequest(Document):
    """`POST /jobs`, by an operator."""

    kind: JobKind
    x_m: Annotated[float, Field(ge=-100, le=100)] | None = None
    y_m: Annotated[float, Field(ge=-100, le=100)] | None = None
    yaw_rad: Annotated[float, Field(ge=-10, le=10)] | None = None
    at: Annotated[str, Field(max_length=80)] = ""
    """Whose dock: a plant's id, or `station/DOCK`."""


class Job(Document):
    """`GET /jobs/{id}`; posting one answers 202 with its Location."""

    job_id: Identifier
    kind: JobKind
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    reason: Sentence = ""
    cost: Breakdown = Breakdown()


class StopRequest(Document):
    """`POST /stop`: anyone enrolled may; only an operator resumes."""

    reason: Sentence = ""


class ResumeRequest(Document):
    """`POST /resume`: releases the stop that the operator saw, and no later one."""

    stop_number: Annotated[StopNumber, Field(ge=1)]


class NamedStop(ResumeRequest):
    robot_id: Identifier


class ResumeAllRequest(Document):
    """`POST /api/resume` at the console: each robot's stop as the page showed it; other robots stay as they are."""

    stops: Annotated[list[NamedStop], Field(min_length=1, max_length=1000)]


class Stopped(Document):
    robot_id: Identifier
    stopped: bool
    by: str = ""
    stop_number: StopNumber = 0
    """What `POST /resume` must name; 0 when it goes on."""
    after_s: Seconds = 0.0
