"""What crosses the local stream between a robot's brain and its body: one JSON document a line.

Plain dataclasses rather than pydantic: the stream runs at 50 Hz and both ends are the same robot; of pydantic it takes only
the JSON, four times as fast as the standard library's. A field at its default is left out of the line. `decode` still
refuses wrong types, unknown fields and non-finite numbers, since the body must survive any brain.
"""

from __future__ import annotations

import json
from dataclasses import MISSING, dataclass, field, fields
from math import isfinite
from operator import attrgetter
from types import NoneType
from typing import Any, Literal

from pydantic_core import from_json, to_json

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
    roll_rad: float | None = None
    """Turn of the fingers about the hand's axis, on a robot whose wrist rolls; None holds it."""
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
    refusal: str = ""
    """Why the gate refused the newest setpoint, or parts of it; empty when all was allowed."""
    down: tuple[str, ...] = ()
    """Devices whose link is down, each with its reason."""
    next_in_s: float = 0.5
    """The next state comes within so many seconds, if nothing happens before."""


Message = Hello | Setpoint | Control | BodyState
_KINDS: dict[str, type[Message]] = {"hello": Hello, "set": Setpoint, "control": Control, "state": BodyState}
_NAMES = {cls: name for name, cls in _KINDS.items()}
_FIELDS = {cls: tuple((f.name, f.default) for f in fields(cls)) for cls in (*_NAMES, Marker)}
_VALUES = {cls: attrgetter(*(name for name, _ in told)) for cls, told in _FIELDS.items() if len(told) > 1}
_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False, check_circular=False)
"""For what might hold a number that is not finite: it raises."""


def encode(message: Message) -> bytes:
    """One line, newline included; raises ValueError for a number that is not finite."""
    cls = type(message)
    document = {"t": _NAMES[cls], **_told(message)}
    if (marker := document.get("marker")) is not None:
        document["marker"] = _told(marker)
    line = to_json(document, inf_nan_mode="constants")
    if b"NaN" in line or b"Infinity" in line:
        return _ENCODER.encode(document).encode() + b"\n"
    return line + b"\n"


def _told(message: Any) -> dict[str, Any]:
    """The fields that say more than their default."""
    told = _FIELDS[type(message)]
    values = _VALUES.get(type(message))
    if values is None:
        return {name: getattr(message, name) for name, _ in told}
    pairs = zip(told, values(message), strict=True)
    return {name: value for (name, default), value in pairs if default is MISSING or value != default}


_NUMBER = frozenset((int, float))
_ACCEPTED: dict[str, frozenset[type]] = {
    "int": frozenset((int,)),
    "float": _NUMBER,
    "bool": frozenset((bool,)),
    "str": frozenset((str,)),
    "float | None": _NUMBER | {NoneType},
    "Marker | None": frozenset((dict, NoneType)),
}
"""The types a field's JSON value may have, by its annotation; a tuple comes as a list, a Literal as a str."""


def _accepted(annotation: str) -> frozenset[type]:
    if annotation.startswith("Literal"):
        return _ACCEPTED["str"]
    if annotation.startswith("tuple"):
        return frozenset((list, NoneType) if annotation.endswith("| None") else (list,))
    return _ACCEPTED[annotation]


_TYPES = {cls: {f.name: _accepted(str(f.type)) for f in fields(cls)} for cls in (*_NAMES, Marker)}
_ITEMS: dict[str, tuple[frozenset[type], int | None]] = {
    "arm": (_NUMBER, 4),
    "arm_rad": (_NUMBER, None),
    "cliff": (_ACCEPTED["bool"], 4),
    "down": (_ACCEPTED["str"], None),
}
"""What a list holds, and how many."""


def decode(line: bytes) -> Message:
    """Read one line; raises Unprocessable for anything that is not exactly a message."""
    try:
        document = from_json(line, allow_inf_nan=False)
    except ValueError as error:
        raise Unprocessable(f"not a body message: {error}") from error
    if not isinstance(document, dict) or (cls := _KINDS.get(str(document.pop("t", "")))) is None:
        raise Unprocessable("not a body message: unknown kind")
    _check(cls, document)
    try:
        return cls(**document)
    except TypeError as error:
        raise Unprocessable(str(error)) from error


def _check(cls: type, document: dict[str, Any]) -> None:
    """Every value has its field's type; lists become tuples and the marker a Marker, in place."""
    types = _TYPES[cls]
    for name, value in document.items():
        kind = type(value)
        if (accepted := types.get(name)) is None:
            raise Unprocessable(f"unknown fields: {name}")
        if kind not in accepted:
            raise Unprocessable(f"{name} is a {kind.__name__}")
        if kind is float and not isfinite(value):
            raise Unprocessable(f"{name} must be a finite number")
        if kind is list:
            document[name] = _items(name, value)
        elif kind is dict:
            _check(Marker, value)
            document[name] = _marker(value)
    if cls is Setpoint and document.get("base", "stop") not in ("stop", "drive", "seek_dock"):
        raise Unprocessable("base must be stop, drive or seek_dock")
    if cls is Control and document.get("order") not in ("stop", "resume", "rest", "wake"):
        raise Unprocessable("order must be stop, resume, rest or wake")


def _items(name: str, values: list[Any]) -> tuple[Any, ...]:
    accepted, count = _ITEMS[name]
    if count is not None and len(values) != count:
        raise Unprocessable(f"{name} must be {count} values")
    for value in values:
        if type(value) not in accepted or (type(value) is float and not isfinite(value)):
            raise Unprocessable(f"{name} holds {value!r}")
    return tuple(values)


def _marker(document: dict[str, Any]) -> Marker:
    try:
        return Marker(**document)
    except TypeError as error:
        raise Unprocessable(str(error)) from error


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
