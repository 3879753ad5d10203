"""What a Create's sensor packets read: senses of the body and state of the firmware, as integers of the Open Interface."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any, Protocol

from hw.ports import ChargingState
from hw.protocols.create import Mode, Model
from hw.protocols.create_sensors import (
    CAP_MM,
    COUNTER_RANGE,
    Beams,
    Packet,
    ir_byte,
    saturate,
)
from sim.devices.plants import CreateSense

TICKS_PER_TURN = 508.8
FULL_RATIO = 0.995
"""From here on the pack is trickle charged."""
FLOOR_SIGNAL, DROP_SIGNAL, WALL_SIGNAL = 2600, 20, 160
SIGNAL_NOISE = 12
INTERNAL_BAUD_BIT = 0x10
_CREATE1 = Model.CREATE1
_NOT_CHARGING = ChargingState.NOT_CHARGING.value


class Firmware(Protocol):
    """The part of the emulator's state that packets tell."""

    mode: Mode
    motion: Any
    songs: Any

    @property
    def may_charge(self) -> bool: ...

    @property
    def streamed_packets(self) -> int: ...


class Counter:
    """A quantity since it was last read, as a whole number; `carry` keeps the fraction for next time."""

    def __init__(self, carry: bool) -> None:
        self._carry, self._read = carry, 0.0

    def take(self, total: float) -> int:
        since = total - self._read
        whole = math.trunc(since)
        self._read = self._read + whole if self._carry else total
        return max(-CAP_MM, min(CAP_MM, whole))


class Senses:
    """Packets 7 to 58."""

    def __init__(self, model: Model, rng: random.Random, wheelbase_m: float, wheel_m: float, carry: bool) -> None:
        self._model, self._rng = model, rng
        self._wheelbase_m, self._m_per_tick = wheelbase_m, math.pi * wheel_m / TICKS_PER_TURN
        flags = (False, True)
        self._ir = {(r, g, f): ir_byte(model, Beams(r, g, f)) for r in flags for g in flags for f in flags}
        self._distance, self._angle = Counter(carry), Counter(carry)
        self.buttons = 0
        self._pressed_until_s = -math.inf

    def press(self, bits: int, until_s: float) -> None:
        self.buttons, self._pressed_until_s = bits, until_s

    def travel_mm(self, sense: CreateSense) -> float:
        return 500.0 * (sense.left_m + sense.right_m)

    def yaw_deg(self, sense: CreateSense) -> float:
        return math.degrees((sense.right_m - sense.left_m) / self._wheelbase_m)

    def values(self, packets: tuple[int, ...], sense: CreateSense, robot: Firmware, now_s: float) -> dict[int, int]:
        """The packets' values; reading distance and angle clears them."""
        if now_s >= self._pressed_until_s:
            self.buttons = 0
        return {number: _READ[number](self, sense, robot, now_s) for number in packets}

    # One function a packet that is more than a lookup

    def bumps(self, s: CreateSense, r: Firmware, now_s: float) -> int:
        caster = s.drop_caster and self._model is _CREATE1
        return s.bump_right | s.bump_left << 1 | s.drop_right << 2 | s.drop_left << 3 | caster << 4

    def infrared(self, s: CreateSense, r: Firmware, now_s: float) -> int:
        return self._ir[s.ir_red, s.ir_green, s.ir_field]

    def distance(self, s: CreateSense, r: Firmware, now_s: float) -> int:
        return self._distance.take(self.travel_mm(s))

    def angle(self, s: CreateSense, r: Firmware, now_s: float) -> int:
        return self._angle.take(self.yaw_deg(s))

    def charging(self, s: CreateSense, r: Firmware, now_s: float) -> int:
        if not (s.contacts and r.may_charge):
            return _NOT_CHARGING
        if not s.charging:
            return ChargingState.WAITING.value
        if s.charge_ah >= FULL_RATIO * s.capacity_ah:
            return ChargingState.TRICKLE.value
        return ChargingState.FULL_CHARGING.value

    def cliff_signal(self, drop: bool) -> int:
        return max(0, (DROP_SIGNAL if drop else FLOOR_SIGNAL) + self._rng.randint(-SIGNAL_NOISE, SIGNAL_NOISE))

    def ticks(self, travel_m: float) -> int:
        return math.floor(travel_m / self._m_per_tick) % COUNTER_RANGE

    def baud_bit(self) -> int:
        return INTERNAL_BAUD_BIT if self._model is Model.CREATE1 else 0


