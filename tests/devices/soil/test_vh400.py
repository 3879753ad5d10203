from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw.protocols import vh400

VECTORS = [(0.5, 4.0), (1.0, 9.0), (1.2, 12.5), (1.5, 24.62), (2.0, 44.75), (2.5, 68.75), (3.0, 100.0)]


@pytest.mark.parametrize(("volts", "percent"), VECTORS)
def test_the_makers_curve(volts: float, percent: float) -> None:
    assert vh400.ratio_of(volts) * 100 == pytest.approx(percent, abs=0.005)


@given(st.floats(0.0, 1.0))
def test_volts_and_water_go_there_and_back(ratio: float) -> None:
    assert vh400.ratio_of(vh400.volts_of(ratio)) == pytest.approx(ratio, abs=3e-4)


@given(st.floats(0, 5), st.floats(0, 5))
def test_more_volts_are_never_less_water(one_v: float, other_v: float) -> None:
    low_v, high_v = sorted((one_v, other_v))
    assert vh400.ratio_of(low_v) <= vh400.ratio_of(high_v) + 3e-4


def test_the_curve_is_clamped_at_its_ends() -> None:
    assert vh400.ratio_of(0.05) == 0.0
    assert vh400.ratio_of(4.0) == 1.0


@pytest.mark.parametrize(("vref_v", "codes"), [(5.0, (225, 266, 373, 451, 614)), (3.3, (341, 403, 565, 683, 931))])
def test_the_converters_codes(vref_v: float, codes: tuple[int, ...]) -> None:
    assert tuple(vh400.code_of(volts, vref_v) for volts in (1.1, 1.3, 1.82, 2.2, 3.0)) == codes


def test_codes_are_clamped_to_ten_bits() -> None:
    assert vh400.code_of(9.0) == 1023
    assert vh400.code_of(-1.0) == 0
    assert vh400.code_volts(512) == 2.5


def test_a_calibration_goes_through_two_weighed_samples() -> None:
    soil = vh400.Calibration.through((1.0, 0.05), (2.0, 0.35))
    assert soil.ratio_of(1.0) == pytest.approx(0.05)
    assert soil.ratio_of(2.0) == pytest.approx(0.35)
    assert soil.ratio_of(3.0) <= 1.0


def test_a_calibration_needs_two_different_samples() -> None:
    with pytest.raises(ValueError, match="wet"):
        vh400.Calibration.through((1.0, 0.05), (1.0, 0.35))
