from __future__ import annotations

import random

import pytest

from sim.devices.bench_ssc32 import BenchRig
from sim.devices.ssc32 import Ssc32Emulator


class Board:
    """An emulator with its own idea of time."""

    def __init__(self) -> None:
        self.rig = BenchRig()
        self.emulator = Ssc32Emulator(self.rig, random.Random(1))
        self.now_s = 50.0

    def say(self, text: str) -> bytes:
        """One line, and what the board answers within its delay."""
        self.emulator.receive(text.encode() + b"\r", self.now_s)
        assert self.emulator.transmit() == b""
        return self.wait(0.005)

    def wait(self, seconds: float) -> bytes:
        end_s, answer = self.now_s + seconds, b""
        while (due_s := self.emulator.due_s()) <= end_s:
            self.now_s = max(self.now_s, due_s)
            self.emulator.step(self.now_s)
            answer += self.emulator.transmit()
        self.now_s = end_s
        self.emulator.step(end_s)
        return answer + self.emulator.transmit()


@pytest.fixture
def board() -> Board:
    return Board()


def test_the_first_move_of_a_channel_jumps_whatever_its_speed(board: Board) -> None:
    board.say("#0P1500S100T5000")
    assert board.rig.pulses_us[0] == 1500
    assert board.say("Q") == b"."


def test_a_known_channel_moves_linearly_and_arrives_on_time(board: Board) -> None:
    board.say("#0P1000")
    board.say("#0P2000T1000")
    board.wait(0.495)
    assert board.rig.pulses_us[0] == pytest.approx(1500, abs=21)
    assert board.say("Q") == b"+"
    board.wait(0.5)
    assert board.rig.pulses_us[0] == 2000
    assert board.say("Q") == b"."


@pytest.mark.parametrize(("line", "takes_s"), [("#0P1500S250T1000", 2.0), ("#0P1500S1000T1000", 1.0)])
def test_the_slower_of_speed_and_time_wins(board: Board, line: str, takes_s: float) -> None:
    board.say("#0P1000")
    board.say(line)
    board.wait(takes_s - 0.05)
    assert board.say("Q") == b"+"
    board.wait(0.05)
    assert board.say("Q") == b"."


def test_a_group_arrives_together(board: Board) -> None:
    board.say("#0P1000#1P1000")
    board.say("#0P2000S500#1P1100")
    board.wait(1.0)
    assert board.rig.pulses_us[0] == pytest.approx(1500, abs=15)
    assert board.rig.pulses_us[1] == pytest.approx(1050, abs=2)


def test_a_move_without_speed_or_time_is_immediate(board: Board) -> None:
    board.say("#0P1000")
    board.say("#0P2000")
    assert board.rig.pulses_us[0] == 2000


def test_query_pulses_answers_tens_of_microseconds_and_zero_for_the_undriven(board: Board) -> None:
    board.say("#0P1500#1P2500")
    assert board.say("QP0 QP1 QP2") == b"\x96\xfa\x00"


def test_the_first_analog_read_after_power_up_is_invalid(board: Board) -> None:
    assert board.say("VA VB") == b"\xff\xff"
    assert board.say("VA VB") == b"\x66\xb3"


def test_a_digital_read_turns_the_pin_back(board: Board) -> None:
    board.say("VA")
    assert board.say("A C") == b"10"
    assert board.say("VA") == b"\xff"


def test_a_latch_remembers_a_low_until_read(board: Board) -> None:
    assert board.say("AL") == b"1"
    board.rig.volts[0] = 0.0
    board.wait(0.05)
    board.rig.volts[0] = 5.0
    board.wait(0.05)
    assert board.say("AL") == b"0"
    assert board.say("AL") == b"1"


def test_outputs_switch_one_by_one_and_by_bank(board: Board) -> None:
    board.say("#8H")
    assert board.rig.outputs == {8: True}
    board.say("#1:0")
    assert board.rig.outputs == {8: False}


def test_stop_holds_one_channel_and_the_group_goes_on(board: Board) -> None:
    board.say("#0P1000#1P1000")
    board.say("#0P2000#1P2000T1000")
    board.wait(0.5)
    board.say("STOP 0")
    board.wait(0.2)
    assert board.say("Q") == b"+"
    board.wait(1.0)
    assert board.rig.pulses_us[0] == pytest.approx(1500, abs=25)
    assert board.rig.pulses_us[1] == 2000


def test_an_offset_shifts_the_pulse_and_not_the_answer(board: Board) -> None:
    board.say("#0P1500")
    board.say("#0PO-20")
    assert board.rig.pulses_us[0] == 1480
    assert board.say("QP0") == b"\x96"


def test_version_and_registers(board: Board) -> None:
    assert board.say("VER") == b"SSC32-V2.50USB\r"
    board.say("R4=11520")
    assert board.say("R4") == b"11520\r"
    assert board.say("RDFLT") == b"OK\r"
    assert board.say("R4") == b"960\r"


def test_a_move_goes_on_when_nobody_speaks(board: Board) -> None:
    board.say("#0P1000")
    board.say("#0P2000T2000#8H")
    board.say("#8H")
    board.wait(60.0)
    assert board.rig.pulses_us[0] == 2000
    assert board.rig.outputs[8]


def test_nothing_is_due_while_nothing_happens(board: Board) -> None:
    board.say("#0P1000")
    assert board.emulator.due_s() == float("inf")
