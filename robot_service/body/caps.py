"""What must survive a restart: how much water was let out under which permit, and whether somebody pressed stop.

A dose is written off in full BEFORE the pump starts. A permit found written off at start is spent for ever: nobody knows
how much of it flowed. All methods but `load` and `debit` only look at memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from core.clock import Clock
from core.errors import StorageError
from core.store import Disk, DurableDocument

HOUR_S, DAY_S = 3600.0, 86400.0
DOSES_SCHEMA, STOP_SCHEMA = "body-doses/1", "body-stop/1"


class Caps(BaseModel):
    """The most water a robot lets out, whatever anybody asks [ml]."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    command_ml: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] = 500.0
    hour_ml: Annotated[float, Field(gt=0, le=1e5, allow_inf_nan=False)] = 6000.0
    day_ml: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] = 20000.0


class _Debit(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    at_s: Annotated[float, Field(allow_inf_nan=False)]
    dose_ml: Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Doses(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    spent: list[str]
    recent: list[_Debit]


class _Stop(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    stopped: bool
    by: str
    number: Annotated[int, Field(ge=0)] = 0


class Ledger:
    """The doses written off."""

    def __init__(self, folder: Path, caps: Caps, clock: Clock, disk: Disk | None = None) -> None:
        self._document = DurableDocument(folder / "doses.json", DOSES_SCHEMA, clock, disk)
        self._caps, self._clock = caps, clock
        self._spent: dict[str, float] = {}
        self._recent: list[_Debit] = []

    def load(self) -> None:
        """Read what was written; raises StorageError rather than start with less than was."""
        if (document := self._document.load()) is None:
            return
        try:
            doses = _Doses.model_validate(document)
        except ValidationError as error:
            raise StorageError(f"{self._document.path} is not a list of doses: {error}") from error
        self._spent = dict.fromkeys(doses.spent, 0.0)
        # The clock of before may not be this one, and how long the body was off nobody can say for sure: that time does
        # not count. Every dose is as old as it was when the last one was written.
        newest_s = max((d.at_s for d in doses.recent), default=0.0)
        shift_s = self._clock.now() - newest_s
        self._recent = [_Debit(at_s=d.at_s + shift_s, dose_ml=d.dose_ml) for d in doses.recent]

    def close(self) -> None:
        self._document.close()

    def spent(self, permit_id: str) -> bool:
        """True when this permit was ever written off."""
        return permit_id in self._spent

    def debited_since_ml(self, since_s: float) -> float:
        return math.fsum(d.dose_ml for d in self._recent if d.at_s > since_s)

    def refusal(self, dose_ml: float) -> str:
        """Why the caps forbid one more dose now; empty when they do not."""
        now_s, caps = self._clock.now(), self._caps
        if self._document.broken:
            return "doses cannot be written down any more"
        if dose_ml > caps.command_ml:
            return f"a dose of {dose_ml:g} ml is above the cap of {caps.command_ml:g} ml"
        if self.debited_since_ml(now_s - HOUR_S) + dose_ml > caps.hour_ml:
            return f"the cap of {caps.hour_ml:g} ml an hour is reached"
        if self.debited_since_ml(now_s - DAY_S) + dose_ml > caps.day_ml:
            return f"the cap of {caps.day_ml:g} ml a day is reached"
        return ""

    async def debit(self, permit_id: str, dose_ml: float) -> None:
        """Write the dose off; durable when this returns. Raises StorageError, and then nothing may be pumped."""
        if self.spent(permit_id):
            raise StorageError(f"the permit {permit_id} is spent already")
        now_s = self._clock.now()
        self._spent[permit_id] = dose_ml
        self._recent = [d for d in self._recent if d.at_s > now_s - DAY_S] + [_Debit(at_s=now_s, dose_ml=dose_ml)]
        await self._document.save(self._document_now())

    def _document_now(self) -> Mapping[str, Any]:
        return {"spent": list(self._spent), "recent": [d.model_dump() for d in self._recent]}


class StopLatch:
    """The e-stop. It latches at once; that it did is durable a moment later. It is released only when that is durable.

    Every press takes the next number, and a release names the press it means: a word of yesterday, said again, does not
    release what somebody pressed today.
    """

    def __init__(self, folder: Path, clock: Clock, disk: Disk | None = None) -> None:
        self._document = DurableDocument(folder / "stop.json", STOP_SCHEMA, clock, disk)
        self._number = 0
        self.stopped = True
        self.by = "not started yet"
        self.kept = False
        """As it stands it is written down."""

    def load(self) -> None:
        """Stand as before the restart; raises StorageError when that cannot be known."""
        document = self._document.load()
        try:
            stop = _Stop(stopped=False, by="") if document is None else _Stop.model_validate(document)
        except ValidationError as error:
            raise StorageError(f"{self._document.path} is no stop latch: {error}") from error
        self.stopped, self.by, self.kept = stop.stopped, stop.by, True
        self._number = max(stop.number, int(stop.stopped))

    @property
    def number(self) -> int:
        """Of the press that is latched and written down; 0 while there is none.

        A number that a crash could take back is not told: nobody may ever hear of two presses by one name.
        """
        return self._number if self.stopped and self.kept else 0

    @property
    def unwritten(self) -> bool:
        """It is latched, no disk knows, and one may yet: a disk was full or failed once, or an order was lost."""
        return self.stopped and not self.kept and not self._document.broken

    def close(self) -> None:
        self._document.close()

    def press(self, by: str) -> None:
        """Stop now, whatever happens to the disk. Pressed again it is another stop."""
        self._number += 1
        self.stopped, self.by, self.kept = True, by or "somebody", False

    async def keep(self) -> None:
        """Write down that it is latched. Raises StorageError; then it stands, and would not survive a restart."""
        number = self._number
        await self._document.save({"stopped": True, "by": self.by, "number": number})
        self.kept = self.stopped and number == self._number

    async def release(self, number: int) -> bool:
        """False, and nothing changes, when `number` is not the stop that is latched.

        Raises StorageError and stays latched when it cannot be made durable.
        """
        if not self.stopped or number != self._number:
            return False
        await self._document.save({"stopped": False, "by": "", "number": number})
        if number != self._number:
            return False
        self.stopped, self.by, self.kept = False, "", True
        return True
