"""Messages between real processes, and a radio cell whose air is shared."""

from random import Random

import pytest

from lab.experiments.network import AWARDS, SENDERS, network
from lab.experiments.radio import CW_MIN, DIFS_S, SLOT_S, TRIES, exchanged, fade_ratio, frame_s


def lone(size=500, fade=0.0, seed=1):
    return exchanged([(1.0, 0, ((0, size, 0.0),))], fade, Random(seed))[0]


def test_a_lone_frame_takes_its_time_on_the_air_and_a_first_backoff():
    least_s = DIFS_S + frame_s(500)
    for seed in range(50):
        assert least_s - 1e-9 <= lone(seed=seed) <= least_s + CW_MIN * SLOT_S + 1e-9


def test_a_full_frame_takes_its_two_preambles_its_bits_the_gap_and_the_acknowledgement():
    assert frame_s(1460) == pytest.approx((192 + 1548 * 8 / 11 + 10 + 192 + 56) * 1e-6)


def test_signals_fade_with_distance():
    assert fade_ratio(1) < fade_ratio(13) < fade_ratio(27) < 0.2
    assert lone(fade=0.9) > TRIES * frame_s(500) / 2


def test_who_talks_at_once_collides_and_waits_and_all_arrive():
    frames = [(1.0, sender, ((sender, 500, 0.0), (9, 200, 0.01))) for sender in range(4)]
    together = exchanged(frames, 0.0, Random(3))
    assert min(together) >= 0.01 + 2 * frame_s(200)
    assert max(together) > lone(500) + lone(200) + 0.01
    assert together == exchanged(frames, 0.0, Random(3))


@pytest.mark.alone
def test_messages_and_awards_of_real_processes_are_timed():
    told = []
    result = network(12, 1, None, told.append)
    ours = result.ours
    assert 0.0 < ours["message_p50_s"] < ours["message_worst_s"] < 2.0
    assert 0.0 < ours["award_median_s"] <= ours["award_s"] < 2.0
    assert {"within_50ms_1m", "within_50ms_13m", "within_50ms_27m"} <= set(ours)
    assert next(bar.metric for bar in result.bars) == "within_50ms_ratio"
    assert f"{SENDERS} senders, 12 messages each" in told
    assert f"{AWARDS} awards" in told
