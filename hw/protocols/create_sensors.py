"""iRobot Create Open Interface: sensor packets, stream frames and the dock's infrared bytes. No I/O.

Source: as `create`; both checksum rules were seen in third-party clients (`docs/devices/create.md`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum

from hw.protocols.create import Model

FRAME_HEADER = 19
COUNTER_RANGE = 65536
CAP_MM = 32767
"""Packets 19 and 20 are capped at this, not wrapped."""


class Packet(IntEnum):
    """Single sensor packets."""

    BUMPS_DROPS = 7
    WALL = 8
    CLIFF_LEFT = 9
    CLIFF_FRONT_LEFT = 10
    CLIFF_FRONT_RIGHT = 11
    CLIFF_RIGHT = 12
    VIRTUAL_WALL = 13
    OVERCURRENTS = 14
    DIRT = 15
    UNUSED_16 = 16
    IR_OMNI = 17
    BUTTONS = 18
    DISTANCE_MM = 19
    ANGLE_DEG = 20
    CHARGING_STATE = 21
    VOLTAGE_MV = 22
    CURRENT_MA = 23
    TEMPERATURE_C = 24
    CHARGE_MAH = 25
    CAPACITY_MAH = 26
    WALL_SIGNAL = 27
    CLIFF_LEFT_SIGNAL = 28
    CLIFF_FRONT_LEFT_SIGNAL = 29
    CLIFF_FRONT_RIGHT_SIGNAL = 30
    CLIFF_RIGHT_SIGNAL = 31
    DIGITAL_INPUTS = 32
    ANALOG_INPUT = 33
    CHARGING_SOURCES = 34
    OI_MODE = 35
    SONG_NUMBER = 36
    SONG_PLAYING = 37
    STREAM_PACKETS = 38
    REQUESTED_VELOCITY = 39
    REQUESTED_RADIUS = 40
    REQUESTED_RIGHT = 41
    REQUESTED_LEFT = 42
    ENCODER_LEFT = 43
    ENCODER_RIGHT = 44
    LIGHT_BUMPER = 45
    LIGHT_LEFT = 46
    LIGHT_FRONT_LEFT = 47
    LIGHT_CENTRE_LEFT = 48
    LIGHT_CENTRE_RIGHT = 49
    LIGHT_FRONT_RIGHT = 50
    LIGHT_RIGHT = 51
    IR_LEFT = 52
    IR_RIGHT = 53
    LEFT_WHEEL_MA = 54
    RIGHT_WHEEL_MA = 55
    MAIN_BRUSH_MA = 56
    SIDE_BRUSH_MA = 57
    STASIS = 58


_SIGNED_WORDS = (*range(19, 21), 23, *range(39, 43), *range(54, 58))
_WORDS = (*range(19, 21), *range(22, 24), *range(25, 32), 33, *range(39, 45), *range(46, 52), *range(54, 58))
FORMAT: Mapping[int, str] = {
    number: "b" if number == 24 else "B" if number not in _WORDS else "h" if number in _SIGNED_WORDS else "H"
    for number in range(7, 59)
}
"""struct letter of each packet."""
_RANGE_OF = {"B": (0, 255), "b": (-128, 127), "H": (0, 65535), "h": (-32768, 32767)}
_RANGE = {number: _RANGE_OF[letter] for number, letter in FORMAT.items()}
SIZE: Mapping[int, int] = {number: struct.calcsize(">" + letter) for number, letter in FORMAT.items()}
LAST_PACKET = {Model.CREATE1: 42, Model.CREATE2: 58}

_GROUPS_BOTH = {0: (7, 26), 1: (7, 16), 2: (17, 20), 3: (21, 26), 4: (27, 34), 5: (35, 42), 6: (7, 42)}
GROUPS: Mapping[Model, Mapping[int, tuple[int, int]]] = {
    Model.CREATE1: _GROUPS_BOTH,
    Model.CREATE2: {**_GROUPS_BOTH, 100: (7, 58), 101: (43, 58), 106: (46, 51), 107: (54, 58)},
}
"""Group id -> its first and last packet."""


def members(model: Model, number: int) -> tuple[int, ...]:
    """The single packets behind a packet or group id, in order; none when this model has no such id."""
    if (ends := GROUPS[model].get(number)) is not None:
        return tuple(range(ends[0], ends[1] + 1))
    return (number,) if 7 <= number <= LAST_PACKET[model] else ()


def saturate(number: int, value: float) -> int:
    """The nearest value that packet can carry."""
    low, high = _RANGE[number]
    return max(low, min(high, round(value)))


class Layout:
    """How a list of packet and group ids lies in bytes: bare as in answers to 142 and 149, or with ids as in a stream."""

    def __init__(self, model: Model, ids: Iterable[int], *, with_ids: bool = False) -> None:
        letters: list[str] = [">"]
        self._order: list[tuple[bool, int]] = []
        for number in ids:
            parts = members(model, number)
            if with_ids and parts:
                letters.append("B")
                self._order.append((True, number))
            letters += [FORMAT[part] for part in parts]
            self._order += [(False, part) for part in parts]
        self._struct = struct.Struct("".join(letters))
        self._marks = tuple((at, number) for at, (mark, number) in enumerate(self._order) if mark)
        self._fields = [at for at, (mark, _) in enumerate(self._order) if not mark]
        self._blank = [number for _, number in self._order]
        """Ids where they stand, and where values stand the ids of these."""
        self.packets = tuple(number for mark, number in self._order if not mark)

    @property
    def size(self) -> int:
        """Bytes."""
        return self._struct.size

    def pack(self, values: Mapping[int, int]) -> bytes:
        """Values by packet id into bytes; each must fit its packet (`saturate`)."""
        told = self._blank.copy()
        for at, number in zip(self._fields, self.packets, strict=True):
            told[at] = values[number]
        return self._struct.pack(*told)

    def unpack(self, data: bytes) -> dict[int, int] | None:
        """Bytes into values by packet id; None when an id is not where it should be."""
        numbers = self._struct.unpack(data)
        for at, number in self._marks:
            if numbers[at] != number:
                return None
        return dict(zip(self.packets, map(numbers.__getitem__, self._fields), strict=True))


class Checksum(Enum):
    """Which bytes of a stream frame sum to a low byte of zero."""

    AFTER_HEADER = "after the header"
    """Create 1: count, payload and checksum."""
    WHOLE = "the whole frame"
    """Create 2: the header 19 too."""


CHECKSUM = {Model.CREATE1: Checksum.AFTER_HEADER, Model.CREATE2: Checksum.WHOLE}
_REST = {Checksum.AFTER_HEADER: FRAME_HEADER, Checksum.WHOLE: 0}
"""What the low byte of the sum of all bytes must be."""


def frame(payload: bytes, rule: Checksum) -> bytes:
    """One stream frame round a payload of ids and data."""
    body = bytes([FRAME_HEADER, len(payload)]) + payload
    return body + bytes([(_REST[rule] - sum(body)) & 0xFF])


class StreamDecoder:
    """Finds the frames of a known packet list in a byte stream that may hold garbage, answers and torn frames."""

    def __init__(self, model: Model, ids: Sequence[int], rules: Iterable[Checksum] = tuple(Checksum)) -> None:
        self._layout = Layout(model, ids, with_ids=True)
        self._start = bytes([FRAME_HEADER, self._layout.size])
        self._length = self._layout.size + 3
        self._rests = frozenset(_REST[rule] for rule in rules)
        self._buffer = bytearray()
        self.skipped_bytes = 0
        """Bytes that belonged to no frame, since the beginning."""

    def feed(self, data: bytes) -> list[dict[int, int]]:
        """Take bytes; give the values of every frame that is now whole, oldest first."""
        buffer = self._buffer
        buffer += data
        frames: list[dict[int, int]] = []
        at = 0
        while True:
            found = self._find(at)
            self.skipped_bytes += found - at
            at = found
            if at + self._length > len(buffer):
                break
            if (values := self._check(at)) is None:
                at += 1
                self.skipped_bytes += 1
            else:
                frames.append(values)
                at += self._length
        del buffer[:at]
        return frames

    def reset(self) -> None:
        """Forget a half-read frame."""
        self._buffer.clear()

    def _find(self, at: int) -> int:
        """Where the next frame may begin; the buffer's end (or its last byte, if that is a header) when nowhere."""
        found = self._buffer.find(self._start, at)
        if found >= 0:
            return found
        end = len(self._buffer)
        return end - 1 if end > at and self._buffer[-1] == FRAME_HEADER else end

    def _check(self, at: int) -> dict[int, int] | None:
        whole = bytes(self._buffer[at : at + self._length])
        return self._layout.unpack(whole[2:-1]) if sum(whole) & 0xFF in self._rests else None


