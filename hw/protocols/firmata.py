"""Firmata 2.5 (Arduino StandardFirmata): MIDI-like messages, seven data bits a byte.

`FirmataReader` parses either direction; the two differ in one thing: towards the board 0xF9 is a bare question, towards
the host it carries major and minor. Source: the Firmata protocol description, version 2.5.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

DIGITAL_MESSAGE = 0x90
REPORT_ANALOG = 0xC0
REPORT_DIGITAL = 0xD0
ANALOG_MESSAGE = 0xE0
START_SYSEX = 0xF0
SET_PIN_MODE = 0xF4
SET_DIGITAL_PIN = 0xF5
END_SYSEX = 0xF7
REPORT_VERSION = 0xF9
SYSTEM_RESET = 0xFF

ANALOG_MAPPING_QUERY = 0x69
ANALOG_MAPPING_RESPONSE = 0x6A
CAPABILITY_QUERY = 0x6B
CAPABILITY_RESPONSE = 0x6C
PIN_STATE_QUERY = 0x6D
PIN_STATE_RESPONSE = 0x6E
EXTENDED_ANALOG = 0x6F
STRING_DATA = 0x71
FIRMWARE = 0x79
SAMPLING_INTERVAL = 0x7A

MODE_INPUT, MODE_OUTPUT, MODE_ANALOG, MODE_PWM, MODE_SERVO, MODE_PULLUP = 0, 1, 2, 3, 4, 11
SYSEX_BYTES_MAX = 512


@dataclass(frozen=True, slots=True)
class Version:
    """0xF9. Towards the board a question, whose numbers are zero."""

    major: int = 0
    minor: int = 0


@dataclass(frozen=True, slots=True)
class Analog:
    """0xE0: a reading of an analog channel, or towards the board a PWM value of a pin."""

    channel: int
    value: int


@dataclass(frozen=True, slots=True)
class Digital:
    """0x90: eight pins at once."""

    port: int
    mask: int


@dataclass(frozen=True, slots=True)
class ReportAnalog:
    channel: int
    on: bool


@dataclass(frozen=True, slots=True)
class ReportDigital:
    port: int
    on: bool


@dataclass(frozen=True, slots=True)
class PinMode:
    pin: int
    mode: int


@dataclass(frozen=True, slots=True)
class PinValue:
    pin: int
    high: bool


@dataclass(frozen=True, slots=True)
class Reset:
    pass


@dataclass(frozen=True, slots=True)
class Sysex:
    command: int
    data: bytes


Message = Version | Analog | Digital | ReportAnalog | ReportDigital | PinMode | PinValue | Reset | Sysex


def to_14_bit(value: int) -> bytes:
    """0..16383 -> low seven bits, high seven bits."""
    return bytes((value & 0x7F, value >> 7 & 0x7F))


def of_14_bit(low: int, high: int) -> int:
    return low & 0x7F | (high & 0x7F) << 7


def pack_text(text: str) -> bytes:
    """Characters as 14-bit pairs, as firmware names and strings travel."""
    return b"".join(to_14_bit(code) for code in text.encode("latin-1", "replace"))


def unpack_text(data: bytes) -> str:
    return bytes(of_14_bit(*data[i : i + 2]) & 0xFF for i in range(0, len(data) - 1, 2)).decode("latin-1")


def sysex(command: int, data: bytes = b"") -> bytes:
    """A system-exclusive message; `data` holds 7-bit bytes only."""
    return bytes((START_SYSEX, command)) + data + bytes((END_SYSEX,))


def encode_version(major: int, minor: int) -> bytes:
    return bytes((REPORT_VERSION, major, minor))


def encode_analog(channel: int, value: int) -> bytes:
    return bytes((ANALOG_MESSAGE | channel,)) + to_14_bit(value)


def encode_digital(port: int, mask: int) -> bytes:
    return bytes((DIGITAL_MESSAGE | port,)) + to_14_bit(mask)


def encode_report_analog(channel: int, on: bool) -> bytes:
    return bytes((REPORT_ANALOG | channel, on))


def encode_pin_mode(pin: int, mode: int) -> bytes:
    return bytes((SET_PIN_MODE, pin, mode))


def encode_pin_value(pin: int, high: bool) -> bytes:
    return bytes((SET_DIGITAL_PIN, pin, high))


def encode_sampling_interval(interval_ms: int) -> bytes:
    return sysex(SAMPLING_INTERVAL, to_14_bit(interval_ms))


def encode_firmware(major: int, minor: int, name: str) -> bytes:
    return sysex(FIRMWARE, bytes((major, minor)) + pack_text(name))


def encode_string(text: str) -> bytes:
    return sysex(STRING_DATA, pack_text(text))


def encode_capabilities(pins: Iterable[Sequence[tuple[int, int]]]) -> bytes:
    """Every pin's modes as (mode, resolution in bits)."""
    body = b"".join(bytes(number for pair in modes for number in pair) + b"\x7f" for modes in pins)
    return sysex(CAPABILITY_RESPONSE, body)


