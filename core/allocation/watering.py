"""Water: one dose at a time, settled by the soil. What of a plant's market only watering needs; pure, no tasks in here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from core.allocation import permits
from core.allocation.permits import Dose, OpenPermit
from core.allocation.plant_state import Limits, Soil
from core.errors import Refused
from core.wire.market import Permit

UNASKED_RISE = 0.03
"""A rise that is no noise and no change of the soil's own: 90 ml in three litres."""


@dataclass(frozen=True, slots=True)
class Measured:
    """An open permit, and the soil after it."""

    held: OpenPermit
    ratio: float

    @property
    def rise(self) -> float:
        return self.ratio - self.held.before_ratio

    @property
    def told(self) -> str:
        return f"soil went from {self.held.before_ratio:.3f} to {self.ratio:.3f}"

    @property
    def arrived(self) -> bool:
        return self.rise >= permits.rise_needed(self.held.permit.dose_ml)


@dataclass(slots=True)
class _Watch:
    """Looks for water that nobody had a permit for: while no dose is on its way, soil only dries."""

    since_s: float
    """Until then a dose may still soak in."""
    lowest: float = math.inf

    def see(self, ratio: float, stamp_s: float) -> str:
        """What rose without a dose, once; empty when nothing did."""
        if stamp_s < self.since_s:
            return ""
        before, self.lowest = self.lowest, min(self.lowest, ratio)
        if ratio - self.lowest < UNASKED_RISE:
            return ""
        self.lowest = ratio
        return f"soil went from {before:.3f} to {ratio:.3f} without a dose: a leak, or somebody watered by hand"

    def rest(self, until_s: float) -> None:
        self.since_s, self.lowest = until_s, math.inf


class Watering:
    """The soil as last measured, the day's doses, and the permit that is not settled yet; `at_s` is when that was."""

    def __init__(self, open_permit: OpenPermit | None, doses: Sequence[Dose], now_s: float, limits: Limits) -> None:
        self.limits = limits
        self.soil = Soil(None, "not measured yet", -math.inf)
        self.open, self.doses, self.at_s = open_permit, list(doses), now_s
        self.settle_at_s = math.inf
        self._watch = _Watch(math.inf if self.open is not None else now_s + limits.soak_s)

    def given_ml(self, now_s: float) -> float:
        return permits.given_ml(self.doses, now_s)

    def left_ml(self, now_s: float) -> float:
        return max(0.0, self.limits.day_cap_ml - self.given_ml(now_s))

    def check(self, now_s: float) -> None:
        """Raises Refused when a dose could not be verified, or the day's are given."""
        if self.soil.ratio is None:
            raise Refused(f"the soil probe is {self.soil.why}: a dose could not be verified", hint="mend the probe first")
        if why := self.spent(now_s):
            raise Refused(why, hint="wait, or raise day_cap_ml")

    def spent(self, now_s: float) -> str:
        """That the day's doses are given; empty while they are not."""
        return f"the day's {self.limits.day_cap_ml:.0f} ml are given" if self.left_ml(now_s) < permits.DOSE_ML_MIN else ""

    def issue(self, permit: Permit, robot_id: str, key: str, now_s: float) -> None:
        """The dose is debited before the permit leaves."""
        before = self.soil.ratio if self.soil.ratio is not None else 0.0
        self.open = OpenPermit(permit=permit, robot_id=robot_id, key=key, issued_s=now_s, before_ratio=before)
        self.settle_at_s, self.at_s = math.inf, now_s
        self._watch.rest(math.inf)
        dose = Dose(permit_id=permit.permit_id, t_s=self.open.act_over_s(), ml=permit.dose_ml)
        self.doses = [*permits.recent(self.doses, now_s), dose]

    def holds(self, task_id: str, robot_id: str, epoch: int) -> bool:
        held = self.open
        return held is not None and (held.permit.task_id, held.robot_id, held.permit.epoch) == (task_id, robot_id, epoch)

    def acted(self, delivered_ml: float | None, now_s: float) -> bool:
        """The holder says that its act is over: note what it gave and when to measure. False: known already."""
        held = self.open
        if held is None or held.finished:
            return False
        if delivered_ml is not None:
            self.doses = permits.corrected(self.doses, held.permit.permit_id, delivered_ml)
        self.open = held.model_copy(update={"finished": True, "delivered_ml": delivered_ml})
        # Whatever it says, nothing can begin after the permit's validity.
        self.settle_at_s = max(now_s, held.valid_until_s()) + self.limits.soak_s
        return True

    def expect_settling(self, task_id: str, now_s: float) -> None:
        """Nobody will tell about this permit's act: measure when it must be over and soaked in."""
        if self.open is None or self.open.permit.task_id != task_id or self.open.finished:
            return
        self.settle_at_s = max(now_s, self.open.act_over_s()) + self.limits.soak_s

    def revive(self, now_s: float, *, task_open: bool) -> None:
        """Read back from its document: when the open permit settles without anybody's word."""
        if self.open is not None and self.open.finished:
            self.settle_at_s = max(now_s, self.open.valid_until_s()) + self.limits.soak_s
        elif self.open is not None and not task_open:
            self.settle_at_s = max(now_s, self.open.act_over_s()) + self.limits.soak_s

    def unasked(self) -> str:
        """What the newest reading tells of water that no dose explains, once; empty when nothing."""
        return "" if self.soil.ratio is None else self._watch.see(self.soil.ratio, self.soil.stamp_s)

    def measured(self, soil: Soil, now_s: float) -> Measured | None:
        """A judged reading; settles the open permit when it was taken after the dose had soaked in."""
        self.soil, self.at_s = soil, now_s
        if self.open is None or soil.ratio is None or soil.stamp_s < self.settle_at_s:
            return None
        settled = Measured(self.open, soil.ratio)
        self.open, self.settle_at_s = None, math.inf
        self._watch.rest(now_s + self.limits.soak_s)
        return settled

    def waiting(self, now_s: float) -> str:
        """Why no other dose is given; empty when nothing is amiss."""
        if self.open is not None and now_s >= self.settle_at_s and self.soil.ratio is None:
            return f"cannot tell whether the last dose arrived: the soil probe is {self.soil.why}"
        if self.open is not None and now_s < self.settle_at_s < math.inf:
            return f"measuring again in {self.settle_at_s - now_s:.0f} s, when the last dose has soaked in"
        return ""