# The dock's infrared bytes


@dataclass(frozen=True, slots=True)
class Beams:
    """What the receiver sees of a dock."""

    red: bool = False
    green: bool = False
    field: bool = False


_IR_BASE = {Model.CREATE1: (240, 8, 4, 2), Model.CREATE2: (160, 8, 4, 1)}
"""Reserved bits, then the bits of red, green and force field."""
IR_NOTHING = {Model.CREATE1: 255, Model.CREATE2: 0}
IR_VIRTUAL_WALL = 162


def ir_byte(model: Model, beams: Beams) -> int:
    """What packet 17 reads in these beams, for the dock that goes with the model."""
    base, red, green, field = _IR_BASE[model]
    bits = red * beams.red + green * beams.green + field * beams.field
    return base + bits if bits else IR_NOTHING[model]


_BEAMS = {
    ir_byte(model, beams): beams
    for model in Model
    for beams in (Beams(bool(k & 4), bool(k & 2), bool(k & 1)) for k in range(1, 8))
}


def ir_beams(byte: int) -> Beams:
    """The beams behind an infrared byte of either dock; none for a remote, a virtual wall or silence."""
    return _BEAMS.get(byte, _NO_BEAMS)


_NO_BEAMS = Beams()


def counter_delta(new: int, old: int) -> int:
    """Encoder counts from old to new across the wrap; the shorter way round."""
    return (new - old + COUNTER_RANGE // 2) % COUNTER_RANGE - COUNTER_RANGE // 2
