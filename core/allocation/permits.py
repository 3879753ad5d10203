"""Permits and doses: one irreversible act at a time, and so many millilitres a day.

A permit is one shot. Until the plant has measured again, after the permit's validity, the longest act and the soak, or
after the robot said that it finished and the soak, no other is given: a lost report cannot become a second dose.
A dose is debited when the permit is given and corrected when the robot tells what it delivered.
"""

from __future__ import annotations

from collections.abc import Sequence

from core.wire.documents import Document, Identifier, Millilitres, Ratio, Seconds
from core.wire.market import Permit

DAY_S = 86400.0
PERMIT_VALID_S = 15.0
FLOW_MLPS_MIN = 5.0
"""The slowest pump we reckon with: a dose is over after dose / this."""
ACT_EXTRA_S = 5.0
DOSE_ML_MIN = 30.0
"""With less of the day's cap left none is given: its rise could not be told from the probe's noise."""


class OpenPermit(Document):
    """A permit given and not yet settled by a measurement."""

    permit: Permit
    robot_id: Identifier
    key: str = ""
    """The request's Idempotency-Key: the same question gets the same permit."""
    issued_s: float
    before_ratio: Ratio
    """The soil's water content when the permit was given."""
    finished: bool = False
    """The robot said that its act is over."""
    delivered_ml: Millilitres | None = None

    def valid_until_s(self) -> float:
        """After this no act may begin [garden s]."""
        return self.issued_s + self.permit.valid_for_s

    def act_over_s(self) -> float:
        """When the act is over at the latest [garden s]."""
        return self.valid_until_s() + longest_act_s(self.permit.dose_ml)

    def again(self, now_s: float) -> Permit:
        """The same permit for a repeated request; its validity still counts from the first."""
        left_s = max(0.0, self.permit.valid_for_s - max(0.0, now_s - self.issued_s))
        return self.permit.model_copy(update={"valid_for_s": left_s})


class Dose(Document):
    permit_id: Identifier
    t_s: float
    """When it has flowed at the latest [garden s]."""
    ml: Millilitres


def longest_act_s(dose_ml: float) -> Seconds:
    """The longest a dose may take once begun."""
    return dose_ml / FLOW_MLPS_MIN + ACT_EXTRA_S


def rise_needed(dose_ml: float) -> float:
    """The rise of the water content that counts as watered: well below a dose's effect in 3 l, above the noise."""
    return min(0.01, max(0.004, 0.2 * dose_ml / 3000.0))


def given_ml(doses: Sequence[Dose], now_s: float) -> float:
    """Millilitres of the past 24 hours."""
    return sum(dose.ml for dose in doses if dose.t_s > now_s - DAY_S)


def recent(doses: Sequence[Dose], now_s: float) -> list[Dose]:
    """Doses that still count."""
    return [dose for dose in doses if dose.t_s > now_s - DAY_S]


def revived(doses: Sequence[Dose], at_s: float | None, now_s: float) -> list[Dose]:
    """The doses of a document of `at_s`, by a clock that may not be the one of now: as old as they were then.

    How long the plant was off nobody can say for sure, so that time does not count. `at_s` None: not known; then a dose
    from the future counts from now.
    """
    if at_s is None:
        return [d.model_copy(update={"t_s": min(d.t_s, now_s)}) for d in recent(doses, now_s)]
    return [d.model_copy(update={"t_s": d.t_s - at_s + now_s}) for d in recent(doses, at_s)]


def corrected(doses: Sequence[Dose], permit_id: str, delivered_ml: float) -> list[Dose]:
    """The doses with one's amount replaced by what was delivered."""
    return [d.model_copy(update={"ml": delivered_ml}) if d.permit_id == permit_id else d for d in doses]
