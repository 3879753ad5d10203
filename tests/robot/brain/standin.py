"""A kinematic stand-in for the world below a brain: bodies that speak `core.wire.body`, pots, docks, a tap, plants.

Nothing is teleported: drive commands are integrated, contact blocks and bumps, docks hold whoever drove onto them.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field

from fastapi import FastAPI
from msgspec import structs

from core.allocation.docks import Docks
from core.clock import VirtualClock
from core.errors import Conflict, LinkDown, Refused
from core.estimation.markers import marker_view
from core.estimation.odometry import arc
from core.geometry.planar import Pose, between, distance_m, wrap
from core.manipulation.arm import Joints
from core.mesh.auth import GardenKey
from core.mesh.chassis import allow, body, create_app
from core.mesh.peers import Peer, Peers
from core.robots import gardener
from core.robots.garden_map import GardenMap, KnownPot, map_of
from core.robots.markers import ceiling_markers
from core.scenario import Scenario, find
from core.virtual import run_virtual
from core.wire.body import COMMAND_LIFE_S, BodyState, Control, Hello, LineBuffer, Marker, Setpoint, decode, encode
from core.wire.documents import NodeCard
from core.wire.geometry import Point3
from core.wire.market import (
    Announcement,
    Award,
    Bid,
    Permit,
    PermitRequest,
    PlantCard,
    Report,
    ReportAnswer,
    Reservation,
    ReservationRequest,
)
from core.wire.plant import TapGrant, TapRequest
from hw.links import ByteLink, MemoryNet
from lab.mesh import MemoryMesh
from robot_service.brain import Brain, build
from robot_service.settings import RobotSettings

DT_S = 0.02
SEEK_M = 1.3
SEEK_MPS = 0.12
CONTACT_M, CONTACT_RAD = 0.012, 0.12
TAP_MLPS = 30.0


@dataclass
class Plane:
    """What all bodies share: the fixed garden and one another."""

    garden: GardenMap
    bodies: list[StandInBody] = field(default_factory=list)
    hidden: list[tuple[float, float, float]] = field(default_factory=list)
    """Obstacles (x, y, radius) that no map shows."""
    filling: set[str] = field(default_factory=set)
    closest_m: float = math.inf
    """The nearest any two robots' centres ever came."""

    def free(self, me: StandInBody, x_m: float, y_m: float) -> bool:
        pots = [(p.x_m, p.y_m, p.radius_m) for p in self.garden.pots]
        others = [(b.pose[0], b.pose[1], gardener.BODY_RADIUS_M) for b in self.bodies if b is not me]
        for ox, oy, radius_m in (*pots, *self.hidden, *others):
            now_m = math.hypot(me.pose[0] - ox, me.pose[1] - oy)
            then_m = math.hypot(x_m - ox, y_m - oy)
            if then_m < gardener.BODY_RADIUS_M + radius_m and then_m < now_m:
                return False
        return True

    def measure(self) -> None:
        for i, a in enumerate(self.bodies):
            for b in self.bodies[i + 1 :]:
                self.closest_m = min(self.closest_m, distance_m(a.pose, b.pose))


