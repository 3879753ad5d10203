"""A service's memory of what happened and what was decided against, in SQLite (WAL).

Entries are queued in memory and written in batches off the loop: history is for people and graphs. What must survive
is in `core.store`; the newest second of history may be lost with the process.
"""

from __future__ import annotations

import asyncio
import csv
import io
import json
import sqlite3
import threading
from collections.abc import Sequence
from pathlib import Path

from core.clock import Clock
from core.errors import StorageError
from core.wire.documents import HistoryEntry

ENTRIES_MAX = 200_000
PENDING_MAX = 10_000
PRUNE_EVERY = 1000
WRITE_COST_S = 0.001
_COLUMNS = "id, t_s, kind, what, task_id, robot_id, data"
_TABLE = (
    "CREATE TABLE IF NOT EXISTS entries (id INTEGER PRIMARY KEY, t_s REAL NOT NULL, kind TEXT NOT NULL, what TEXT NOT NULL,"
    " task_id TEXT NOT NULL, robot_id TEXT NOT NULL, data TEXT NOT NULL)"
)


class History:
    """`add` queues, `run` writes, `query` reads both. Ids grow for ever, over restarts too."""

    def __init__(self, path: Path | None, clock: Clock, entries_max: int = ENTRIES_MAX) -> None:
        """`path` None keeps everything in memory. Raises StorageError when the file cannot be used."""
        self._clock, self._entries_max = clock, entries_max
        self._pending: list[HistoryEntry] = []
        self._wake = asyncio.Event()
        self._since_prune = 0
        self._writing = threading.Lock()
        self.lost = 0
        """Entries that could not be written and were dropped."""
        try:
            self._db = _open(path)
        except (sqlite3.Error, OSError) as error:
            raise StorageError(
                f"cannot open the history {path}: {error}", hint="move the file away to begin anew"
            ) from error
        row = self._db.execute("SELECT COALESCE(MAX(id), 0) FROM entries").fetchone()
        self.last_id: int = row[0]

    def add(self, entry: HistoryEntry) -> None:
        """Queue an entry; its id must be above all before it."""
        self.last_id = max(self.last_id, entry.id)
        self._pending.append(entry)
        if len(self._pending) > PENDING_MAX:
            self._pending.pop(0)
            self.lost += 1
        self._wake.set()

    async def run(self) -> None:
        """Write whatever is queued, for ever; flushes and closes when cancelled."""
        try:
            while True:
                await self._wake.wait()
                await self._clock.sleep(1.0)
                await self.flush()
        finally:
            self.close()

    async def flush(self) -> None:
        """Write everything queued so far; a disk that refuses is tried again with the next entry."""
        self._wake.clear()
        batch, self._pending = self._pending, []
        if not batch:
            return
        try:
            await self._clock.offload(lambda: self._write(batch), WRITE_COST_S)
        except sqlite3.Error:
            self._pending = batch + self._pending
        except asyncio.CancelledError:
            self._pending = batch + self._pending
            raise

    def close(self) -> None:
        """Write what is left and close; nothing may be added afterwards."""
        try:
            self._write(self._pending)
        except sqlite3.Error:
            self.lost += len(self._pending)
        self._pending = []
        self._db.close()

    def query(
        self, *, since_id: int = 0, since_s: float | None = None, kind: str = "", task_id: str = "", limit: int = 500
    ) -> list[HistoryEntry]:
        """The newest `limit` matching entries, oldest first."""
        where, values = ["id > ?"], [since_id]  # type: tuple[list[str], list[object]]
        for column, value in (("kind", kind), ("task_id", task_id)):
            if value:
                where.append(f"{column} = ?")
                values.append(value)
        if since_s is not None:
            where.append("t_s >= ?")
            values.append(since_s)
        sql = f"SELECT {_COLUMNS} FROM entries WHERE {' AND '.join(where)} ORDER BY id DESC LIMIT ?"
        try:
            stored = [_entry(row) for row in self._db.execute(sql, [*values, limit])][::-1]
        except sqlite3.Error as error:
            raise StorageError(f"cannot read the history: {error}") from error
        last = stored[-1].id if stored else since_id
        fresh = [e for e in self._pending if e.id > max(last, since_id) and _fits(e, since_s, kind, task_id)]
        return (stored + fresh)[-limit:]

    def _write(self, batch: Sequence[HistoryEntry]) -> None:
        rows = [(e.id, e.t_s, e.kind, e.what, e.task_id, e.robot_id, json.dumps(e.data)) for e in batch]
        with self._writing, self._db:
            self._db.executemany(f"INSERT OR REPLACE INTO entries ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
            self._since_prune += len(rows)
            if self._since_prune >= PRUNE_EVERY:
                self._since_prune = 0
                self._db.execute("DELETE FROM entries WHERE id <= ?", (self.last_id - self._entries_max,))


def as_csv(entries: Sequence[HistoryEntry]) -> str:
    """Entries as comma-separated values with a header line; `data` is JSON."""
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(_COLUMNS.split(", "))
    for e in entries:
        writer.writerow([e.id, e.t_s, e.kind, e.what, e.task_id, e.robot_id, json.dumps(e.data)])
    return out.getvalue()


def _open(path: Path | None) -> sqlite3.Connection:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    db = sqlite3.connect(path if path is not None else ":memory:", check_same_thread=False, timeout=2.0)
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("PRAGMA synchronous=NORMAL")
    db.execute("PRAGMA cache_size=-512")
    db.execute(_TABLE)
    db.commit()
    return db


def _entry(row: tuple[int, float, str, str, str, str, str]) -> HistoryEntry:
    entry_id, t_s, kind, what, task_id, robot_id, data = row
    return HistoryEntry(
        id=entry_id, t_s=t_s, kind=kind, what=what, task_id=task_id, robot_id=robot_id, data=json.loads(data)
    )


def _fits(entry: HistoryEntry, since_s: float | None, kind: str, task_id: str) -> bool:
    recent = since_s is None or entry.t_s >= since_s
    return recent and kind in ("", entry.kind) and task_id in ("", entry.task_id)
