"""Devices without wires, a brain without a mind."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from msgspec import structs

from core.clock import VirtualClock
from core.errors import LinkDown
from core.robots import gardener
from core.wire.body import BodyState, Control, Hello, LineBuffer, Setpoint, decode, encode
from hw.links import ByteLink, MemoryNet
from hw.ports import BaseReading, ChargingState, LinkStatus, MarkerFix, ServoReading
from robot_service.body.body import BodyNode, Drivers, build_body
from robot_service.body.settings import BodySettings

SECRET = "a-secret-of-this-robot"
UP = LinkStatus(up=True, why="the device answers", since_s=0.0)
DOWN = LinkStatus(up=False, why="unplugged", since_s=1.0)
DOCKED = {"home_base": True, "charging": ChargingState.FULL_CHARGING, "current_a": 1.0}


class FakeBase:
    """A base that remembers what it was told, and since when it does what it does."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self.link = UP
        self.reading: BaseReading | None = None
        self.sense: dict[str, Any] = {}
        self.doing: tuple[Any, ...] = ("stop",)
        self.log: list[tuple[float, tuple[Any, ...]]] = []
        self.resting = False
        self.left_m = self.right_m = 0.0

    def _do(self, *what: Any) -> None:
        self.doing = what
        self.log.append((self._clock.now(), what))

    def drive(self, v_mps: float, omega_radps: float) -> None:
        self._do("drive", v_mps, omega_radps)

    def seek_dock(self) -> None:
        self._do("seek_dock")

    def stop(self) -> None:
        self._do("stop")

    def rest(self, resting: bool) -> None:
        self.resting = resting

    async def run(self) -> None:
        while True:
            if self.link.up:
                travel = {"left_m": self.left_m, "right_m": self.right_m}
                self.reading = BaseReading(stamp_s=self._clock.now(), **travel, **self.sense)
            began_s = self._clock.now()
            await self._clock.sleep(1.0 if self.resting else 0.015)
            self._roll(self._clock.now() - began_s)

    def _roll(self, dt_s: float) -> None:
        if self.doing[0] == "drive":
            _, v_mps, omega_radps = self.doing
            half_m = omega_radps * gardener.WHEELBASE_M["create2"] / 2
            self.left_m += (v_mps - half_m) * dt_s
            self.right_m += (v_mps + half_m) * dt_s


class FakeServos:
    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self.link = UP
        self.reading: ServoReading | None = None
        self.pulses: dict[int, float] = {}
        self.tank_v = 3.0
        self.moves: list[tuple[float, dict[int, float], float]] = []
        self.moving_until_s = -1.0
        self.pump = False
        self.pump_s = 0.0
        self.pump_log: list[tuple[float, bool]] = []
        self.stops = 0

    def move(self, pulses_us: dict[int, float], duration_s: float) -> None:
        self.pulses |= pulses_us
        self.moves.append((self._clock.now(), dict(pulses_us), duration_s))
        self.moving_until_s = self._clock.now() + duration_s

    def output(self, channel: int, high: bool) -> None:
        assert channel == gardener.PUMP_CHANNEL
        if high is not self.pump:
            self.pump_log.append((self._clock.now(), high))
        if self.pump and not high:
            self.pump_s += self._clock.now() - self.pump_log[-2][0]
        self.pump = high

    def stop(self) -> None:
        self.output(gardener.PUMP_CHANNEL, False)
        self.moving_until_s = -1.0
        self.stops += 1

    def rest(self, resting: bool) -> None: ...

    async def run(self) -> None:
        while True:
            if self.link.up:
                now_s = self._clock.now()
                moving = now_s < self.moving_until_s
                self.reading = ServoReading(
                    stamp_s=now_s, pulses_us=dict(self.pulses), moving=moving, analog_v=(0.0, self.tank_v, 0.0, 0.0)
                )
            await self._clock.sleep(0.1)

    @property
    def pumped_ml(self) -> float:
        return self.pump_s * gardener.PUMP_MLPS


class FakeLocalizer:
    def __init__(self) -> None:
        self.link = UP
        self.fix: MarkerFix | None = None

    def rest(self, resting: bool) -> None: ...

    async def run(self) -> None:
        await asyncio.Event().wait()


class Brain:
    """Sends what it is given, 40 times a second, until it is told not to."""

    def __init__(self, link: ByteLink, clock: VirtualClock) -> None:
        self.link, self._clock = link, clock
        self.states: list[BodyState] = []
        self.wish: Setpoint | None = None
        self.closed = False
        self._seq = 0

    @property
    def state(self) -> BodyState:
        return self.states[-1]

    def hello(self, secret: str = SECRET) -> None:
        self.link.write(encode(Hello(secret=secret)))

    def order(self, order: Any, by: str = "test", stop_number: int = 0) -> None:
        self.link.write(encode(Control(order=order, by=by, stop_number=stop_number)))

    async def listen(self) -> None:
        lines = LineBuffer()
        try:
            while True:
                for line in lines.feed(await self.link.read()):
                    message = decode(line)
                    assert isinstance(message, BodyState)
                    self.states.append(message)
        except LinkDown:
            self.closed = True

    async def talk(self) -> None:
        while not self.closed:
            if self.wish is not None:
                self._seq += 1
                self.link.write(encode(structs.replace(self.wish, seq=self._seq)))
            await self._clock.sleep(0.025)


class Rig:
    """A body in memory with stand-in devices. Use `async with`."""

    def __init__(self, folder: Path, *, folded: bool = True, **settings: Any) -> None:
        self.clock = VirtualClock(1000.0)
        self.net = MemoryNet(self.clock)
        self.base, self.servos, self.localizer = FakeBase(self.clock), FakeServos(self.clock), FakeLocalizer()
        if folded:
            for name, angle in zip(gardener.ARM_JOINTS, gardener.ARM_HOME_RAD, strict=True):
                servo = gardener.SERVOS[name]
                self.servos.pulses[servo.channel] = servo.pulse_us(angle)
        self.settings = BodySettings(
            id="robot-1",
            base_url="memory://base",
            servo_url="memory://servos",
            marker_url="memory://markers",
            listen="memory://body",
            data=folder,
            secret=SECRET,
            **settings,
        )
        self.tasks: list[asyncio.Task[None]] = []
        self.body: BodyNode
        self._running: asyncio.Task[None]

    async def __aenter__(self) -> Rig:
        drivers = Drivers(base=self.base, servos=self.servos, localizer=self.localizer)
        self.body = build_body(self.settings, self.clock, self.net.open, self.net.listen, drivers)
        self._running = asyncio.create_task(self.body.run())
        await self.clock.sleep(0.1)
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in (*self.tasks, self._running):
            task.cancel()
        await asyncio.wait([*self.tasks, self._running])

    @property
    def ended(self) -> bool:
        return self._running.done()

    async def brain(self, secret: str = SECRET) -> Brain:
        brain = Brain(await self.net.open("memory://body"), self.clock)
        brain.hello(secret)
        self.tasks += [asyncio.create_task(brain.listen()), asyncio.create_task(brain.talk())]
        await self.clock.sleep(0.2)
        return brain

    async def until(self, true: Callable[[], bool], within_s: float = 5.0) -> float:
        """Garden seconds until it is true; fails when it never becomes so."""
        began_s = self.clock.now()
        while not true():
            assert self.clock.now() - began_s < within_s, "it did not happen"
            await self.clock.sleep(0.005)
        return self.clock.now() - began_s
