"""An Arduino Uno running StandardFirmata: analog reporting, digital outputs, and the queries of a client's setup.

It answers as version 2.5. Outputs hold until told otherwise: the firmware has no watchdog, so a closed link switches
nothing.
"""

from __future__ import annotations

import math
import random

from hw.protocols import firmata as wire
from hw.protocols.vh400 import code_of
from sim.devices.outbox import Outbox
from sim.devices.plants import BoardPins

DIGITAL_PINS = 14
ANALOG_PINS = 6
PINS = DIGITAL_PINS + ANALOG_PINS
PWM_PINS = (3, 5, 6, 9, 10, 11)
FIRMWARE = (2, 5, "StandardFirmata.ino")
ANSWER_DELAY_S = 0.004
SAMPLING_S = 0.019
SAMPLING_S_MIN = 0.001


class FirmataEmulator:
    """Fills `Emulator` over `BoardPins`.

    A probe's noise belongs to the pins; `noise_v` is the standard deviation of the converter's own, drawn from `rng`.
    """

    def __init__(
        self, pins: BoardPins, rng: random.Random, vref_v: float = 5.0, bits: int = 10, *, noise_v: float = 0.0
    ) -> None:
        self._pins, self._rng = pins, rng
        self._vref_v, self._bits, self._noise_v = vref_v, bits, noise_v
        self._reader, self._out = wire.FirmataReader(to_host=False), Outbox()
        self._levels = [False] * PINS
        self._sample_s = math.inf
        self._reset()
        self._out.put(wire.encode_version(*FIRMWARE[:2]) + wire.encode_firmware(*FIRMWARE), 0.0)

    def receive(self, data: bytes, now_s: float) -> None:
        self.step(now_s)
        for message in self._reader.feed(data):
            self._obey(message, now_s)

    def step(self, now_s: float) -> None:
        if now_s >= self._sample_s - 1e-9:
            for channel in sorted(self._reporting):
                self._out.put(wire.encode_analog(channel, self._read(channel)), now_s)
            self._sample_s = now_s + self._interval_s if self._reporting else math.inf
        self._out.release(now_s)

    def transmit(self) -> bytes:
        return self._out.take()

    def due_s(self) -> float:
        return min(self._sample_s, self._out.due_s())

    def _reset(self) -> None:
        """As after power-up: nothing reports, every output is low."""
        self._modes = [wire.MODE_OUTPUT] * DIGITAL_PINS + [wire.MODE_ANALOG] * ANALOG_PINS
        self._reporting: set[int] = set()
        self._ports: set[int] = set()
        self._interval_s = SAMPLING_S
        for pin in range(PINS):
            self._set_level(pin, False)

    def _obey(self, message: wire.Message, now_s: float) -> None:
        match message:
            case wire.Version():
                self._say(wire.encode_version(*FIRMWARE[:2]), now_s)
            case wire.ReportAnalog(channel, on):
                self._report_analog(channel, on, now_s)
            case wire.ReportDigital(port, on):
                self._report_digital(port, on, now_s)
            case wire.PinMode(pin, mode) if pin < PINS and mode in dict(_capabilities(pin)):
                self._modes[pin] = mode
                self._set_level(pin, False)
            case wire.PinValue(pin, high) if pin < PINS and self._modes[pin] == wire.MODE_OUTPUT:
                self._set_level(pin, high)
            case wire.Digital(port, mask):
                self._write_port(port, mask)
            case wire.Analog(pin, value):
                self._write_pwm(pin, value)
            case wire.Reset():
                self._reset()
            case wire.Sysex(command, data):
                self._obey_sysex(command, data, now_s)

    def _obey_sysex(self, command: int, data: bytes, now_s: float) -> None:
        match command:
            case wire.FIRMWARE:
                self._say(wire.encode_firmware(*FIRMWARE), now_s)
            case wire.CAPABILITY_QUERY:
                self._say(wire.encode_capabilities(_capabilities(pin) for pin in range(PINS)), now_s)
            case wire.ANALOG_MAPPING_QUERY:
                channels = [None] * DIGITAL_PINS + list(range(ANALOG_PINS))
                self._say(wire.encode_analog_mapping(channels), now_s)
            case wire.PIN_STATE_QUERY if len(data) == 1 and data[0] < PINS:
                state = bytes((data[0], self._modes[data[0]], self._levels[data[0]]))
                self._say(wire.sysex(wire.PIN_STATE_RESPONSE, state), now_s)
            case wire.SAMPLING_INTERVAL if len(data) == 2:
                self._interval_s = max(SAMPLING_S_MIN, wire.of_14_bit(data[0], data[1]) / 1000.0)
            case wire.EXTENDED_ANALOG if len(data) >= 2:
                self._write_pwm(data[0], sum(part << 7 * i for i, part in enumerate(data[1:])))
            case wire.STRING_DATA:
                self._say(wire.encode_string(wire.unpack_text(data)), now_s)

    def _say(self, data: bytes, now_s: float) -> None:
        self._out.put(data, now_s + ANSWER_DELAY_S)

    def _report_analog(self, channel: int, on: bool, now_s: float) -> None:
        """Turning it on sends one value at once, the rest at the sampling interval."""
        if channel >= ANALOG_PINS:
            return
        if not on:
            self._reporting.discard(channel)
            self._sample_s = self._sample_s if self._reporting else math.inf
            return
        if not self._reporting:
            self._sample_s = now_s + self._interval_s
        self._reporting.add(channel)
        self._say(wire.encode_analog(channel, self._read(channel)), now_s)

    def _report_digital(self, port: int, on: bool, now_s: float) -> None:
        """Inputs hang on nothing here: they read as their pull-up says and never change."""
        if port * 8 >= PINS or not on:
            self._ports.discard(port)
            return
        self._ports.add(port)
        pins = range(port * 8, min(PINS, port * 8 + 8))
        mask = sum(1 << pin - port * 8 for pin in pins if self._modes[pin] == wire.MODE_PULLUP)
        self._say(wire.encode_digital(port, mask), now_s)

    def _read(self, channel: int) -> int:
        noise_v = self._rng.gauss(0.0, self._noise_v) if self._noise_v > 0 else 0.0
        return code_of(self._pins.analog_v(channel) + noise_v, self._vref_v, self._bits)

    def _write_port(self, port: int, mask: int) -> None:
        for pin in range(port * 8, min(PINS, port * 8 + 8)):
            if self._modes[pin] == wire.MODE_OUTPUT:
                self._set_level(pin, bool(mask >> pin - port * 8 & 1))

    def _write_pwm(self, pin: int, value: int) -> None:
        """A duty of half or more counts as on: nothing here can tell more."""
        if pin < PINS and self._modes[pin] == wire.MODE_PWM:
            self._set_level(pin, value >= 128)

    def _set_level(self, pin: int, high: bool) -> None:
        if self._levels[pin] != high:
            self._levels[pin] = high
            self._pins.set_digital(pin, high)


def _capabilities(pin: int) -> list[tuple[int, int]]:
    """(mode, resolution in bits) of an Uno's pin; the serial port's own pins have none.

    The protocol leaves the order open; clients of the pyFirmata family look for output right after input.
    """
    if pin < 2:
        return []
    modes = [(wire.MODE_INPUT, 1), (wire.MODE_OUTPUT, 1), (wire.MODE_PULLUP, 1)]
    if pin >= DIGITAL_PINS:
        return [*modes, (wire.MODE_ANALOG, 10)]
    return modes + ([(wire.MODE_PWM, 8)] if pin in PWM_PINS else []) + [(wire.MODE_SERVO, 14)]
