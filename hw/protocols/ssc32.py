"""Lynxmotion SSC-32 / SSC-32U command language: what a host writes, and what those lines mean to the board.

ASCII lines ended by CR, case-insensitive, blanks ignored; answers are single raw bytes without an end mark
(`Q`, `QP`, `VA`..) or short text ended by CR (`VER`, registers). Source: SSC-32U User Guide, pages 24 to 38.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

CHANNELS = 32
ANALOG_INPUTS = 8
PULSE_US_MIN, PULSE_US_MAX = 500, 2500
DURATION_MS_MAX = 65535
VOLTS_PER_COUNT = 5.0 / 256.0
DONE, MOVING = b".", b"+"
QUERY_MOVING = b"Q\r"
VERSION = b"VER\r"
LINE_CHARS_MAX = 1024
QUERY_PULSE_US = 10
"""`QP` answers a pulse in units of this."""
ESC = b"\x1b"
_IGNORED = bytes(byte for byte in range(256) if not 0x20 < byte < 0x7F and byte not in b"\r\x1b")


def encode_move(
    pulses_us: Mapping[int, float], duration_s: float | None = None, speeds_usps: Mapping[int, float] | None = None
) -> bytes:
    """A group move: channel -> pulse [us], one common duration [s], a speed [us/s] for some channels."""
    speeds = speeds_usps or {}
    parts = [f"#{channel}P{round(pulse)}" + _speed(speeds.get(channel)) for channel, pulse in pulses_us.items()]
    if duration_s is not None:
        parts.append(f"T{min(DURATION_MS_MAX, max(0, round(duration_s * 1000)))}")
    return _line("".join(parts))


def _speed(speed_usps: float | None) -> str:
    return "" if speed_usps is None else f"S{max(1, round(speed_usps))}"


def _line(text: str) -> bytes:
    return text.encode("ascii") + b"\r"


def encode_outputs(levels: Mapping[int, bool]) -> bytes:
    """Discrete outputs in one line: channel -> high (5 V) or low (0 V)."""
    return _line("".join(f"#{channel}{'H' if high else 'L'}" for channel, high in levels.items()))


def encode_byte_output(bank: int, value: int) -> bytes:
    """Eight outputs at once: bank 0 holds channels 0 to 7, bank 3 channels 24 to 31."""
    return _line(f"#{bank}:{value}")


def encode_offset(channel: int, offset_us: int) -> bytes:
    """A pulse offset of -100 to 100 us, kept until power-off."""
    return _line(f"#{channel}PO{offset_us}")


def encode_stop(channels: Iterable[int]) -> bytes:
    """STOP for each channel: a line each, meant to be written at once."""
    return b"".join(_line(f"STOP{channel}") for channel in channels)


def encode_query_pulses(channels: Iterable[int]) -> bytes:
    """Asks one byte a channel: the pulse in tens of microseconds, 0 if never driven."""
    return _line("".join(f"QP{channel}" for channel in channels))


def encode_query_analog(inputs: Iterable[int]) -> bytes:
    """Asks one byte an input; input 0 is VA."""
    return _line("".join(f"V{chr(ord('A') + index)}" for index in inputs))


def volts_of(count: int) -> float:
    """An analog answer byte -> volts (0 to 4.98)."""
    return count * VOLTS_PER_COUNT


def count_of(volts: float) -> int:
    """Volts at an input -> the board's answer byte."""
    return min(255, max(0, int(volts / VOLTS_PER_COUNT + 0.5)))


@dataclass(frozen=True, slots=True)
class ChannelMove:
    """One channel of a group move."""

    channel: int
    pulse_us: int
    speed_usps: int | None = None


@dataclass(frozen=True, slots=True)
class Move:
    moves: tuple[ChannelMove, ...]
    duration_ms: int | None = None


@dataclass(frozen=True, slots=True)
class Offset:
    channel: int
    offset_us: int


@dataclass(frozen=True, slots=True)
class Output:
    channel: int
    high: bool


@dataclass(frozen=True, slots=True)
class QueryMoving:
    pass


@dataclass(frozen=True, slots=True)
class QueryPulses:
    channels: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class QueryAnalog:
    inputs: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class QueryDigital:
    """Pairs of input and whether the latch is meant (`AL`)."""

    inputs: tuple[tuple[int, bool], ...]