class StandInBody:
    """One robot's body. Change its public fields to make faults."""

    def __init__(
        self, name: str, plane: Plane, clock: VirtualClock, net: MemoryNet, secret: str, pose: Pose, seed: int
    ) -> None:
        self.name, self.plane, self.clock, self.secret, self.pose = name, plane, clock, secret, pose
        self.rng = random.Random(seed)
        self.markers = {n: (p.x_m, p.y_m, p.yaw_rad) for n, p in ceiling_markers(plane.garden.arena).items()}
        self.travel_scale, self.noise_m = 1.03, 0.006
        self.battery_ratio = 0.9
        self.tank_ml: float | None = 1200.0
        self.stopped, self.stopped_by, self.blind, self.pump_stuck = False, "", False, False
        self.disk_broken, self.stop_number = False, 0
        self.attracted_to = ""
        """A dock whose beams drown the others."""
        self.arm: Joints | None = None
        self.permits: dict[str, float] = {}
        self.link: ByteLink | None = None
        self.ahead_s = 0.0
        """Of the brain's clock."""
        self.setpoint: Setpoint | None = None
        self.heard_s = -1e9
        self.left_m = self.right_m = 0.0
        self.v, self.omega = 0.0, 0.0
        self.bump = (False, False)
        self.permit_id, self.pumped_ml, self.pumping = "", 0.0, False
        self.marker: Marker | None = None
        self._marker_s, self._fixes, self._active_s = -1e9, 0, 0.0
        self._arm_from: Joints | None = None
        self._arm_said: Joints | None = None
        self._arm_goal: tuple[Joints, float, float] | None = None
        self.poured_at: list[tuple[str, float]] = []
        self.states = 0
        self._dock_of: tuple[Pose | None, str] = (None, "")
        plane.bodies.append(self)
        net.listen(name, self._accept)

    async def begin_anew(self, ahead_s: float) -> None:
        """Its process dies and another one begins: by another clock, its wheels' counters at nothing."""
        if self.link is not None:
            await self.link.close()
        self.link = self.setpoint = None
        self.ahead_s, self.left_m, self.right_m = ahead_s, 0.0, 0.0

    def _accept(self, link: ByteLink) -> None:
        if self.link is not None:
            self._closing = asyncio.ensure_future(self.link.close())
        self.link = link
        self._listener = asyncio.ensure_future(self._listen(link))

    async def _listen(self, link: ByteLink) -> None:
        lines = LineBuffer()
        try:
            while True:
                for line in lines.feed(await link.read()):
                    self._hear(decode(line))
        except LinkDown:
            if self.link is link:
                self.link, self.setpoint = None, None

    def _hear(self, message: object) -> None:
        if isinstance(message, Hello):
            assert message.secret == self.secret
        elif isinstance(message, Setpoint):
            self.setpoint, self.heard_s = message, self.clock.now()
        elif isinstance(message, Control):
            if message.order == "stop":
                self.stopped, self.stopped_by = True, message.by
                self.stop_number += 1
            elif message.order == "resume" and message.stop_number == self.stop_number:
                self.stopped, self.stopped_by = False, ""
            elif message.order == "wake":
                self._active_s = self.clock.now()

    # ------------------------------------------------------------------ physics
    @property
    def dock(self) -> str:
        """The dock whose contacts it stands on."""
        if self._dock_of[0] is not self.pose:
            self._dock_of = (self.pose, self._find_dock())
        return self._dock_of[1]

    def _find_dock(self) -> str:
        for dock in self.plane.garden.docks:
            x, y, yaw = between((dock.pose.x_m, dock.pose.y_m, dock.pose.yaw_rad), self.pose)
            if abs(x) < CONTACT_M and abs(y) < 0.03 and abs(yaw) < CONTACT_RAD:
                return dock.name
        return ""

    @property
    def docked(self) -> bool:
        return bool(self.dock) and self.v == 0.0

    async def run(self) -> None:
        told_s = -1e9
        while True:
            moving = self.v != 0 or self.omega != 0 or self.clock.now() - self.heard_s < 1.0
            dt_s = DT_S if moving else 5 * DT_S
            await self.clock.sleep(dt_s)
            self.step(dt_s)
            if moving or self.clock.now() - told_s >= 0.5:
                told_s = self.clock.now()
                self._tell()

    def step(self, dt_s: float) -> None:
        wanted = self.setpoint if self.clock.now() - self.heard_s <= COMMAND_LIFE_S and not self.stopped else None
        self._move(wanted, dt_s)
        self._move_arm(wanted)
        self._pump(wanted, dt_s)
        self._supply(dt_s)
        self._sight()
        self.plane.measure()

    def _move(self, wanted: Setpoint | None, dt_s: float) -> None:
        v = omega = 0.0
        if wanted is not None and wanted.base == "drive":
            v, omega = wanted.v_mps, wanted.omega_radps
        elif wanted is not None and wanted.base == "seek_dock" and not self.dock:
            v, omega = self._seek()
        if any(self.bump) and v > 0:
            v = 0.0
        if v == 0.0 and omega == 0.0:
            self.v = self.omega = 0.0
            return
        x, y, yaw = arc(self.pose, v * dt_s, omega * dt_s)
        blocked = not self.plane.free(self, x, y)
        at_dock = v > 0 and any(
            abs(between((d.pose.x_m, d.pose.y_m, d.pose.yaw_rad), (x, y, yaw))[1]) < 0.1
            and 0.004 < between((d.pose.x_m, d.pose.y_m, d.pose.yaw_rad), (x, y, yaw))[0] < 0.1
            for d in self.plane.garden.docks
        )
        if (blocked or at_dock) and v > 0:
            x, y, v = self.pose[0], self.pose[1], 0.0
        pressed = blocked or (any(self.bump) and v >= 0)
        self.bump = (pressed, pressed)
        self.pose = (x, y, yaw)
        self.v, self.omega = v, omega
        half_m = omega * gardener.WHEELBASE_M["create2"] / 2
        self.left_m += (v - half_m) * dt_s / self.travel_scale
        self.right_m += (v + half_m) * dt_s / self.travel_scale

    def _seek(self) -> tuple[float, float]:
        """Drive itself onto the nearest dock in sight, as opcode 143 does."""
        docks = [d for d in self.plane.garden.docks if not self.attracted_to or d.name == self.attracted_to]
        dock = min(docks, key=lambda d: distance_m((d.pose.x_m, d.pose.y_m), self.pose))
        x, y, yaw = between((dock.pose.x_m, dock.pose.y_m, dock.pose.yaw_rad), self.pose)
        if not self.attracted_to and (x < -SEEK_M or abs(y) > 0.6):
            return 0.0, 0.0
        error = wrap(math.atan2(-y, max(0.15, -0.5 * x)) - yaw)
        return (SEEK_MPS if x < -0.1 else 0.04) * (abs(error) < 0.6), max(-1.0, min(1.0, 3.0 * error))

    def forget_arm(self) -> None:
        """The servo board lost its supply."""
        self.arm = self._arm_said = self._arm_goal = None

    def _move_arm(self, wanted: Setpoint | None) -> None:
        now_s = self.clock.now()
        if wanted is not None and self.arm is None and wanted.arm != gardener.ARM_HOME_RAD:
            wanted = None
        if wanted is not None and wanted.arm is not None and self._arm_said != wanted.arm:
            self._arm_said = wanted.arm
            self._arm_from = self.arm or wanted.arm
            self._arm_goal = (wanted.arm, now_s, max(0.1, wanted.arm_s))
        if self._arm_goal is not None and self._arm_from is not None:
            goal, began_s, for_s = self._arm_goal
            share = min(1.0, (now_s - began_s) / for_s)
            a, b, c, d = (p + share * (q - p) for p, q in zip(self._arm_from, goal, strict=True))
            self.arm = (a, b, c, d)
            if share == 1.0:
                self._arm_goal = None

    def _pump(self, wanted: Setpoint | None, dt_s: float) -> None:
        self.pumping = False
        if wanted is None or not wanted.pump or not self.docked or self.arm is None or self._arm_goal is not None:
            return
        self.permit_id = wanted.permit_id
        self.pumped_ml = self.permits.get(wanted.permit_id, 0.0)
        if self.pumped_ml < wanted.dose_ml and self.tank_ml > 0 and not self.pump_stuck:
            self.pumping = True
            ml = min(gardener.PUMP_MLPS * dt_s, wanted.dose_ml - self.pumped_ml)
            self.tank_ml -= ml
            self.pumped_ml += ml
            self.permits[wanted.permit_id] = self.pumped_ml
            self.poured_at.append((self.dock, ml))

    def _supply(self, dt_s: float) -> None:
        if self.name in self.plane.filling:
            self.tank_ml = min(gardener.TANK_ML, self.tank_ml + TAP_MLPS * dt_s)
        if self.docked:
            self.battery_ratio = min(1.0, self.battery_ratio + gardener.CHARGE_W * dt_s / 3600 / gardener.PACK_WH)

    def _sight(self) -> None:
        now_s = self.clock.now()
        if now_s - self._marker_s < 0.5 or self.blind:
            return
        self._marker_s = now_s
        self._fixes += 1
        number, place = min(self.markers.items(), key=lambda item: distance_m(item[1], self.pose))
        x, y, yaw = marker_view(self.pose, place)
        n = self.rng.gauss
        self.marker = Marker(
            marker_id=number,
            x_m=x + n(0, self.noise_m),
            y_m=y + n(0, self.noise_m),
            yaw_rad=yaw + n(0, 0.008),
            age_s=0.0,
            count=self._fixes,
        )

    def _tell(self) -> None:
        if self.link is None:
            return
        self.states += 1
        now_s = self.clock.now()
        marker = self.marker and structs.replace(self.marker, age_s=now_s - self._marker_s)
        state = BodyState(
            stamp_s=now_s + self.ahead_s,
            left_m=self.left_m,
            right_m=self.right_m,
            bump_left=self.bump[0],
            bump_right=self.bump[1],
            docked=self.docked,
            battery_ratio=self.battery_ratio,
            battery_a=2.0 if self.docked else -1.0,
            tank_ml=self.tank_ml,
            arm_rad=self.arm,
            arm_moving=self._arm_goal is not None,
            pump=self.pumping,
            pumped_ml=self.pumped_ml,
            permit_id=self.permit_id,
            marker=marker,
            stopped=self.stopped,
            stopped_by=self.stopped_by,
            stop_kept=not self.disk_broken,
            stop_number=self.stop_number if self.stopped and not self.disk_broken else 0,
        )
        try:
            self.link.write(encode(state))
        except LinkDown:
            self.link = None


