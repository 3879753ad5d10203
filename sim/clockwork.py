"""The world's time: ticks of 20 ms while anything moves, strides while all rests, and the feed that services follow.

Garden time is the pacing clock's time times the speed. In the process the pacing clock is the wall's; in the lab it is the
virtual clock, which never falls behind. When the machine cannot keep up, garden time slows and the feed says so.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from core.clock import Clock

TICK_S = 0.02
STRIDE_S_MAX = 5.0
"""A resting world is brought to the present whenever it is looked at, so long strides hide nothing."""
STRIDE_S_MIN = 0.001
FORGIVEN_S = 0.15
"""Wall seconds the world may lag and still catch up; beyond it, garden time slows."""
BEAT_S = 0.5
BEAT_IDLE_S = 1.0
RATE_STEP = 0.05
"""Relative change of the achieved rate that is worth a message of its own."""
_WINDOW_S = 0.5


class Moving(Protocol):
    """The part of the world that time moves."""

    time_s: float

    @property
    def at_rest(self) -> bool: ...

    def advance(self, seconds: float) -> None:
        """Full physics."""
        ...

    def stride(self, seconds: float) -> None:
        """Only what goes on while nothing moves: soil, batteries, growth."""
        ...


class Host(Protocol):
    """An emulator with its links."""

    def pump(self, now_s: float) -> None:
        """Give the firmware the bytes that have arrived, let it run up to now, send what it answers."""
        ...

    def due_s(self) -> float:
        """When it next wants to run; the past if bytes wait."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Beat:
    """One message of the feed."""

    garden_s: float
    rate: float


