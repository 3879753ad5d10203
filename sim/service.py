"""The world's HTTP side: truth, pictures, time and faults. For people, judges and experiments, never for algorithms."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Annotated, TypeVar

from fastapi import FastAPI, Path, Query
from fastapi.responses import StreamingResponse
from prometheus_client import CollectorRegistry, Gauge
from pydantic import Field
from starlette.responses import Response

from core.clock import Clock
from core.errors import Unavailable, Unprocessable
from core.mesh.auth import Caller, Verifier
from core.mesh.chassis import allow, body, create_app, version
from core.mesh.events import EventLog
from core.mesh.node import Loop, Node
from core.mesh.runtime import Runtime
from core.mesh.worldclock import ClockBeat
from core.scenario import Scenario, device_ports, find
from core.wire.documents import Document, NodeCard
from sim import settings as sim_settings
from sim.camera import warm
from sim.faults import KINDS, Fault, FaultRequest
from sim.keeping import Keeper
from sim.pictures import HAND_SIZE, Pictures
from sim.truth import Truth
from sim.wiring import Rig, assemble, power_up, serve

T = TypeVar("T")
FILM_TYPE = "multipart/x-mixed-replace; boundary=frame"
FILM_FPS_MAX = 25.0
FILM_FRAMES_MAX = 4000
_Robot = Annotated[str, Path(max_length=40)]
_Width = Annotated[int, Query(ge=32, le=640)]
_Height = Annotated[int, Query(ge=24, le=480)]


class ClockState(Document):
    """`GET /clock`."""

    garden_s: float
    rate: float
    """Garden seconds a second, as achieved of late."""
    speed: float
    """What was asked for."""
    paused: bool
    hour: float
    """Of the garden's day."""


class ClockPatch(Document):
    """`PATCH /clock`."""

    speed: Annotated[float, Field(ge=0.01, le=100)] | None = None
    paused: bool | None = None


class GardenTime:
    """The world's own time as a `Clock`, for tokens and events; it waits as the pacing clock does."""

    def __init__(self, rig: Rig, pace: Clock) -> None:
        self._rig, self._pace = rig, pace

    def now(self) -> float:
        return self._rig.clockwork.beat().garden_s

    async def sleep(self, seconds: float) -> None:
        await self._pace.sleep(seconds)

    def timeout(self, seconds: float | None) -> AbstractAsyncContextManager[object]:
        return self._pace.timeout(seconds)

    async def offload(self, fn: Callable[[], T], cost_s: float = 0.0) -> T:
        return await self._pace.offload(fn, cost_s)


async def build(runtime: Runtime) -> Node:
    """The world's process: reads `SIM_...`, restores the last checkpoint, serves every device on its port."""
    settings = sim_settings.read()
    scenario = find(settings.scenario)
    seed = scenario.seed if settings.seed is None else settings.seed
    rig = assemble(scenario, seed, runtime.clock, settings.speed or scenario.speed)
    if any(plant.inventory or plant.harvest for plant in scenario.plants):
        # Robots will look. To load the kernels holds the interpreter for a second: not while the world moves.
        await runtime.clock.offload(warm)
    loops: list[Loop] = []
    if settings.data is not None:
        keeper = Keeper(settings.data, rig.world, rig.faults, rig.clockwork)
        if settings.fresh:
            keeper.begin_anew()
        elif keeper.restore():
            power_up(rig.world)
        loops.append(lambda: keeper.run(runtime.clock))
    return make_node(
        rig,
        runtime.clock,
        runtime.verifier,
        address=runtime.settings.host,
        ports=device_ports(scenario),
        open_reads=runtime.settings.open_reads,
        loops=loops,
    )


