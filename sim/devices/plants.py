"""Where an emulator's firmware meets physics.

An emulator (`sim/devices/*.py`) is bytes in, bytes out and a step: no I/O, no clock of its own. What it feels and moves is
one of the small Protocols below; the MuJoCo world fills them, and so do the bench stand-ins that tests and
`garden emulate` use.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Emulator(Protocol):
    """One device's firmware. Time is garden seconds and never goes back."""

    def receive(self, data: bytes, now_s: float) -> None:
        """Bytes from the host. May be a fragment of a command, or several."""
        ...

    def step(self, now_s: float) -> None:
        """Let the firmware run up to `now_s`: timers, streams, closed loops."""
        ...

    def transmit(self) -> bytes:
        """The bytes waiting for the host; empties the buffer."""
        ...

    def due_s(self) -> float:
        """When the firmware next wants a step by itself; math.inf if never."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class CreateSense:
    """What a Create's sensors feel at one instant."""

    bump_left: bool = False
    bump_right: bool = False
    drop_left: bool = False
    drop_right: bool = False
    drop_caster: bool = False
    wall: bool = False
    cliff_left: bool = False
    cliff_front_left: bool = False
    cliff_front_right: bool = False
    cliff_right: bool = False
    ir_red: bool = False
    ir_green: bool = False
    ir_field: bool = False
    contacts: bool = False
    """The home base's contacts touch ours (geometry only: whether charge flows is the pack's affair)."""
    charging: bool = False
    """Charge current flows into the pack."""
    voltage_v: float = 19.2
    current_a: float = 0.0
    charge_ah: float = 6.77
    capacity_ah: float = 6.77
    temperature_c: float = 25.0
    left_m: float = 0.0
    right_m: float = 0.0
    """Cumulative wheel travel by the encoders, slip unseen [m]."""


class CreateBody(Protocol):
    """The Create's wheels and senses."""

    def sense(self) -> CreateSense: ...

    def set_wheels(self, left_mps: float, right_mps: float) -> None:
        """Rim speed setpoints [m/s]; they hold until replaced."""
        ...


class ServoRig(Protocol):
    """What hangs on an SSC-32: servos, relays, analog sources."""

    def set_pulse(self, channel: int, pulse_us: float) -> None: ...

    def set_output(self, channel: int, high: bool) -> None: ...

    def analog_v(self, index: int) -> float:
        """Volts on input VA (0) .. VD (3)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkerSight:
    """The StarGazer's raw view of a marker: theta clockwise-positive, x right and y forward of the marker, in cm."""

    marker_id: int
    theta_deg: float
    x_cm: float
    y_cm: float
    z_cm: float


class MarkerCamera(Protocol):
    def sight(self, now_s: float) -> MarkerSight | None:
        """The nearest marker in view with the sensor's noise, or None (dead zone)."""
        ...


class BoardPins(Protocol):
    """What hangs on an Arduino's pins: a soil probe, a tap's valve."""

    def analog_v(self, pin: int) -> float: ...

    def set_digital(self, pin: int, high: bool) -> None: ...