@dataclass(frozen=True, slots=True)
class Stop:
    channel: int


@dataclass(frozen=True, slots=True)
class QueryVersion:
    pass


@dataclass(frozen=True, slots=True)
class ReadRegister:
    register: int


@dataclass(frozen=True, slots=True)
class WriteRegister:
    register: int
    value: int


@dataclass(frozen=True, slots=True)
class DefaultRegisters:
    pass


Command = (
    Move
    | Offset
    | Output
    | QueryMoving
    | QueryPulses
    | QueryAnalog
    | QueryDigital
    | Stop
    | QueryVersion
    | ReadRegister
    | WriteRegister
    | DefaultRegisters
)


class LineReader:
    """Bytes from a host -> whole lines, upper case and without blanks. ESC drops the line being typed."""

    def __init__(self) -> None:
        self._line = b""

    def feed(self, data: bytes) -> list[str]:
        *ended, rest = (self._line + data.translate(None, _IGNORED)).split(b"\r")
        self._line = rest.rpartition(ESC)[2][-LINE_CHARS_MAX:]
        return [line.rpartition(ESC)[2].decode("ascii").upper() for line in ended]


_GROUP_ITEM = re.compile(r"#(\d+)(?:PO([+-]?\d+)|P(\d+)|(H|L)|:(\d+))((?:[ST]\d+)*)")
_SPEED = re.compile(r"S(\d+)")
_TIME = re.compile(r"T(\d+)")


@lru_cache(maxsize=256)
def parse_line(line: str) -> tuple[Command, ...]:
    """One line as `LineReader` gives it -> commands; what the board would not understand yields nothing."""
    return tuple(_parse(line))


def _parse(line: str) -> list[Command]:
    if line.startswith("#"):
        return _parse_group(line)
    if line == "Q":
        return [QueryMoving()]
    if line == "VER":
        return [QueryVersion()]
    if line == "RDFLT":
        return [DefaultRegisters()]
    if match := re.fullmatch(r"STOP(\d+)", line):
        return [Stop(int(match[1]))] if int(match[1]) < CHANNELS else []
    if match := re.fullmatch(r"R(\d+)(?:=([+-]?\d+))?", line):
        return [WriteRegister(int(match[1]), int(match[2])) if match[2] else ReadRegister(int(match[1]))]
    return _parse_queries(line)


def _parse_queries(line: str) -> list[Command]:
    if re.fullmatch(r"(QP\d+)+", line):
        channels = tuple(int(text) for text in re.findall(r"\d+", line))
        return [QueryPulses(tuple(channel for channel in channels if channel < CHANNELS))]
    if re.fullmatch(r"(V[A-H])+", line):
        return [QueryAnalog(tuple(ord(letter) - ord("A") for letter in line[1::2]))]
    if re.fullmatch(r"([A-F]L?)+", line):
        items = re.findall(r"([A-F])(L?)", line)
        return [QueryDigital(tuple((ord(letter) - ord("A"), latch == "L") for letter, latch in items))]
    return []


def _parse_group(line: str) -> list[Command]:
    moves: list[ChannelMove] = []
    others: list[Command] = []
    for match in _GROUP_ITEM.finditer(line):
        number, offset, pulse, level, value, modifiers = match.groups()
        if value is not None:
            others += _parse_bank(int(number), int(value))
        elif int(number) >= CHANNELS:
            continue
        elif level is not None:
            others.append(Output(int(number), level == "H"))
        elif offset is not None and -100 <= int(offset) <= 100:
            others.append(Offset(int(number), int(offset)))
        elif pulse is not None and PULSE_US_MIN <= int(pulse) <= PULSE_US_MAX:
            moves.append(ChannelMove(int(number), int(pulse), _positive(_SPEED.search(modifiers))))
    time = _TIME.search(line)
    group: list[Command] = [Move(tuple(moves), min(DURATION_MS_MAX, int(time[1])) if time else None)] if moves else []
    return others + group


def _positive(match: re.Match[str] | None) -> int | None:
    return int(match[1]) or None if match else None


def _parse_bank(bank: int, value: int) -> list[Command]:
    if bank > 3 or value > 255:
        return []
    return [Output(bank * 8 + bit, bool(value >> bit & 1)) for bit in range(8)]
