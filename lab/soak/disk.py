"""Disks in memory that know what is synced: what is not is lost, or torn, when the power goes."""

from __future__ import annotations

import errno
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from core.store import Disk


@dataclass(eq=False, slots=True)
class _Inode:
    data: bytes = b""
    synced: bytes = b""


@dataclass(eq=False)
class Platter:
    """What lies on one machine's disk; it outlives the processes that use it."""

    names: dict[Path, _Inode] = field(default_factory=dict)
    """As a running system sees it."""
    synced: dict[Path, _Inode] = field(default_factory=dict)
    """The directories as they would be found after the power went."""

    def lose_power(self, rng: random.Random) -> bool:
        """Only what is synced stays, and perhaps a part of the rest; True when anything was lost or torn."""
        lost = self.names != self.synced
        self.names = dict(self.synced)
        for inode in set(self.names.values()):
            if inode.data != inode.synced:
                lost = True
                more = inode.data if len(inode.data) > len(inode.synced) else inode.synced
                inode.data = rng.choice((inode.synced, more[: rng.randrange(len(more) + 1)]))
                inode.synced = inode.data
        return lost


Hook = Callable[[str, Path], None]
"""Called before each operation with its name and path, and as `synced` after a commit; may raise, or end the process."""


class SoakDisk(Disk):
    """One process's view of a platter; useless once the process is dead."""

    def __init__(self, platter: Platter, hook: Hook) -> None:
        self._platter, self._hook = platter, hook
        self._open: dict[int, tuple[Path, _Inode]] = {}
        self._next_fd = 1000
        self.dead = False

    def _about(self, operation: str, path: Path) -> None:
        if self.dead:
            raise OSError(errno.EIO, "this process is dead")
        self._hook(operation, path)

    def read(self, path: Path) -> bytes:
        self._about("read", path)
        if (inode := self._platter.names.get(path)) is None:
            raise FileNotFoundError(errno.ENOENT, "no such file", str(path))
        return inode.data

    def create(self, path: Path) -> int:
        self._about("create", path)
        inode = self._platter.names.get(path)
        if inode is None:
            inode = self._platter.names[path] = _Inode()
        inode.data = b""
        self._next_fd += 1
        self._open[self._next_fd] = (path, inode)
        return self._next_fd

    def write(self, fd: int, data: bytes) -> int:
        path, inode = self._open[fd]
        self._about("write", path)
        inode.data += data
        return len(data)

    def fsync(self, fd: int) -> None:
        path, inode = self._open[fd]
        self._about("fsync", path)
        inode.synced = inode.data

    def close(self, fd: int) -> None:
        self._open.pop(fd, None)

    def hold(self, path: Path) -> int | None:
        return None

    def link(self, source: Path, target: Path) -> None:
        self._about("link", target)
        if source not in self._platter.names:
            raise FileNotFoundError(errno.ENOENT, "no such file", str(source))
        self._platter.names[target] = self._platter.names[source]

    def unlink(self, path: Path) -> None:
        self._about("unlink", path)
        if self._platter.names.pop(path, None) is None:
            raise FileNotFoundError(errno.ENOENT, "no such file", str(path))

    def rename(self, source: Path, target: Path) -> None:
        self._about("rename", target)
        self._platter.names[target] = self._platter.names.pop(source)

    def fsync_dir(self, path: Path) -> None:
        self._about("fsync_dir", path)
        here = {name: inode for name, inode in self._platter.names.items() if name.parent == path}
        elsewhere = {name: inode for name, inode in self._platter.synced.items() if name.parent != path}
        self._platter.synced = elsewhere | here
        self._about("synced", path)
