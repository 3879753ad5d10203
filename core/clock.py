"""Garden time: the one clock that services, drivers and the world share.

Three clocks fill the `Clock` protocol. `WallClock` is for real gardens. `WorldClock` follows a simulated world, which may
run faster, slower or not at all. `VirtualClock` belongs to `core.virtual.VirtualLoop`, whose time jumps to the next timer.
Node code never asks the operating system for the time (DESIGN, section 4).
"""

from __future__ import annotations

import asyncio
import time
from asyncio import get_running_loop
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Protocol, TypeVar

T = TypeVar("T")


class Clock(Protocol):
    """Garden seconds: `now` never goes back."""

    def now(self) -> float:
        """Garden time [s]."""
        ...

    async def sleep(self, seconds: float) -> None:
        """Returns when `seconds` of garden time have passed; zero or less yields once."""
        ...

    def timeout(self, seconds: float | None) -> AbstractAsyncContextManager[object]:
        """`async with clock.timeout(s):` raises TimeoutError after s garden seconds; None never does."""
        ...

    async def offload(self, fn: Callable[[], T], cost_s: float = 0.0) -> T:
        """Run slow synchronous work off the loop; a virtual clock runs it inline and lets `cost_s` pass."""
        ...


class _LoopClock:
    """Shared by clocks whose garden seconds are the loop's seconds plus an offset."""

    def __init__(self, offset_s: float) -> None:
        self._offset_s = offset_s

    def now(self) -> float:
        return get_running_loop().time() + self._offset_s

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(max(0.0, seconds))

    def timeout(self, seconds: float | None) -> AbstractAsyncContextManager[object]:
        return asyncio.timeout(seconds)


class WallClock(_LoopClock):
    """Real gardens: Unix seconds, made monotonic by anchoring once to the loop's clock."""

    def __init__(self) -> None:
        super().__init__(time.time() - time.monotonic())

    async def offload(self, fn: Callable[[], T], cost_s: float = 0.0) -> T:
        return await asyncio.to_thread(fn)


class VirtualClock(_LoopClock):
    """On a `VirtualLoop`: offloaded work runs inline and takes exactly `cost_s`."""

    def __init__(self, start_s: float = 0.0) -> None:
        super().__init__(start_s)

    async def offload(self, fn: Callable[[], T], cost_s: float = 0.0) -> T:
        result = fn()
        await asyncio.sleep(cost_s)
        return result


class WorldClock:
    """Follows a simulated world's feed of (garden time, rate); between messages it extrapolates.

    `steer` is called for every feed message. Time never runs back: when the world lags, `now` waits for it.
    Without any message for `silence_s` wall seconds the world is taken to be gone and garden time stands still.
    """

    def __init__(self, silence_s: float = 3.0) -> None:
        self._anchor_garden_s = 0.0
        self._anchor_loop_s = 0.0
        self._rate = 0.0
        self._floor_s = 0.0
        self._silence_s = silence_s
        self._changed = asyncio.Event()

    @property
    def rate(self) -> float:
        """Garden seconds a wall second, as the world last said."""
        return self._rate

    def steer(self, garden_s: float, rate: float) -> None:
        """Take one message of the world's feed: its time now [s] and its rate."""
        before = self._rate
        self._anchor_garden_s, self._rate = garden_s, max(0.0, rate)
        self._anchor_loop_s = asyncio.get_running_loop().time()
        if self._rate != before:
            self._changed.set()
            self._changed = asyncio.Event()

    def now(self) -> float:
        loop_s = asyncio.get_running_loop().time()
        ahead_s = min(loop_s - self._anchor_loop_s, self._silence_s)
        self._floor_s = max(self._floor_s, self._anchor_garden_s + self._rate * ahead_s)
        return self._floor_s

    async def sleep(self, seconds: float) -> None:
        until_s = self.now() + max(0.0, seconds)
        await asyncio.sleep(0)
        while (left_s := until_s - self.now()) > 1e-6:
            wait_s = min(1.0, max(left_s / self._rate, 0.0005)) if self._rate > 0 else 1.0
            changed = self._changed
            try:
                async with asyncio.timeout(wait_s):
                    await changed.wait()
            except TimeoutError:
                pass

    @asynccontextmanager
    async def _timeout(self, seconds: float | None) -> AsyncIterator[object]:
        async with asyncio.timeout(None) as limit:
            if seconds is None:
                yield limit
                return

            async def expire() -> None:
                await self.sleep(seconds)
                limit.reschedule(asyncio.get_running_loop().time())

            watcher = asyncio.create_task(expire())
            try:
                yield limit
            finally:
                watcher.cancel()

    def timeout(self, seconds: float | None) -> AbstractAsyncContextManager[object]:
        return self._timeout(seconds)

    async def offload(self, fn: Callable[[], T], cost_s: float = 0.0) -> T:
        return await asyncio.to_thread(fn)
