"""Pure soil: nothing is lost, nothing comes from nowhere."""

from __future__ import annotations

import math

import pytest

from sim.soil import CAPACITY_RATIO, DAY_S, PROBE_LAG_S, Soil, demand_mlps, light_ratio


def soil(moisture_ratio: float = 0.2) -> Soil:
    return Soil.of(3.0, moisture_ratio, litres_per_day=0.5)


def test_every_millilitre_is_stored_given_off_or_drained() -> None:
    it = soil(0.3)
    before_ml = it.stored_ml
    for minute in range(3 * 24 * 60):
        if minute % 400 == 0:
            it.pour(400.0)
        it.advance(60.0, minute / 60.0 % 24)
    out_ml = it.given_off_ml + it.drained_ml
    assert it.drained_ml > 100.0
    assert it.poured_ml == 400.0 * 11
    assert it.stored_ml + out_ml == pytest.approx(before_ml + it.poured_ml, abs=1e-6)


def test_a_day_takes_what_the_climate_says() -> None:
    day_ml = sum(demand_mlps(0.5, minute / 60) * 60 for minute in range(24 * 60))
    assert day_ml == pytest.approx(500.0, rel=1e-3)


def test_plants_drink_by_day_and_hardly_by_night() -> None:
    assert demand_mlps(0.5, 13.0) > 10 * demand_mlps(0.5, 2.0) > 0.0
    assert light_ratio(13.0) == pytest.approx(1.0)
    assert light_ratio(5.9) == light_ratio(20.1) == 0.0


def test_a_dry_plant_stops_drinking_before_the_soil_is_empty() -> None:
    it = soil(0.10)
    for minute in range(60 * 24 * 60):
        it.advance(60.0, minute / 60.0 % 24)
    assert 0.04 < it.moisture_ratio < 0.06


def test_too_much_water_runs_out_below() -> None:
    it = soil(0.39)
    it.pour(300.0)
    it.advance(600.0, 2.0)
    assert it.moisture_ratio == pytest.approx(CAPACITY_RATIO, abs=0.002)
    assert it.drained_ml > 250.0


def test_the_probe_feels_a_dose_only_after_the_water_has_spread() -> None:
    it = soil(0.2)
    it.pour(150.0)
    it.advance(PROBE_LAG_S, 2.0)
    assert it.probe_ratio == pytest.approx(0.2 + 0.05 * (1 - math.exp(-1)), abs=1e-4)
    for _ in range(10):
        it.advance(PROBE_LAG_S, 2.0)
    assert it.probe_ratio == pytest.approx(it.moisture_ratio, abs=1e-4)


def test_long_strides_and_short_ones_agree() -> None:
    coarse, fine = soil(0.3), soil(0.3)
    for minute in range(0, 24 * 60):
        coarse.advance(60.0, minute / 60)
        for second in range(60):
            fine.advance(1.0, (minute + second / 60) / 60)
    assert coarse.stored_ml == pytest.approx(fine.stored_ml, abs=0.5)
    assert DAY_S == 24 * 60 * 60
