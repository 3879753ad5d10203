from __future__ import annotations

import random

import pytest

from hw.protocols import firmata as wire
from hw.protocols.vh400 import code_of
from sim.devices.firmata import FirmataEmulator


class Pins:
    def __init__(self) -> None:
        self.volts = 1.5
        self.levels: dict[int, bool] = {}

    def analog_v(self, pin: int) -> float:
        return self.volts if pin == 0 else 0.0

    def set_digital(self, pin: int, high: bool) -> None:
        self.levels[pin] = high


class Board:
    def __init__(self) -> None:
        self.pins = Pins()
        self.emulator = FirmataEmulator(self.pins, random.Random(1))
        self.reader = wire.FirmataReader(to_host=True)
        self.now_s = 5.0
        self.hello = self.wait(0.01)

    def wait(self, seconds: float) -> list[wire.Message]:
        end_s, data = self.now_s + seconds, b""
        while (due_s := self.emulator.due_s()) <= end_s:
            self.now_s = max(self.now_s, due_s)
            self.emulator.step(self.now_s)
            data += self.emulator.transmit()
        self.now_s = end_s
        return self.reader.feed(data)

    def say(self, data: bytes, wait_s: float = 0.01) -> list[wire.Message]:
        self.emulator.receive(data, self.now_s)
        assert self.emulator.transmit() == b""
        return self.wait(wait_s)


@pytest.fixture
def board() -> Board:
    return Board()


def test_it_says_version_and_name_at_power_up(board: Board) -> None:
    version, firmware = board.hello
    assert version == wire.Version(2, 5)
    assert isinstance(firmware, wire.Sysex)
    assert wire.unpack_text(firmware.data[2:]) == "StandardFirmata.ino"


def test_reporting_is_off_until_asked_for(board: Board) -> None:
    assert board.wait(10.0) == []
    assert board.emulator.due_s() == float("inf")


def test_values_come_at_once_and_then_at_the_sampling_interval(board: Board) -> None:
    board.say(wire.encode_sampling_interval(20))
    values = board.say(wire.encode_report_analog(0, True), 0.111)
    assert values == [wire.Analog(0, code_of(1.5))] * 6
    board.say(wire.encode_report_analog(0, False), 0.03)
    assert board.wait(1.0) == []


def test_outputs_follow_the_pin_and_the_port(board: Board) -> None:
    board.say(wire.encode_pin_mode(8, wire.MODE_OUTPUT) + wire.encode_pin_value(8, True))
    assert board.pins.levels == {8: True}
    board.say(wire.encode_digital(1, 0b10))
    assert board.pins.levels == {8: False, 9: True}


def test_a_pin_that_is_no_output_is_not_driven(board: Board) -> None:
    board.say(wire.encode_pin_mode(8, wire.MODE_PULLUP) + wire.encode_pin_value(8, True))
    assert board.pins.levels == {}


def test_pin_state_tells_mode_and_level(board: Board) -> None:
    board.say(wire.encode_pin_value(8, True))
    (state,) = board.say(wire.sysex(wire.PIN_STATE_QUERY, b"\x08"))
    assert state == wire.Sysex(wire.PIN_STATE_RESPONSE, b"\x08\x01\x01")


def test_a_reset_lowers_outputs_and_ends_reports(board: Board) -> None:
    board.say(wire.encode_pin_value(8, True) + wire.encode_report_analog(0, True))
    board.say(b"\xff")
    assert board.pins.levels == {8: False}
    assert board.wait(1.0) == []


def test_the_queries_of_a_clients_setup_are_answered(board: Board) -> None:
    (capabilities,) = board.say(wire.sysex(wire.CAPABILITY_QUERY))
    (mapping,) = board.say(wire.sysex(wire.ANALOG_MAPPING_QUERY))
    assert isinstance(capabilities, wire.Sysex)
    assert isinstance(mapping, wire.Sysex)
    pins = wire.decode_capabilities(capabilities.data)
    assert len(pins) == 20
    assert pins[0] == {}
    assert pins[14][wire.MODE_ANALOG] == 10
    assert wire.decode_analog_mapping(mapping.data)[13:] == (None, 0, 1, 2, 3, 4, 5)


def test_strings_and_pwm_are_taken(board: Board) -> None:
    (echo,) = board.say(wire.encode_string("hello"))
    assert isinstance(echo, wire.Sysex)
    assert wire.unpack_text(echo.data) == "hello"
    board.say(wire.encode_pin_mode(9, wire.MODE_PWM) + wire.encode_analog(9, 200))
    assert board.pins.levels == {9: True}


def test_nothing_closes_a_valve_but_the_host(board: Board) -> None:
    board.say(wire.encode_pin_value(8, True))
    board.wait(1000.0)
    assert board.pins.levels == {8: True}


def test_garbage_moves_no_pin(board: Board) -> None:
    rng = random.Random(9)
    for _ in range(50):
        board.say(bytes(rng.randrange(0x80) for _ in range(20)))
    assert board.pins.levels == {}
