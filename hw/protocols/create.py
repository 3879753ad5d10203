"""iRobot Create Open Interface: models, opcodes, command bytes and the parser of the robot's side. No I/O.

Sensor packets, stream frames and the dock's infrared bytes are in `create_sensors`.
All integers are big-endian. Source: iRobot Create Open Interface manual v2 (Create 1) and Create 2 Open Interface
specification based on the Roomba 600; `docs/devices/create.md`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum

SPEED_MMPS_MAX = 500
RADIUS_MM_MAX = 2000
STRAIGHT = -0x8000
"""Drive radius of a straight line; 0x7FFF means the same."""
STRAIGHT_TOO = 0x7FFF
SPIN_LEFT = 1
SPIN_RIGHT = -1
PWM_MAX = 255
SONG_NOTES_MAX = 16
SCRIPT_BYTES_MAX = 100
SONG_TICK_S = 1 / 64
TICK_S = 0.015
"""Sensors refresh and stream frames leave this often."""


class Model(Enum):
    """Which Open Interface: the 2007 Create, or the Create 2 (a Roomba 600)."""

    CREATE1 = "create1"
    CREATE2 = "create2"


class Mode(IntEnum):
    """Packet 35."""

    OFF = 0
    PASSIVE = 1
    SAFE = 2
    FULL = 3


class Op(IntEnum):
    """Opcodes of either model; 136 is Demo (one data byte) on a Create 1 and Max (none) on a Create 2."""

    RESET = 7
    START = 128
    BAUD = 129
    CONTROL = 130
    SAFE = 131
    FULL = 132
    POWER = 133
    SPOT = 134
    COVER = 135
    DEMO_OR_MAX = 136
    DRIVE = 137
    MOTORS = 138
    LEDS = 139
    SONG = 140
    PLAY = 141
    SENSORS = 142
    SEEK_DOCK = 143
    PWM_MOTORS = 144
    DRIVE_DIRECT = 145
    DRIVE_PWM = 146
    DIGITAL_OUTPUTS = 147
    STREAM = 148
    QUERY = 149
    STREAM_SWITCH = 150
    SEND_IR = 151
    SCRIPT = 152
    PLAY_SCRIPT = 153
    SHOW_SCRIPT = 154
    WAIT_TIME = 155
    WAIT_DISTANCE = 156
    WAIT_ANGLE = 157
    WAIT_EVENT = 158
    SCHEDULING_LEDS = 162
    DIGITS_RAW = 163
    DIGITS_ASCII = 164
    BUTTONS = 165
    SCHEDULE = 167
    SET_DAY_TIME = 168
    STOP = 173


BAUD_RATES = (300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200)

_BOTH: Mapping[int, int] = {
    Op.START: 0,
    Op.BAUD: 1,
    Op.CONTROL: 0,
    Op.SAFE: 0,
    Op.FULL: 0,
    Op.POWER: 0,
    Op.SPOT: 0,
    Op.COVER: 0,
    Op.DRIVE: 4,
    Op.MOTORS: 1,
    Op.LEDS: 3,
    Op.PLAY: 1,
    Op.SENSORS: 1,
    Op.SEEK_DOCK: 0,
    Op.PWM_MOTORS: 3,
    Op.DRIVE_DIRECT: 4,
    Op.STREAM_SWITCH: 1,
}
DATA_BYTES: Mapping[Model, Mapping[int, int]] = {
    Model.CREATE1: {
        **_BOTH,
        Op.DEMO_OR_MAX: 1,
        Op.DIGITAL_OUTPUTS: 1,
        Op.SEND_IR: 1,
        Op.PLAY_SCRIPT: 0,
        Op.SHOW_SCRIPT: 0,
        Op.WAIT_TIME: 1,
        Op.WAIT_DISTANCE: 2,
        Op.WAIT_ANGLE: 2,
        Op.WAIT_EVENT: 1,
    },
    Model.CREATE2: {
        **_BOTH,
        Op.RESET: 0,
        Op.DEMO_OR_MAX: 0,
        Op.DRIVE_PWM: 4,
        Op.SCHEDULING_LEDS: 2,
        Op.DIGITS_RAW: 4,
        Op.DIGITS_ASCII: 4,
        Op.BUTTONS: 1,
        Op.SCHEDULE: 15,
        Op.SET_DAY_TIME: 3,
        Op.STOP: 0,
    },
}
"""Data bytes after the opcode, where that is a constant."""

COUNTED: Mapping[Model, Mapping[int, tuple[int, int]]] = {
    Model.CREATE1: {Op.SONG: (2, 2), Op.STREAM: (1, 1), Op.QUERY: (1, 1), Op.SCRIPT: (1, 1)},
    Model.CREATE2: {Op.SONG: (2, 2), Op.STREAM: (1, 1), Op.QUERY: (1, 1)},
}
"""Counted commands: (bytes of head, bytes per item); the head's last byte is the count."""


