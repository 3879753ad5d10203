from __future__ import annotations

import random
from typing import Any

import pytest

from hw.protocols import stargazer as wire
from sim.devices.plants import MarkerSight
from sim.devices.stargazer import StargazerEmulator

HERE = MarkerSight(marker_id=24706, theta_deg=-96.61, x_cm=-48.13, y_cm=-21.35, z_cm=221.64)
THERE = MarkerSight(marker_id=24594, theta_deg=-94.27, x_cm=101.58, y_cm=-17.8, z_cm=230.71)


class Ceiling:
    """Shows whatever is put there."""

    def __init__(self, shown: MarkerSight | None = HERE) -> None:
        self.shown = shown

    def sight(self, now_s: float) -> MarkerSight | None:
        return self.shown


class Sensor:
    def __init__(self, **options: Any) -> None:
        self.ceiling = Ceiling()
        self.emulator = StargazerEmulator(self.ceiling, random.Random(4), **options)
        self.now_s = 10.0

    def wait(self, seconds: float) -> list[str]:
        """The texts of the frames sent meanwhile."""
        end_s, data = self.now_s + seconds, b""
        while (due_s := self.emulator.due_s()) <= end_s:
            self.now_s = max(self.now_s, due_s)
            self.emulator.step(self.now_s)
            data += self.emulator.transmit()
        self.now_s = end_s
        return wire.FrameReader().feed(data)

    def say(self, text: str, wait_s: float = 0.1) -> list[str]:
        self.emulator.receive(text.encode(), self.now_s)
        return self.wait(wait_s)


def test_it_powers_up_reporting_at_two_hertz() -> None:
    frames = Sensor().wait(10.0)
    assert frames == ["^I24706|-96.61|-48.13|-21.35|221.64"] * len(frames)
    assert len(frames) in (19, 20)


def test_without_a_marker_it_says_dead_zone() -> None:
    sensor = Sensor()
    sensor.ceiling.shown = None
    assert set(sensor.wait(3.0)) == {"*DeadZone"}


def test_multi_id_firmware_counts_the_markers() -> None:
    other = Ceiling(THERE)
    sensor = Sensor(mode="multi", also=other)
    assert sensor.wait(1.1)[0] == "^224706|-96.61|-48.13|-21.35|221.64|24594|-94.27|+101.58|-17.80|230.71"
    other.shown = None
    sensor.wait(0.6)
    assert sensor.wait(1.1)[0] == "^124706|-96.61|-48.13|-21.35|221.64"


def test_a_settings_session_runs_as_the_guide_says() -> None:
    sensor = Sensor()
    assert "!CalcStop" in sensor.say("~#CalcStop`")
    assert sensor.wait(5.0) == []
    assert sensor.say("~#MarkType|HLD1S`") == ["!MarkType|HLD1S"]
    assert sensor.say("~#SetEnd`") == ["!SetEnd"]
    assert sensor.wait(1.0) == ["!ParameterUpdate"]
    assert sensor.say("~@MarkType`") == ["!MarkType", "$MarkType|HLD1S"]
    assert sensor.say("~#CalcStart`", 1.0) == ["!CalcStart", "^I24706|-96.61|-48.13|-21.35|221.64"]


@pytest.mark.parametrize("text", ["~#MarkType|XXL`", "~#Version|3`", "~#Unheard|1`", "~@Unheard`", "~#IDNum|two`"])
def test_what_it_does_not_know_gets_no_answer(text: str) -> None:
    sensor = Sensor()
    sensor.say("~#CalcStop`")
    assert sensor.say(text) == []


def test_nothing_is_written_while_it_calculates() -> None:
    sensor = Sensor()
    assert "!MarkMode|Map" not in sensor.say("~#MarkMode|Map`")


def test_building_a_map_visits_every_marker() -> None:
    sensor = Sensor()
    sensor.say("~#CalcStop`")
    sensor.say("~#IDNum|2`")
    heard = sensor.say("~#MapMode|Start`", 1.2)
    assert "!MapMode|Start" in heard
    assert "*MAPID|24706" in heard
    assert "^F24706|-96.61|-48.13|-21.35|221.64" in heard
    sensor.ceiling.shown = THERE
    heard = sensor.wait(2.0)
    assert [text for text in heard if text[0] in "*!"] == ["*MAPID|24594", "!MapDataSave", "!ParameterUpdate"]
    assert heard[-1].startswith("^I24594|")


def test_height_is_measured_on_demand() -> None:
    sensor = Sensor()
    heard = sensor.say("~#HeightCalc`", 3.0)
    assert any(text.startswith("^Z24706|") for text in heard)
    assert "!ParameterUpdate" in heard
    assert sensor.say("~@MarkHeight`")[-1] == "$MarkHeight|2216"


def test_reset_restores_the_settings() -> None:
    sensor = Sensor()
    sensor.say("~#CalcStop`")
    sensor.say("~#MarkType|HLD3L`")
    assert sensor.say("~#Reset`", 1.0) == ["!Reset", "!ParameterUpdate"]
    assert sensor.say("~@MarkType`")[-1] == "$MarkType|HLD1L"


def test_bytes_that_come_too_fast_are_lost() -> None:
    sensor = Sensor(byte_gap_s=0.03)
    assert "!CalcStop" not in sensor.say("~#CalcStop`", 1.0)
    heard: list[str] = []
    for letter in "~#CalcStop`":
        heard += sensor.say(letter, 0.04)
    assert "!CalcStop" in heard + sensor.wait(0.1)


def test_nothing_is_due_while_it_is_stopped() -> None:
    sensor = Sensor()
    sensor.say("~#CalcStop`", 1.0)
    assert sensor.emulator.due_s() == float("inf")
