"""A task with a deadline: asked for until then, failed when nobody has begun it, finished when somebody has."""

from __future__ import annotations

import math
from typing import Any

import pytest

from core.allocation.plant_side import Market
from core.allocation.plant_state import Grant, Kill, Limits, MarketDocument, Solicit
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, PlantCard, Report, Task

CARD = PlantCard(
    plant_id="plant-1", url="http://plant-1", stem=Point3(x_m=0.0, y_m=0.0, z_m=0.25),
    dock=Pose2(x_m=0.5, y_m=0.0, yaw_rad=3.0), nozzle=Point3(x_m=0.06, y_m=0.0, z_m=0.06),
)  # fmt: skip
TASK_ID = "plant-1:1:1"


class Play:
    """One market; robots answer what `costs` says, at once."""

    def __init__(self, within_s: float | None = 60.0, document: MarketDocument | None = None, now_s: float = 0.0) -> None:
        self.market = Market(CARD, document, now_s, limits=Limits(soak_s=10.0))
        self.market.soil(0.15, "", now_s)
        if document is None:
            self.market.ask("water", 150.0, "operator", "asked by hand", now_s, within_s=within_s)
        self.costs: dict[str, float | None] = {"robot-1": 5.0}
        self.sent: list[Any] = []

    @property
    def task(self) -> Task:
        return self.market.task(TASK_ID)

    def tick(self, now_s: float) -> None:
        self.market.tick(now_s, list(self.costs))
        while effects := self.market.take_effects():
            self.sent += effects
            for ask in [effect for effect in effects if isinstance(effect, Solicit)]:
                for name in ask.robots:
                    cost_s = self.costs[name]
                    answer = Bid(
                        task_id=TASK_ID, robot_id=name, cost_s=cost_s, reason="" if cost_s is not None else "no pump"
                    )
                    self.market.bid(TASK_ID, ask.round_number, name, answer, now_s)

    def run(self, from_s: float, until_s: float) -> None:
        """Tick whenever something is due."""
        now_s = from_s
        while now_s <= until_s:
            self.tick(now_s)
            now_s = max(now_s + 0.01, self.market.due_s())

    def report(self, state: Any, now_s: float) -> bool:
        return self.market.report(TASK_ID, Report(robot_id="robot-1", epoch=1, state=state), now_s).keep


def of(kind: type, effects: list[Any]) -> list[Any]:
    return [effect for effect in effects if isinstance(effect, kind)]


def test_it_is_asked_for_until_the_deadline_and_then_fails_with_what_robots_said() -> None:
    play = Play()
    play.costs = {"robot-1": None}
    play.run(0.0, 59.9)
    assert play.task.state == "announced"
    asked = [ask.announcement.within_s for ask in of(Solicit, play.sent)]
    assert asked[0] == 60.0
    assert len(asked) > 7
    assert asked == sorted(asked, reverse=True), "the time left, not the time given"
    play.run(60.0, 61.0)
    assert (play.task.state, play.task.deadline_s) == ("failed", 60.0)
    assert "not begun within 60 s" in play.task.reason
    assert "no pump" in play.task.reason


def test_a_holder_that_has_not_begun_is_told_by_a_kill_and_an_answer() -> None:
    play = Play()
    play.tick(0.0)
    for now_s in range(1, 60):
        assert play.report("awarded", float(now_s))
    play.tick(60.0)
    assert play.task.state == "failed"
    assert of(Kill, play.sent) == [Kill("robot-1", TASK_ID, 1)]
    assert "robot-1 had it in its queue" in play.task.reason
    assert not play.report("running", 60.1)


def test_what_runs_when_the_deadline_passes_is_finished() -> None:
    play = Play()
    play.tick(0.0)
    assert play.report("running", 59.0)
    for now_s in range(61, 90, 2):
        play.tick(float(now_s))
        assert play.report("running", float(now_s))
    assert play.task.state == "running"
    assert of(Kill, play.sent) == []


def test_what_ran_and_was_lost_after_the_deadline_is_not_asked_for_again() -> None:
    play = Play()
    play.tick(0.0)
    assert play.report("running", 59.0)
    play.run(60.0, 100.0)
    assert play.task.state == "failed"
    assert {grant.award.epoch for grant in of(Grant, play.sent)} == {1}


def test_without_a_deadline_it_is_asked_for_for_ever() -> None:
    play = Play(within_s=None)
    play.costs = {"robot-1": None}
    play.run(0.0, 4000.0)
    assert play.task.state == "announced"
    assert all(ask.announcement.within_s is None for ask in of(Solicit, play.sent))


@pytest.mark.parametrize(("began_s", "restarted_s", "deadline_s"), [(0.0, 20.0, 60.0), (500.0, 3.0, 63.0)])
def test_a_restart_keeps_the_deadline_and_a_clock_that_began_anew_moves_it(
    began_s: float, restarted_s: float, deadline_s: float
) -> None:
    play = Play(now_s=began_s)
    again = Play(document=play.market.document().by_clock(restarted_s), now_s=restarted_s)
    assert (again.task.created_s, again.task.deadline_s) == (min(began_s, restarted_s), deadline_s)
    again.costs = {"robot-1": None}
    again.run(restarted_s, deadline_s - 0.1)
    assert again.task.state == "announced"
    again.run(deadline_s, deadline_s)
    assert again.task.state == "failed"


def test_a_missed_deadline_is_not_a_failure_of_the_work() -> None:
    missed = Play()
    missed.costs = {"robot-1": None}
    missed.run(0.0, 61.0)
    assert missed.task.state == "failed"
    assert missed.market.gave_up_s("water") == -math.inf
