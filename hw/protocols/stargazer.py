"""Hagisonic StarGazer messages: `~` type text `` ` ``, fields split by `|`; no checksum, no line end.

The same frames carry both directions. Raw angles are degrees, clockwise-positive seen from above; lengths are in cm.
Sources: the user guide's command list as quoted by public drivers (K-Team, KIT, pyStargazer).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

STX, ETX = 0x7E, 0x60
FRAME_CHARS_MAX = 160
BYTE_GAP_S = 0.04
"""The device loses bytes that come closer together than 30 to 50 ms."""


@dataclass(frozen=True, slots=True)
class MarkerView:
    """The sensor relative to one marker: x right, y forward of it; z its height above the sensor."""

    marker_id: int
    theta_deg: float
    x_cm: float
    y_cm: float
    z_cm: float

    def pose(self) -> tuple[float, float, float]:
        """(x [m], y [m], yaw [rad, counter-clockwise]) of the sensor in the marker's frame."""
        return self.x_cm * 0.01, self.y_cm * 0.01, math.radians(-self.theta_deg)


@dataclass(frozen=True, slots=True)
class Poses:
    """`~^`: kind `I` (map mode), `F` (building a map), `Z` (measuring height) or `1`, `2` (multi-id firmware)."""

    kind: str
    views: tuple[MarkerView, ...]


@dataclass(frozen=True, slots=True)
class DeadZone:
    """`~*DeadZone`: no marker in view."""


@dataclass(frozen=True, slots=True)
class Note:
    """Any other `~*`: `MAPID|n` while a map is built."""

    text: str


@dataclass(frozen=True, slots=True)
class Ack:
    """`~!`: an echo of the command, or `ParameterUpdate`, `MapDataSave` when something slow has ended."""

    text: str


@dataclass(frozen=True, slots=True)
class Value:
    """`~$`: a parameter that was asked for."""

    name: str
    value: str


@dataclass(frozen=True, slots=True)
class Command:
    """`~#`: an action, or a write when `value` is given."""

    name: str
    value: str | None = None


@dataclass(frozen=True, slots=True)
class Read:
    """`~@`: asks for a parameter."""

    name: str


Message = Poses | DeadZone | Note | Ack | Value | Command | Read


def _frame(body: str) -> bytes:
    return b"~" + body.encode("ascii") + b"`"


def encode_poses(kind: str, views: Sequence[MarkerView]) -> bytes:
    """A pose frame; signs and two decimals are always written, as the parsers in use expect."""
    return _frame(f"^{kind}" + "|".join(_fields(view) for view in views))


def _fields(view: MarkerView) -> str:
    return f"{view.marker_id}|{view.theta_deg:+.2f}|{view.x_cm:+.2f}|{view.y_cm:+.2f}|{max(0.0, view.z_cm):.2f}"


def encode(message: DeadZone | Note | Ack | Value | Command | Read) -> bytes:
    """Any message but a pose frame."""
    match message:
        case DeadZone():
            return _frame("*DeadZone")
        case Note(text):
            return _frame("*" + text)
        case Ack(text):
            return _frame("!" + text)
        case Value(name, value):
            return _frame(f"${name}|{value}")
        case Command(name, value):
            return _frame("#" + (name if value is None else f"{name}|{value}"))
        case Read(name):
            return _frame("@" + name)


class FrameReader:
    """A byte stream -> message texts. A new `~`, a control byte or an over-long text drops the frame begun."""

    def __init__(self) -> None:
        self._text: bytearray | None = None
        self.dropped = 0
        """Frames begun and not ended properly."""

    def feed(self, data: bytes) -> list[str]:
        texts = []
        for byte in data:
            if byte == STX:
                self._drop()
                self._text = bytearray()
            elif self._text is None:
                continue
            elif byte == ETX:
                texts.append(self._text.decode("ascii"))
                self._text = None
            elif 0x21 <= byte < 0x7F and len(self._text) < FRAME_CHARS_MAX:
                self._text.append(byte)
            else:
                self._drop()
        return texts

    def _drop(self) -> None:
        self.dropped += self._text is not None
        self._text = None


_SIGNED = r"[+-]?\d+(?:\.\d+)?"
_VIEW = re.compile(rf"(\d+)\|({_SIGNED})\|({_SIGNED})\|({_SIGNED})\|(\d+(?:\.\d+)?)")
_COUNTS = {"I": 1, "F": 1, "Z": 1, "1": 1, "2": 2}
THETA_DEG_MAX = 360.0


def parse(text: str) -> Message | None:
    """A text of `FrameReader` -> its message; None when it is none of the known forms or its numbers are damaged."""
    if len(text) < 2:
        return None
    kind, rest = text[0], text[1:]
    name, bar, value = rest.partition("|")
    match kind:
        case "^":
            return _parse_poses(rest)
        case "*":
            return DeadZone() if rest == "DeadZone" else Note(rest)
        case "!":
            return Ack(rest)
        case "$":
            return Value(name, value) if bar else None
        case "#":
            return Command(name, value if bar else None)
        case "@":
            return Read(rest)
    return None


def _parse_poses(rest: str) -> Poses | None:
    """The letter or digit after `^` is never part of the id."""
    kind, fields = rest[0], rest[1:]
    count = _COUNTS.get(kind)
    if count is None or not re.fullmatch(r"\|".join([_VIEW.pattern] * count), fields):
        return None
    views = tuple(
        MarkerView(int(marker), float(theta), float(x), float(y), float(z))
        for marker, theta, x, y, z in _VIEW.findall(fields)
    )
    return Poses(kind, views) if all(abs(view.theta_deg) <= THETA_DEG_MAX for view in views) else None
