"""What differs from one robot to the next though the same parts list built both: drawn once, by the seed."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

WHEEL_SCALE_SIGMA = 0.004
"""Wheels are worn and pressed into the turf unequally."""
TRACK_SCALE_SIGMA = 0.006
PUMP_SCALE_SIGMA = 0.015


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """Factors on the nominal numbers of `core.robots.gardener`."""

    wheel_left: float
    wheel_right: float
    track: float
    pump: float


def generator(seed: int, purpose: str) -> np.random.Generator:
    """An independent stream of chance for every purpose; the same for the same seed, whatever the other purposes do."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])


def traits_of(robot_id: str, seed: int) -> Traits:
    rng = generator(seed, f"traits/{robot_id}")

    def scale(sigma: float) -> float:
        return 1.0 + float(np.clip(rng.normal(0.0, sigma), -2 * sigma, 2 * sigma))

    return Traits(
        wheel_left=scale(WHEEL_SCALE_SIGMA),
        wheel_right=scale(WHEEL_SCALE_SIGMA),
        track=scale(TRACK_SCALE_SIGMA),
        pump=scale(PUMP_SCALE_SIGMA),
    )