class Clockwork:
    """Moves a world and its devices through garden time.

    `wake` ends a stride at once: bytes have arrived, or somebody changed the world. `speed` is garden seconds a second of
    the pacing clock.
    """

    def __init__(self, world: Moving, hosts: Sequence[Host], speed: float = 1.0) -> None:
        self._world, self._hosts = world, hosts
        self._speed, self._paused = speed, False
        self._clock: Clock | None = None
        self._anchor_clock_s = self._anchor_garden_s = 0.0
        self._until_s = world.time_s
        self._due_s = -math.inf
        """When the first host wants to run, as of the last look at all of them."""
        self._rate = 0.0
        self._window = (0.0, 0.0)
        self._woken = asyncio.Event()
        self._news = asyncio.Event()
        self.ticks = self.strides = 0
        self.busy_s = 0.0
        """CPU-side seconds spent moving the world; for the metrics only."""

    @property
    def speed(self) -> float:
        return self._speed

    @property
    def paused(self) -> bool:
        return self._paused

    @property
    def running(self) -> bool:
        return self._clock is not None

    @property
    def rate(self) -> float:
        """Garden seconds a second, as achieved of late; 0 while paused."""
        return 0.0 if self._paused or self._clock is None else self._rate

    def steer(self, *, speed: float | None = None, paused: bool | None = None) -> None:
        """Change the speed, or pause and go on."""
        self.catch_up()
        if self._clock is not None:
            self._anchor()
        self._speed = self._speed if speed is None else speed
        self._paused = self._paused if paused is None else paused
        self._rate = self._speed
        self._tell()
        self.wake()

    def wake(self) -> None:
        self._woken.set()

    def beat(self) -> Beat:
        """Garden time now [s], between the ticks too, and its rate."""
        return Beat(garden_s=self._garden_s(), rate=self.rate)

    async def feed(self) -> AsyncIterator[Beat]:
        """A beat at once, at every change of the rate, and now and then; ends never."""
        while True:
            news = self._news
            yield self.beat()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(BEAT_IDLE_S if self._world.at_rest else BEAT_S):
                    await news.wait()

    async def run(self, clock: Clock) -> None:
        """Keeps the world going until cancelled."""
        self._clock = clock
        self._rate = self._speed
        self._anchor()
        self._tell()
        try:
            while True:
                await self._beat_once(clock)
        finally:
            self.catch_up()
            self._clock = None
            self._tell()

    async def _beat_once(self, clock: Clock) -> None:
        """One tick or one stride, at its time."""
        self._woken.clear()
        if self._paused:
            await self._woken.wait()
            self._due_s = -math.inf
            self._anchor()
            return
        if self._due_s == -math.inf:
            self._serve_hosts()
        resting = self._world.at_rest
        step_s = self._stride_s() if resting else TICK_S
        self._until_s = self._world.time_s + step_s
        wait_s = self._due_clock_s(self._until_s) - clock.now()
        if resting:
            await self._doze(clock, wait_s)
            if self._paused:
                return
            step_s = min(step_s, max(self._garden_s() - self._world.time_s, 0.0))
        else:
            await clock.sleep(wait_s)
            self._allow_for_lag(-wait_s)
        begun_s = time.perf_counter()
        self._move(step_s, resting)
        self.busy_s += time.perf_counter() - begun_s
        self._measure(clock)

    def _move(self, step_s: float, resting: bool) -> None:
        if step_s > 0:
            (self._world.stride if resting else self._world.advance)(step_s)
        if resting:
            self.strides += 1
        else:
            self.ticks += 1
        self._serve_hosts()

    def _serve_hosts(self) -> None:
        """Let every host run that is due; when the next one will be."""
        self._due_s = min([self._pumped(host, self._world.time_s) for host in self._hosts], default=math.inf)

    def _pumped(self, host: Host, now_s: float) -> float:
        """Let a host run if it is due; when it wants to run next."""
        if (due_s := host.due_s()) > now_s + 1e-9:
            return due_s
        host.pump(now_s)
        return host.due_s()

    def _stride_s(self) -> float:
        return min(max(self._due_s - self._world.time_s, STRIDE_S_MIN), STRIDE_S_MAX)

    async def _doze(self, clock: Clock, seconds: float) -> None:
        """Sleeps unless woken."""
        if seconds <= 0:
            await clock.sleep(0)
            self._allow_for_lag(-seconds)
            return
        with contextlib.suppress(TimeoutError):
            async with clock.timeout(seconds):
                await self._woken.wait()

    def _garden_s(self) -> float:
        """Garden time by the pacing clock, never beyond the tick that is being waited for."""
        if self._clock is None or self._paused:
            return self._world.time_s
        running_s = self._anchor_garden_s + (self._clock.now() - self._anchor_clock_s) * self._speed
        return min(max(running_s, self._world.time_s), max(self._until_s, self._world.time_s))

    def _due_clock_s(self, garden_s: float) -> float:
        return self._anchor_clock_s + (garden_s - self._anchor_garden_s) / self._speed

    def _anchor(self) -> None:
        assert self._clock is not None
        self._anchor_clock_s, self._anchor_garden_s = self._clock.now(), self._world.time_s
        self._until_s = self._world.time_s
        self._window = (self._anchor_clock_s, self._anchor_garden_s)

    def catch_up(self) -> None:
        """Bring a dozing world to the present: before it is looked at or changed from outside."""
        if (ahead_s := self._garden_s() - self._world.time_s) > 0 and self._world.at_rest:
            self._world.stride(ahead_s)

    def _allow_for_lag(self, late_s: float) -> None:
        """Garden time slows: what cannot be caught up is forgotten."""
        if late_s > FORGIVEN_S:
            self._anchor_clock_s += late_s - FORGIVEN_S

    def _measure(self, clock: Clock) -> None:
        """The rate of the last half second; within a few per cent it is the speed itself."""
        clock_s, garden_s = self._window
        passed_s = clock.now() - clock_s
        if passed_s < _WINDOW_S:
            return
        self._window = (clock.now(), self._world.time_s)
        rate = min((self._world.time_s - garden_s) / passed_s, self._speed)
        rate = self._speed if rate > 0.97 * self._speed else rate
        changed = abs(rate - self._rate) > RATE_STEP * self._speed or (rate == self._speed != self._rate)
        self._rate = rate
        if changed:
            self._tell()

    def _tell(self) -> None:
        self._news.set()
        self._news = asyncio.Event()
