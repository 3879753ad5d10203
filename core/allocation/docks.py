"""Who stands where: docks belong to their plant or station, and are lent for a while. Pure; time is passed in.

Asking again renews. Who is refused is remembered for a while and is next in line; a holder that only rests (`yielding`)
learns from its renewal that somebody waits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from core.errors import Conflict, Forbidden, NotFound, Unprocessable
from core.wire.documents import Document, Identifier, Seconds
from core.wire.market import Reservation, ReservationRequest

WISH_S = 10.0
"""Whoever wants a dock asks again within this time, or is forgotten."""


class Loan(Document):
    """A dock lent to a robot."""

    dock_id: Identifier
    robot_id: str = ""
    epoch: int = 0
    for_s: Seconds = 0.0
    yielding: bool = False


class DocksDocument(Document):
    loans: list[Loan] = []


@dataclass(slots=True)
class _Dock:
    loan: Loan
    until_s: float = 0.0
    wishes: dict[str, float] = field(default_factory=dict)
    """Robot -> when it last asked, in order of first asking."""


class Docks:
    """The docks of one owner. After a restart every loan runs for its whole time again."""

    def __init__(self, owner: str, dock_ids: Sequence[str], document: DocksDocument | None, now_s: float) -> None:
        self._owner = owner
        known = {loan.dock_id: loan for loan in document.loans} if document else {}
        self._docks: dict[str, _Dock] = {}
        for dock_id in dock_ids:
            loan = known.get(dock_id, Loan(dock_id=dock_id))
            self._docks[dock_id] = _Dock(loan, now_s + loan.for_s if loan.robot_id else 0.0)
        self.dirty = False

    def document(self) -> DocksDocument:
        return DocksDocument(loans=[dock.loan for dock in self._docks.values()])

    def loan(self, dock_id: str, now_s: float) -> Loan:
        """The dock's loan; without a robot when it is free."""
        dock = self._find(dock_id)
        self._expire(dock, now_s)
        return dock.loan

    def wanted_by(self, dock_id: str, now_s: float) -> str:
        """Who waits for a dock, first in line; empty when nobody does."""
        return self._next(self._find(dock_id), now_s)

    def reserve(self, request: ReservationRequest, now_s: float) -> Reservation:
        """Grant or renew; raises Conflict naming the holder, or who comes first."""
        dock = self._find(request.dock_id)
        self._expire(dock, now_s)
        held = dock.loan.robot_id
        first = self._next(dock, now_s)
        if held not in ("", request.robot_id) or (not held and first not in ("", request.robot_id)):
            dock.wishes[request.robot_id] = now_s
            raise self._refusal(dock, held, first, now_s)
        dock.wishes.pop(request.robot_id, None)
        epoch = dock.loan.epoch if held else dock.loan.epoch + 1
        loan = Loan(
            dock_id=dock.loan.dock_id, robot_id=request.robot_id, epoch=epoch, for_s=request.for_s, yielding=request.yielding
        )
        self.dirty = self.dirty or loan != dock.loan
        dock.loan, dock.until_s = loan, now_s + request.for_s
        return self._reservation(dock, now_s)

    def release(self, reservation_id: str, robot_id: str) -> str:
        """Give a dock back and return its id; an empty `robot_id` is an operator's. Releasing an older loan does nothing."""
        for dock in self._docks.values():
            if not reservation_id.startswith(f"{self._owner}:{dock.loan.dock_id}:"):
                continue
            if self._id(dock.loan) != reservation_id or not dock.loan.robot_id:
                return ""
            if robot_id not in ("", dock.loan.robot_id):
                raise Forbidden(
                    f"{reservation_id} is {dock.loan.robot_id}'s", hint="only its holder or an operator releases it"
                )
            self._free(dock)
            return dock.loan.dock_id
        raise NotFound(f"{self._owner} gave no reservation {reservation_id}", hint=f"docks: {', '.join(self._docks)}")

    def _find(self, dock_id: str) -> _Dock:
        if not dock_id and len(self._docks) == 1:
            return next(iter(self._docks.values()))
        if (dock := self._docks.get(dock_id)) is not None:
            return dock
        hint = f"dock_id is one of: {', '.join(self._docks)}"
        if not dock_id:
            raise Unprocessable(f"{self._owner} has several docks", hint=hint)
        raise NotFound(f"{self._owner} has no dock {dock_id}", hint=hint)

    def _expire(self, dock: _Dock, now_s: float) -> None:
        if dock.loan.robot_id and now_s >= dock.until_s:
            self._free(dock)

    def _free(self, dock: _Dock) -> None:
        dock.loan = Loan(dock_id=dock.loan.dock_id, epoch=dock.loan.epoch)
        dock.until_s = 0.0
        self.dirty = True

    def _next(self, dock: _Dock, now_s: float) -> str:
        for robot_id, asked_s in list(dock.wishes.items()):
            if now_s - asked_s > WISH_S:
                del dock.wishes[robot_id]
        return next(iter(dock.wishes), "")

    def _refusal(self, dock: _Dock, held: str, first: str, now_s: float) -> Conflict:
        if held:
            left_s = dock.until_s - now_s
            how = (
                "it only rests there and will leave" if dock.loan.yielding else f"its reservation lasts {left_s:.0f} s more"
            )
            return Conflict(f"dock {dock.loan.dock_id} is held by {held}: {how}", hint="ask again in a second or two")
        return Conflict(f"dock {dock.loan.dock_id} is free, but {first} asked first", hint="ask again in a second or two")

    def _id(self, loan: Loan) -> str:
        return f"{self._owner}:{loan.dock_id}:{loan.epoch}"

    def _reservation(self, dock: _Dock, now_s: float) -> Reservation:
        loan = dock.loan
        return Reservation(
            reservation_id=self._id(loan), dock_id=loan.dock_id, robot_id=loan.robot_id, epoch=loan.epoch,
            valid_for_s=loan.for_s, wanted_by=self._next(dock, now_s),
        )  # fmt: skip
