from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw.protocols import stargazer as wire

views = st.builds(
    wire.MarkerView,
    st.integers(0, 65535),
    st.floats(-180, 180),
    st.floats(-500, 500),
    st.floats(-500, 500),
    st.floats(0, 500),
)


def messages(data: bytes) -> list[wire.Message | None]:
    return [wire.parse(text) for text in wire.FrameReader().feed(data)]


def test_a_map_mode_frame_is_written_as_the_device_writes_it() -> None:
    frame = wire.encode_poses("I", [wire.MarkerView(24706, -96.61, -48.13, -21.35, 221.64)])
    assert frame == b"~^I24706|-96.61|-48.13|-21.35|221.64`"


def test_signs_are_always_written() -> None:
    assert wire.encode_poses("1", [wire.MarkerView(48, -175.91, 98.74, 7.1, 182.39)]) == (
        b"~^148|-175.91|+98.74|+7.10|182.39`"
    )


def test_the_digit_of_a_multi_id_frame_is_a_count_and_not_the_ids() -> None:
    (one,) = messages(b"~^124706|-96.61|-48.13|-21.35|221.64`")
    (two,) = messages(b"~^224706|-96.28|-48.90|-21.13|220.50|24594|-94.27|+101.58|-17.80|230.71`")
    assert isinstance(one, wire.Poses)
    assert isinstance(two, wire.Poses)
    assert [view.marker_id for view in one.views] == [24706]
    assert [view.marker_id for view in two.views] == [24706, 24594]


@given(st.lists(views, min_size=1, max_size=1), st.sampled_from("IFZ1"))
def test_poses_come_back_to_the_hundredth(shown: list[wire.MarkerView], kind: str) -> None:
    frame = wire.encode_poses(kind, shown)
    (poses,) = messages(frame)
    assert isinstance(poses, wire.Poses)
    assert poses.kind == kind
    assert poses.views[0].marker_id == shown[0].marker_id
    assert poses.views[0].x_cm == pytest.approx(shown[0].x_cm, abs=0.006)
    assert len(frame) < 70


def test_theta_is_clockwise_and_yaw_is_not() -> None:
    x_m, y_m, yaw_rad = wire.MarkerView(1, 90.0, 100.0, -50.0, 200.0).pose()
    assert (x_m, y_m, yaw_rad) == pytest.approx((1.0, -0.5, -math.pi / 2))


@given(st.binary(max_size=300))
def test_no_garbage_is_too_odd_to_parse(data: bytes) -> None:
    for text in wire.FrameReader().feed(data):
        wire.parse(text)


@given(st.binary(max_size=100))
def test_a_good_frame_after_garbage_is_read(garbage: bytes) -> None:
    texts = wire.FrameReader().feed(garbage + b"~*DeadZone`")
    assert wire.parse(texts[-1]) == wire.DeadZone()


def test_a_frame_that_breaks_off_is_dropped_and_counted() -> None:
    reader = wire.FrameReader()
    assert reader.feed(b"~^I24706|-96.~*DeadZone`~^I1|\r+0.00`") == ["*DeadZone"]
    assert reader.dropped == 2


@pytest.mark.parametrize(
    "text", ["^I1|+0.00|+0.00|+0.00", "^I1|+0.00|nan|+0.00|1.00", "^31|+0|+0|+0|1", "^", "^I1|+999.00|+0.00|+0.00|1.0"]
)
def test_damaged_poses_are_no_message(text: str) -> None:
    assert wire.parse(text) is None


def test_every_other_message_goes_there_and_back() -> None:
    shown = [
        wire.DeadZone(),
        wire.Note("MAPID|3"),
        wire.Ack("CalcStop"),
        wire.Value("Version", "2.0100224"),
        wire.Command("CalcStart"),
        wire.Command("MarkType", "HLD1L"),
        wire.Read("IDNum"),
    ]
    assert messages(b"".join(wire.encode(message) for message in shown)) == shown