class FakePlant:
    """A pot's market side, without a market: it awards when the test says so."""

    def __init__(self, id: str, card: PlantCard, clock: VirtualClock, verifier: object) -> None:
        self.id, self.card, self.clock = id, card, clock
        self.docks = Docks(id, [id], None, clock.now())
        self.reports: list[Report] = []
        self.permits: dict[str, Permit] = {}
        self.keep, self.silent = True, False
        self.refuse_permit = ""
        self.app = _app(id, "plant", clock, verifier)
        self._routes()

    def announcement(self, number: int = 1, dose_ml: float = 150.0) -> Announcement:
        return Announcement(task_id=f"{self.id}:{number}", kind="water", plant=self.card, dose_ml=dose_ml)

    def _routes(self) -> None:
        @self.app.post("/tasks/{task_id}/reports")
        async def report(task_id: str, told: Report = body(Report), caller: object = allow("robot")) -> ReportAnswer:
            if self.silent:
                await self.clock.sleep(1e6)
            self.reports.append(told)
            return ReportAnswer(keep=self.keep, reason="" if self.keep else "given to somebody else", lease_s=8.0)

        @self.app.post("/tasks/{task_id}/permits")
        async def permit(task_id: str, wish: PermitRequest = body(PermitRequest), caller: object = allow("robot")) -> Permit:
            if self.refuse_permit:
                raise Refused(self.refuse_permit)
            if task_id in self.permits:
                raise Refused("a permit was given already")
            self.permits[task_id] = Permit(
                permit_id=f"permit:{task_id}",
                task_id=task_id,
                epoch=wish.epoch,
                act="water",
                dose_ml=wish.amount_ml,
                valid_for_s=30.0,
            )
            return self.permits[task_id]

        _dock_routes(self.app, self.docks, self.clock)

    @property
    def ended(self) -> Report | None:
        return next((r for r in self.reports if r.state in ("done", "failed")), None)


