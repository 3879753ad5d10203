"""The harvest's ledger: a line for every fruit, who asked, who bid, who picked, when, with a picture before and after."""

from __future__ import annotations

import asyncio
import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from starlette.responses import Response

from core.clock import Clock
from core.errors import NotFound, StorageError, TooLarge, Unprocessable
from core.store import Disk
from core.wire.documents import Document
from core.wire.fruit import Fruit, LedgerLine, Pick, PickBid
from core.wire.market import Permit, Task
from plant_service.keeper import Keeper

LINES_MAX = 300
PICTURE_BYTES_MAX = 60_000
WRITE_COST_S = 0.002
When = Literal["before", "after"]
_LEFT_OUT = {"bids", "epoch"}
_COLUMNS = [name for name in LedgerLine.model_fields if name not in _LEFT_OUT]


class LedgerDocument(Document):
    lines: list[LedgerLine] = []


class Lines:
    """A machine for `Keeper`: the newest `LINES_MAX` lines, oldest first."""

    def __init__(self, document: LedgerDocument | None) -> None:
        self.lines = {line.line_id: line for line in document.lines} if document else {}
        self.dirty = False

    def document(self) -> LedgerDocument:
        return LedgerDocument.model_construct(lines=list(self.lines.values()))

    def write(self, *lines: LedgerLine) -> None:
        """New lines, or more about old ones; what an older line knew of pictures stays."""
        for line in lines:
            self._write(line)
        for old in list(self.lines)[:-LINES_MAX]:
            del self.lines[old]
        self.dirty = True

    def _write(self, line: LedgerLine) -> None:
        if (before := self.lines.get(line.line_id)) is not None:
            line = line.model_copy(update={"before": before.before, "after": before.after})
        self.lines[line.line_id] = line

    def change(self, line_id: str, **changes: object) -> None:
        if (line := self.lines.get(line_id)) is not None:
            self.lines[line_id] = line.model_copy(update=changes)
            self.dirty = True


def begun(task: Task, permit: Permit, fruit: Fruit | None, now_s: float) -> LedgerLine | None:
    """The line of a pick that was just permitted; None when nobody knows the fruit."""
    return None if fruit is None else _line(task, fruit, permit.permit_id, "permitted", permitted_s=now_s)


def ended(task: Task, pick: Pick, robot_id: str, fruit: Fruit | None, before: LedgerLine | None, now_s: float) -> LedgerLine:
    """The line of a pick whose end was told; of the line `before` it, or of the fruit as it was."""
    told = {
        "outcome": pick.outcome, "reason": pick.reason, "ended_s": now_s, "robot_id": robot_id,
    }  # fmt: skip
    line = before
    if line is None:
        assert fruit is not None
        line = _line(task, fruit, pick.permit_id or f"{task.task_id}:{pick.fruit_id}", pick.outcome)
    return line.model_copy(update=told)


def _line(task: Task, fruit: Fruit, line_id: str, outcome: str, permitted_s: float | None = None) -> LedgerLine:
    won = next((r for r in reversed(task.rounds) if r.winner == task.robot_id), None)
    bids = [PickBid(robot_id=b.robot_id, cost_s=b.cost_s, reason=b.reason) for b in won.bids] if won else []
    return LedgerLine.model_validate({
        **fruit.model_dump(include={"fruit_id", "colour", "radius_m", "x_m", "y_m", "z_m"}),
        "line_id": line_id[:80], "plant_id": task.plant_id, "task_id": task.task_id, "order_id": task.order_id,
        "asked_by": task.asked_by, "bids": bids, "robot_id": task.robot_id or "nobody", "epoch": task.epoch,
        "permitted_s": permitted_s, "outcome": outcome,
    })  # fmt: skip


def as_csv(lines: Sequence[LedgerLine]) -> str:
    """With a header line; bids are left out."""
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(_COLUMNS)
    writer.writerows([getattr(line, name) for name in _COLUMNS] for line in lines)
    return out.getvalue()


class Ledger:
    """The lines and their pictures, both on disk before they are acknowledged."""

    def __init__(self, keeper: Keeper[Lines, LedgerDocument], folder: Path, clock: Clock, disk: Disk | None = None) -> None:
        self._keeper, self._folder, self._clock, self._disk = keeper, folder, clock, disk or Disk()
        self._writing = asyncio.Lock()

    @property
    def broken(self) -> str:
        return self._keeper.broken

    def lines(self) -> list[LedgerLine]:
        """Oldest first."""
        durable = self._keeper.durable
        return list(durable.lines) if durable else []

    def line(self, line_id: str) -> LedgerLine | None:
        return self._keeper.machine.lines.get(line_id)

    async def write(self, *lines: LedgerLine) -> None:
        if lines:
            await self._keeper.change(lambda book: book.write(*lines))

    async def change(self, line_id: str, **changes: object) -> None:
        await self._keeper.change(lambda book: book.change(line_id, **changes))

    async def keep(self, line_id: str, when: When, jpeg: bytes, robot_id: str) -> None:
        """A picture of a pick, from the robot that picked; raises NotFound, Unprocessable, TooLarge, StorageError."""
        line = self.line(line_id)
        if line is None or (robot_id and line.robot_id != robot_id):
            raise NotFound(f"no pick {line_id} of {robot_id or 'anybody'} is in the ledger", hint="GET /ledger lists them")
        if len(jpeg) > PICTURE_BYTES_MAX:
            raise TooLarge(f"a picture of {len(jpeg)} bytes", hint=f"at most {PICTURE_BYTES_MAX}: send a smaller one")
        if not (jpeg.startswith(b"\xff\xd8\xff") and jpeg.endswith(b"\xff\xd9")):
            raise Unprocessable("that is not a JPEG", hint="send image/jpeg")
        async with self._writing:
            await self._clock.offload(lambda: self._store(self._path(line_id, when), jpeg), WRITE_COST_S)
        await self.change(line_id, **{when: f"/ledger/{line_id}/{when}.jpg"})

    async def picture(self, line_id: str, when: When) -> Response:
        """Raises NotFound."""
        line = self.line(line_id)
        if line is None or not getattr(line, when):
            raise NotFound(f"no picture {when} the pick {line_id}", hint="GET /ledger tells which there are")
        jpeg = await self._clock.offload(lambda: self._disk.read(self._path(line_id, when)), WRITE_COST_S)
        return Response(jpeg, media_type="image/jpeg")

    def close(self) -> None:
        self._keeper.close()

    def _path(self, line_id: str, when: When) -> Path:
        return self._folder / f"{line_id.replace(':', '_').replace('/', '_')}-{when}.jpg"

    def _store(self, path: Path, jpeg: bytes) -> None:
        """As any document: whole or not at all, and on disk when this returns. Pictures without a line are let go."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            new = path.with_suffix(".tmp")
            fd = self._disk.create(new)
            try:
                written = 0
                while written < len(jpeg):
                    written += self._disk.write(fd, jpeg[written:])
                self._disk.fsync(fd)
            finally:
                self._disk.close(fd)
            self._disk.rename(new, path)
            self._disk.fsync_dir(self._folder)
            kept = sorted(self._folder.glob("*.jpg"), key=lambda p: p.stat().st_mtime_ns)
            for old in kept[: -2 * LINES_MAX]:
                self._disk.unlink(old)
        except OSError as error:
            raise StorageError(f"the picture cannot be stored: {error}", hint="look at the disk") from error
