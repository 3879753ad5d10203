"""Processes on one loop: each with its own clock, stopped and continued like SIGSTOP and SIGCONT, killed like SIGKILL.

A process is a context: every task and timer that its code makes carries the `Life` it belongs to, and the loop keeps
what belongs to a stopped life aside until it goes on. Its timers then fire late, as they do for a process that slept.
"""

from __future__ import annotations

import asyncio
import contextvars
import random
import weakref
from collections.abc import Callable, Coroutine
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from core.virtual import VirtualLoop

T = TypeVar("T")
OVERTAKING = 0.3
"""Chance that a callback runs before the one before it, if that is another process's."""
_life: contextvars.ContextVar[Life | None] = contextvars.ContextVar("life", default=None)


class NodeClock:
    """One process's garden clock: it starts somewhere and runs a little too fast or too slow."""

    def __init__(self, offset_s: float = 0.0, rate: float = 1.0) -> None:
        self.offset_s, self.rate = offset_s, rate

    def now(self) -> float:
        return asyncio.get_running_loop().time() * self.rate + self.offset_s

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(max(0.0, seconds) / self.rate)

    def timeout(self, seconds: float | None) -> AbstractAsyncContextManager[object]:
        return asyncio.timeout(None if seconds is None else seconds / self.rate)

    async def offload(self, fn: Callable[[], T], cost_s: float = 0.0) -> T:
        result = fn()
        await asyncio.sleep(cost_s)
        return result


@dataclass(eq=False)
class Life:
    """One process from its start to its death."""

    name: str
    clock: NodeClock = field(default_factory=NodeClock)
    alive: bool = True
    stopped: bool = False
    """SIGSTOP: nothing of it runs."""
    held: list[asyncio.Handle] = field(default_factory=list)
    _tasks: weakref.WeakValueDictionary[int, asyncio.Task[Any]] = field(default_factory=weakref.WeakValueDictionary)
    """In the order in which they began, so that their ends are a function of the seed."""
    _begun: int = 0

    def __post_init__(self) -> None:
        self._context = contextvars.copy_context()
        self._context.run(_life.set, self)

    def start(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        """Run it as a task of this process."""
        return asyncio.get_running_loop().create_task(work, context=self._context.copy())

    def run(self, fn: Callable[[], T]) -> T:
        """Call it as this process."""
        return self._context.copy().run(fn)

    def go_on(self) -> None:
        """SIGCONT."""
        self.stopped = False
        held, self.held = self.held, []
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SoakLoop)
        loop.take_back(held)

    def kill(self) -> None:
        """SIGKILL: whatever it still does reaches nobody; its tasks end at their next step."""
        self.alive = False
        if self.stopped:
            self.go_on()
        for task in list(self._tasks.values()):
            task.cancel()

    def adopt(self, task: asyncio.Task[Any]) -> None:
        """A task of this process has begun."""
        self._begun += 1
        self._tasks[self._begun] = task
        if not self.alive:
            task.cancel()


class SoakLoop(VirtualLoop):
    """A virtual loop that knows which process a callback belongs to, and lets processes overtake one another."""

    def __init__(self, rng: random.Random) -> None:
        super().__init__()
        self._rng = rng
        self.set_task_factory(_task)

    def _call_soon(self, callback: Any, args: Any, context: contextvars.Context | None) -> asyncio.Handle:
        handle = asyncio.Handle(callback, args, self, context)
        life = handle._context.get(_life)  # type: ignore[attr-defined]
        if life is not None and life.stopped:
            life.held.append(handle)
        else:
            self._line_up(handle, life)
        return handle

    def _line_up(self, handle: asyncio.Handle, life: Life | None) -> None:
        """Behind what this process has ready already, but by chance before what others have."""
        ready = self._ready  # type: ignore[attr-defined]
        place = len(ready)
        while place and self._rng.random() < OVERTAKING and ready[place - 1]._context.get(_life) is not life:
            place -= 1
        ready.insert(place, handle)

    def take_back(self, handles: list[asyncio.Handle]) -> None:
        self._ready.extend(handles)  # type: ignore[attr-defined]


def _task(loop: asyncio.AbstractEventLoop, work: Any, context: contextvars.Context | None = None) -> asyncio.Task[Any]:
    task = asyncio.Task(work, loop=loop, context=context)
    life = context.get(_life) if context is not None else _life.get()
    if life is not None:
        life.adopt(task)
    return task


def skewed(rng: random.Random, ppm_max: float = 200.0, offset_s_max: float = 1e5) -> NodeClock:
    """A clock that was set wrong and drifts."""
    return NodeClock(rng.uniform(0.0, offset_s_max), 1.0 + rng.uniform(-ppm_max, ppm_max) * 1e-6)
