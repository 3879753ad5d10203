"""A bench for the SSC-32: servos that only remember, a relay, and a potentiometer on each of two inputs."""

from __future__ import annotations

import random

from sim.devices.ssc32 import Ssc32Emulator

BENCH_V = (2.0, 3.5, 0.0, 0.0)
"""On VA, VB, VC, VD."""


class BenchRig:
    """Fills `ServoRig`; what it was told last can be read."""

    def __init__(self, analog_v: tuple[float, ...] = BENCH_V) -> None:
        self.pulses_us: dict[int, float] = {}
        self.outputs: dict[int, bool] = {}
        self.volts = list(analog_v)

    def set_pulse(self, channel: int, pulse_us: float) -> None:
        self.pulses_us[channel] = pulse_us

    def set_output(self, channel: int, high: bool) -> None:
        self.outputs[channel] = high

    def analog_v(self, index: int) -> float:
        return self.volts[index]


def bench_emulator(seed: int) -> Ssc32Emulator:
    """An SSC-32U on the bench."""
    return Ssc32Emulator(BenchRig(), random.Random(seed))