def make_node(
    rig: Rig,
    pace: Clock,
    verifier: Verifier | None,
    *,
    address: str = "127.0.0.1",
    ports: Mapping[str, int] | None = None,
    open_reads: bool = True,
    loops: Sequence[Loop] = (),
) -> Node:
    """A node round an assembled world; without `ports` its devices are on no TCP port (the lab listens in memory)."""
    time = GardenTime(rig, pace)
    bound: dict[str, int] = {}
    awaited = set(ports or ())

    def ready() -> list[str]:
        missing = [f"{name} is not on its port yet" for name in sorted(awaited - bound.keys())]
        return missing + ([] if rig.clockwork.running else ["the world does not move yet"])

    async def devices() -> None:
        async with serve(rig.hosts, address, ports or {}) as now_bound:
            bound.update(now_bound)
            await asyncio.Event().wait()

    registry = CollectorRegistry()
    events = EventLog(time)
    app = create_app(
        card=lambda: _card(rig.world.scenario, bound),
        clock=time,
        verifier=verifier,
        ready=ready,
        events=events,
        registry=registry,
        open_reads=open_reads,
    )
    rig.faults.on_end = lambda fault: _note(events, "fault over", fault)
    _measure(registry, rig)
    _look_routes(app, rig, Pictures(rig, pace), pace)
    _clock_routes(app, rig, events)
    _fault_routes(app, rig, events)
    own: list[Loop] = [lambda: rig.clockwork.run(pace)]
    return Node(id="sim", kind="sim", app=app, loops=[*own, *([devices] if ports else []), *loops])


def _card(scenario: Scenario, bound: Mapping[str, int]) -> NodeCard:
    return NodeCard(
        id="sim",
        kind="sim",
        capabilities=["truth", "overview", "clock", "faults", "cameras"],
        place={"scenario": scenario.name, **scenario.arena.model_dump()},
        links={name: f"tcp port {port}" for name, port in bound.items()},
        version=version(),
    )


def _measure(registry: CollectorRegistry, rig: Rig) -> None:
    clockwork = rig.clockwork
    for name, text, value in (
        ("sim_garden_seconds", "Garden time", lambda: clockwork.beat().garden_s),
        ("sim_rate", "Garden seconds a second, achieved", lambda: clockwork.rate),
        ("sim_ticks", "Ticks of full physics so far", lambda: clockwork.ticks),
        ("sim_strides", "Strides so far", lambda: clockwork.strides),
        ("sim_busy_seconds", "Seconds spent moving the world", lambda: clockwork.busy_s),
        ("sim_faults", "Faults in force", lambda: len(rig.faults.all())),
    ):
        Gauge(name, text, registry=registry).set_function(value)


def _look_routes(app: FastAPI, rig: Rig, pictures: Pictures, pace: Clock) -> None:
    @app.get("/truth", summary="What is so, exactly", tags=["world"])
    async def truth() -> Truth:
        rig.clockwork.catch_up()
        return rig.world.truth()

    @app.get("/overview.jpg", summary="The garden from above", tags=["world"], response_class=Response)
    async def overview() -> Response:
        return _jpeg(await pictures.overview())

    @app.get("/cameras/{robot}/hand.jpg", summary="What a robot's hand sees", tags=["world"], response_class=Response)
    async def hand(robot: _Robot, w: _Width = HAND_SIZE[0], h: _Height = HAND_SIZE[1]) -> Response:
        return _jpeg(await pictures.hand(robot, w, h))

    @app.get("/cameras/{robot}/hand.mjpg", summary="The same as a film", tags=["world"], response_class=StreamingResponse)
    async def film(
        robot: _Robot,
        w: _Width = HAND_SIZE[0],
        h: _Height = HAND_SIZE[1],
        fps: Annotated[float, Query(ge=0.1, le=FILM_FPS_MAX, description="Pictures a garden second, at most")] = 4.0,
    ) -> StreamingResponse:
        first = await pictures.hand(robot, w, h)
        return StreamingResponse(_film(first, pictures, pace, robot, (w, h), 1.0 / fps), media_type=FILM_TYPE)

    @app.get("/cameras/{robot}/hand.png", summary="How far it is, 16-bit mm", tags=["world"], response_class=Response)
    async def depth(robot: _Robot, w: _Width = HAND_SIZE[0], h: _Height = HAND_SIZE[1]) -> Response:
        data = await pictures.depth(robot, w, h)
        return Response(data, media_type="image/png", headers={"cache-control": "no-store"})


