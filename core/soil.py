"""What a soil reading is worth: the voltages of one sampling -> a probe state and, only when it is good, a water content.

`judge` is pure: the caller keeps the readings of the past (`remember`) and hands them in. The rules, first match wins:

- SHORT: the median sits at the converter's reference.
- OUT_OF_RANGE: above what the probe can give, below the reference; or not a number.
- OPEN: the input floats. Without a probe it lies near 0 V, or wanders: the samples of one reading spread widely.
- STUCK: `stuck_readings` readings in a row (ten minutes at one in 10 s) in which not one sample differed. A living probe
  shows some millivolts of noise, about half a step of a 10-bit converter: one reading without any spread is ordinary,
  sixty identical ones are not.
- GOOD otherwise.

Without new samples the last reading stands until it is `stale_s` old: then STALE. DOWN when there never was one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from statistics import median


class ProbeState(Enum):
    """What a soil reading is worth. Only GOOD is a measurement."""

    GOOD = "good"
    STALE = "stale"
    STUCK = "stuck"
    OUT_OF_RANGE = "out_of_range"
    OPEN = "open"
    SHORT = "short"
    DOWN = "down"


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Of one probe and its converter. `ratio_of` is its curve: volts -> volumetric water content 0..1."""

    ratio_of: Callable[[float], float]
    vref_v: float = 5.0
    probe_v_max: float = 3.1
    """The VH400 ends at 3.0 V; a tenth for tolerances."""
    open_v_max: float = 0.05
    """Below, no probe: in dry soil a VH400 gives more, and its curve begins at 0.1 V."""
    spread_v_max: float = 0.25
    short_ratio: float = 0.99
    """Of the reference."""
    stuck_readings: int = 60
    stale_s: float = 60.0


@dataclass(frozen=True, slots=True)
class Reading:
    """One sampling: when it was begun [garden s] and its voltages [V]."""

    stamp_s: float
    samples_v: tuple[float, ...]


def remember(history: Sequence[Reading], samples_v: Sequence[float], stamp_s: float, limits: Limits) -> tuple[Reading, ...]:
    """The history with a new reading, no longer than `judge` needs; an empty sampling changes nothing."""
    if not samples_v:
        return tuple(history)
    return (*history, Reading(stamp_s, tuple(samples_v)))[-limits.stuck_readings :]


def judge(
    samples_v: Sequence[float], history: Sequence[Reading], now_s: float, limits: Limits
) -> tuple[ProbeState, float | None]:
    """The state of the probe, and the water content 0..1 when GOOD.

    `samples_v` are this sampling's voltages, empty when it failed; `history` the readings before it, oldest first.
    """
    if samples_v:
        return _judge_reading(samples_v, history, limits)
    if not history:
        return ProbeState.DOWN, None
    last = history[-1]
    if now_s - last.stamp_s > limits.stale_s:
        return ProbeState.STALE, None
    return _judge_reading(last.samples_v, history[:-1], limits)


def _judge_reading(
    samples_v: Sequence[float], history: Sequence[Reading], limits: Limits
) -> tuple[ProbeState, float | None]:
    if not all(math.isfinite(sample) for sample in samples_v):
        return ProbeState.OUT_OF_RANGE, None
    volts = median(samples_v)
    if volts >= limits.short_ratio * limits.vref_v:
        return ProbeState.SHORT, None
    if volts > limits.probe_v_max:
        return ProbeState.OUT_OF_RANGE, None
    if volts < limits.open_v_max or max(samples_v) - min(samples_v) > limits.spread_v_max:
        return ProbeState.OPEN, None
    if _is_stuck(samples_v, history, limits.stuck_readings):
        return ProbeState.STUCK, None
    return ProbeState.GOOD, limits.ratio_of(volts)


def _is_stuck(samples_v: Sequence[float], history: Sequence[Reading], readings: int) -> bool:
    """Whether the last `readings` readings, this one included, hold one and the same sample throughout."""
    first = samples_v[0]
    past = history[max(0, len(history) - readings + 1) :] if readings > 1 else ()
    if len(past) < readings - 1 or any(sample != first for sample in samples_v):
        return False
    return all(sample == first for reading in reversed(past) for sample in reading.samples_v)
