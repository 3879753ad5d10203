"""The world's bench: the shape of its rows, and what is cheap to measure."""

from __future__ import annotations

import os

from lab.bench.world import _family_cpu_s, bench_physics, bench_quiet_day

KEYS = {"name", "ours", "peer", "ratio", "unit", "n", "target", "ok"}


def test_physics_rows_stand_beside_bare_mujoco():
    rows = bench_physics(1, seconds=0.4)
    assert [row["name"] for row in rows] == ["world.physics_idle_x", "world.physics_driving_x"]
    for row in rows:
        assert row.keys() == KEYS
        assert row["ours"] > 0
        assert row["peer"] > 0
        assert row["ratio"] == row["ours"] / row["peer"]
        assert row["ok"] is (row["ours"] >= float(row["target"].split()[-1]))


def test_a_shorter_day_says_so_instead_of_being_scaled():
    row = bench_quiet_day(seconds=30.0)
    assert row.keys() == KEYS
    assert row["peer"] is None
    assert row["unit"] == "CPU s / 30 garden s"
    assert 0 < row["ours"] < 30.0


def test_a_process_counts_with_its_children():
    burnt = sum(i * i for i in range(2_000_000))
    assert burnt > 0
    assert _family_cpu_s(os.getpid()) > 0
