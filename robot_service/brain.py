"""A robot's brain, put together: `build` makes the node that a process, or the lab, runs."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import replace

import httpx

from core.allocation import deadlines
from core.allocation.bidding import OTHER_WORK_S, Condition, Stop, ride_s, work_s
from core.allocation.epochs import owner_of
from core.allocation.queue import Entry, TaskQueue
from core.allocation.reorder import better_order
from core.clock import Clock
from core.errors import Forbidden, Overtaken, Refused, Unavailable, Unprocessable
from core.geometry.pinhole import from_fov
from core.mesh.auth import Caller, Identity, Verifier
from core.mesh.client import Mesh, PeerTransport
from core.mesh.events import EventLog
from core.mesh.node import Node
from core.mesh.peers import Peers
from core.mesh.presence import add_presence
from core.robots import gardener
from core.robots.markers import ceiling_markers
from core.wire.body import BodyState
from core.wire.documents import NodeCard
from core.wire.geometry import Point2, Pose2
from core.wire.market import Announcement, Award, Bid
from core.wire.robot import Job, JobRequest, Position, QueuedTask, RobotState, Stopped
from hw.drivers.camera import open_camera
from hw.links import Opener
from robot_service.bodylink import BodyLink
from robot_service.docks import Docks
from robot_service.eye import Eye
from robot_service.fitness import PUMP, Fitness, LeakWatch
from robot_service.ground import Ground
from robot_service.localisation import Localisation
from robot_service.neighbours import Neighbours
from robot_service.planner import Hand, Planner
from robot_service.reporter import Reporter
from robot_service.robot import Robot, launch_of
from robot_service.scheduler import Scheduler
from robot_service.settings import NEED_EYE, RobotSettings
from robot_service.spread import Spread

STOP_ANSWER_S = 2.0
STOPPED_BY_CHARS = 200
OVERTAKEN_FOR_S = 300.0
"""A task that has waited so long is not put back any more."""


class Brain:
    """Everything one robot is, but for HTTP."""

    def __init__(
        self,
        settings: RobotSettings,
        clock: Clock,
        opener: Opener,
        mesh: Mesh,
        peers: Peers,
        rng: random.Random,
        eye: Eye,
        hand: Hand | None = None,
    ) -> None:
        self.settings, self.clock = settings, clock
        self.body = BodyLink(settings.body_url, settings.secret(), opener, clock)
        markers = ceiling_markers(settings.map.arena)
        where = Localisation(settings.localisation, settings.wheelbase_m, markers, settings.map, clock)
        self.events = EventLog(clock)
        neighbours = Neighbours(settings.id, peers, mesh, clock, lambda: self.robot.moving, lambda: where.pose, self._idle)
        self.robot = Robot(
            settings, clock, rng, self.body, where, Ground(settings.map), neighbours, mesh, peers, self.events, eye,
            Fitness(clock),
        )  # fmt: skip
        self.docks = Docks(settings.id, mesh, peers, clock, neighbours.calm)
        self.queue = TaskQueue()
        self.reporter = Reporter(self.robot, self.queue)
        planner = Planner(self.robot, self.docks, self.travel_s, hand or Hand())
        spread = Spread(self.robot, self.travel_s)
        self.scheduler = Scheduler(self.robot, self.docks, planner, self.queue, self.reporter, spread)
        self.reporter.kill = self.scheduler.kill
        self._stopped = True
        self._travels: dict[tuple[int, str, str], float | None] = {}
        self._job_number = 0
        self.body.listeners += [where.take, self.robot.watch, self._see, LeakWatch(self._leaks).see]

    # ------------------------------------------------------------------ readings
    def _idle(self) -> bool:
        charging = self.robot.activity.job == "charge" and bool(self.robot.where.docked_at)
        return charging or (self.robot.activity.job == "idle" and not self.queue.entries)

    def _see(self, state: BodyState) -> None:
        if state.stopped != self._stopped:
            self._stopped = state.stopped
            self.robot.note("stop", f"stopped by {state.stopped_by}" if state.stopped else "released")
            if state.stopped:
                self.scheduler.halt(f"stopped by {state.stopped_by or 'the e-stop'}")
            else:
                self.robot.fitness.looked_after()

    def _leaks(self, how: str) -> None:
        self.robot.note("alarm", how)
        self.scheduler.cannot(PUMP, how)

    def missing(self) -> list[str]:
        """What keeps it from work, for `/readyz`."""
        state = self.body.state
        if self.body.down or state is None:
            return [self.body.down or "the body is silent"]
        return [*state.down, *([self.robot.where.lost] if self.robot.where.lost else [])]

    def card(self) -> NodeCard:
        pose = self.robot.where.pose
        place = {} if pose is None else {"pose": _pose2(pose).model_dump()}
        return NodeCard(
            id=self.settings.id,
            kind="robot",
            capabilities=[name for name in self.settings.capabilities if name in self._can()],
            place=place,
            links={name: f"{self.settings.url}/{name}" for name in ("state", "position", "tasks", "history", "docs")},
        )

    def state(self) -> RobotState:
        body, activity, where = self.body.state, self.robot.activity, self.robot.where
        pose = where.pose
        stopped = body is None or body.stopped
        return RobotState(
            robot_id=self.settings.id,
            now_s=self.clock.now(),
            pose=None if pose is None else _pose2(pose),
            position_sigma_m=None if pose is None else where.sigma_m,
            docked_at=where.docked_at,
            battery_ratio=0.0 if body is None else min(1.0, max(0.0, body.battery_ratio)),
            tank_ml=None if body is None or body.tank_ml is None else max(0.0, body.tank_ml),
            job="stopped" if stopped and body is not None else activity.job,
            waiting=activity.waiting,
            stop_number=0 if body is None else body.stop_number,
            stopped=stopped,
            stopped_by="" if body is None else body.stopped_by,
            down=[self.body.down] if self.body.down or body is None else [*body.down, *self.robot.fitness.told()],
            queue=[queued(entry) for entry in self.queue.entries if entry.kind != "job"],
            route=[Point2(x_m=x, y_m=y) for x, y in activity.route],
        )

    def position(self) -> Position:
        """Raises Unavailable until the robot knows where it is."""
        self.robot.neighbours.asked()
        pose, activity = self.robot.where.pose, self.robot.activity
        if pose is None:
            raise Unavailable(self.robot.where.lost or "does not know where it is", hint="ask again in a second")
        return Position(
            robot_id=self.settings.id,
            pose=_pose2(pose),
            radius_m=gardener.BODY_RADIUS_M,
            v_mps=activity.v_mps,
            moving=self.robot.moving,
            docked_at=self.robot.where.docked_at,
            route=[Point2(x_m=x, y_m=y) for x, y in activity.route],
            rank=activity.rank,
        )

    # ------------------------------------------------------------------ the market
    async def bid(self, asked: Announcement) -> Bid:
        """Price a task. Wavefronts are computed once a dock and map, so that this is a lookup."""
        await self.prepare()
        if self.robot.peers.find(asked.plant.plant_id) is None:
            return self._no(asked, f"{asked.plant.plant_id} is nobody we know")
        if self.settings.map.dock(asked.plant.plant_id) is None:
            return self._no(asked, f"the dock of {asked.plant.plant_id} is not on our map")
        return deadlines.offer(asked, self.condition(), self._promised())

    def _no(self, asked: Announcement, reason: str) -> Bid:
        return Bid(task_id=asked.task_id, robot_id=self.settings.id, cost_s=None, reason=reason)

    async def prepare(self) -> None:
        """Have the field of every dock at hand."""
        ground = self.robot.ground
        for dock in self.settings.map.docks:
            x_m, y_m, _ = launch_of(dock)
            if not ground.knows((x_m, y_m)):
                await self.clock.offload(lambda goal=(x_m, y_m): ground.field_to(goal), 0.003)  # type: ignore[misc]

    def travel_s(self, place: str, dock: str) -> float | None:
        """Seconds from a dock's launch point, or from here, to another's; None when there is no way."""
        goal = launch_of(self.robot.dock(dock))
        here = place == "here" or self.settings.map.dock(place) is None
        key = (self.robot.ground.version, place, dock)
        if not here and key in self._travels:
            return self._travels[key]
        start = self.robot.where.pose if here else launch_of(self.robot.dock(place))
        length_m = None if start is None else self.robot.ground.length_m(start, (goal[0], goal[1]))
        time_s = None if length_m is None else ride_s(length_m)
        if not here:
            if next(iter(self._travels), key)[0] != key[0]:
                self._travels.clear()
            self._travels[key] = time_s
        return time_s

    def _can(self) -> frozenset[str]:
        """What it is fitted for and has what it takes."""
        blind = frozenset() if self.robot.eye.fitted else frozenset(NEED_EYE)
        return frozenset(self.settings.capabilities) - blind

    def condition(self) -> Condition:
        body, where = self.body.state, self.robot.where
        begun = self.queue.begun
        docks, broken = self.settings.map.docks, self.robot.fitness.why_not(PUMP)
        return Condition(
            robot_id=self.settings.id,
            can=self._can(),
            unfit={"water": broken} if broken else {},
            travel=self.travel_s,
            stopped_by=(body.stopped_by if body is not None and body.stopped else None),
            down=(self.body.down,) if self.body.down else tuple(body.down if body is not None else ("body",)),
            lost=where.lost,
            battery_ratio=0.0 if body is None else body.battery_ratio,
            tank_ml=None if body is None else body.tank_ml,
            docked_at=where.docked_at,
            current=None if begun is None else self._stop(begun),
            at_work_s=0.0 if begun is None else self._at_work_s(begun),
            queue=tuple(self._stop(entry) for entry in self.queue.waiting),
            taps=tuple(name for name, dry in self.robot.taps().items() if not dry),
            chargers=tuple(dock.name for dock in docks),
        )

    def _stop(self, entry: Entry) -> Stop:
        if (asked := entry.announcement) is not None:
            labour_s = work_s(asked.kind, asked.dose_ml, asked.count)
            return Stop(
                dock=entry.plant_id, work_s=labour_s, dose_ml=asked.dose_ml, task_id=entry.task_id,
                priority=asked.priority, settled=self.clock.now() - entry.since_s > OVERTAKEN_FOR_S,
            )  # fmt: skip
        charge, refill = entry.kind == "charge", entry.kind == "refill"
        dock = "" if charge or refill else self.robot.where.docked_at
        return Stop(dock=dock, work_s=OTHER_WORK_S, task_id=entry.task_id, charge=charge, refill=refill, settled=True)

    def _promised(self) -> list[Announcement]:
        """What waits and has a deadline, with the seconds left until then."""
        now_s = self.clock.now()
        return [
            asked.model_copy(update={"within_s": max(0.0, entry.since_s + asked.within_s - now_s)})
            for entry in self.queue.waiting
            if (asked := entry.announcement) is not None and asked.within_s is not None
        ]

    def _at_work_s(self, running: Entry) -> float:
        """How long it has been at what it came for."""
        where, now_s = self.robot.where, self.clock.now()
        if running.announcement is None:
            return now_s - self.scheduler.began_s
        return now_s - max(self.scheduler.began_s, where.docked_s) if where.docked_at == running.plant_id else 0.0

    def award(self, award: Award, caller: Caller) -> QueuedTask:
        """Take a task; raises Forbidden for another plant's, Refused for a stale epoch, Overtaken for too low a price."""
        plant_id = award.announcement.plant.plant_id
        check_owner(award.announcement, caller)
        if self.robot.peers.find(plant_id) is None or self.settings.map.dock(plant_id) is None:
            raise Unprocessable(f"{plant_id} is not a plant we know")
        if award.announcement.kind not in self._can():
            raise Unprocessable(f"cannot {award.announcement.kind}")
        if award.announcement.kind == "water" and (broken := self.robot.fitness.why_not(PUMP)):
            raise Overtaken(broken, hint="ask all robots again")
        self._check_price(award)
        at = deadlines.place(award.announcement, self.condition(), self._promised())
        entry = self.queue.award(award, self.clock.now(), at)
        self._shorten_queue()
        self.robot.note("award", f"{entry.kind} for {plant_id}", task_id=entry.task_id, epoch=entry.epoch)
        self.scheduler.changed()
        self.reporter.soon()
        return queued(entry)

    def _check_price(self, award: Award) -> None:
        """Raises Overtaken when so much was taken since the bid that another robot would be the better one."""
        if award.at_most_s is None or self.queue.find(award.announcement.task_id) is not None:
            return
        bid = deadlines.offer(award.announcement, self.condition(), self._promised())
        if bid.cost_s is None or bid.cost_s > award.at_most_s:
            now = bid.reason if bid.cost_s is None else f"{bid.cost_s:.0f} s by now"
            raise Overtaken(f"bid {award.cost_s:.0f} s, {now}", hint="ask all robots again")

    def _shorten_queue(self) -> None:
        """Put what waits in a better order; what has a deadline keeps its place."""
        me, due = self.condition(), {task.task_id for task in self._promised()}
        queue = tuple(replace(stop, settled=stop.settled or stop.task_id in due) for stop in me.queue)
        self.queue.arrange(better_order(replace(me, queue=queue)))

    def kill(self, task_id: str, caller: Caller, epoch: int | None = None) -> QueuedTask:
        """Kill task; a plant only its own. Raises Refused for an epoch that is over: that word came late."""
        entry = self.queue.get(task_id)
        if caller.role == "plant" and caller.subject != entry.plant_id:
            owner = entry.plant_id or self.settings.id
            raise Forbidden(f"{task_id} is a task of {owner}", hint=f"only {owner} or an operator kills it")
        if epoch is not None and epoch != entry.epoch:
            raise Refused(f"{task_id} is held under epoch {entry.epoch}, not {epoch}", hint="kill the epoch that is meant")
        self.scheduler.kill(entry, f"killed by {caller.subject}")
        return queued(entry)

    # ------------------------------------------------------------------ the operator
    def add_job(self, wish: JobRequest, by: str = "", key: str = "") -> Job:
        """Queue a direct job, once for one `key` as long as the job is remembered.

        Raises Unprocessable for one that makes no sense here.
        """
        request = wish.model_dump_json()
        if key and (before := self.reporter.asked_before(by, key, request)) is not None:
            return before
        job = self._new_job(wish)
        if key:
            self.reporter.remember_key(by, key, request, job)
        return job

    def _new_job(self, wish: JobRequest) -> Job:
        if wish.kind == "dock" and self.settings.map.dock(wish.at) is None:
            known = ", ".join(dock.name for dock in self.settings.map.docks)
            raise Unprocessable(f"no dock {wish.at!r}", hint=f"one of: {known}")
        if wish.kind == "goto" and (wish.x_m is None or wish.y_m is None):
            raise Unprocessable("goto needs x_m and y_m")
        if wish.kind == "goto" and not self.robot.ground.fixed().is_free(wish.x_m or 0.0, wish.y_m or 0.0):
            raise Unprocessable("the robot cannot stand there", hint="GET / tells the arena; keep off pots and edges")
        self._job_number += 1
        job = Job(
            job_id=f"{self.settings.id}:job:{int(self.clock.now())}:{self._job_number}", kind=wish.kind, state="queued"
        )
        self.queue.push(Entry(task_id=job.job_id, kind="job", job=wish), first=True)
        self.reporter.remember(job)
        self.scheduler.changed()
        return job

    def call_off(self, job_id: str, caller: Caller) -> Job:
        """Cancel a job that has not ended."""
        job = self.reporter.job(job_id)
        if (entry := self.queue.find(job_id)) is not None:
            running = entry.running
            self.scheduler.kill(entry, f"called off by {caller.subject}")
            if not running:
                job = self.reporter.remember(job.model_copy(update={"state": "cancelled", "reason": entry.killed}))
        return job

    async def stop(self, caller: Caller, reason: str) -> Stopped:
        """Latch the e-stop in the body; answers once the body has written it down. It stops whatever the answer.

        Pressed while it is latched it is a stop of its own, which only its own number releases.
        """
        began_s = self.clock.now()
        before = self._stop_number()
        # Told again in bids, reports and reasons for waiting, which are sentences of their own.
        self.body.order("stop", f"{caller.subject}: {reason}"[:STOPPED_BY_CHARS] if reason else caller.subject)
        await self._until("stop", lambda: self._stop_number() > before)
        return self._stop_state(began_s)

    async def resume(self, caller: Caller, stop_number: int) -> Stopped:
        """Release the stop of this number; raises Refused while another one is latched. Released, it stays so."""
        began_s = self.clock.now()
        self._check_stop(stop_number)
        self.body.order("resume", caller.subject, stop_number)
        await self._until("resume", lambda: self._released(stop_number))
        self.scheduler.changed()
        return self._stop_state(began_s)

    def _stop_number(self) -> int:
        return 0 if self.body.state is None else self.body.state.stop_number

    def _released(self, stop_number: int) -> bool:
        """Raises Refused when somebody pressed again meanwhile."""
        self._check_stop(stop_number)
        state = self.body.state
        return state is not None and not state.stopped and state.stop_kept

    def _check_stop(self, stop_number: int) -> None:
        if (latched := self._stop_number()) not in (0, stop_number):
            by = "" if self.body.state is None else self.body.state.stopped_by
            told = f"the robot stands by stop {latched}, not by {stop_number}: {by}"
            raise Refused(told, hint=f"see why it was stopped, then name stop_number {latched}")

    async def _until(self, order: str, done: Callable[[], bool]) -> None:
        try:
            async with self.clock.timeout(STOP_ANSWER_S):
                while not done():
                    await self.clock.sleep(0.02)
        except TimeoutError:
            held = self.body.state is not None and self.body.state.stopped and order == "stop"
            stands = "; it stands still, but a restart would forget it: look at its disk" if held else ""
            raise Unavailable(f"the body did not confirm the {order} within {STOP_ANSWER_S:g} s{stands}") from None

    def _stop_state(self, began_s: float) -> Stopped:
        state = self.body.state
        return Stopped(
            robot_id=self.settings.id,
            stopped=state is None or state.stopped,
            by="" if state is None else state.stopped_by,
            stop_number=self._stop_number(),
            after_s=max(0.0, self.clock.now() - began_s),
        )


