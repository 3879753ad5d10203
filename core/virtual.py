"""An asyncio loop whose time jumps to the next timer: whole gardens run as a function of their seed."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


LOOKS_EVERY = 16
"""The operating system is asked so seldom: on this loop it has nothing to say but its own wake-up."""


class _JumpingSelector(selectors.SelectSelector):
    """Instead of waiting for a timer, moves the loop's time to it."""

    loop: VirtualLoop
    turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.turns += 1
        ready = super().select(0) if timeout is None or self.turns % LOOKS_EVERY == 0 else []
        if ready or timeout == 0:
            return ready
        if timeout is None:
            raise RuntimeError("the virtual garden is deadlocked: nothing is ready and no timer is set")
        self.loop.virtual_s += timeout
        return ready


class VirtualLoop(asyncio.SelectorEventLoop):
    """Starts at 0 s. No sockets, no threads: whatever waits, waits for a timer or another task."""

    def __init__(self) -> None:
        self.virtual_s = 0.0
        selector = _JumpingSelector()
        selector.loop = self
        super().__init__(selector)

    def time(self) -> float:
        return self.virtual_s


def run_virtual(main: Coroutine[Any, Any, T]) -> T:
    """`asyncio.run` on virtual time; leftover tasks are cancelled and the loop closed."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main)
