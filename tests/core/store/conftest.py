"""Disks worse than any real one."""

from __future__ import annotations

import errno
import random
from pathlib import Path

import pytest

from core.store import Disk


class PowerCut(BaseException):
    """The machine stops here."""


class FailingDisk(Disk):
    """The real disk, but call number `fail_at` (counted from 1) of the named method fails with `code`."""

    def __init__(self, method: str, code: int, fail_at: int = 1) -> None:
        self.method, self.code, self.left = method, code, fail_at

    def __getattribute__(self, name: str):  # type: ignore[no-untyped-def]
        found = super().__getattribute__(name)
        if name.startswith("_") or name in ("method", "code", "left") or name != self.method:
            return found

        def failing(*args):  # type: ignore[no-untyped-def]
            self.left -= 1
            if self.left == 0:
                raise OSError(self.code, errno.errorcode[self.code])
            return found(*args)

        return failing


class SimDisk(Disk):
    """A disk in memory that stops after `stop_after` operations and then loses what was not synced.

    File contents count when their fsync came, directory entries when the directory's did. What was not synced is, by
    the dice, kept, lost, or (contents) torn in the middle: each operation by itself, in any combination.
    """

    def __init__(self, names: dict[str, bytes], stop_after: int) -> None:
        self.synced_names = {name: [bytes(data)] for name, data in names.items()}
        """Name -> inode; an inode is a one-element list with its contents."""
        self.names = dict(self.synced_names)
        self.synced_contents = {id(inode): inode[0] for inode in self.names.values()}
        self.pending: list[tuple[str, str, list[bytes] | None]] = []
        self.open: dict[int, list[bytes]] = {}
        self.steps, self.stop_after = 0, stop_after

    def step(self) -> None:
        if self.steps == self.stop_after:
            raise PowerCut
        self.steps += 1

    def read(self, path: Path) -> bytes:
        if path.name not in self.names:
            raise FileNotFoundError(errno.ENOENT, "absent")
        return self.names[path.name][0]

    def create(self, path: Path) -> int:
        self.step()
        inode = self.names.get(path.name)
        if inode is None:
            inode = [b""]
            self._entry(path.name, inode)
        inode[0] = b""
        self.open[fd := len(self.open) + 3] = inode
        return fd

    def write(self, fd: int, data: bytes) -> int:
        self.step()
        taken = data[: max(1, len(data) // 2)]
        self.open[fd][0] += taken
        return len(taken)

    def fsync(self, fd: int) -> None:
        self.step()
        self.synced_contents[id(self.open[fd])] = self.open[fd][0]

    def close(self, fd: int) -> None:
        return

    def hold(self, path: Path) -> int | None:
        return None

    def link(self, source: Path, target: Path) -> None:
        self.step()
        if source.name not in self.names:
            raise FileNotFoundError(errno.ENOENT, "absent")
        self._entry(target.name, self.names[source.name])

    def unlink(self, path: Path) -> None:
        self.step()
        if path.name not in self.names:
            raise FileNotFoundError(errno.ENOENT, "absent")
        self._entry(path.name, None)

    def rename(self, source: Path, target: Path) -> None:
        self.step()
        inode = self.names[source.name]
        # One journalled operation: both entries change, or neither.
        self.pending.append(("rename", f"{source.name}>{target.name}", inode))
        del self.names[source.name]
        self.names[target.name] = inode

    def fsync_dir(self, path: Path) -> None:
        self.step()
        self.pending.clear()
        self.synced_names = dict(self.names)

    def _entry(self, name: str, inode: list[bytes] | None) -> None:
        self.pending.append(("entry", name, inode))
        if inode is None:
            self.names.pop(name, None)
        else:
            self.names[name] = inode

    def after_power_cut(self, rng: random.Random) -> dict[str, bytes]:
        """The files a restart finds."""
        names = dict(self.synced_names)
        for kind, name, inode in self.pending:
            if rng.random() < 0.5:
                continue
            if kind == "rename":
                source, _, target = name.partition(">")
                names.pop(source, None)
                names[target] = inode or [b""]
            elif inode is None:
                names.pop(name, None)
            else:
                names[name] = inode
        return {name: self._contents(inode, rng) for name, inode in names.items()}

    def _contents(self, inode: list[bytes], rng: random.Random) -> bytes:
        synced = self.synced_contents.get(id(inode))
        if synced == inode[0]:
            return inode[0]
        return rng.choice([inode[0], inode[0][: rng.randrange(len(inode[0]) + 1)], synced or b""])


@pytest.fixture
def disks() -> dict[str, type]:
    return {"failing": FailingDisk, "sim": SimDisk, "cut": PowerCut}
