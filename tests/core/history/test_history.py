from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from core.clock import VirtualClock
from core.errors import StorageError
from core.history import History, as_csv
from core.virtual import run_virtual
from core.wire.documents import HistoryEntry


def entry(number: int, kind: str = "soil", **more: str) -> HistoryEntry:
    return HistoryEntry(id=number, t_s=float(number), kind=kind, what=f"entry {number}", data={"n": number}, **more)


def test_entries_are_found_before_and_after_they_are_written(tmp_path: Path) -> None:
    async def main() -> None:
        history = History(tmp_path / "h.sqlite3", VirtualClock())
        for number in range(1, 6):
            history.add(entry(number))
        await history.flush()
        history.add(entry(6, "done", task_id="t1"))
        assert [e.id for e in history.query()] == [1, 2, 3, 4, 5, 6]
        assert [e.id for e in history.query(limit=2)] == [5, 6]
        assert [e.id for e in history.query(since_id=4)] == [5, 6]
        assert [e.id for e in history.query(since_s=5.0)] == [5, 6]
        assert [e.id for e in history.query(kind="done")] == [6]
        assert [e.id for e in history.query(task_id="t1")] == [6]
        assert history.query()[5] == entry(6, "done", task_id="t1")
        history.close()

    run_virtual(main())


def test_a_running_history_writes_within_seconds_and_closes_clean(tmp_path: Path) -> None:
    async def main() -> None:
        clock = VirtualClock()
        history = History(tmp_path / "h.sqlite3", clock)
        writer = asyncio.create_task(history.run())
        history.add(entry(1))
        await clock.sleep(3.0)
        other = History(tmp_path / "h.sqlite3", clock)
        assert [e.id for e in other.query()] == [1]
        other.close()
        history.add(entry(2))
        writer.cancel()
        await asyncio.gather(writer, return_exceptions=True)
        again = History(tmp_path / "h.sqlite3", clock)
        assert again.last_id == 2
        again.close()

    run_virtual(main())


def test_old_entries_make_room(tmp_path: Path) -> None:
    async def main() -> None:
        history = History(tmp_path / "h.sqlite3", VirtualClock(), entries_max=100)
        for number in range(1, 2501):
            history.add(entry(number))
            if number % 500 == 0:
                await history.flush()
        assert len(history.query(limit=5000)) <= 600
        assert history.query()[-1].id == 2500
        history.close()

    run_virtual(main())


def test_a_file_that_is_no_history_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite3"
    path.write_bytes(b"something else entirely" * 100)

    async def main() -> None:
        with pytest.raises(StorageError, match=r"h\.sqlite3"):
            History(path, VirtualClock())

    run_virtual(main())
    assert path.read_bytes().startswith(b"something else")


def test_csv_has_a_header_and_quotes_what_needs_it() -> None:
    lines = as_csv([entry(1, what := "soil"), HistoryEntry(id=2, t_s=0.5, kind=what, what='a, "b"')]).splitlines()
    assert lines[0] == "id,t_s,kind,what,task_id,robot_id,data"
    assert lines[2] == '2,0.5,soil,"a, ""b""",,,{}'
