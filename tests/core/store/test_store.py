from __future__ import annotations

import asyncio
import errno
import hashlib
import json
import math
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import pytest

from core.clock import VirtualClock
from core.errors import StorageError
from core.store import Disk, DurableDocument, pack
from core.virtual import run_virtual

Disks = dict[str, Any]
T = TypeVar("T")


def open_file(folder: Path, disk: Any = None) -> DurableDocument:
    return DurableDocument(folder / "doc.json", "test/1", VirtualClock(), disk)


def reopen(file: DurableDocument) -> Any:
    file.close()
    again = open_file(file.path.parent)
    try:
        return again.load()
    finally:
        again.close()


def test_what_was_saved_is_loaded_again(tmp_path: Path) -> None:
    file = open_file(tmp_path)
    assert file.load() is None
    assert file.commit({"a": [1, 2.5, "ü"]}) == 1
    assert file.commit(b'{"a":2}') == 2
    assert reopen(file) == {"a": 2}


def test_the_file_is_readable_json_with_its_generation(tmp_path: Path) -> None:
    file = open_file(tmp_path)
    file.load()
    file.commit({"a": 1})
    envelope = json.loads(file.path.read_bytes())
    assert (envelope["schema"], envelope["generation"], envelope["doc"]) == ("test/1", 1, {"a": 1})
    file.close()


def test_a_file_is_the_same_bytes_for_the_same_document(tmp_path: Path) -> None:
    file = open_file(tmp_path)
    file.load()
    file.commit({"a": [1, 2.5], "b": "x"})
    doc = b'{"a":[1,2.5],"b":"x"}'
    digest = hashlib.sha256(b"test/1\n1\n" + doc).hexdigest().encode()
    assert file.path.read_bytes() == b'{"schema":"test/1","generation":1,"sha256":"' + digest + b'","doc":' + doc + b"}\n"
    with pytest.raises(ValueError, match="not JSON compliant"):
        file.commit({"a": math.nan})
    file.close()


def test_a_commit_is_these_system_calls_in_this_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = open_file(tmp_path)
    file.load()
    file.commit({"n": 1})
    file.commit({"n": 2})
    calls: list[tuple[Any, ...]] = []
    names: dict[int, str] = {}

    def watch(name: str) -> None:
        real = getattr(os, name)

        def call(*args: Any) -> Any:
            answer = real(*args)
            if name == "open":
                names[answer] = Path(args[0]).name
            calls.append(
                (name, *(names.get(a, a) if isinstance(a, int) else a.name if isinstance(a, Path) else a for a in args))
            )
            return answer

        monkeypatch.setattr(os, name, call)

    for name in ("open", "write", "fsync", "close", "link", "unlink", "rename"):
        watch(name)
    file.commit({"n": 3})
    monkeypatch.undo()
    folder = tmp_path.name
    assert calls == [
        ("open", "doc.json.tmp", os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600),
        ("write", "doc.json.tmp", pack("test/1", 3, b'{"n":3}')),
        ("fsync", "doc.json.tmp"),
        ("close", "doc.json.tmp"),
        ("unlink", "doc.json.1"),
        ("link", "doc.json", "doc.json.1"),
        ("rename", "doc.json.tmp", "doc.json"),
        ("open", folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC),
        ("fsync", folder),
        ("close", folder),
    ]
    file.close()


def test_beside_a_document_lie_its_older_copy_and_its_lock(tmp_path: Path) -> None:
    file = DurableDocument(tmp_path / "not" / "yet" / "doc.json", "test/1", VirtualClock())
    file.load()
    file.commit({"n": 1})
    file.commit({"n": 2})
    file.close()
    assert {path.name for path in file.path.parent.iterdir()} == {"doc.json", "doc.json.1", "doc.json.lock"}


