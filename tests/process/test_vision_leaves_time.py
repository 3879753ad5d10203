"""A robot that scans and picks in real processes still answers bids at once, and its body still turns evenly."""

import pytest

from lab.bench.vision import bench_vision


@pytest.mark.soak
@pytest.mark.alone
def test_a_robot_at_a_plant_answers_bids_at_once_and_its_body_keeps_50_hz():
    rows = {row["name"]: row for row in bench_vision(3)}
    print(rows)
    assert rows["vision.bid_p99"]["ok"], rows
    assert rows["vision.body_jitter_p99"]["ok"], rows
    assert 49.0 < rows["vision.body_rate"]["ours"] < 51.0, rows