class FakeStation:
    def __init__(self, garden: GardenMap, plane: Plane, clock: VirtualClock, verifier: object) -> None:
        ids = [d.dock_id for d in garden.docks if d.owner == "station"]
        self.docks = Docks("station", ids, None, clock.now())
        self.app = _app("station", "station", clock, verifier)
        _dock_routes(self.app, self.docks, clock)
        self.taps, self.dry = 0, False

        @self.app.post("/tap")
        async def tap(wish: TapRequest = body(TapRequest), caller: object = allow("robot")) -> TapGrant:
            if self.docks.loan("tap", clock.now()).robot_id != wish.robot_id:
                raise Refused("the tap's dock is somebody else's")
            if wish.robot_id in plane.filling:
                raise Conflict("the tap is open")
            self.taps += 1
            if not self.dry:
                plane.filling.add(wish.robot_id)
                asyncio.get_running_loop().call_later(wish.open_s, plane.filling.discard, wish.robot_id)
            return TapGrant(open_s=wish.open_s, flow_mlps=TAP_MLPS)


def _app(id: str, kind: str, clock: VirtualClock, verifier: object) -> FastAPI:
    return create_app(card=lambda: NodeCard(id=id, kind=kind), clock=clock, verifier=verifier, ready=list)  # type: ignore[arg-type]


