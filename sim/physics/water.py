"""Water: from the tap into tanks, from tanks through pumps and nozzles to where it falls."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from core.robots import gardener as g

TAP_MLPS = 50.0
TAP_PIN = 8


class PumpFault(Enum):
    """What may be wrong with a pump."""

    OK = "ok"
    STUCK_OFF = "stuck_off"
    STUCK_ON = "stuck_on"


@dataclass(slots=True)
class Tank:
    level_ml: float
    flow: float = 1.0
    """This pump's flow as a factor on the nominal."""
    switched_on: bool = False
    fault: PumpFault = PumpFault.OK

    def running(self, powered: bool) -> bool:
        """Does water leave the nozzle now?"""
        asked = self.switched_on if self.fault is PumpFault.OK else self.fault is PumpFault.STUCK_ON
        return powered and asked and self.level_ml > 0.0

    def pump(self, seconds: float) -> float:
        """Takes what the pump moves in `seconds` out of the tank [ml]."""
        drawn_ml = min(self.level_ml, g.PUMP_MLPS * self.flow * seconds)
        self.level_ml -= drawn_ml
        return drawn_ml

    def fill(self, offered_ml: float) -> float:
        """Takes in what fits and returns what runs over [ml]."""
        taken_ml = min(offered_ml, g.TANK_ML - self.level_ml)
        self.level_ml += taken_ml
        return offered_ml - taken_ml


def lands_in(nozzle: tuple[float, float, float], pots: dict[str, tuple[float, float]]) -> str | None:
    """The pot whose soil lies below the nozzle, or None: a thin jet falls straight down."""
    x_m, y_m, z_m = nozzle
    for name, (px, py) in pots.items():
        if z_m > g.SOIL_HEIGHT_M and (x_m - px) ** 2 + (y_m - py) ** 2 <= g.SOIL_RADIUS_M**2:
            return name
    return None
