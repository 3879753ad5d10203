"""A bench for the Firmata board: a soil probe in a drying pot on A0, a potentiometer on A1, a tap on any digital pin."""

from __future__ import annotations

import random

from hw.protocols.vh400 import volts_of
from sim.devices.firmata import FirmataEmulator

START_RATIO = 0.22
DRYING_PER_READ = 1e-6
POTENTIOMETER_V = 2.5
NOISE_V = 0.0025


class BenchPins:
    """Fills `BoardPins`; the pot dries a little with every look at it. What the digital pins were told can be read."""

    def __init__(self, rng: random.Random, ratio: float = START_RATIO) -> None:
        self._rng, self.ratio = rng, ratio
        self.levels: dict[int, bool] = {}

    def analog_v(self, pin: int) -> float:
        if pin == 0:
            self.ratio = max(0.0, self.ratio - DRYING_PER_READ)
            return volts_of(self.ratio) + self._rng.gauss(0.0, NOISE_V)
        return POTENTIOMETER_V if pin == 1 else 0.0

    def set_digital(self, pin: int, high: bool) -> None:
        self.levels[pin] = high


def bench_emulator(seed: int) -> FirmataEmulator:
    """An Arduino Uno with StandardFirmata on the bench."""
    rng = random.Random(seed)
    return FirmataEmulator(BenchPins(rng), rng)
