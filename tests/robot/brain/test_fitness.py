"""What a robot makes of parts that failed, and of water that goes where nobody sent it."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from robot_service.fitness import AGAIN_S, AGAIN_S_MAX, LEAK_FOR_S, LEAK_ML, PUMPED_S, Fitness, LeakWatch
from robot_service.skills.water import LEVEL_ERROR_ML, Poured, _believe


@dataclass
class Hands:
    now_s: float = 0.0

    def now(self) -> float:
        return self.now_s


def test_a_part_rests_twice_as_long_each_time_it_fails_until_it_works() -> None:
    clock = Hands()
    fitness = Fitness(clock)  # type: ignore[arg-type]
    assert fitness.why_not("pump") == ""
    for rest_s in (AGAIN_S, 2 * AGAIN_S, 4 * AGAIN_S, AGAIN_S_MAX, AGAIN_S_MAX):
        fitness.failed("pump", "no more came")
        clock.now_s += rest_s - 1e-3
        assert (fitness.why_not("pump"), fitness.told()) == ("no more came", ["no more came"])
        assert fitness.why_not("tap") == ""
        clock.now_s += 2e-3
        assert (fitness.why_not("pump"), fitness.told()) == ("", [])
    fitness.worked("pump")
    fitness.failed("pump", "again")
    clock.now_s += AGAIN_S
    assert fitness.why_not("pump") == ""
    fitness.failed("pump", "again")
    fitness.looked_after()
    assert fitness.why_not("pump") == ""


@dataclass
class Level:
    """A body's state, as far as a leak can be told by it."""

    stamp_s: float
    tank_ml: float | None
    pump: bool = False


@dataclass
class Watched:
    alarms: list[str] = field(default_factory=list)

    def through(self, *levels: Level) -> list[str]:
        watch = LeakWatch(self.alarms.append)
        for level in levels:
            watch.see(level)  # type: ignore[arg-type]
        return self.alarms


def falls(by_ml: float, begin_s: float = 0.0, until_s: float = 20.0, pump: bool = False) -> list[Level]:
    """Two hertz: full, and after a second so much less."""
    count = int((until_s - begin_s) * 2)
    return [Level(begin_s + k / 2, 1000.0 - (by_ml if k > 2 else 0.0), pump) for k in range(count)]


def test_a_leak_is_told_once_for_every_forty_millilitres() -> None:
    assert Watched().through(*falls(LEAK_ML)) == ["the tank lost 40 ml while the pump was off"]
    assert Watched().through(*falls(LEAK_ML - 1.0)) == []
    steadily = [Level(k / 2, 1000.0 - k) for k in range(400)]
    assert 3 <= len(Watched().through(*steadily)) <= 400 / LEAK_ML


def test_what_slops_comes_back_and_is_no_leak() -> None:
    slopping = [Level(k / 2, 1000.0 - (60.0 if k % 8 < LEAK_FOR_S * 2 - 1 else 0.0)) for k in range(200)]
    assert Watched().through(*slopping) == []


def test_a_dose_is_no_leak_and_neither_is_what_the_sensor_tells_late() -> None:
    pumping = falls(150.0, 0.0, 10.0, pump=True)
    late = [Level(10.0 + k / 2, 850.0 - 10.0 * min(k, 2 * PUMPED_S - 1)) for k in range(100)]
    assert Watched().through(*pumping, *late) == []


def test_a_pump_that_does_not_stop_is_a_leak() -> None:
    assert Watched().through(*[Level(k / 2, 1000.0 - 3.75 * k) for k in range(40)]) != []


def test_a_silent_sensor_tells_of_no_leak() -> None:
    silent = [Level(0.0, 1000.0), *(Level(0.5 + k / 2, None) for k in range(40)), *falls(0.0, 30.0, 40.0)]
    assert Watched().through(*silent) == []
    assert Watched().through(Level(0.0, 1000.0), Level(0.5, None), *[Level(1.0 + k / 2, 900.0) for k in range(40)]) == []


@pytest.mark.parametrize(
    ("said_ml", "gone_ml", "believed_ml"),
    [
        (150.0, 150.0, 150.0),
        (150.0, 80.0, 150.0),
        (150.0, 70.0, 70.0),
        (150.0, 0.0, 0.0),
        (150.0, 204.0, 150.0),
        (150.0, 206.0, 206.0),
        (30.0, 0.0, 30.0),
        (0.0, 2 * LEVEL_ERROR_ML, 0.0),
        (0.0, 2 * LEVEL_ERROR_ML + 1.0, 2 * LEVEL_ERROR_ML + 1.0),
    ],
)
def test_what_the_pump_says_came_out_is_held_against_the_tanks_level(
    said_ml: float, gone_ml: float, believed_ml: float
) -> None:
    poured = Poured(said_ml)
    _believe(poured, 1000.0, 1000.0 - gone_ml)
    assert poured.delivered_ml == believed_ml
    assert bool(poured.why) == poured.pump_failed == (believed_ml != said_ml)
    for before_ml, after_ml in ((None, 500.0), (500.0, None)):
        silent = Poured(said_ml)
        _believe(silent, before_ml, after_ml)
        assert silent == Poured(said_ml)