Reader = Callable[[Senses, CreateSense, Firmware, float], int]

_READ: dict[int, Reader] = dict.fromkeys(range(7, 59), lambda n, s, r, t: 0)
_READ |= {
    Packet.BUMPS_DROPS: Senses.bumps,
    Packet.WALL: lambda n, s, r, t: int(s.wall),
    Packet.CLIFF_LEFT: lambda n, s, r, t: int(s.cliff_left),
    Packet.CLIFF_FRONT_LEFT: lambda n, s, r, t: int(s.cliff_front_left),
    Packet.CLIFF_FRONT_RIGHT: lambda n, s, r, t: int(s.cliff_front_right),
    Packet.CLIFF_RIGHT: lambda n, s, r, t: int(s.cliff_right),
    Packet.VIRTUAL_WALL: lambda n, s, r, t: int(s.ir_field),
    Packet.IR_OMNI: Senses.infrared,
    Packet.BUTTONS: lambda n, s, r, t: n.buttons,
    Packet.DISTANCE_MM: Senses.distance,
    Packet.ANGLE_DEG: Senses.angle,
    Packet.CHARGING_STATE: Senses.charging,
    Packet.VOLTAGE_MV: lambda n, s, r, t: saturate(22, 1000 * s.voltage_v),
    Packet.CURRENT_MA: lambda n, s, r, t: saturate(23, 1000 * s.current_a),
    Packet.TEMPERATURE_C: lambda n, s, r, t: saturate(24, s.temperature_c),
    Packet.CHARGE_MAH: lambda n, s, r, t: saturate(25, 1000 * s.charge_ah),
    Packet.CAPACITY_MAH: lambda n, s, r, t: saturate(26, 1000 * s.capacity_ah),
    Packet.WALL_SIGNAL: lambda n, s, r, t: WALL_SIGNAL if s.wall else 0,
    Packet.CLIFF_LEFT_SIGNAL: lambda n, s, r, t: n.cliff_signal(s.cliff_left),
    Packet.CLIFF_FRONT_LEFT_SIGNAL: lambda n, s, r, t: n.cliff_signal(s.cliff_front_left),
    Packet.CLIFF_FRONT_RIGHT_SIGNAL: lambda n, s, r, t: n.cliff_signal(s.cliff_front_right),
    Packet.CLIFF_RIGHT_SIGNAL: lambda n, s, r, t: n.cliff_signal(s.cliff_right),
    Packet.DIGITAL_INPUTS: lambda n, s, r, t: n.baud_bit(),
    Packet.CHARGING_SOURCES: lambda n, s, r, t: s.contacts << 1,
    Packet.OI_MODE: lambda n, s, r, t: int(r.mode),
    Packet.SONG_NUMBER: lambda n, s, r, t: r.songs.number,
    Packet.SONG_PLAYING: lambda n, s, r, t: int(r.songs.playing(t)),
    Packet.STREAM_PACKETS: lambda n, s, r, t: r.streamed_packets,
    Packet.REQUESTED_VELOCITY: lambda n, s, r, t: r.motion.velocity,
    Packet.REQUESTED_RADIUS: lambda n, s, r, t: r.motion.radius,
    Packet.REQUESTED_RIGHT: lambda n, s, r, t: r.motion.direct_right,
    Packet.REQUESTED_LEFT: lambda n, s, r, t: r.motion.direct_left,
    Packet.ENCODER_LEFT: lambda n, s, r, t: n.ticks(s.left_m),
    Packet.ENCODER_RIGHT: lambda n, s, r, t: n.ticks(s.right_m),
    Packet.IR_LEFT: Senses.infrared,
    Packet.IR_RIGHT: Senses.infrared,
    Packet.STASIS: lambda n, s, r, t: int(r.motion.forward),
}
