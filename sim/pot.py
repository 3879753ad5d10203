"""One simulated pot (soil, probe) and the station's board (tap). Both fill `BoardPins`."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from core.scenario import Plant
from hw.protocols.vh400 import volts_of
from sim.physics.pose import Planar
from sim.physics.water import TAP_PIN
from sim.soil import Soil

PROBE_PIN = 0
PROBE_NOISE_V = 0.0025
"""Half a step of a 10-bit converter, which adds none: a living probe flickers, a stuck one does not."""
GROWN_M = 0.9
"""A plant this tall gives off the climate's `litres_per_day`; others in proportion."""
OPEN_V = 0.0
"""A broken wire: the board's pull-down wins. Even bone-dry soil reads 0.1 V."""
SHORT_V = 5.0
"""The signal wire touches the supply; the probe itself cannot give more than 3 V."""


class ProbeFault(Enum):
    """What may be wrong with a soil probe."""

    OK = "ok"
    STUCK = "stuck"
    OPEN = "open"
    SHORT = "short"


class Pot:
    def __init__(self, plant: Plant, litres_per_day: float, rng: np.random.Generator) -> None:
        self.id = plant.id
        self.plant = plant
        self.stem = Planar(plant.x_m, plant.y_m, math.radians(plant.dock_yaw_deg))
        self.soil = Soil.of(plant.soil_litres, plant.moisture_ratio, litres_per_day * plant.height_m / GROWN_M)
        self.rng = rng
        self.probe_fault = ProbeFault.OK
        self.stuck_v: float | None = None

    @property
    def thirst(self) -> float:
        """0: it drinks all it wants; 1: it wilts."""
        return 1.0 - self.soil.supply

    @property
    def place(self) -> tuple[float, float]:
        return self.plant.x_m, self.plant.y_m

    def analog_v(self, pin: int) -> float:
        """Pin 0: the probe [V]; the others hang on nothing."""
        if pin != PROBE_PIN:
            return 0.0
        fixed_v = {ProbeFault.OPEN: OPEN_V, ProbeFault.SHORT: SHORT_V}.get(self.probe_fault)
        if fixed_v is not None:
            return fixed_v
        if self.probe_fault is not ProbeFault.STUCK:
            self.stuck_v = None
        elif self.stuck_v is not None:
            return self.stuck_v
        volts = volts_of(self.soil.probe_ratio) + float(self.rng.normal(0.0, PROBE_NOISE_V))
        self.stuck_v = volts if self.probe_fault is ProbeFault.STUCK else None
        return volts

    def set_digital(self, pin: int, high: bool) -> None:
        """Nothing hangs on a pot's outputs."""


class TapBoard:
    """Digital pin 8 opens the valve of the first tap; further taps follow on 9, 10 ..."""

    def __init__(self, taps: tuple[str, ...]) -> None:
        self.taps = taps
        self.open: set[str] = set()

    def analog_v(self, pin: int) -> float:
        return 0.0

    def set_digital(self, pin: int, high: bool) -> None:
        if not TAP_PIN <= pin < TAP_PIN + len(self.taps):
            return
        tap = self.taps[pin - TAP_PIN]
        if high:
            self.open.add(tap)
        else:
            self.open.discard(tap)
