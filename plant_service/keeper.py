"""A state machine in memory and its document on disk: nothing is answered before the document is durable."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

from core.store import DurableDocument
from core.wire.documents import Document


class Machine(Protocol):
    """Pure state; `dirty` from a change until its document is taken to be saved."""

    dirty: bool

    def document(self) -> Any: ...


M = TypeVar("M", bound=Machine)
D = TypeVar("D", bound=Document)
T = TypeVar("T")


def _dump(document: Document) -> bytes:
    return document.model_dump_json().encode()


class Keeper(Generic[M, D]):
    """Runs events on a machine and saves it. A failed save takes the machine back to its last durable document."""

    def __init__(
        self,
        file: DurableDocument,
        model: type[D],
        revive: Callable[[D | None], M],
        encode: Callable[[D], bytes] = _dump,
        found: Callable[[D], D] = lambda document: document,
    ) -> None:
        """Reads the file; `revive` makes the machine of a document, `encode` its JSON, off the loop. Raises StorageError.

        `found` says what another process's document means in this one; called once, here.
        """
        self._file, self._revive, self._encode = file, revive, encode
        stored = file.load()
        self.durable: D | None = None if stored is None else found(model.model_validate(stored))
        self._machine = revive(self.durable)
        self._failures = self._saving = 0
        self.commits, self.commit_s, self.last_commit_s = 0, 0.0, 0.0
        """How many, how long all of them and the last one took [s of the loop]."""

    @property
    def broken(self) -> str:
        """Why nothing is acknowledged any more; empty while all is well."""
        return self._file.broken

    @property
    def name(self) -> str:
        """Of its file."""
        return self._file.path.stem

    @property
    def failures(self) -> int:
        """Commits that failed."""
        return self._file.failures

    @property
    def alarms(self) -> list[str]:
        """What was found damaged on disk."""
        return self._file.alarms

    @property
    def machine(self) -> M:
        """The newest state; the durable one again after a failure."""
        if self._failures != self._file.failures:
            self._failures = self._file.failures
            self._machine = self._revive(self.durable)
        return self._machine

    async def settle(self) -> None:
        """Returns when the state as it is now is durable; raises StorageError when it will not be."""
        machine = self.machine
        if not machine.dirty and self._saving == 0:
            return
        machine.dirty = False
        document: D = machine.document()
        self._saving += 1
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        try:
            await self._file.save(lambda: self._encode(document))
        finally:
            self._saving -= 1
            self.last_commit_s = loop.time() - began_s
            self.commits, self.commit_s = self.commits + 1, self.commit_s + self.last_commit_s
        self.durable = document

    async def change(self, event: Callable[[M], T]) -> T:
        """Run an event and wait until what it did is durable."""
        result = event(self.machine)
        await self.settle()
        return result

    def close(self) -> None:
        self._file.close()