def _dock_routes(app: FastAPI, docks: Docks, clock: VirtualClock) -> None:
    @app.post("/dock/reservations")
    async def reserve(wish: ReservationRequest = body(ReservationRequest), caller: object = allow("robot")) -> Reservation:
        return docks.reserve(wish, clock.now())

    @app.delete("/dock/reservations/{reservation_id:path}", status_code=204)
    async def release(reservation_id: str, caller: object = allow("robot")) -> None:
        docks.release(reservation_id, "")


class Garden:
    """Brains on stand-in bodies in the default garden, with fake plants and station."""

    def __init__(
        self,
        seed: int = 1,
        scenario: Scenario | None = None,
        robots: int = 1,
        walls: Sequence[KnownPot] = (),
        **settings: object,
    ) -> None:
        """`walls`: more discs on everybody's map and in the world; `settings` are every robot's."""
        self.seed, self.clock = seed, VirtualClock()
        self.scenario = scenario or find("garden")
        known = map_of(self.scenario)
        self.map = known.model_copy(update={"pots": [*known.pots, *walls]})
        self.net, self.mesh = MemoryNet(self.clock), MemoryMesh(self.clock, random.Random(seed))
        self.plane = Plane(self.map)
        self.key = GardenKey.from_seed(seed)
        self.peers: list[Peer] = []
        self.tasks: dict[str, list[asyncio.Task[None]]] = {}
        verifier = self.key.verifier()
        self.plants: dict[str, FakePlant] = {}
        for p in self.scenario.plants:
            card = PlantCard(
                plant_id=p.id,
                url=f"http://{p.id}",
                stem=Point3(x_m=p.x_m, y_m=p.y_m, z_m=gardener.SOIL_HEIGHT_M),
                dock=p.dock,
                nozzle=Point3(x_m=gardener.NOZZLE_POINT_M[0], y_m=0.0, z_m=gardener.NOZZLE_POINT_M[2]),
            )
            self.plants[p.id] = FakePlant(p.id, card, self.clock, verifier)
            self._enrol(p.id, "plant", self.plants[p.id].app)
        self.station = FakeStation(self.map, self.plane, self.clock, verifier)
        self._enrol("station", "station", self.station.app)
        self.bodies: dict[str, StandInBody] = {}
        self.brains: dict[str, Brain] = {}
        self.settings = settings
        chosen = self.scenario.robots[:robots]
        self.peers += [Peer(id=r.id, kind="robot", url=f"http://{r.id}") for r in chosen]
        for number, r in enumerate(chosen):
            pose = (r.home.x_m, r.home.y_m, r.home.yaw_rad)
            self.bodies[r.id] = StandInBody(r.id, self.plane, self.clock, self.net, f"secret-of-{r.id}", pose, seed + number)

    def _enrol(self, id: str, kind: str, app: FastAPI) -> None:
        self.peers.append(Peer(id=id, kind=kind, url=f"http://{id}"))  # type: ignore[arg-type]
        self.mesh.attach(id, f"{id}", app)

    def boot(self, id: str) -> Brain:
        """Start a robot's brain."""
        home = next(r for r in self.scenario.robots if r.id == id).home
        settings = RobotSettings(
            id=id, body_url=f"memory://{id}", body_secret=f"secret-of-{id}", home=home, map=self.map, **self.settings
        )  # type: ignore[arg-type]
        identity = self.key.issue(id, "robot", 0.0)
        node = build(
            settings,
            self.clock,
            self.net.open,
            self.mesh.transport(id),
            random.Random(self.seed),
            identity=identity,
            verifier=self.key.verifier(),
            peers=Peers(self.peers),
        )
        self.mesh.attach(id, f"{id}", node.app)
        self.tasks[id] = [asyncio.ensure_future(loop()) for loop in node.loops]
        self.brains[id] = node.app.state.brain
        return self.brains[id]

    async def kill(self, id: str) -> None:
        """SIGKILL the brain: no goodbye, no more bytes."""
        self.mesh.detach(f"{id}")
        link = self.brains[id].body._link
        if link is not None:
            link.muted = True  # type: ignore[attr-defined]
        for task in self.tasks.pop(id):
            task.cancel()
        await self.clock.sleep(0.01)

    async def start(self) -> None:
        for id, stand_in in self.bodies.items():
            self.tasks[f"body-{id}"] = [asyncio.ensure_future(stand_in.run())]
            self.boot(id)
        await self.until(lambda: all(b.robot.where.pose is not None for b in self.brains.values()), 20.0)

    async def until(self, happened: Callable[[], object], within_s: float) -> None:
        """Let time pass until `happened()`; fails when it does not, or when a brain's loop died."""
        until_s = self.clock.now() + within_s
        while not happened():
            for tasks in self.tasks.values():
                for task in tasks:
                    if task.done() and not task.cancelled():
                        task.result()
            assert self.clock.now() < until_s, f"not within {within_s} s: {self.story()}"
            await self.clock.sleep(0.05)

    def story(self) -> str:
        lines = [f"{e.t_s:.1f} {e.what}" for b in self.brains.values() for e in b.events.since(0)][-30:]
        states = [b.state().model_dump_json() for b in self.brains.values()]
        return "\n".join([*lines, *states])

    async def award(
        self, plant: str, robot: str = "robot-1", number: int = 1, epoch: int = 1, dose_ml: float = 150.0
    ) -> object:
        return await self.call(robot, "POST", "/tasks", self.award_of(plant, number, epoch, dose_ml), as_=plant)

    def award_of(self, plant: str, number: int = 1, epoch: int = 1, dose_ml: float = 150.0) -> Award:
        asked = self.plants[plant].announcement(number, dose_ml)
        return Award(announcement=asked, epoch=epoch, lease_s=8.0, cost_s=60.0)

    async def empty_tank(self, robot: str, left_ml: float) -> None:
        """Somebody takes the tank off, pours it out and puts it back."""
        body = self.bodies[robot]
        body.tank_ml = None
        await self.clock.sleep(2.5)  # a resting body says something every two seconds
        body.tank_ml = left_ml
        await self.clock.sleep(2.5)

    async def bid(self, plant: str, robot: str = "robot-1", dose_ml: float = 150.0) -> Bid:
        answer = await self.call(robot, "POST", "/bids", self.plants[plant].announcement(99, dose_ml), as_=plant)
        return Bid.model_validate_json(answer.content)

    async def call(  # type: ignore[no-untyped-def]
        self, to: str, method: str, path: str, document: object = None, as_: str = "operator", key: str = ""
    ):
        import httpx

        role = "plant" if as_.startswith("plant") else "robot" if as_.startswith("robot") else as_
        token = self.key.issue(as_, role, 0.0).token
        async with httpx.AsyncClient(transport=self.mesh.transport(as_), base_url=f"http://{to}") as client:
            content = None if document is None else document.model_dump_json()  # type: ignore[attr-defined]
            headers = {"authorization": f"Bearer {token}", "content-type": "application/json"}
            headers |= {"idempotency-key": key} if key else {}
            return await client.request(method, path, content=content, headers=headers, timeout=30.0)


def in_garden(story: Callable[[Garden], Awaitable[None]], seed: int = 1, **options: object) -> Garden:
    """Run one story on virtual time."""
    print(f"seed {seed}")

    async def main() -> Garden:
        garden = Garden(seed, **options)  # type: ignore[arg-type]
        await garden.start()
        try:
            await story(garden)
        finally:
            tasks = [task for group in garden.tasks.values() for task in group]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        return garden

    return run_virtual(main())
