"""The Open Interface codec: documented bytes, and properties over any bytes."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw.protocols import create as oi
from hw.protocols import create_sensors as sensors
from hw.protocols.create import Command, CommandParser, Model, Op
from hw.protocols.create_sensors import CHECKSUM, Beams, Checksum, Layout, StreamDecoder, frame

models = st.sampled_from(list(Model))


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (oi.bare(Op.START), "80"),
        (oi.bare(Op.SAFE), "83"),
        (oi.bare(Op.FULL), "84"),
        (oi.drive(-200, 500), "89 ff 38 01 f4"),
        (oi.drive(200, oi.STRAIGHT), "89 00 c8 80 00"),
        (oi.drive(100, oi.SPIN_LEFT), "89 00 64 00 01"),
        (oi.drive_direct(100, -100), "91 00 64 ff 9c"),
        (oi.drive_direct(0, 0), "91 00 00 00 00"),
        (oi.sensors(100), "8e 64"),
        (oi.query((19, 20, 17, 7)), "95 04 13 14 11 07"),
        (oi.stream((29, 13)), "94 02 1d 0d"),
        (oi.stream_switch(False), "96 00"),
        (oi.bare(Op.SEEK_DOCK), "8f"),
        (oi.bare(Op.STOP), "ad"),
        (oi.baud(57600), "81 0a"),
        (oi.baud(115200), "81 0b"),
        (oi.song(0, [(60, 32)]), "8c 00 01 3c 20"),
        (oi.demo(-1), "88 ff"),
        (oi.wait_event(-5), "9e fb"),
        (oi.wait_distance(-300), "9c fe d4"),
        (oi.script(oi.wait_time(10)), "98 02 9b 0a"),
        (oi.digits_ascii("ab"), "a4 61 62 20 20"),
    ],
)
def test_commands_are_the_documented_bytes(made: bytes, expected: str) -> None:
    assert made == bytes.fromhex(expected)


@pytest.mark.parametrize(
    "make",
    [
        lambda: oi.drive(501, 100),
        lambda: oi.drive(100, 0),
        lambda: oi.drive(100, 2001),
        lambda: oi.drive_direct(0, -501),
        lambda: oi.song(0, []),
        lambda: oi.wait_event(0x17),
        lambda: oi.demo(10),
        lambda: oi.script(bytes(101)),
        lambda: oi.schedule(1, [(1, 1)]),
    ],
)
def test_what_the_manual_does_not_allow_is_refused(make) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        make()


@pytest.mark.parametrize(
    ("group", "size"),
    [(0, 26), (1, 10), (2, 6), (3, 10), (4, 14), (5, 12), (6, 52), (100, 80), (101, 28), (106, 12), (107, 9)],
)
def test_groups_have_the_documented_sizes(group: int, size: int) -> None:
    assert Layout(Model.CREATE2, [group]).size == size
    assert Layout(Model.CREATE1, [group]).size == (size if group <= 6 else 0)


@pytest.mark.parametrize(
    ("packet", "offset"), [(19, 12), (20, 14), (21, 16), (22, 17), (35, 40), (39, 44), (43, 52), (45, 56), (52, 69)]
)
def test_packets_lie_where_the_manual_puts_them_in_group_100(packet: int, offset: int) -> None:
    assert Layout(Model.CREATE2, range(7, packet)).size == offset


def test_stream_frames_are_the_documented_bytes() -> None:
    payload = Layout(Model.CREATE1, (29, 13), with_ids=True).pack({29: 549, 13: 0})
    assert frame(payload, Checksum.AFTER_HEADER) == bytes.fromhex("13 05 1d 02 25 0d 00 aa")
    assert frame(payload, Checksum.WHOLE) == bytes.fromhex("13 05 1d 02 25 0d 00 97")
    payload = Layout(Model.CREATE2, (19, 20, 17), with_ids=True).pack({19: 123, 20: -7, 17: 0})
    assert frame(payload, Checksum.WHOLE) == bytes.fromhex("13 08 13 00 7b 14 ff f9 11 00 3a")
    payload = Layout(Model.CREATE2, (7, 17, 35), with_ids=True).pack({7: 3, 17: 168, 35: 2})
    assert frame(payload, Checksum.WHOLE) == bytes.fromhex("13 06 07 03 11 a8 23 02 ff")


def test_the_manuals_example_ends_in_182_on_a_create_1_and_in_163_on_a_create_2() -> None:
    payload = bytes([29, 2, 25, 13, 0])
    assert frame(payload, Checksum.AFTER_HEADER) == bytes([19, 5, 29, 2, 25, 13, 0, 182])
    assert frame(payload, Checksum.WHOLE)[-1] == 163


@pytest.mark.parametrize(
    ("model", "beams", "byte"),
    [
        (Model.CREATE1, Beams(), 255),
        (Model.CREATE1, Beams(field=True), 242),
        (Model.CREATE1, Beams(green=True), 244),
        (Model.CREATE1, Beams(green=True, field=True), 246),
        (Model.CREATE1, Beams(red=True), 248),
        (Model.CREATE1, Beams(red=True, field=True), 250),
        (Model.CREATE1, Beams(red=True, green=True), 252),
        (Model.CREATE1, Beams(red=True, green=True, field=True), 254),
        (Model.CREATE2, Beams(), 0),
        (Model.CREATE2, Beams(field=True), 161),
        (Model.CREATE2, Beams(green=True), 164),
        (Model.CREATE2, Beams(green=True, field=True), 165),
        (Model.CREATE2, Beams(red=True), 168),
        (Model.CREATE2, Beams(red=True, field=True), 169),
        (Model.CREATE2, Beams(red=True, green=True), 172),
        (Model.CREATE2, Beams(red=True, green=True, field=True), 173),
    ],
)
def test_infrared_bytes_of_both_docks(model: Model, beams: Beams, byte: int) -> None:
    assert sensors.ir_byte(model, beams) == byte
    assert sensors.ir_beams(byte) == beams


def test_remotes_and_virtual_walls_are_no_dock() -> None:
    for byte in (*range(129, 144), sensors.IR_VIRTUAL_WALL, 240, 160):
        assert sensors.ir_beams(byte) == Beams()


@given(old=st.integers(0, 65535), way=st.integers(-32767, 32767))
def test_encoder_counts_differ_by_the_way_across_the_wrap(old: int, way: int) -> None:
    assert sensors.counter_delta((old + way) % 65536, old) == way


# Command parser

_DRIVES = st.builds(oi.drive_direct, st.integers(-500, 500), st.integers(-500, 500))
_SONGS = st.builds(
    oi.song, st.integers(0, 4), st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), min_size=1, max_size=16)
)
_LISTS = st.builds(oi.stream, st.lists(st.integers(7, 58), max_size=20)) | st.builds(
    oi.query, st.lists(st.integers(7, 58), max_size=20)
)
_BARE = st.sampled_from([Op.START, Op.SAFE, Op.FULL, Op.SEEK_DOCK, Op.POWER]).map(oi.bare)
commands = st.lists(_DRIVES | _SONGS | _LISTS | _BARE, max_size=12)


def _fed(parser: CommandParser, data: bytes, cuts: list[int]) -> list[Command]:
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    return [command for a, b in pairwise(edges) for command in parser.feed(data[a:b])]


@given(model=models, written=commands, cuts=st.lists(st.integers(0, 300)))
def test_commands_are_read_back_however_they_are_cut(model: Model, written: list[bytes], cuts: list[int]) -> None:
    read = _fed(CommandParser(model), b"".join(written), cuts)
    assert [bytes([command.op]) + command.data for command in read] == written


@given(model=models, garbage=st.binary(max_size=300), cuts=st.lists(st.integers(0, 300)))
def test_garbage_is_read_alike_however_it_is_cut(model: Model, garbage: bytes, cuts: list[int]) -> None:
    assert _fed(CommandParser(model), garbage, cuts) == CommandParser(model).feed(garbage)


def test_opcode_136_has_a_byte_of_data_on_a_create_1_only() -> None:
    assert CommandParser(Model.CREATE1).feed(b"\x88\x80") == [Command(136, b"\x80")]
    assert CommandParser(Model.CREATE2).feed(b"\x88\x80") == [Command(136), Command(128)]


# Streams

all_cuts = st.lists(st.integers(0, 400))
packet_lists = st.lists(st.integers(7, 42), min_size=1, max_size=20, unique=True)


def _made(model: Model, ids: list[int], seed: int) -> tuple[dict[int, int], bytes]:
    values = {number: sensors.saturate(number, (seed * 2654435761 * number) % 65536 - 300) for number in ids}
    return values, frame(Layout(model, ids, with_ids=True).pack(values), CHECKSUM[model])


@given(
    model=models, ids=packet_lists, seed=st.integers(0, 10**6), count=st.integers(1, 4), cuts=st.lists(st.integers(0, 400))
)
def test_frames_survive_any_cutting(model: Model, ids: list[int], seed: int, count: int, cuts: list[int]) -> None:
    made = [_made(model, ids, seed + k) for k in range(count)]
    data = b"".join(raw for _, raw in made)
    decoder = StreamDecoder(model, ids)
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    got = [values for a, b in pairwise(edges) for values in decoder.feed(data[a:b])]
    assert got == [values for values, _ in made]
    assert decoder.skipped_bytes == 0


@given(model=models, ids=packet_lists, before=st.binary(max_size=80), torn=st.integers(1, 60))
def test_a_frame_is_found_behind_garbage_and_a_torn_frame(model: Model, ids: list[int], before: bytes, torn: int) -> None:
    _, half = _made(model, ids, 3)
    values, whole = _made(model, ids, 4)
    decoder = StreamDecoder(model, ids)
    frames = decoder.feed(before + half[: min(torn, len(half) - 1)] + whole + whole)
    assert values in frames or values in decoder.feed(whole)


def test_a_header_byte_within_the_data_does_not_mislead() -> None:
    decoder = StreamDecoder(Model.CREATE2, (7, 8))
    payload = Layout(Model.CREATE2, (7, 8), with_ids=True).pack({7: 19, 8: 4})
    whole = frame(payload, Checksum.WHOLE)
    assert decoder.feed(whole[3:] + whole) == [{7: 19, 8: 4}]


@pytest.mark.parametrize("model", list(Model))
def test_a_decoder_takes_only_the_rules_it_was_given(model: Model) -> None:
    values, raw = _made(model, [19, 20, 35], 5)
    other = next(rule for rule in Checksum if rule is not CHECKSUM[model])
    assert StreamDecoder(model, (19, 20, 35)).feed(raw) == [values]
    assert StreamDecoder(model, (19, 20, 35), [CHECKSUM[model]]).feed(raw) == [values]
    assert StreamDecoder(model, (19, 20, 35), [other]).feed(raw) == []


@given(model=models, garbage=st.binary(max_size=400))
def test_garbage_never_breaks_the_decoder_and_it_keeps_no_more_than_a_frame(model: Model, garbage: bytes) -> None:
    decoder = StreamDecoder(model, (7, 19, 20))
    decoder.feed(garbage)
    assert len(decoder._buffer) < decoder._length
