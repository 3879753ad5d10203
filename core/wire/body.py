"""What crosses the local stream between a robot's brain and its body: one JSON document a line.

msgspec's structures rather than pydantic's models: the stream runs at 50 Hz and both ends are the same robot. A field at its
default is left out of the line. `decode` refuses wrong types, unknown fields and non-finite numbers, since the body must
survive any brain.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Literal

import msgspec

from core.errors import Unprocessable

COMMAND_LIFE_S = 0.3
"""A setpoint not renewed within this many garden seconds is dead: everything stops."""


class _Line(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True, tag_field="t", gc=False):
    """What all messages have in common."""


class Hello(_Line, frozen=True, kw_only=True, tag="hello"):
    """First line from the brain: it proves that it is this robot's brain."""

    secret: str


class Setpoint(_Line, frozen=True, kw_only=True, tag="set"):
    """The whole of what the brain wants now. Whatever is not asked for stops."""

    seq: int
    base: Literal["stop", "drive", "seek_dock"] = "stop"
    v_mps: float = 0.0
    omega_radps: float = 0.0
    arm: tuple[float, float, float, float] | None = None
    """Joint goals [rad] in the order of `gardener.ARM_JOINTS`; None holds the arm where it is."""
    arm_s: float = 0.0
    """Seconds the group move should take, counted from when this goal first appeared."""
    gripper_m: float | None = None
    roll_rad: float | None = None
    """Turn of the fingers about the hand's axis, on a robot whose wrist rolls; None holds it."""
    pump: bool = False
    permit_id: str = ""
    """The plant's permit under which the pump runs."""
    dose_ml: float = 0.0
    """The most this permit may deliver: the body stops the pump there by itself."""


class Control(_Line, frozen=True, kw_only=True, tag="control"):
    """Rare orders: `stop` latches the e-stop, `resume` releases it, `rest` asks for slow readings."""

    order: Literal["stop", "resume", "rest", "wake"]
    by: str = ""
    stop_number: int = 0
    """Which stop `resume` releases: it does nothing to any other."""


class Marker(_Line, frozen=True, kw_only=True, tag=False, tag_field=None):
    """A ceiling-marker fix as the sensor gave it, in the marker's frame; `age_s` when this line was sent."""

    marker_id: int
    x_m: float
    y_m: float
    yaw_rad: float
    age_s: float
    count: int
    """Fixes since the body started: a new number is a new fix."""


class BodyState(_Line, frozen=True, kw_only=True, tag="state"):
    """One sample of everything the body knows. Times are the body's garden clock; `BodyLink` puts them into the brain's."""

    stamp_s: float
    left_m: float = 0.0
    right_m: float = 0.0
    odometry_epoch: int = 0
    """Grows when the base reconnected and the travel counters began anew; in a body that was started anew it begins anew."""
    bump_left: bool = False
    bump_right: bool = False
    wheel_drop: bool = False
    cliff: tuple[bool, bool, bool, bool] = (False, False, False, False)
    """Left, front left, front right, right."""
    wall: bool = False
    ir_red: bool = False
    ir_green: bool = False
    ir_field: bool = False
    contacts: bool = False
    """On a dock's contacts: they are under voltage."""
    docked: bool = False
    """On a dock's contacts with charge current flowing."""
    oi_mode: int = 0
    battery_ratio: float = 0.0
    battery_v: float = 0.0
    battery_a: float = 0.0
    tank_ml: float | None = None
    """None while the tank's sensor is silent."""
    force_n: float | None = None
    arm_rad: tuple[float, ...] | None = None
    """Where the servo board commands the arm now; None until each channel was driven once."""
    arm_moving: bool = False
    pump: bool = False
    pumped_ml: float = 0.0
    """Delivered under the current permit, by the pump's calibration and running time."""
    permit_id: str = ""
    marker: Marker | None = None
    marker_blind_s: float = 0.0
    """Seconds since the last fix."""
    stopped: bool = True
    """The e-stop is latched."""
    stopped_by: str = ""
    stop_kept: bool = True
    """That it is latched, or is not, is written down and survives a restart."""
    stop_number: int = 0
    """Names the stop that is latched and written down; 0 while there is none. No number comes twice."""
    refusal: str = ""
    """Why the gate refused the newest setpoint, or parts of it; empty when all was allowed."""
    down: tuple[str, ...] = ()
    """Devices whose link is down, each with its reason."""
    next_in_s: float = 0.5
    """The next state comes within so many seconds, if nothing happens before."""


Message = Hello | Setpoint | Control | BodyState
_ENCODER = msgspec.json.Encoder(enc_hook=float)  # of a numpy scalar
_DECODER: msgspec.json.Decoder[Message] = msgspec.json.Decoder(Message)


def encode(message: Message) -> bytes:
    """One line, newline included; raises ValueError for a number that is not finite."""
    line = _ENCODER.encode(message)
    # That is how such numbers are written; None is a default, and left out.
    if b"null" in line and not _finite(msgspec.to_builtins(message, enc_hook=float)):
        raise ValueError(f"a number is not finite: {message}")
    return line + b"\n"


def _finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(_finite(each) for each in value.values())
    if isinstance(value, (list, tuple)):
        return all(_finite(each) for each in value)
    return not isinstance(value, float) or isfinite(value)


def decode(line: bytes) -> Message:
    """Read one line; raises Unprocessable for anything that is not exactly a message."""
    try:
        return _DECODER.decode(line)
    except msgspec.DecodeError as error:
        raise Unprocessable(f"not a body message: {error}") from error


@dataclass(slots=True)
class LineBuffer:
    """Cuts a byte stream into lines; a line longer than `limit` is an error of the other side."""

    limit: int = 16 * 1024
    pending: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[bytes]:
        if not self.pending and data.endswith(b"\n"):
            return [line for line in data.split(b"\n") if line]
        self.pending += data
        if b"\n" not in self.pending and len(self.pending) > self.limit:
            self.pending.clear()
            raise Unprocessable("a line without end")
        *lines, rest = bytes(self.pending).split(b"\n")
        self.pending = bytearray(rest)
        return [line for line in lines if line]
