"""Answers that leave a device a little later than the question came in, in order."""

from __future__ import annotations

import math
from collections import deque


class Outbox:
    """Bytes with the time they may leave; an answer never leaves in the instant of its question."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._ready = bytearray()

    def put(self, data: bytes, due_s: float) -> None:
        """Queue `data` for `due_s`, or after what is queued already."""
        if data:
            last_s = self._waiting[-1][0] if self._waiting else due_s
            self._waiting.append((max(due_s, last_s), data))

    def release(self, now_s: float) -> None:
        """Let everything due go."""
        while self._waiting and self._waiting[0][0] <= now_s + 1e-9:
            self._ready += self._waiting.popleft()[1]

    def take(self) -> bytes:
        """What has been released; empties the buffer."""
        data = bytes(self._ready)
        self._ready.clear()
        return data

    def due_s(self) -> float:
        """When the next bytes may leave; math.inf if none wait, the past if some are ready."""
        if self._ready:
            return 0.0
        return self._waiting[0][0] if self._waiting else math.inf
