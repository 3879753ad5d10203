from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hw.protocols import firmata as wire


def to_host(data: bytes) -> list[wire.Message]:
    return wire.FirmataReader(to_host=True).feed(data)


def to_board(data: bytes) -> list[wire.Message]:
    return wire.FirmataReader(to_host=False).feed(data)


@given(st.integers(0, 15), st.integers(0, 16383))
def test_an_analog_value_comes_back(channel: int, value: int) -> None:
    assert to_host(wire.encode_analog(channel, value)) == [wire.Analog(channel, value)]


@given(st.text(st.characters(max_codepoint=255), max_size=40))
def test_text_travels_as_fourteen_bit_pairs(text: str) -> None:
    packed = wire.pack_text(text)
    assert all(byte < 0x80 for byte in packed)
    assert wire.unpack_text(packed) == text


def test_the_version_is_a_question_one_way_and_an_answer_the_other() -> None:
    assert to_board(b"\xf9") == [wire.Version()]
    assert to_host(b"\xf9\x02\x05") == [wire.Version(2, 5)]


def test_the_hosts_messages_are_those_of_the_protocol() -> None:
    assert wire.encode_report_analog(0, True) == b"\xc0\x01"
    assert wire.encode_pin_mode(8, wire.MODE_OUTPUT) == b"\xf4\x08\x01"
    assert wire.encode_pin_value(8, True) == b"\xf5\x08\x01"
    assert wire.encode_sampling_interval(20) == b"\xf0\x7a\x14\x00\xf7"
    assert wire.encode_digital(1, 0x81) == b"\x91\x01\x01"


def test_the_board_understands_them() -> None:
    data = b"\xc0\x01\xd1\x00\xf4\x08\x01\xf5\x08\x01\x91\x01\x01\xff\xf0\x7a\x14\x00\xf7"
    assert to_board(data) == [
        wire.ReportAnalog(0, True),
        wire.ReportDigital(1, False),
        wire.PinMode(8, 1),
        wire.PinValue(8, True),
        wire.Digital(1, 0x81),
        wire.Reset(),
        wire.Sysex(wire.SAMPLING_INTERVAL, b"\x14\x00"),
    ]


def test_capabilities_and_mapping_come_back() -> None:
    (message,) = to_host(wire.encode_capabilities([[], [(0, 1), (1, 1)], [(2, 10)]]))
    assert isinstance(message, wire.Sysex)
    assert wire.decode_capabilities(message.data) == ({}, {0: 1, 1: 1}, {2: 10})
    (message,) = to_host(wire.encode_analog_mapping([None, 0]))
    assert isinstance(message, wire.Sysex)
    assert wire.decode_analog_mapping(message.data) == (None, 0)


@given(st.binary(max_size=300), st.booleans())
def test_no_garbage_is_too_odd_to_parse(data: bytes, towards_host: bool) -> None:
    reader = wire.FirmataReader(to_host=towards_host)
    reader.feed(data)
    assert wire.Analog(3, 700) in reader.feed(wire.encode_analog(3, 700))


@given(st.integers(1, 8))
def test_a_message_cut_anywhere_is_one_message(cut: int) -> None:
    data = wire.encode_firmware(2, 5, "ab")
    reader = wire.FirmataReader(to_host=True)
    assert reader.feed(data[:cut]) == []
    (message,) = reader.feed(data[cut:])
    assert message == wire.Sysex(wire.FIRMWARE, b"\x02\x05a\x00b\x00")


def test_an_endless_sysex_does_not_grow_for_ever() -> None:
    reader = wire.FirmataReader(to_host=True)
    assert reader.feed(b"\xf0" + b"\x01" * 5000) == []
    assert reader.dropped > 0
