from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hw.protocols import ssc32 as wire

pulses = st.dictionaries(st.integers(0, 31), st.integers(500, 2500), min_size=1, max_size=6)


def commands(data: bytes) -> list[wire.Command]:
    return [command for line in wire.LineReader().feed(data) for command in wire.parse_line(line)]


def test_the_manuals_group_move_comes_out_to_the_byte() -> None:
    expected = bytes.fromhex("23 30 50 31 35 30 30 23 31 50 32 30 30 30 54 31 30 30 30 0d")
    assert wire.encode_move({0: 1500, 1: 2000}, 1.0) == expected


def test_speeds_go_with_their_channel_and_time_with_the_group() -> None:
    (move,) = commands(b"#0P1500S750#1P1600#2P900T1000\r")
    moves = (wire.ChannelMove(0, 1500, 750), wire.ChannelMove(1, 1600), wire.ChannelMove(2, 900))
    assert move == wire.Move(moves, 1000)
    assert wire.encode_move({0: 1500, 1: 1600, 2: 900}, 1.0, {0: 750}) == b"#0P1500S750#1P1600#2P900T1000\r"


@given(pulses, st.integers(0, 65535))
def test_what_is_encoded_is_parsed(pulses_us: dict[int, int], duration_ms: int) -> None:
    (move,) = commands(wire.encode_move(pulses_us, duration_ms / 1000))
    assert isinstance(move, wire.Move)
    assert {each.channel: each.pulse_us for each in move.moves} == pulses_us
    assert move.duration_ms == duration_ms


@given(st.binary(max_size=200))
def test_no_garbage_is_too_odd_to_parse(data: bytes) -> None:
    for command in commands(data + b"\r"):
        assert command is not None


def test_case_blanks_and_line_feeds_do_not_matter() -> None:
    assert commands(b" #8\th \n\r") == [wire.Output(8, True)]
    assert commands(b"va Vb\r") == [wire.QueryAnalog((0, 1))]


def test_escape_cancels_the_line_being_typed() -> None:
    assert commands(b"#8H\x1b#9L\r") == [wire.Output(9, False)]


def test_a_command_cut_anywhere_is_one_command() -> None:
    reader = wire.LineReader()
    lines = [line for byte in b"#0P1500T500\r" for line in reader.feed(bytes((byte,)))]
    assert lines == ["#0P1500T500"]


def test_a_byte_output_is_eight_outputs() -> None:
    highs = [output.channel for output in commands(b"#3:5\r") if isinstance(output, wire.Output) and output.high]
    assert highs == [24, 26]
    assert len(commands(b"#3:5\r")) == 8


def test_channels_and_pulses_the_board_has_not_are_left_out() -> None:
    assert commands(b"#32P1500\r") == []
    assert commands(b"#0P2600\r") == []
    assert commands(b"#4:1\r#0:256\rSTOP32\r#0PO101\r") == []


def test_queries_are_told_apart() -> None:
    assert commands(b"Q\rQP1QP31\rAL B\rVER\rR4\rR4=960\rRDFLT\r") == [
        wire.QueryMoving(),
        wire.QueryPulses((1, 31)),
        wire.QueryDigital(((0, True), (1, False))),
        wire.QueryVersion(),
        wire.ReadRegister(4),
        wire.WriteRegister(4, 960),
        wire.DefaultRegisters(),
    ]


def test_two_volts_are_102_counts() -> None:
    assert (wire.count_of(2.0), wire.count_of(3.5)) == (102, 179)
    assert wire.volts_of(102) == 102 * 5 / 256


def test_a_stop_of_many_channels_is_one_short_write() -> None:
    assert wire.encode_stop((0, 1, 12)) == b"STOP0\rSTOP1\rSTOP12\r"
