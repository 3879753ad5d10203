"""What happened here: streamed to whoever listens, kept in the history, and the important part in the log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import structlog

from core.clock import Clock
from core.history import History
from core.mesh.events import EventLog

QUIET = frozenset({"soil", "measured"})


class Journal:
    """One call notes an event everywhere."""

    def __init__(self, node_id: str, path: Path, clock: Clock) -> None:
        self.history = History(path, clock)
        self.events = EventLog(clock, first_id=self.history.last_id + 1)
        self._log = structlog.get_logger("garden.plant").bind(node=node_id)

    def note(self, kind: str, what: str, *, task_id: str = "", robot_id: str = "", **data: Any) -> None:
        """`what` is a sentence for people; `data` plain JSON values."""
        self.history.add(self.events.add(kind, what, task_id=task_id, robot_id=robot_id, **data))
        if kind not in QUIET:
            self._log.info(what, kind=kind, task=task_id, robot=robot_id)

    def alarm(self, what: str) -> None:
        """Something a person should look at."""
        self.history.add(self.events.add("alarm", what))
        self._log.error(what)

    async def run(self) -> None:
        await self.history.run()
