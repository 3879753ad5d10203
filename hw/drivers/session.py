"""What every serial driver shares: connect by URL, notice silence, reconnect with backoff for ever, say so once."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from abc import ABC, abstractmethod
from typing import NoReturn

import structlog

from core.clock import Clock
from core.errors import DriverError, DriverTimeout, LinkDown, Unavailable
from hw.links import ByteLink, Opener
from hw.ports import LinkStatus

OPEN_S_MAX = 5.0
CLOSE_S_MAX = 1.0
BACKOFF_S_MIN = 0.1
BACKOFF_S_MAX = 2.0
GRACE_S = 0.02
"""After a stall of our own, bytes that wait in the socket are read before the device is called silent."""
LONG_REST_S = 120.0
"""A device that has rested so long is asked only now and then."""


class Pulse:
    """Wakes whoever waits now, and keeps nothing for later; free while nobody waits."""

    def __init__(self) -> None:
        self._waiters: list[asyncio.Future[None]] = []

    def fire(self) -> None:
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)

    async def wait(self) -> None:
        waiter = asyncio.get_running_loop().create_future()
        self._waiters.append(waiter)
        try:
            await waiter
        finally:
            if waiter in self._waiters:
                self._waiters.remove(waiter)


class Session(ABC):
    """A device at the end of a byte link, for ever.

    A driver subclasses it and fills `_received` (bytes arrived), and where needed `_converse` (set-up and polling),
    `_gone` (forget what this connection knew) and `_farewell` (bytes that make the device safe). It calls `_heard` for
    every valid answer: the first one of a connection makes the link up, and none for `silence_s` makes it down.
    Raising LinkDown or DriverError from `_received` or `_converse` ends the connection, and the next one begins.
    """

    def __init__(self, url: str, opener: Opener, clock: Clock, *, name: str, silence_s: float) -> None:
        self._url, self._opener, self._clock = url, opener, clock
        self._name, self._silence_s = name, silence_s
        self._hushed = Pulse()
        self._log = structlog.get_logger().bind(device=name, url=url)
        self._link: ByteLink | None = None
        self._status = LinkStatus(up=False, why="not connected yet", since_s=0.0)
        self._told = False
        self._heard_s = 0.0
        self._changed = Pulse()

    # What a service sees

    @property
    def name(self) -> str:
        return self._name

    @property
    def link(self) -> LinkStatus:
        return self._status

    @property
    def silence_s(self) -> float:
        """How long the device may say nothing [s]; math.inf while it has nothing to say, which costs nothing."""
        return self._silence_s

    @silence_s.setter
    def silence_s(self, seconds: float) -> None:
        if seconds < self._silence_s:
            self._hushed.fire()
        self._silence_s = seconds

    async def wait_link(self, up: bool = True) -> None:
        """Returns when the link is up (or down)."""
        while self._status.up is not up:
            await self._changed.wait()

    async def run(self) -> None:
        """Connect, talk, reconnect; ends only by cancellation, saying farewell to the device."""
        backoff_s = BACKOFF_S_MIN
        while True:
            why = await self._attempt()
            backoff_s = BACKOFF_S_MIN if self._status.up else min(2.0 * backoff_s, BACKOFF_S_MAX)
            self._say(False, why)
            await self._clock.sleep(backoff_s)

    # What a driver fills

    @abstractmethod
    def _received(self, data: bytes) -> None:
        """Bytes from the device, cut anywhere."""

    async def _converse(self) -> None:
        """Runs beside the reading, from connection on: set the device up, then ask what must be asked."""
        return

    def _gone(self) -> None:
        """The connection ended: forget half-read frames and old setpoints."""
        return

    def _farewell(self) -> bytes:
        """Written before a link that still works is closed."""
        return b""

    # What a driver uses

    def _heard(self) -> None:
        """A valid answer came: the device is there."""
        self._heard_s = self._clock.now()
        if not self._status.up:
            self._say(True, "the device answers")

    def _send(self, data: bytes) -> bool:
        """Write if connected; False when the bytes went nowhere (`link` says why, or soon will)."""
        if self._link is None:
            return False
        try:
            self._link.write(data)
        except LinkDown:
            return False
        return True

    # One connection

    async def _attempt(self) -> str:
        """Open, talk until it breaks; the reason, for people."""
        try:
            async with self._clock.timeout(OPEN_S_MAX):
                self._link = link = await self._opener(self._url)
        except TimeoutError:
            return f"cannot open {self._url}: no answer for {OPEN_S_MAX:g} s"
        except (Unavailable, DriverError, OSError) as error:
            return str(error)
        why = ""
        try:
            why = await self._talk(link)
        finally:
            self._send(self._farewell())
            self._link = None
            self._gone()
            await self._shut(link)
        return why

    async def _talk(self, link: ByteLink) -> str:
        self._heard_s = self._clock.now()
        why = ""
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._listen(link))
                group.create_task(self._watch())
                group.create_task(self._converse())
        except* (Unavailable, DriverError, OSError) as broken:
            why = str(broken.exceptions[0])
        return why

    async def _listen(self, link: ByteLink) -> NoReturn:
        while True:
            self._received(await link.read())

    async def _watch(self) -> NoReturn:
        while True:
            left_s = self._heard_s + self.silence_s - self._clock.now()
            if left_s <= 1e-6:
                raise DriverTimeout(self._url, self.silence_s)
            with contextlib.suppress(TimeoutError):
                async with self._clock.timeout(None if math.isinf(left_s) else left_s):
                    await self._hushed.wait()

    async def _shut(self, link: ByteLink) -> None:
        try:
            async with self._clock.timeout(CLOSE_S_MAX):
                await link.close()
        except (TimeoutError, LinkDown, OSError) as error:
            self._log.debug("closing failed", error=str(error))

    def _say(self, up: bool, why: str) -> None:
        """Take the new standing; log it when it changed, and the first failure too."""
        if up == self._status.up and self._told:
            if why != self._status.why:
                self._status = LinkStatus(up=up, why=why, since_s=self._status.since_s)
            return
        self._told = True
        self._status = LinkStatus(up=up, why=why, since_s=self._clock.now())
        self._log.log(logging.INFO if up else logging.WARNING, f"link {'up' if up else 'down'}", why=why)
        self._changed.fire()