def check_owner(asked: Announcement, caller: Caller) -> None:
    """A plant speaks of its own tasks only: whoever could name another's could outbid its epochs. Raises Forbidden."""
    plant_id = asked.plant.plant_id
    if caller.role == "plant" and caller.subject != plant_id:
        raise Forbidden(f"{caller.subject} cannot offer a task of {plant_id}", hint="offer your own tasks")
    if (owner := owner_of(asked.task_id)) not in ("", plant_id):
        raise Forbidden(f"{asked.task_id} is a task of {owner}, not of {plant_id}", hint="offer tasks under your own ids")


def queued(entry: Entry) -> QueuedTask:
    return QueuedTask(
        task_id=entry.task_id,
        kind="charge" if entry.kind == "job" else entry.kind,
        plant_id=entry.plant_id,
        epoch=entry.epoch,
        state="running" if entry.running else "queued",
        phase=entry.phase,
        progress=entry.progress,
    )


def _pose2(pose: tuple[float, float, float]) -> Pose2:
    return Pose2(x_m=pose[0], y_m=pose[1], yaw_rad=pose[2])


def build(
    settings: RobotSettings,
    clock: Clock,
    opener: Opener,
    transport: PeerTransport | httpx.AsyncBaseTransport,
    rng: random.Random,
    *,
    identity: Identity | None = None,
    verifier: Verifier | None = None,
    peers: Peers | None = None,
    open_reads: bool = True,
    cameras: httpx.AsyncBaseTransport | None = None,
    eye: Eye | None = None,
    hand: Hand | None = None,
) -> Node:
    """One robot's brain as a node. `verifier` None switches authentication off, for tests.

    `cameras` carries the HTTP of its camera; None: the network. `eye` and `hand` take the place of those it would make.
    """
    from robot_service.api import make_app

    mesh = Mesh(transport, identity, clock)
    lens = from_fov(*gardener.CAMERA_PIXELS, math.radians(gardener.CAMERA_FOV_Y_DEG))
    camera = open_camera(settings.camera_url, clock, cameras) if settings.camera_url else None
    eye = eye or Eye(camera, settings.detector, lens, clock)
    peers = peers if peers is not None else Peers()
    brain = Brain(settings, clock, opener, mesh, peers, rng, eye, hand)
    app = make_app(brain, verifier, open_reads)
    add_presence(app, peers, clock, identity, "robot", settings.url)
    app.state.brain = brain
    loops = [brain.body.run, brain.robot.neighbours.run, brain.docks.run, brain.reporter.run, brain.scheduler.run]
    if camera is not None:
        loops.append(camera.run)
    return Node(id=settings.id, kind="robot", app=app, loops=tuple(loops), url=settings.url)