def decode_capabilities(data: bytes) -> tuple[dict[int, int], ...]:
    """A capability response's data -> mode to resolution, a pin each."""
    return tuple(dict(zip(pin[0::2], pin[1::2], strict=False)) for pin in data.split(b"\x7f")[:-1])


def encode_analog_mapping(channels: Iterable[int | None]) -> bytes:
    """Every pin's analog channel; None for pins that have none."""
    return sysex(ANALOG_MAPPING_RESPONSE, bytes(0x7F if channel is None else channel for channel in channels))


def decode_analog_mapping(data: bytes) -> tuple[int | None, ...]:
    return tuple(None if channel == 0x7F else channel for channel in data)


class FirmataReader:
    """A byte stream -> messages. Stray data bytes are skipped; a command byte within a message drops that message."""

    def __init__(self, *, to_host: bool) -> None:
        self._to_host = to_host
        self._begun = bytearray()
        self.dropped = 0
        """Messages begun and not ended properly, and stray bytes."""

    def feed(self, data: bytes) -> list[Message]:
        messages = []
        for byte in data:
            if (message := self._take(byte)) is not None:
                messages.append(message)
        return messages

    def _take(self, byte: int) -> Message | None:
        if byte == END_SYSEX and self._begun[:1] == bytes((START_SYSEX,)):
            return self._end_sysex()
        if byte >= 0x80:
            self.dropped += bool(self._begun)
            self._begun = bytearray((byte,))
        elif self._begun:
            self._begun.append(byte)
        else:
            self.dropped += 1
            return None
        return self._end_short()

    def _end_sysex(self) -> Message | None:
        body, self._begun = bytes(self._begun[1:]), bytearray()
        return Sysex(body[0], body[1:]) if body else None

    def _end_short(self) -> Message | None:
        head = self._begun[0]
        if head == START_SYSEX:
            if len(self._begun) > SYSEX_BYTES_MAX:
                self.dropped += 1
                self._begun.clear()
            return None
        if len(self._begun) <= self._arguments(head):
            return None
        body, self._begun = bytes(self._begun), bytearray()
        return _short(body)

    def _arguments(self, head: int) -> int:
        """Data bytes after the command byte `head`."""
        if head == REPORT_VERSION:
            return 2 if self._to_host else 0
        if head in (SET_PIN_MODE, SET_DIGITAL_PIN) or head & 0xF0 in (ANALOG_MESSAGE, DIGITAL_MESSAGE):
            return 2
        return 1 if head & 0xF0 in (REPORT_ANALOG, REPORT_DIGITAL) else 0


def _short(body: bytes) -> Message | None:
    head = body[0]
    if head == REPORT_VERSION:
        return Version(*body[1:])
    if head == SYSTEM_RESET:
        return Reset()
    if head == SET_PIN_MODE:
        return PinMode(body[1], body[2])
    if head == SET_DIGITAL_PIN:
        return PinValue(body[1], bool(body[2]))
    low = head & 0x0F
    match head & 0xF0:
        case 0xE0:
            return Analog(low, of_14_bit(body[1], body[2]))
        case 0x90:
            return Digital(low, of_14_bit(body[1], body[2]))
        case 0xC0:
            return ReportAnalog(low, bool(body[1]))
        case 0xD0:
            return ReportDigital(low, bool(body[1]))
    return None
