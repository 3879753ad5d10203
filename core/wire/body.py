"""What crosses the local stream between a robot's brain and its body: one JSON document a line.

Plain dataclasses rather than pydantic: the stream runs at 50 Hz and both ends are the same robot. `decode` still refuses
wrong types, unknown fields and non-finite numbers, since the body must survive any brain.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, TypeVar

from core.errors import Unprocessable

COMMAND_LIFE_S = 0.3
"""A setpoint not renewed within this many garden seconds is dead: everything stops."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """First line from the brain: it proves that it is this robot's brain."""

    secret: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Setpoint:
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
    pump: bool = False
    permit_id: str = ""
    """The plant's permit under which the pump runs."""
    dose_ml: float = 0.0
    """The most this permit may deliver: the body stops the pump there by itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """Rare orders: `stop` latches the e-stop, `resume` releases it, `rest` asks for slow readings."""

    order: Literal["stop", "resume", "rest", "wake"]
    by: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Marker:
    """A ceiling-marker fix as the sensor gave it, in the marker's frame; `age_s` when this line was sent."""

    marker_id: int
    x_m: float
    y_m: float
    yaw_rad: float
    age_s: float
    count: int
    """Fixes since the body started: a new number is a new fix."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyState:
    """One sample of everything the body knows. Times are the body's garden clock."""

    stamp_s: float
    left_m: float = 0.0
    right_m: float = 0.0
    odometry_epoch: int = 0
    """Grows when the base reconnected and the travel counters began anew."""
    bump_left: bool = False
    bump_right: bool = False
    wheel_drop: bool = False
    cliff: tuple[bool, bool, bool, bool] = (False, False, False, False)
    """Left, front left, front right, right."""
    wall: bool = False
    ir_red: bool = False
    ir_green: bool = False
    ir_field: bool = False
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
    refusal: str = ""
    """Why the gate refused the newest setpoint, or parts of it; empty when all was allowed."""
    down: tuple[str, ...] = ()
    """Devices whose link is down, each with its reason."""


Message = Hello | Setpoint | Control | BodyState
_KINDS: dict[str, type[Message]] = {"hello": Hello, "set": Setpoint, "control": Control, "state": BodyState}
_NAMES = {cls: name for name, cls in _KINDS.items()}
_ORDER = {cls: tuple(f.name for f in fields(cls)) for cls in _NAMES}
_FIELDS = {cls: frozenset(names) for cls, names in _ORDER.items()}
_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False)
M = TypeVar("M")


def encode(message: Message) -> bytes:
    """One line, newline included."""
    cls = type(message)
    document: dict[str, Any] = {"t": _NAMES[cls]}
    for name in _ORDER[cls]:
        value = getattr(message, name)
        document[name] = asdict(value) if isinstance(value, Marker) else value
    return _ENCODER.encode(document).encode() + b"\n"


def decode(line: bytes) -> Message:
    """Read one line; raises Unprocessable for anything that is not exactly a message."""
    try:
        document = json.loads(line, parse_constant=_refuse_constant)
    except ValueError as error:
        raise Unprocessable(f"not a body message: {error}") from error
    if not isinstance(document, dict) or (cls := _KINDS.get(str(document.pop("t", "")))) is None:
        raise Unprocessable("not a body message: unknown kind")
    if unknown := document.keys() - _FIELDS[cls]:
        raise Unprocessable(f"unknown fields: {', '.join(sorted(unknown))}")
    try:
        return _checked(cls(**{name: _frozen(value) for name, value in document.items()}))
    except TypeError as error:
        raise Unprocessable(str(error)) from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number we take")


def _frozen(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(value)
    return Marker(**value) if isinstance(value, dict) else value


_NUMBERS = {
    Setpoint: ("seq", "v_mps", "omega_radps", "arm_s", "dose_ml"),
    BodyState: ("stamp_s", "left_m", "right_m", "battery_ratio"),
}


def _checked(message: M) -> M:
    for name in _NUMBERS.get(type(message), ()):
        value = getattr(message, name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise Unprocessable(f"{name} must be a finite number")
    if isinstance(message, Setpoint):
        _check_setpoint(message)
    return message


def _check_setpoint(setpoint: Setpoint) -> None:
    if setpoint.base not in ("stop", "drive", "seek_dock"):
        raise Unprocessable("base must be stop, drive or seek_dock")
    if not isinstance(setpoint.pump, bool) or not isinstance(setpoint.permit_id, str):
        raise Unprocessable("pump must be true or false, permit_id a text")
    joints = setpoint.arm if setpoint.arm is not None else ()
    extra = () if setpoint.gripper_m is None else (setpoint.gripper_m,)
    if setpoint.arm is not None and (not isinstance(setpoint.arm, tuple) or len(setpoint.arm) != 4):
        raise Unprocessable("arm must be four joint angles")
    for value in (*joints, *extra):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise Unprocessable("arm and gripper goals must be finite numbers")


@dataclass(slots=True)
class LineBuffer:
    """Cuts a byte stream into lines; a line longer than `limit` is an error of the other side."""

    limit: int = 16 * 1024
    pending: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[bytes]:
        self.pending += data
        if b"\n" not in self.pending and len(self.pending) > self.limit:
            self.pending.clear()
            raise Unprocessable("a line without end")
        *lines, rest = bytes(self.pending).split(b"\n")
        self.pending = bytearray(rest)
        return [line for line in lines if line]
