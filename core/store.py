"""Durable documents: what was acknowledged survives `kill -9` and power loss.

One update: serialise, write all of `.tmp`, fsync it, link the old file as `.1`, rename, fsync the directory, answer.
The file is JSON, `{"schema", "generation", "sha256", "doc"}`; the hash covers schema, generation and document, so that
every damaged byte is noticed. Loading takes the highest valid generation of the file and its `.1`; a damaged file is
moved aside to `.bad-N`, never deleted. One process writes (flock). Standard library only.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import hashlib
import json
import logging
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from core.clock import Clock
from core.errors import StorageError

COMMIT_COST_S = 0.001
"""What one commit takes on a virtual clock."""
_HEADER = re.compile(rb'\{"schema":"([a-z0-9_./-]+)","generation":([1-9][0-9]{0,17}),"sha256":"([0-9a-f]{64})","doc":')
_log = logging.getLogger(__name__)

Content = bytes | Mapping[str, Any] | Callable[[], bytes]
"""JSON text, what becomes it, or what makes it: called off the loop, and only for the newest of a commit."""


class Disk:
    """The operating system's file calls, one method each, so that a test can bring a worse disk."""

    def read(self, path: Path) -> bytes:
        """Raises FileNotFoundError when, and only when, the file does not exist."""
        return path.read_bytes()

    def create(self, path: Path) -> int:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)

    def write(self, fd: int, data: bytes) -> int:
        return os.write(fd, data)

    def fsync(self, fd: int) -> None:
        os.fsync(fd)

    def close(self, fd: int) -> None:
        os.close(fd)

    def hold(self, path: Path) -> int | None:
        """Keeps a file's blocks until `close`, also when it is unlinked; None when there is nothing to hold."""
        with contextlib.suppress(OSError):
            return os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        return None

    def link(self, source: Path, target: Path) -> None:
        os.link(source, target)

    def unlink(self, path: Path) -> None:
        os.unlink(path)

    def rename(self, source: Path, target: Path) -> None:
        os.rename(source, target)

    def fsync_dir(self, path: Path) -> None:
        fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


class DamagedFileError(ValueError):
    """The bytes are not a whole envelope of ours."""


class _FsyncError(OSError):
    """The kernel could not say that our bytes are on the disk."""


@dataclass(frozen=True, slots=True)
class Envelope:
    generation: int
    doc: bytes


def pack(schema: str, generation: int, doc: bytes) -> bytes:
    """The file's bytes for a document that is JSON text already."""
    head = f'{{"schema":"{schema}","generation":{generation},"sha256":"{_digest(schema, generation, doc)}","doc":'
    return head.encode() + doc + b"}\n"


def unpack(schema: str, data: bytes) -> Envelope:
    """The inverse of `pack`; raises DamagedFileError when any byte is not as it was written."""
    if (head := _HEADER.match(data)) is None or not data.endswith(b"}\n"):
        raise DamagedFileError("not a whole envelope")
    found, generation, digest = head[1].decode(), int(head[2]), head[3].decode()
    doc = data[head.end() : -2]
    if _digest(found, generation, doc) != digest:
        raise DamagedFileError("its hash does not match")
    if found != schema:
        raise StorageError(f"the file holds {found}, this program reads {schema}", hint="move it away or update")
    return Envelope(generation, doc)


def _digest(schema: str, generation: int, doc: bytes) -> str:
    return hashlib.sha256(f"{schema}\n{generation}\n".encode() + doc).hexdigest()


def _encode(doc: Content) -> bytes:
    if callable(doc):
        return doc()
    if isinstance(doc, bytes):
        return doc
    return json.dumps(doc, separators=(",", ":"), allow_nan=False).encode()


