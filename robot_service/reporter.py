"""Tells plants how their tasks stand: at every change, every quarter of a lease, and the end until it is heard."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from core.allocation.queue import Entry, TaskQueue
from core.errors import GardenError, NotFound, Unavailable, Unprocessable
from core.wire.market import Report, ReportAnswer
from core.wire.robot import Job
from robot_service.robot import Robot

LOOK_S = 0.5
NOTHING_S = 60.0
"""While there is nothing to tell; an award or an end is told of at once."""
FINAL_RETRY_S = 2.0
FINAL_LIFE_S = 600.0
JOBS_KEPT = 100


@dataclass(slots=True)
class _Told:
    phase: str = ""
    at_s: float = -1e9


@dataclass(slots=True)
class _Final:
    entry: Entry
    report: Report
    since_s: float
    next_s: float = 0.0


@dataclass(slots=True)
class Reporter:
    robot: Robot
    queue: TaskQueue
    kill: Callable[[Entry, str], None] = lambda entry, why: None
    jobs: dict[str, Job] = field(default_factory=dict)
    keys: dict[tuple[str, str], tuple[str, str]] = field(default_factory=dict)
    """By whom and with which Idempotency-Key: what was asked for, and the job's id."""
    _told: dict[str, _Told] = field(default_factory=dict)
    _finals: deque[_Final] = field(default_factory=lambda: deque(maxlen=100))
    _soon: asyncio.Event = field(default_factory=asyncio.Event)

    async def run(self) -> None:
        while True:
            self._soon.clear()
            await asyncio.gather(*(self._tell(entry) for entry in self._due()), self._tell_ends())
            self._told = {task_id: told for task_id, told in self._told.items() if self.queue.find(task_id)}
            try:
                async with self.robot.clock.timeout(LOOK_S if self._telling() else NOTHING_S):
                    await self._soon.wait()
            except TimeoutError:
                pass

    def soon(self) -> None:
        """Something changed: do not wait for the next look."""
        self._soon.set()

    def finish(self, entry: Entry, report: Report) -> None:
        """Queue a final report; it is repeated until the plant has heard it."""
        self._finals.append(_Final(entry, report, self.robot.clock.now()))
        self.soon()

    # ------------------------------------------------------------------ an operator's jobs
    def remember(self, job: Job) -> Job:
        """Keep a job's document; the oldest are forgotten."""
        self.jobs[job.job_id] = job
        while len(self.jobs) > JOBS_KEPT:
            del self.jobs[next(iter(self.jobs))]
        return job

    def remember_key(self, by: str, key: str, request: str, job: Job) -> None:
        """As long as the job itself."""
        self.keys = {name: (asked, job_id) for name, (asked, job_id) in self.keys.items() if job_id in self.jobs}
        self.keys[by, key] = request, job.job_id

    def asked_before(self, by: str, key: str, request: str) -> Job | None:
        """The job that this request made when it first came; raises Unprocessable when its key came with another."""
        asked, job_id = self.keys.get((by, key), (request, ""))
        if asked != request:
            raise Unprocessable("this Idempotency-Key came before with another body", hint="take a new key")
        return self.job(job_id) if job_id in self.jobs else None

    def job(self, job_id: str) -> Job:
        """Raises NotFound."""
        if (job := self.jobs.get(job_id)) is None:
            raise NotFound(f"no job {job_id} here")
        entry = self.queue.find(job_id)
        return job.model_copy(update={"state": "running"}) if entry is not None and entry.running else job

    def all_jobs(self) -> list[Job]:
        return [self.job(job_id) for job_id in self.jobs]

    def jobs_ended(self, entry: Entry, report: Report) -> None:
        if (job := self.jobs.get(entry.task_id)) is not None:
            state = "cancelled" if entry.killed else report.state
            self.jobs[entry.task_id] = job.model_copy(update={"state": state, "reason": report.reason or entry.killed})

    @property
    def unheard(self) -> int:
        """Ends that their plants have not heard yet."""
        return len(self._finals)

    def _telling(self) -> bool:
        """Whether a plant waits for word of us; of the robot's own errands nobody wants to hear."""
        return bool(self._finals) or any(entry.announcement is not None for entry in self.queue.entries)

    def _due(self) -> list[Entry]:
        now_s = self.robot.clock.now()
        due = []
        for entry in self.queue.entries:
            if entry.announcement is None:
                continue
            entry.phase = self._phase(entry)
            told = self._told.setdefault(entry.task_id, _Told())
            if told.phase != entry.phase or now_s - told.at_s >= entry.lease_s / 4 - LOOK_S / 2:
                due.append(entry)
        return due

    def _phase(self, entry: Entry) -> str:
        if not entry.running:
            return "queued"
        activity = self.robot.activity
        return (f"{activity.job}: {activity.waiting}" if activity.waiting else activity.job)[:500]

    async def _tell(self, entry: Entry) -> None:
        told = self._told[entry.task_id]
        told.phase, told.at_s = entry.phase, self.robot.clock.now()
        report = Report(
            robot_id=self.robot.settings.id,
            epoch=entry.epoch,
            state="running" if entry.running else "awarded",
            phase=entry.phase,
            progress=entry.progress,
            picks=list(entry.picks),
        )
        epoch, asked_s = entry.epoch, self.robot.clock.now()
        try:
            answer = await self._post(entry, report)
        except Unavailable:
            if self.robot.clock.now() > entry.lease_until_s and not entry.killed:
                self.kill(entry, "the lease ran out: the plant does not answer")
            return
        except GardenError as error:
            if error.status in (403, 404, 409) and entry.epoch == epoch and not entry.killed:
                self.kill(entry, f"{entry.plant_id} refuses our report: {error}")
            return
        if answer.keep:
            entry.lease_until_s = max(entry.lease_until_s, asked_s + answer.lease_s)
        elif entry.epoch == epoch and not entry.killed:
            self.kill(entry, answer.reason or "no longer ours")

    async def _post(self, entry: Entry, report: Report) -> ReportAnswer:
        plant = self.robot.peers.get(entry.plant_id)
        return await self.robot.mesh.call(plant, "POST", f"/tasks/{entry.task_id}/reports", report, expect=ReportAnswer)

    async def _tell_ends(self) -> None:
        now_s = self.robot.clock.now()
        for final in [f for f in self._finals if f.next_s <= now_s]:
            try:
                await self._post(final.entry, final.report)
            except GardenError as error:
                final.next_s = now_s + FINAL_RETRY_S
                if (error.status < 500 and error.status != 429) or now_s - final.since_s > FINAL_LIFE_S:
                    self._finals.remove(final)
                    self.robot.note("report", f"the end was not taken: {error}", task_id=final.entry.task_id)
                continue
            self._finals.remove(final)
