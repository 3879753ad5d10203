"""A bar holds only what was measured."""

import math
from xml.etree import ElementTree

import pytest

from lab.report import write
from lab.results import Bar, Result, held


@pytest.mark.parametrize(
    ("value", "op", "bar", "ok"),
    [(1.0, ">=", 1.0, True), (0.99, ">=", 1.0, False), (0.02, "<=", 0.02, True), (0.03, "<=", 0.02, False)],
)
def test_a_bar_is_the_comparison_it_names(value, op, bar, ok):
    assert Bar(metric="m", value=value, op=op, bar=bar).ok is ok


@pytest.mark.parametrize("op", [">=", "<="])
def test_what_was_not_measured_is_never_ok(op):
    bar = Bar(metric="m", value=math.nan, op=op, bar=0.0)
    assert not bar.ok
    assert bar.document()["value"] is None


def test_a_missing_metric_fails_its_bar():
    assert [bar.ok for bar in held({"a": 1}, ("a", ">=", 1.0), ("b", ">=", 0.0))] == [True, False]


def test_a_report_shows_ours_beside_the_papers_and_what_was_missed(tmp_path):
    ours = {"error_m": 0.03}
    result = Result(
        name="square-loop",
        seed=1,
        trials=2,
        paper={"error_m": 0.1},
        ours=ours,
        bars=held(ours, ("error_m", "<=", 0.02)),
        series={"markers": [0.01, 0.03]},
        axes=("loop", "m"),
    )
    text = write([result], tmp_path).read_text()
    assert "| `error_m` | 0.1 | 0.03 | <= 0.02 | MISSED |" in text
    chart = ElementTree.fromstring((tmp_path / "reproduction-square-loop.svg").read_text())
    assert chart.tag.endswith("svg")


def test_a_report_keeps_what_is_not_run_again(tmp_path):
    def run(name, error_m):
        ours = {"error_m": error_m}
        return Result(name=name, seed=1, trials=2, paper={}, ours=ours, bars=held(ours), series={}, axes=("", ""))

    whole = write([run("watering", 1.0), run("network", 2.0)], tmp_path).read_text()
    again = write([run("watering", 3.0)], tmp_path).read_text()
    assert again == whole.replace("| 1 |", "| 3 |") != whole
    assert write([run("watering", 1.0)], tmp_path).read_text() == whole