async def _film(
    first: bytes, pictures: Pictures, pace: Clock, robot: str, size: tuple[int, int], every_s: float
) -> AsyncIterator[bytes]:
    """Ends when the camera does, or after `FILM_FRAMES_MAX`: whoever still watches asks again."""
    picture = first
    for _ in range(FILM_FRAMES_MAX):
        yield b"--frame\r\ncontent-type: image/jpeg\r\ncontent-length: %d\r\n\r\n%b\r\n" % (len(picture), picture)
        await pace.sleep(every_s)
        try:
            picture = await pictures.hand(robot, *size)
        except Unavailable:
            return


def _jpeg(data: bytes) -> Response:
    return Response(data, media_type="image/jpeg", headers={"cache-control": "no-store"})


def _clock_routes(app: FastAPI, rig: Rig, events: EventLog) -> None:
    def state() -> ClockState:
        beat, clockwork = rig.clockwork.beat(), rig.clockwork
        return ClockState(
            garden_s=beat.garden_s,
            rate=beat.rate,
            speed=clockwork.speed,
            paused=clockwork.paused,
            hour=rig.world.hour,
        )

    async def lines() -> AsyncIterator[str]:
        async for beat in rig.clockwork.feed():
            yield ClockBeat(garden_s=beat.garden_s, rate=beat.rate).model_dump_json() + "\n"

    @app.get("/clock", summary="Garden time and how fast it runs", tags=["clock"])
    async def clock() -> ClockState:
        return state()

    @app.get("/clock/feed", summary="Every change of time's rate, one JSON line each", tags=["clock"])
    async def feed() -> StreamingResponse:
        return StreamingResponse(lines(), media_type="application/x-ndjson", headers={"cache-control": "no-store"})

    @app.patch("/clock", summary="Change the speed, pause, go on", tags=["clock"])
    async def patch(caller: Caller = allow("operator"), change: ClockPatch = body(ClockPatch)) -> ClockState:
        if change.speed is None and change.paused is None:
            raise Unprocessable("nothing to change", hint='send {"speed": 5} or {"paused": true}')
        rig.clockwork.steer(speed=change.speed, paused=change.paused)
        events.add("clock", f"{caller.subject} set speed {rig.clockwork.speed:g}, paused {rig.clockwork.paused}")
        return state()


def _fault_routes(app: FastAPI, rig: Rig, events: EventLog) -> None:
    @app.get("/faults", summary="The faults in force", tags=["faults"])
    async def faults() -> list[Fault]:
        return rig.faults.all()

    @app.post("/faults", status_code=201, summary=f"Bring one about: {', '.join(KINDS)}", tags=["faults"])
    async def add(caller: Caller = allow("operator"), request: FaultRequest = body(FaultRequest)) -> Fault:
        rig.clockwork.catch_up()
        fault = rig.faults.add(request)
        rig.clockwork.wake()
        _note(events, "fault", fault)
        return fault

    @app.delete("/faults/{fault_id}", summary="Lift one", tags=["faults"])
    async def remove(fault_id: Annotated[str, Path(max_length=40)], caller: Caller = allow("operator")) -> Fault:
        rig.clockwork.catch_up()
        fault = rig.faults.remove(fault_id)
        rig.clockwork.wake()
        _note(events, "fault over", fault)
        return fault


def _note(events: EventLog, kind: str, fault: Fault) -> None:
    events.add(kind, f"{fault.kind} of {fault.target}", fault_id=fault.id)
