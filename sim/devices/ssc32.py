"""A Lynxmotion SSC-32's firmware: moves pulses, switches outputs, answers. A closed link stops nothing.

Pulses run linearly in 20 ms servo frames. A channel's first move after power-up ignores speed and time and jumps,
because the board cannot know where the servo stands. When speed and time are both given, the slower wins.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from hw.protocols import ssc32 as wire
from sim.devices.outbox import Outbox
from sim.devices.plants import ServoRig

FRAME_S = 0.02
ANSWER_DELAY_S = 0.004
DEBOUNCE_S = 0.015
DIGITAL_HIGH_V = 2.0
UNSETTLED_COUNT = 255
"""What the first analog read of an input gives: the pull-up of the digital mode it leaves."""
REGISTER_DEFAULTS = {0: 0, 4: 960}


@dataclass(slots=True)
class _Channel:
    start_us: float
    target_us: float
    start_s: float
    end_s: float
    sent_us: float = -1.0

    def pulse_us(self, now_s: float) -> float:
        if now_s >= self.end_s - 1e-9:
            return self.target_us
        return self.start_us + (self.target_us - self.start_us) * (now_s - self.start_s) / (self.end_s - self.start_s)


@dataclass(slots=True)
class _Input:
    analog: bool = False
    latched_low: bool = False
    armed: bool = False


class Ssc32Emulator:
    """Fills `Emulator` over a `ServoRig`. `noise_counts` is the converter's own noise, drawn from `rng`."""

    def __init__(
        self, rig: ServoRig, rng: random.Random, version: str = "SSC32-V2.50USB", *, noise_counts: float = 0.0
    ) -> None:
        self._rig, self._rng, self._version, self._noise_counts = rig, rng, version, noise_counts
        self._lines, self._out = wire.LineReader(), Outbox()
        self._channels: dict[int, _Channel] = {}
        self._moving: set[int] = set()
        self._offsets_us: dict[int, int] = {}
        self._levels: dict[int, bool] = {}
        self._inputs = [_Input() for _ in range(wire.ANALOG_INPUTS)]
        self._registers = dict(REGISTER_DEFAULTS)
        self._group_end_s = -math.inf
        self._frame_s = math.inf
        self._poll_s = math.inf

    def receive(self, data: bytes, now_s: float) -> None:
        self.step(now_s)
        for line in self._lines.feed(data):
            for command in wire.parse_line(line):
                self._out.put(self._obey(command, now_s), now_s + ANSWER_DELAY_S)

    def step(self, now_s: float) -> None:
        if self._moving and now_s >= self._frame_s - 1e-9:
            self._drive(now_s)
        if now_s >= self._poll_s - 1e-9:
            self._poll_latches()
            self._poll_s = now_s + DEBOUNCE_S
        self._out.release(now_s)

    def transmit(self) -> bytes:
        return self._out.take()

    def due_s(self) -> float:
        return min(self._frame_s, self._poll_s, self._out.due_s())

    def _drive(self, now_s: float) -> None:
        """One servo frame: every moving channel's pulse as of now."""
        next_s = now_s + FRAME_S
        for number in sorted(self._moving):
            channel = self._channels[number]
            self._send(number, channel, now_s)
            if channel.end_s <= now_s + 1e-9:
                self._moving.discard(number)
            elif channel.end_s < next_s:
                next_s = channel.end_s
        self._frame_s = next_s if self._moving else math.inf

    def _send(self, number: int, channel: _Channel, now_s: float) -> None:
        pulse = channel.pulse_us(now_s) + self._offsets_us.get(number, 0)
        if pulse != channel.sent_us:
            channel.sent_us = pulse
            self._rig.set_pulse(number, pulse)

    def _obey(self, command: wire.Command, now_s: float) -> bytes:
        match command:
            case wire.Move():
                self._move(command, now_s)
            case wire.Output(channel, high):
                self._set_output(channel, high)
            case wire.Offset(channel, offset_us):
                self._set_offset(channel, offset_us, now_s)
            case wire.Stop(channel):
                self._stop(channel, now_s)
            case _:
                return self._answer(command, now_s)
        return b""

    def _answer(self, command: wire.Command, now_s: float) -> bytes:
        match command:
            case wire.QueryMoving():
                return wire.MOVING if now_s < self._group_end_s else wire.DONE
            case wire.QueryPulses(channels):
                return bytes(self._pulse_count(channel, now_s) for channel in channels)
            case wire.QueryAnalog(inputs):
                return bytes(self._read_analog(index) for index in inputs)
            case wire.QueryDigital(inputs):
                return "".join(self._read_digital(index, latch, now_s) for index, latch in inputs).encode()
            case wire.QueryVersion():
                return self._version.encode() + b"\r"
            case wire.ReadRegister(register):
                return b"%d\r" % self._registers.get(register, 0)
            case wire.WriteRegister(register, value):
                self._registers[register] = value
            case wire.DefaultRegisters():
                self._registers = dict(REGISTER_DEFAULTS)
                return b"OK\r"
        return b""

    def _move(self, group: wire.Move, now_s: float) -> None:
        duration_s = self._duration(group, now_s)
        for move in group.moves:
            known = self._channels.get(move.channel)
            start_us = known.pulse_us(now_s) if known else float(move.pulse_us)
            end_s = now_s + (duration_s if known else 0.0)
            sent_us = known.sent_us if known else -1.0
            self._channels[move.channel] = _Channel(start_us, float(move.pulse_us), now_s, end_s, sent_us)
            self._moving.add(move.channel)
        self._group_end_s = now_s + duration_s
        self._drive(now_s)

    def _duration(self, group: wire.Move, now_s: float) -> float:
        """The slowest of the common time and each known channel's distance over its speed [s]."""
        known = [move for move in group.moves if move.channel in self._channels]
        if not known:
            return 0.0
        times_s = [(group.duration_ms or 0) / 1000.0]
        for move in known:
            if move.speed_usps:
                distance_us = abs(move.pulse_us - self._channels[move.channel].pulse_us(now_s))
                times_s.append(distance_us / move.speed_usps)
        return max(times_s)

    def _stop(self, number: int, now_s: float) -> None:
        """The channel holds where it is; `Q` goes on to tell of the group's own end."""
        if (channel := self._channels.get(number)) is not None and number in self._moving:
            here_us = channel.pulse_us(now_s)
            self._channels[number] = _Channel(here_us, here_us, now_s, now_s, channel.sent_us)
            self._drive(now_s)

    def _set_output(self, channel: int, high: bool) -> None:
        if self._levels.get(channel, False) != high:
            self._levels[channel] = high
            self._rig.set_output(channel, high)

    def _set_offset(self, number: int, offset_us: int, now_s: float) -> None:
        self._offsets_us[number] = offset_us
        if (channel := self._channels.get(number)) is not None:
            self._send(number, channel, now_s)

    def _pulse_count(self, number: int, now_s: float) -> int:
        channel = self._channels.get(number)
        return round(channel.pulse_us(now_s) / 10.0) if channel else 0

    def _volts(self, index: int) -> float:
        return self._rig.analog_v(index) if index < 4 else 0.0

    def _read_analog(self, index: int) -> int:
        pin = self._inputs[index]
        if not pin.analog:
            pin.analog = True
            return UNSETTLED_COUNT
        noise = self._rng.gauss(0.0, self._noise_counts) if self._noise_counts > 0 else 0.0
        return wire.count_of(self._volts(index) + noise * wire.VOLTS_PER_COUNT)

    def _read_digital(self, index: int, latch: bool, now_s: float) -> str:
        pin = self._inputs[index]
        pin.analog = False
        high = self._volts(index) >= DIGITAL_HIGH_V
        if not latch:
            return "1" if high else "0"
        was_low, pin.latched_low = pin.latched_low or not high, False
        pin.armed = True
        self._poll_s = min(self._poll_s, now_s + DEBOUNCE_S)
        return "0" if was_low else "1"

    def _poll_latches(self) -> None:
        for index, pin in enumerate(self._inputs):
            if pin.armed and self._volts(index) < DIGITAL_HIGH_V:
                pin.latched_low = True
