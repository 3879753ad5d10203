"""A bench for the StarGazer: the sensor circles slowly below one marker, and is blind on a small part of the way."""

from __future__ import annotations

import math
import random

from sim.devices.plants import MarkerSight
from sim.devices.stargazer import StargazerEmulator

MARKER_ID = 24706
RADIUS_CM = 80.0
LAP_S = 60.0
BLIND_RATIO = 0.1
HEIGHT_CM = 221.64
NOISE_CM, NOISE_DEG = 1.0, 0.5


class BenchCamera:
    """Fills `MarkerCamera`: a function of time, and noise from `rng`."""

    def __init__(self, rng: random.Random, blind_ratio: float = BLIND_RATIO) -> None:
        self._rng, self._blind_ratio = rng, blind_ratio

    def sight(self, now_s: float) -> MarkerSight | None:
        lap = now_s / LAP_S % 1.0
        if lap >= 1.0 - self._blind_ratio:
            return None
        bearing_rad = lap * math.tau
        return MarkerSight(
            marker_id=MARKER_ID,
            theta_deg=-math.degrees(bearing_rad) - 90.0 + self._rng.gauss(0.0, NOISE_DEG),
            x_cm=RADIUS_CM * math.cos(bearing_rad) + self._rng.gauss(0.0, NOISE_CM),
            y_cm=RADIUS_CM * math.sin(bearing_rad) + self._rng.gauss(0.0, NOISE_CM),
            z_cm=HEIGHT_CM,
        )


def bench_emulator(seed: int) -> StargazerEmulator:
    """A single-id StarGazer on the bench, at 2 Hz."""
    rng = random.Random(seed)
    return StargazerEmulator(BenchCamera(rng), rng)
