"""What the services see of hardware: one Protocol a device, filled by `hw/drivers` over bytes and by soak bodies without.

Every driver owns `run()`, a loop that connects, talks and reconnects with backoff for ever; `link` tells how it stands.
A reading carries the garden time it was taken at; nobody may use one without looking at its age.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from core.soil import ProbeState as ProbeState


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatus:
    """How a driver's wire stands. `why` is a sentence for people."""

    up: bool
    why: str
    since_s: float


class ChargingState(Enum):
    """Packet 21 of the Open Interface."""

    NOT_CHARGING = 0
    RECONDITIONING = 1
    FULL_CHARGING = 2
    TRICKLE = 3
    WAITING = 4
    FAULT = 5


_CHARGES = (ChargingState.RECONDITIONING, ChargingState.FULL_CHARGING, ChargingState.TRICKLE)


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseReading:
    """One sample of a Create base. Travel is cumulative since the driver connected, as the wheels' encoders saw it."""

    stamp_s: float
    left_m: float
    right_m: float
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
    virtual_wall: bool = False
    ir_red: bool = False
    ir_green: bool = False
    ir_field: bool = False
    oi_mode: int = 0
    charging: ChargingState = ChargingState.NOT_CHARGING
    home_base: bool = False
    voltage_v: float = 0.0
    current_a: float = 0.0
    """Negative while discharging."""
    charge_ah: float = 0.0
    capacity_ah: float = 0.0
    battery_temperature_c: float = 0.0

    @property
    def battery_ratio(self) -> float:
        return self.charge_ah / self.capacity_ah if self.capacity_ah > 0 else 0.0

    @property
    def mated(self) -> bool:
        """On a dock with charge current flowing, which is the only proof of docking."""
        return self.home_base and self.current_a > 0.0 and self.charging in _CHARGES


class Base(Protocol):
    """A differential-drive base. A setpoint holds until replaced: the body's gate must stop it."""

    @property
    def link(self) -> LinkStatus: ...

    @property
    def reading(self) -> BaseReading | None: ...

    def drive(self, v_mps: float, omega_radps: float) -> None:
        """Forward speed [m/s] and yaw rate [rad/s, counter-clockwise positive]."""
        ...

    def seek_dock(self) -> None:
        """The base's own docking (opcode 143): it drives itself until `drive` or `stop` takes over."""
        ...

    def stop(self) -> None: ...

    def rest(self, resting: bool) -> None:
        """Ask for slow readings (1 Hz) while nothing moves, or the full rate again."""
        ...

    async def run(self) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoReading:
    """One sample of the servo board. Pulses are what the board commands now; it has no position feedback."""

    stamp_s: float
    pulses_us: dict[int, float] = field(default_factory=dict)
    moving: bool = False
    analog_v: tuple[float, ...] = ()
    """VA, VB and so on [V], as many as the driver was told to read; empty until they have settled."""


class ServoBoard(Protocol):
    """An SSC-32: open-loop servos, discrete outputs, four analog inputs."""

    @property
    def link(self) -> LinkStatus: ...

    @property
    def reading(self) -> ServoReading | None: ...

    def move(self, pulses_us: dict[int, float], duration_s: float) -> None:
        """Group move: all channels arrive together after `duration_s`. A channel's first move after power-up jumps."""
        ...

    def output(self, channel: int, high: bool) -> None:
        """Discrete output, 5 V or 0 V (the pump relay)."""
        ...

    def stop(self) -> None:
        """STOP every channel that was ever moved and set every output low."""
        ...

    def rest(self, resting: bool) -> None: ...

    async def run(self) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkerFix:
    """One StarGazer fix: the sensor's pose in the frame of one ceiling marker. `marker_id` None means dead zone."""

    stamp_s: float
    marker_id: int | None
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    height_m: float = 0.0


class Localizer(Protocol):
    """A ceiling-marker localizer (Hagisonic StarGazer)."""

    @property
    def link(self) -> LinkStatus: ...

    @property
    def fix(self) -> MarkerFix | None: ...

    def rest(self, resting: bool) -> None: ...

    async def run(self) -> None: ...


class SoilProbe(Protocol):
    """An analog soil probe behind some converter."""

    @property
    def link(self) -> LinkStatus: ...

    async def sample(self, count: int) -> tuple[float, ...]:
        """`count` fresh probe voltages [V]; raises DriverTimeout or LinkDown when the probe is silent."""
        ...

    async def run(self) -> None: ...


class Valve(Protocol):
    """A tap: closed unless told otherwise, and closed again by the driver after `for_s`."""

    @property
    def link(self) -> LinkStatus: ...

    async def open_for(self, for_s: float) -> None: ...

    async def shut(self) -> None: ...

    async def run(self) -> None: ...
