"""What happened at a node, kept for a while and streamed to whoever listens."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator
from typing import Any

from core.clock import Clock
from core.wire.documents import HistoryEntry


class EventLog:
    """The newest `size` events. Ids grow by one; `first_id` lets a node go on where its last life ended."""

    def __init__(self, clock: Clock, size: int = 1000, first_id: int = 1) -> None:
        self._clock = clock
        self._entries: deque[HistoryEntry] = deque(maxlen=size)
        self._next_id = first_id
        self._grown = asyncio.Event()
        self.counts: Counter[str] = Counter()
        """Events of this life by kind."""

    @property
    def last_id(self) -> int:
        return self._next_id - 1

    def add(self, kind: str, what: str, *, task_id: str = "", robot_id: str = "", **data: Any) -> HistoryEntry:
        """Note one event now; `data` must be plain JSON values."""
        entry = HistoryEntry(
            id=self._next_id,
            t_s=self._clock.now(),
            kind=kind,
            what=what[:500],
            task_id=task_id,
            robot_id=robot_id,
            data=data,
        )
        self._next_id += 1
        self.counts[kind] += 1
        self._entries.append(entry)
        self._grown.set()
        self._grown = asyncio.Event()
        return entry

    def since(self, id: int) -> list[HistoryEntry]:
        """Events after `id`, oldest first."""
        newer = []
        for entry in reversed(self._entries):
            if entry.id <= id:
                break
            newer.append(entry)
        return newer[::-1]

    async def follow(self, id: int) -> AsyncIterator[HistoryEntry]:
        """Events after `id`, then every new one as it comes; never ends."""
        while True:
            grown = self._grown
            for entry in self.since(id):
                id = entry.id
                yield entry
            if id >= self.last_id:
                await grown.wait()
