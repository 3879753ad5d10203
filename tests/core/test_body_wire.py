"""The stream between brain and body: what is sent arrives as it was, and nothing else is taken."""

import numpy as np
import pytest

from core.errors import Unprocessable
from core.wire.body import BodyState, Control, Hello, LineBuffer, Marker, Setpoint, decode, encode

MARKER = Marker(marker_id=3, x_m=0.1, y_m=-0.2, yaw_rad=1.5, age_s=0.04, count=17)
STATE = BodyState(
    stamp_s=12.5, left_m=1.25, cliff=(False, True, False, False), tank_ml=812.0, arm_rad=(0.1, 0.2, 0.3, 0.4), marker=MARKER,
    down=("markers: gone",), refusal='the nozzle says "null"',
)  # fmt: skip


@pytest.mark.parametrize(
    "message",
    [
        Hello(secret="s"),
        Setpoint(seq=1),
        Setpoint(
            seq=2, base="drive", v_mps=-0.1, arm=(0.0, 1.0, 2.0, 3.0), arm_s=1.5, pump=True, permit_id="p", dose_ml=60.0
        ),
        Control(order="stop", by="null"),
        BodyState(stamp_s=0.0),
        STATE,
    ],
    ids=lambda message: type(message).__name__,
)
def test_a_message_arrives_as_it_was_sent(message):
    line = encode(message)
    assert line.endswith(b"\n")
    assert decode(line) == message


def test_a_field_at_its_default_is_left_out():
    assert encode(Setpoint(seq=7, omega_radps=0.5)) == b'{"t":"set","seq":7,"omega_radps":0.5}\n'


def test_numbers_of_numpy_are_numbers():
    assert decode(encode(Setpoint(seq=1, v_mps=np.float64(0.25)))) == Setpoint(seq=1, v_mps=0.25)


@pytest.mark.parametrize("number", [float("nan"), float("inf"), np.float64("nan")])
def test_a_number_that_is_not_finite_is_not_sent(number):
    with pytest.raises(ValueError, match="not finite"):
        encode(Setpoint(seq=1, v_mps=number))
    with pytest.raises(ValueError, match="not finite"):
        encode(BodyState(stamp_s=0.0, arm_rad=(0.0, number)))


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b"", "truncated"),
        (b"\xff\xfe", "malformed"),
        (b"[]", "object"),
        (b"{}", "t"),
        (b'{"t":"dance"}', "dance"),
        (b'{"t":"set"}', "seq"),
        (b'{"t":"set","seq":true}', "bool"),
        (b'{"t":"set","seq":1.5}', "float"),
        (b'{"t":"set","seq":1,"v_mps":NaN}', "malformed"),
        (b'{"t":"set","seq":1,"v_mps":1e999}', "out of range"),
        (b'{"t":"set","seq":1,"v_mps":"1"}', "str"),
        (b'{"t":"set","seq":1,"speed":1}', "speed"),
        (b'{"t":"set","seq":1,"base":"fly"}', "fly"),
        (b'{"t":"set","seq":1,"arm":[1,2,3]}', "length 4"),
        (b'{"t":"state","stamp_s":1,"cliff":[1,0,0,0]}', "bool"),
        (b'{"t":"state","stamp_s":1,"marker":{"marker_id":1}}', "x_m"),
        (b'{"t":"control","order":"jump"}', "jump"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_anything_else_is_refused_and_says_what_is_wrong(line, why):
    with pytest.raises(Unprocessable, match=why):
        decode(line)


def test_lines_come_whole_however_the_bytes_were_cut():
    told, lines = encode(Setpoint(seq=1)) + encode(STATE), LineBuffer()
    found = [line for k in range(0, len(told), 7) for line in lines.feed(told[k : k + 7])]
    assert [decode(line) for line in found] == [Setpoint(seq=1), STATE]