@dataclass(frozen=True, slots=True)
class Command:
    """One command as the robot reads it."""

    op: int
    data: bytes = b""

    def int16s(self) -> tuple[int, ...]:
        """The data as signed big-endian words."""
        return struct.unpack(f">{len(self.data) // 2}h", self.data)


class CommandParser:
    """The robot's side: a byte stream, cut anywhere, into commands. Bytes that are no opcode of this model are skipped."""

    def __init__(self, model: Model) -> None:
        self._fixed, self._counted = DATA_BYTES[model], COUNTED[model]
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Command]:
        """Take bytes; give every command that is now whole."""
        buffer = self._buffer
        buffer += data
        commands: list[Command] = []
        at = 0
        while at < len(buffer):
            op = buffer[at]
            length = self._length(op, at)
            if length is None:
                at += 1
                continue
            if at + 1 + length > len(buffer):
                break
            commands.append(Command(op, bytes(buffer[at + 1 : at + 1 + length])))
            at += 1 + length
        del buffer[:at]
        return commands

    def reset(self) -> None:
        """Forget a half-read command."""
        self._buffer.clear()

    def _length(self, op: int, at: int) -> int | None:
        """Data bytes of the command that begins at `at`, as far as known yet; None for no opcode."""
        if (fixed := self._fixed.get(op)) is not None:
            return fixed
        if (counted := self._counted.get(op)) is None:
            return None
        head, item = counted
        count_at = at + head
        return head + item * self._buffer[count_at] if count_at < len(self._buffer) else head


def bare(op: Op) -> bytes:
    """A command without data: start, safe, full, seek dock, stop and the like."""
    return bytes([op])


def baud(rate: int) -> bytes:
    """Another baud rate; wait 100 ms before the next byte."""
    return bytes([Op.BAUD, BAUD_RATES.index(rate)])


def demo(number: int) -> bytes:
    """Create 1: run a built-in demo, 0 to 9; -1 stops it."""
    return bytes([Op.DEMO_OR_MAX, _within(number, -1, 9, "demo") & 0xFF])


def drive(v_mmps: int, radius_mm: int) -> bytes:
    """Velocity [mm/s] and turn radius [mm, positive left]; STRAIGHT, SPIN_LEFT and SPIN_RIGHT are special radii."""
    _within(v_mmps, -SPEED_MMPS_MAX, SPEED_MMPS_MAX, "velocity")
    if radius_mm not in (STRAIGHT, STRAIGHT_TOO):
        _within(radius_mm, -RADIUS_MM_MAX, RADIUS_MM_MAX, "radius")
    if radius_mm == 0:
        raise ValueError("radius 0 has no meaning; use SPIN_LEFT or SPIN_RIGHT")
    return struct.pack(">Bhh", Op.DRIVE, v_mmps, radius_mm)


def drive_direct(right_mmps: int, left_mmps: int) -> bytes:
    """Rim speeds [mm/s], right first as on the wire."""
    _within(right_mmps, -SPEED_MMPS_MAX, SPEED_MMPS_MAX, "right speed")
    _within(left_mmps, -SPEED_MMPS_MAX, SPEED_MMPS_MAX, "left speed")
    return struct.pack(">Bhh", Op.DRIVE_DIRECT, right_mmps, left_mmps)


def drive_pwm(right: int, left: int) -> bytes:
    """Create 2: wheel duty, -255 to 255, right first as on the wire."""
    _within(right, -PWM_MAX, PWM_MAX, "right duty")
    _within(left, -PWM_MAX, PWM_MAX, "left duty")
    return struct.pack(">Bhh", Op.DRIVE_PWM, right, left)


def motors(bits: int) -> bytes:
    """Create 1: low-side drivers; Create 2: brushes and vacuum."""
    return bytes([Op.MOTORS, bits])