class DurableDocument:
    """One document on disk. `load` once, then `save`; concurrent saves share one commit.

    `alarms` says what was found damaged. After a failed fsync nothing is acknowledged any more (`broken` says why).
    """

    def __init__(self, path: Path, schema: str, clock: Clock, disk: Disk | None = None, gather_s: float = 0.0) -> None:
        """A commit waits `gather_s` at most for those who shared the last one; a lone writer never waits.

        Where it may wait, the disk frees the copy before last after the answer: that takes a fifth of a commit's time.
        """
        self.path, self.schema = Path(path), schema
        self.generation = 0
        self.alarms: list[str] = []
        self.broken = ""
        self.failures = 0
        """Commits that failed; whoever keeps the document in memory goes back to the last durable one."""
        self._clock, self._disk = clock, disk or Disk()
        self._lock: IO[str] | None = None
        self._queue: list[tuple[Content, asyncio.Future[int]]] = []
        self._gather_s, self._crowd = gather_s, 1
        self._crowded = asyncio.Event()
        self._writer: asyncio.Task[None] | None = None
        self._held: int | None = None

    def load(self) -> Any:
        """Become the writer and return the newest valid document, or None when there never was one.

        Raises StorageError when another process writes it, when it cannot be read, or when only damaged files are left.
        """
        self._become_writer()
        found = {path: envelope for path in self._copies() if (envelope := self._read(path)) is not None}
        sound = {path: envelope for path, envelope in found.items() if isinstance(envelope, Envelope)}
        if found and not sound:
            raise StorageError(f"{self.path} and its older copy are damaged", hint="restore one from a backup")
        for path in found.keys() - sound.keys():
            self._put_aside(path, str(found[path]))
        if not sound:
            return None
        best = max(sound.values(), key=lambda envelope: envelope.generation)
        self.generation = best.generation
        if sound.get(self.path) is not best:
            self._reinstate()
        return json.loads(best.doc)

    async def save(self, doc: Content) -> int:
        """Returns the generation when this document, or one saved after it, is durable; raises StorageError.

        The document must not change while it is being saved.
        """
        if self.broken:
            self.failures += 1
            raise StorageError(f"{self.path.name} is not durable any more: {self.broken}", hint="restart the service")
        done: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._queue.append((doc, done))
        if len(self._queue) >= self._crowd:
            self._crowded.set()
        if self._writer is None:
            self._writer = asyncio.create_task(self._drain())
        return await done

    def close(self) -> None:
        """Give the file to another writer; saves that have not begun fail."""
        self._let_go()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    async def _drain(self) -> None:
        while self._queue:
            await self._gather()
            batch, self._queue = self._queue, []
            newest = batch[-1][0]
            try:
                generation = await self._clock.offload(lambda doc=newest: self.commit(doc), COMMIT_COST_S)  # type: ignore[misc]
            except StorageError as error:
                # What was queued meanwhile may build upon what just failed.
                self.failures += 1
                batch, self._queue = batch + self._queue, []
                _settle(batch, error)
            else:
                self._crowd = len(batch) + len(self._queue)
                _settle(batch, generation)
            if self._held is not None:
                await self._clock.offload(self._let_go)
        self._writer = None

    async def _gather(self) -> None:
        """Give those who shared the last commit, and have just been answered, the time to come again."""
        if self._gather_s == 0.0 or len(self._queue) >= self._crowd:
            return
        self._crowded.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._gather_s):
                await self._crowded.wait()

    def commit(self, doc: Content) -> int:
        """The recipe itself, blocking; `save` calls it off the loop. One caller at a time."""
        if self._lock is None:
            raise StorageError(f"{self.path.name} is closed")
        if self.broken:
            raise StorageError(f"{self.path.name} is not durable any more: {self.broken}", hint="restart the service")
        data = pack(self.schema, self.generation + 1, _encode(doc))
        try:
            self._replace(data)
        except _FsyncError as error:
            self.broken = f"fsync failed: {error.strerror}"
            raise StorageError(f"{self.path}: {self.broken}", hint="look at the disk, then restart") from error
        except OSError as error:
            raise StorageError(f"cannot write {self.path}: {error.strerror}", hint="is the disk full?") from error
        self.generation += 1
        return self.generation

    def _replace(self, data: bytes) -> None:
        temporary, older = self._beside(".tmp"), self._beside(".1")
        fd = self._disk.create(temporary)
        try:
            self._write_all(fd, data)
            _fsync(lambda: self._disk.fsync(fd))
        finally:
            self._disk.close(fd)
        if self._gather_s and self._held is None:
            self._held = self._disk.hold(older)
        _unless_absent(lambda: self._disk.unlink(older))
        _unless_absent(lambda: self._disk.link(self.path, older))
        self._disk.rename(temporary, self.path)
        _fsync(lambda: self._disk.fsync_dir(self.path.parent))

    def _let_go(self) -> None:
        held, self._held = self._held, None
        if held is not None:
            self._disk.close(held)

    def _write_all(self, fd: int, data: bytes) -> None:
        left = memoryview(data)
        while left:
            written = self._disk.write(fd, bytes(left))
            if written <= 0:
                raise OSError(errno.EIO, "the disk took no bytes")
            left = left[written:]

    def _become_writer(self) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            lock = open(self._beside(".lock"), "a")  # noqa: SIM115
        except OSError as error:
            raise StorageError(f"cannot use {self.path.parent}: {error.strerror}") from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            lock.close()
            raise StorageError(f"{self.path} has another writer", hint="is the service running twice?") from error
        self._lock = lock

    def _copies(self) -> tuple[Path, Path]:
        return self.path, self._beside(".1")

    def _beside(self, suffix: str) -> Path:
        return self.path.with_name(self.path.name + suffix)

    def _read(self, path: Path) -> Envelope | str | None:
        """The envelope, why it is damaged, or None when there is no file."""
        try:
            return unpack(self.schema, self._disk.read(path))
        except FileNotFoundError:
            return None
        except DamagedFileError as error:
            return str(error)
        except OSError as error:
            raise StorageError(f"cannot read {path}: {error.strerror}", hint="nothing was changed; try again") from error

    def _reinstate(self) -> None:
        """The older copy becomes current, so that the next commit never stands without a valid file."""
        try:
            _unless_absent(lambda: self._disk.unlink(self.path))
            self._disk.link(self._beside(".1"), self.path)
            self._disk.fsync_dir(self.path.parent)
        except OSError as error:
            raise StorageError(f"cannot reinstate {self.path}: {error.strerror}") from error

    def _put_aside(self, path: Path, why: str) -> None:
        number = 1
        while (aside := path.with_name(f"{path.name}.bad-{number}")).exists():
            number += 1
        try:
            self._disk.rename(path, aside)
        except OSError as error:
            raise StorageError(f"cannot move the damaged {path} aside: {error.strerror}") from error
        self.alarms.append(f"{path.name} was damaged ({why}); kept as {aside.name}")
        _log.error("damaged document put aside: %s (%s) as %s", path, why, aside.name)


def _settle(batch: list[tuple[Content, asyncio.Future[int]]], answer: int | StorageError) -> None:
    for _, done in batch:
        if done.done():
            continue
        if isinstance(answer, int):
            done.set_result(answer)
        else:
            done.set_exception(StorageError(str(answer), hint=answer.hint))


def _fsync(sync: Callable[[], None]) -> None:
    try:
        sync()
    except OSError as error:
        raise _FsyncError(error.errno, error.strerror or "") from error


def _unless_absent(call: Callable[[], None]) -> None:
    """Only ENOENT means absent."""
    with contextlib.suppress(FileNotFoundError):
        call()