def test_a_place_that_cannot_hold_files_is_named(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    file = DurableDocument(tmp_path / "taken" / "doc.json", "test/1", VirtualClock())
    with pytest.raises(StorageError, match=r"cannot use .*taken"):
        file.load()


def test_two_writers_are_refused(tmp_path: Path) -> None:
    first, second = open_file(tmp_path), open_file(tmp_path)
    first.load()
    with pytest.raises(StorageError, match="another writer"):
        second.load()
    first.close()
    assert second.load() is None
    second.close()


def test_a_closed_file_takes_nothing(tmp_path: Path) -> None:
    file = open_file(tmp_path)
    file.load()
    file.close()
    with pytest.raises(StorageError, match="closed"):
        file.commit({"a": 1})


def test_concurrent_saves_share_commits_and_each_is_durable_when_answered(tmp_path: Path) -> None:
    async def main() -> tuple[list[int], int]:
        file = open_file(tmp_path)
        file.load()
        generations = await asyncio.gather(*(file.save({"n": n}) for n in range(50)))
        file.close()
        return generations, file.generation

    generations, last = run_virtual(main())
    assert last == 1
    assert generations == [1] * 50
    file = open_file(tmp_path)
    assert file.load() == {"n": 49}
    file.close()


def written_by(folder: Path, writers: int, each: int, gather_s: float, uneven_s: float = 0.0) -> tuple[int, float]:
    """Commits and virtual seconds that writers need who write again half a millisecond after their answer.

    Each further one thinks `uneven_s` longer.
    """

    async def main() -> tuple[int, float]:
        clock = VirtualClock()
        file = DurableDocument(folder / "doc.json", "test/1", clock, None, gather_s)
        file.load()

        async def write(writer: int) -> None:
            await clock.sleep(0.0002 * writer)
            for n in range(each):
                await file.save({"n": n})
                await clock.sleep(0.0005 + uneven_s * writer)

        began_s = clock.now()
        await asyncio.gather(*(write(writer) for writer in range(writers)))
        file.close()
        return file.generation, clock.now() - began_s

    return run_virtual(main())


def test_writers_who_shared_a_commit_share_the_next_one(tmp_path: Path) -> None:
    alone, together = written_by(tmp_path / "a", 8, 20, 0.0), written_by(tmp_path / "b", 8, 20, 0.002)
    assert together[0] <= 20 + 2
    assert together[0] < 0.6 * alone[0]
    assert together[1] < alone[1]


def test_nobody_waits_longer_than_for_the_last_who_shared_the_commit_before(tmp_path: Path) -> None:
    commits, took_s = written_by(tmp_path, 4, 20, 0.5, uneven_s=0.001)
    assert commits <= 20 + 2
    assert took_s < 0.2 + 0.5  # the last one finds nobody to share with, once


def test_who_shared_a_commit_is_not_waited_for_unless_that_was_asked_for(tmp_path: Path) -> None:
    async def main() -> None:
        file = open_file(tmp_path)
        file.load()
        await asyncio.gather(file.save({"n": 1}), file.save({"n": 2}))
        began_s = asyncio.get_running_loop().time()
        await file.save({"n": 3})
        assert asyncio.get_running_loop().time() - began_s == pytest.approx(0.001)
        file.close()

    run_virtual(main())


def test_a_lone_writer_never_waits_for_others(tmp_path: Path) -> None:
    assert written_by(tmp_path / "a", 1, 20, 0.5) == written_by(tmp_path / "b", 1, 20, 0.0)


class Telling(Disk):
    """Says in which order it is called, and fails to rename as often as it is told."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.failures = 0
        self._held = set[int]()

    def hold(self, path: Path) -> int | None:
        if (fd := super().hold(path)) is not None:
            self._held.add(fd)
            self.calls.append("hold")
        return fd

    def unlink(self, path: Path) -> None:
        super().unlink(path)
        self.calls.append("unlink")

    def rename(self, source: Path, target: Path) -> None:
        if self.failures:
            self.failures -= 1
            raise OSError(errno.ENOSPC, "full")
        super().rename(source, target)

    def fsync_dir(self, path: Path) -> None:
        super().fsync_dir(path)
        self.calls.append("durable")

    def close(self, fd: int) -> None:
        super().close(fd)
        if fd in self._held:
            self._held.discard(fd)
            self.calls.append("let go")


@pytest.mark.parametrize(
    ("gather_s", "freed"), [(0.0, ["unlink", "durable"]), (0.01, ["hold", "unlink", "durable", "let go"])]
)
def test_where_writers_follow_each_other_the_copy_before_last_is_freed_once_the_new_one_is_durable(
    tmp_path: Path, gather_s: float, freed: list[str]
) -> None:
    disk = Telling()

    async def main() -> None:
        file = DurableDocument(tmp_path / "doc.json", "test/1", VirtualClock(), disk, gather_s)
        file.load()
        for n in range(4):
            await file.save({"n": n})
            await asyncio.sleep(1.0)
        file.close()

    run_virtual(main())
    assert disk.calls == ["durable", "durable", *freed, *freed]


def test_a_copy_that_is_held_is_let_go_when_the_commit_fails_and_when_the_file_is_closed(tmp_path: Path) -> None:
    disk = Telling()

    async def main() -> None:
        file = DurableDocument(tmp_path / "doc.json", "test/1", VirtualClock(), disk, 0.01)
        file.load()
        for n in range(2):
            await file.save({"n": n})
        disk.failures, disk.calls = 1, []
        with pytest.raises(StorageError, match="full"):
            await file.save({"n": 2})
        await asyncio.sleep(1.0)
        assert disk.calls == ["hold", "unlink", "let go"]
        disk.calls = []
        file.commit({"n": 3})
        file.commit({"n": 4})
        file.close()
        assert disk.calls == ["hold", "unlink", "durable", "unlink", "durable", "let go"]

    run_virtual(main())


def test_any_damaged_byte_is_noticed_and_the_older_copy_used(tmp_path: Path) -> None:
    seed = 2026
    print("seed", seed)
    rng = random.Random(seed)
    good, older = pack("test/1", 2, b'{"n":2}'), pack("test/1", 1, b'{"n":1}')
    for round_ in range(5000):
        folder = tmp_path / str(round_ % 7)
        folder.mkdir(exist_ok=True)
        damaged = _damage(good, rng)
        (folder / "doc.json").write_bytes(damaged)
        (folder / "doc.json.1").write_bytes(older)
        file = open_file(folder)
        assert file.load() == {"n": 1}, damaged
        assert file.alarms
        assert sorted(folder.glob("doc.json.bad-*"))[-1].exists()
        file.close()
        for left in folder.iterdir():
            left.unlink()


def _damage(data: bytes, rng: random.Random) -> bytes:
    how, at = rng.randrange(4), rng.randrange(len(data))
    if how == 0:
        return data[:at]
    if how == 1:
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if how == 2:
        return data[:at] + b"\0" * (len(data) - at)
    return data + rng.randbytes(rng.randrange(1, 5))


def test_after_the_older_copy_was_used_a_crash_still_leaves_one(tmp_path: Path, disks: Disks) -> None:
    older = pack("test/1", 1, b'{"n":1}')
    for stop in range(24):
        disk = disks["sim"]({"doc.json.1": older}, 10_000)
        file = open_file(tmp_path, disk)
        assert file.load() == {"n": 1}
        disk.steps, disk.stop_after = 0, stop
        acknowledged = _commit_until_cut(file, disks)
        files = disk.after_power_cut(random.Random(stop))
        again = open_file(tmp_path, disks["sim"](files, 10_000))
        assert again.load() in ([{"n": 2}] if acknowledged else [{"n": 1}, {"n": 2}])
        again.close()


def _commit_until_cut(file: DurableDocument, disks: Disks) -> bool:
    try:
        file.commit({"n": 2})
        return True
    except disks["cut"]:
        return False
    finally:
        file.close()


@pytest.mark.parametrize("has_older", [False, True])
def test_every_crash_point_recovers_to_the_old_or_the_new_document(tmp_path: Path, disks: Disks, has_older: bool) -> None:
    files = {"doc.json": pack("test/1", 7, b'{"n":1}')}
    if has_older:
        files["doc.json.1"] = pack("test/1", 6, b'{"n":0}')
    seen = set()
    for stop in range(24):
        for seed in range(80):
            disk = disks["sim"](files, stop)
            file = open_file(tmp_path, disk)
            file.load()
            acknowledged = _commit_until_cut(file, disks)
            again = open_file(tmp_path, disks["sim"](disk.after_power_cut(random.Random(seed)), 10_000))
            found = again.load()
            again.close()
            assert found in ([{"n": 2}] if acknowledged else [{"n": 1}, {"n": 2}]), (stop, seed)
            seen.add((acknowledged, found["n"]))
    assert seen == {(False, 1), (False, 2), (True, 2)}


def test_the_first_document_ever_is_there_once_acknowledged(tmp_path: Path, disks: Disks) -> None:
    for stop in range(24):
        for seed in range(50):
            disk = disks["sim"]({}, stop)
            file = open_file(tmp_path, disk)
            assert file.load() is None
            acknowledged = _commit_until_cut(file, disks)
            again = open_file(tmp_path, disks["sim"](disk.after_power_cut(random.Random(seed)), 10_000))
            assert again.load() in ([{"n": 2}] if acknowledged else [None, {"n": 2}]), (stop, seed)
            again.close()


@pytest.mark.parametrize("method", ["create", "write", "link", "rename", "unlink"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_a_failed_write_is_said_and_the_next_one_may_succeed(tmp_path: Path, disks: Disks, method: str, code: int) -> None:
    file = open_file(tmp_path)
    file.load()
    file.commit({"n": 1})
    file.commit({"n": 2})
    file._disk = disks["failing"](method, code)
    with pytest.raises(StorageError) as raised:
        file.commit({"n": 3})
    assert raised.value.status == 507
    assert not file.broken
    assert file.commit({"n": 4}) == 3
    assert reopen(file) == {"n": 4}


@pytest.mark.parametrize("method", ["fsync", "fsync_dir"])
def test_after_a_failed_fsync_nothing_is_acknowledged_any_more(tmp_path: Path, disks: Disks, method: str) -> None:
    async def main() -> None:
        file = open_file(tmp_path, disks["failing"](method, errno.EIO))
        file.load()
        for n in range(3):
            with pytest.raises(StorageError):
                await file.save({"n": n})
        assert "fsync" in file.broken
        file.close()

    run_virtual(main())


def test_saves_queued_behind_a_failed_commit_fail_with_it(tmp_path: Path, disks: Disks) -> None:
    async def main() -> None:
        file = open_file(tmp_path, disks["failing"]("rename", errno.ENOSPC))
        file.load()
        answers = await asyncio.gather(*(file.save({"n": n}) for n in range(5)), return_exceptions=True)
        assert all(isinstance(answer, StorageError) for answer in answers)
        assert await file.save({"n": 9}) == 1
        file.close()

    run_virtual(main())


class LateClock(VirtualClock):
    """Offloaded work has its effect when its time is over, so that others may ask meanwhile."""

    async def offload(self, fn: Callable[[], T], cost_s: float = 0.0) -> T:
        await asyncio.sleep(cost_s)
        return fn()


def test_what_was_queued_while_a_commit_failed_fails_too_and_one_failure_is_counted(tmp_path: Path, disks: Disks) -> None:
    async def main() -> None:
        file = DurableDocument(tmp_path / "doc.json", "test/1", LateClock(), disks["failing"]("rename", errno.ENOSPC))
        file.load()
        assert file.failures == 0
        first = asyncio.create_task(file.save({"n": 1}))
        await asyncio.sleep(0.0005)
        second = asyncio.create_task(file.save({"n": 2}))
        answers = await asyncio.gather(first, second, return_exceptions=True)
        assert all(isinstance(answer, StorageError) for answer in answers)
        assert (file.failures, file.generation) == (1, 0)
        assert await file.save({"n": 3}) == 1
        file.close()

    run_virtual(main())


def test_a_broken_file_counts_and_refuses_every_save_and_every_commit(tmp_path: Path, disks: Disks) -> None:
    async def main() -> None:
        file = open_file(tmp_path, disks["failing"]("fsync", errno.EIO))
        file.load()
        for failures in (1, 2, 3):
            with pytest.raises(StorageError, match="fsync failed" if failures == 1 else "not durable any more"):
                await file.save({"n": failures})
            assert file.failures == failures
        with pytest.raises(StorageError, match="not durable any more"):
            file.commit({"n": 4})
        file.close()

    run_virtual(main())


def test_who_stops_waiting_for_a_save_does_not_hold_up_the_others(tmp_path: Path) -> None:
    async def main() -> None:
        file = open_file(tmp_path)
        file.load()
        saves = [asyncio.create_task(file.save({"n": n})) for n in range(3)]
        await asyncio.sleep(0.0)
        saves[0].cancel()
        assert await asyncio.gather(*saves[1:]) == [1, 1]
        assert await file.save({"n": 3}) == 2
        file.close()

    run_virtual(main())


def test_a_disk_that_takes_no_bytes_is_an_error(tmp_path: Path) -> None:
    class Full(Disk):
        def write(self, fd: int, data: bytes) -> int:
            return 0

    file = open_file(tmp_path, Full())
    file.load()
    with pytest.raises(StorageError, match="took no bytes"):
        file.commit({"n": 1})
    file.close()


def test_the_newer_of_two_sound_copies_counts_and_becomes_the_current_one(tmp_path: Path) -> None:
    (tmp_path / "doc.json").write_bytes(pack("test/1", 4, b'{"n":4}'))
    (tmp_path / "doc.json.1").write_bytes(pack("test/1", 5, b'{"n":5}'))
    file = open_file(tmp_path)
    assert file.load() == {"n": 5}
    assert (file.generation, file.alarms) == (5, [])
    assert file.path.read_bytes() == pack("test/1", 5, b'{"n":5}')
    file.close()


@pytest.mark.parametrize(("method", "said"), [("link", "cannot reinstate"), ("rename", "cannot move the damaged")])
def test_a_disk_that_fails_while_copies_are_put_in_order_is_said(
    tmp_path: Path, disks: Disks, method: str, said: str
) -> None:
    (tmp_path / "doc.json").write_bytes(b"{}")
    (tmp_path / "doc.json.1").write_bytes(pack("test/1", 1, b'{"n":1}'))
    file = open_file(tmp_path, disks["failing"](method, errno.EIO))
    with pytest.raises(StorageError, match=said):
        file.load()
    assert reopen(file) == {"n": 1}


def test_damaged_files_are_all_kept_and_numbered(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        (tmp_path / "doc.json").unlink(missing_ok=True)  # it may be one file with its older copy
        (tmp_path / "doc.json").write_bytes(f"damage {number}".encode())
        (tmp_path / "doc.json.1").write_bytes(pack("test/1", 1, b'{"n":1}'))
        file = open_file(tmp_path)
        assert file.load() == {"n": 1}
        assert file.alarms == [f"doc.json was damaged (not a whole envelope); kept as doc.json.bad-{number}"]
        assert (tmp_path / f"doc.json.bad-{number}").read_bytes() == f"damage {number}".encode()
        file.close()


@pytest.mark.parametrize("code", [errno.EMFILE, errno.EACCES, errno.EIO])
def test_only_enoent_means_absent(tmp_path: Path, disks: Disks, code: int) -> None:
    first = open_file(tmp_path)
    first.load()
    first.commit({"n": 1})
    first.close()
    file = open_file(tmp_path, disks["failing"]("read", code))
    with pytest.raises(StorageError, match="cannot read"):
        file.load()
    assert reopen(file) == {"n": 1}


def test_two_damaged_copies_refuse_to_start_and_stay_where_they_are(tmp_path: Path) -> None:
    for name in ("doc.json", "doc.json.1"):
        (tmp_path / name).write_bytes(b"{}")
    file = open_file(tmp_path)
    with pytest.raises(StorageError, match="damaged"):
        file.load()
    assert {path.name for path in tmp_path.glob("doc.json*")} >= {"doc.json", "doc.json.1"}
    file.close()


def test_another_programs_document_is_not_taken_for_ours(tmp_path: Path) -> None:
    (tmp_path / "doc.json").write_bytes(pack("other/1", 1, b"{}"))
    file = open_file(tmp_path)
    with pytest.raises(StorageError, match="other/1"):
        file.load()
    file.close()
