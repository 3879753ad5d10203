"""The robot's battery pack: charge by what is drawn and what the dock gives."""

from __future__ import annotations

from dataclasses import dataclass

from core.robots import gardener as g

CAPACITY_AH = g.PACK_WH / g.PACK_V
EMPTY_V, FULL_V = 17.4, 21.0
"""Rest voltage of a lithium-polymer pack, taken as linear in its charge; the mean is near the nominal 19.2 V."""
RESISTANCE_OHM = 0.12
FULL_RATIO = 0.998
TRICKLE_W = 1.0


@dataclass(slots=True)
class Pack:
    """`advance` it by what is used; read the rest."""

    charge_ah: float
    capacity_ah: float = CAPACITY_AH
    current_a: float = 0.0
    """Positive into the pack."""
    charging: bool = False

    @classmethod
    def at(cls, ratio: float) -> Pack:
        return cls(charge_ah=ratio * CAPACITY_AH)

    @property
    def ratio(self) -> float:
        return self.charge_ah / self.capacity_ah

    @property
    def empty(self) -> bool:
        return self.charge_ah <= 0.0

    @property
    def voltage_v(self) -> float:
        return EMPTY_V + (FULL_V - EMPTY_V) * self.ratio + RESISTANCE_OHM * self.current_a

    def advance(self, seconds: float, load_w: float, on_charger: bool) -> None:
        """A charger carries the load beside its charge; a full pack is held full by a trickle."""
        self.charging = on_charger
        power_w = -load_w
        if on_charger:
            power_w = g.CHARGE_W - load_w if self.ratio < FULL_RATIO else TRICKLE_W
        if self.empty and not on_charger:
            power_w = 0.0
        self.current_a = power_w / (EMPTY_V + (FULL_V - EMPTY_V) * self.ratio)
        charge_ah = self.charge_ah + self.current_a * seconds / 3600.0
        self.charge_ah = min(self.capacity_ah, max(0.0, charge_ah))
