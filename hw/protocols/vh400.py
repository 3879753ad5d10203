"""Vegetronix VH400 soil probe: volts to volumetric water content and back, and the ADC in front of it.

The maker's curve is piecewise linear; the last piece (2.2 to 3.0 V) is in the newer publication only. The curve tends
to over-read in real soil, so `Calibration` maps it to a given soil. Water content is a ratio 0..1 of volume.
"""

from __future__ import annotations

from dataclasses import dataclass

PROBE_V_MAX = 3.0
WARM_UP_S = 0.4

_PIECES = (
    # up to [V], VWC [%] per volt, VWC [%] at 0 V
    (1.1, 10.0, -1.0),
    (1.3, 25.0, -17.5),
    (1.82, 48.08, -47.5),
    (2.2, 26.32, -7.89),
    (3.0, 62.5, -87.5),
)


def ratio_of(volts: float) -> float:
    """Probe voltage [V] -> volumetric water content 0..1; clamped to the curve's ends (0.1 V and 3.0 V)."""
    volts = min(max(volts, 0.0), PROBE_V_MAX)
    for v_max, slope, offset in _PIECES:
        if volts <= v_max:
            return max(0.0, slope * volts + offset) / 100.0
    return 1.0


def volts_of(ratio: float) -> float:
    """Volumetric water content 0..1 -> probe voltage [V]; the inverse of `ratio_of` above its clamp."""
    percent = min(max(ratio, 0.0), 1.0) * 100.0
    for v_max, slope, offset in _PIECES:
        if percent <= slope * v_max + offset:
            return (percent - offset) / slope
    return PROBE_V_MAX


def code_of(volts: float, vref_v: float = 5.0, bits: int = 10) -> int:
    """Volts -> ADC code, clamped to 0 .. 2**bits - 1."""
    steps = 1 << bits
    return min(steps - 1, max(0, int(volts / vref_v * steps + 0.5)))


def code_volts(code: int, vref_v: float = 5.0, bits: int = 10) -> float:
    """ADC code -> volts."""
    return code * vref_v / (1 << bits)


@dataclass(frozen=True, slots=True)
class Calibration:
    """One soil's correction of the maker's curve: `ratio = gain * curve + offset`, clamped to 0..1."""

    gain: float = 1.0
    offset_ratio: float = 0.0

    def ratio_of(self, volts: float) -> float:
        """Probe voltage [V] -> water content of this soil, 0..1."""
        return min(1.0, max(0.0, self.gain * ratio_of(volts) + self.offset_ratio))

    @classmethod
    def through(cls, dry: tuple[float, float], wet: tuple[float, float]) -> Calibration:
        """From two weighed samples (volts, true ratio); raises ValueError when the curve cannot tell them apart."""
        low, high = ratio_of(dry[0]), ratio_of(wet[0])
        if high - low < 1e-6:
            raise ValueError("the wet sample must read more than the dry one")
        gain = (wet[1] - dry[1]) / (high - low)
        return cls(gain, dry[1] - gain * low)