def pwm_motors(first: int, second: int, third: int) -> bytes:
    """Create 1: low-side drivers 2, 1, 0 duty 0..128; Create 2: main brush, side brush (signed) and vacuum."""
    return bytes([Op.PWM_MOTORS, first & 0xFF, second & 0xFF, third & 0xFF])


def digital_outputs(bits: int) -> bytes:
    """Create 1: the cargo bay's digital outputs 0 to 2."""
    return bytes([Op.DIGITAL_OUTPUTS, bits])


def leds(bits: int, colour: int, intensity: int) -> bytes:
    """LED bits, power LED colour (0 green to 255 red) and its intensity."""
    return bytes([Op.LEDS, bits, colour, intensity])


def song(number: int, notes: Sequence[tuple[int, int]]) -> bytes:
    """Define a song of 1 to 16 (MIDI note, duration in 1/64 s)."""
    _within(len(notes), 1, SONG_NOTES_MAX, "notes")
    return bytes([Op.SONG, number, len(notes), *(byte for note in notes for byte in note)])


def play(number: int) -> bytes:
    """Play a defined song."""
    return bytes([Op.PLAY, number])


def sensors(packet: int) -> bytes:
    """Ask once for a packet or a group."""
    return bytes([Op.SENSORS, packet])


def query(packets: Sequence[int]) -> bytes:
    """Ask once for a list; the answer is the payloads back to back."""
    return bytes([Op.QUERY, len(packets), *packets])


def stream(packets: Sequence[int]) -> bytes:
    """Send these packets every 15 ms; an empty list ends the stream."""
    return bytes([Op.STREAM, len(packets), *packets])


def stream_switch(on: bool) -> bytes:
    """Pause the stream, or go on with the old list."""
    return bytes([Op.STREAM_SWITCH, int(on)])


def send_ir(byte: int) -> bytes:
    """Create 1: send one infrared byte through low-side driver 1."""
    return bytes([Op.SEND_IR, byte])


def script(commands: bytes) -> bytes:
    """Create 1: store up to 100 bytes of commands; none clears."""
    _within(len(commands), 0, SCRIPT_BYTES_MAX, "script bytes")
    return bytes([Op.SCRIPT, len(commands)]) + commands


def wait_time(tenths_s: int) -> bytes:
    """Create 1: wait, in tenths of a second."""
    return bytes([Op.WAIT_TIME, tenths_s])


def wait_distance(distance_mm: int) -> bytes:
    """Create 1: wait until this has been driven, negative backwards."""
    return struct.pack(">Bh", Op.WAIT_DISTANCE, distance_mm)


def wait_angle(angle_deg: int) -> bytes:
    """Create 1: wait until this has been turned, counter-clockwise positive."""
    return struct.pack(">Bh", Op.WAIT_ANGLE, angle_deg)


def wait_event(event: int) -> bytes:
    """Create 1: wait for an event 1 to 22, or for its end when negative."""
    _within(abs(event), 1, 22, "event")
    return struct.pack(">Bb", Op.WAIT_EVENT, event)


def scheduling_leds(days: int, bits: int) -> bytes:
    return bytes([Op.SCHEDULING_LEDS, days, bits])


def digits_raw(segments: Iterable[int]) -> bytes:
    """Create 2: the segments of the four digits, left to right."""
    return bytes([Op.DIGITS_RAW, *_exactly(4, segments)])


def digits_ascii(text: str) -> bytes:
    """Create 2: four characters on the display."""
    return bytes([Op.DIGITS_ASCII, *_exactly(4, text.ljust(4)[:4].encode("ascii"))])


def buttons(bits: int) -> bytes:
    """Create 2: push buttons for a sixth of a second."""
    return bytes([Op.BUTTONS, bits])


def schedule(days: int, times: Iterable[tuple[int, int]]) -> bytes:
    """Create 2: cleaning times (hour, minute) for Sunday to Saturday."""
    return bytes([Op.SCHEDULE, days, *_exactly(14, (number for time in times for number in time))])


def set_day_time(day: int, hour: int, minute: int) -> bytes:
    """Create 2: day 0 is Sunday."""
    return bytes([Op.SET_DAY_TIME, day, hour, minute])


def _within(value: int, low: int, high: int, what: str) -> int:
    if not low <= value <= high:
        raise ValueError(f"{what} {value} is outside {low}..{high}")
    return value


def _exactly(count: int, numbers: Iterable[int]) -> list[int]:
    listed = list(numbers)
    if len(listed) != count:
        raise ValueError(f"{len(listed)} numbers where {count} are due")
    return listed
