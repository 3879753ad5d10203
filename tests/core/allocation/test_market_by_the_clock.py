"""Whole stories of a plant's market, told to the second: what happens when, and what people read of it."""

from __future__ import annotations

import math
from typing import Any
from zlib import crc32

import pytest

from core.allocation.plant_side import Market
from core.allocation.plant_state import Grant, Kill, Limits, MarketDocument, Note, Rules, Solicit
from core.errors import Conflict, NotFound, Refused
from core.wire.fruit import Fruit, Pick
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, Permit, PermitRequest, PlantCard, Report, Task

ORIGIN = Point3(x_m=0.0, y_m=0.0, z_m=0.0)
CARD = PlantCard(
    plant_id="plant-1", url="http://plant-1", stem=ORIGIN, dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0), nozzle=ORIGIN
)
LONG = "x" * 1000
"""Longer than anything a document may say."""


def fruit(name: str) -> Fruit:
    return Fruit(fruit_id=name, colour="red", x_m=0.1, y_m=0.0, z_m=0.2, radius_m=0.013)


class Plant:
    """One market and robots that answer at once with the price that `costs_s` says; None: unable, absent: silent."""

    def __init__(self, document: MarketDocument | None = None, now_s: float = 0.0, **costs_s: float | None) -> None:
        self.now_s = now_s
        self.market = Market(CARD, document, now_s, Rules(), Limits(soak_s=10.0))
        self.robots: tuple[str, ...] = tuple(costs_s) or ("robot-1",)
        self.costs_s: dict[str, float | None] = dict(costs_s) or {"robot-1": 5.0}
        self.why = "unable"
        self.effects: list[Any] = []

    def wet(self, ratio: float | None = 0.15, why: str = "") -> Plant:
        self.market.soil(ratio, why, self.now_s)
        return self

    def ask(self, kind: Any = "water", dose_ml: float = 150.0, **more: Any) -> str:
        return self.market.ask(kind, dose_ml, "anna", "dry", self.now_s, **more).task_id

    def at(self, now_s: float) -> list[Any]:
        """The clock goes there; returns what left then, questions answered."""
        self.now_s = now_s
        self.market.tick(now_s, self.robots)
        return self.carried_out()

    def carried_out(self) -> list[Any]:
        left: list[Any] = []
        while effects := self.market.take_effects():
            left += effects
            for asked in [effect for effect in effects if isinstance(effect, Solicit)]:
                for robot_id in asked.robots:
                    if robot_id in self.costs_s:
                        task_id, cost_s = asked.announcement.task_id, self.costs_s[robot_id]
                        bid = Bid(
                            task_id=task_id, robot_id=robot_id, cost_s=cost_s, reason="" if cost_s is not None else self.why
                        )
                        self.market.bid(task_id, asked.round_number, robot_id, bid, self.now_s)
        self.effects += left
        return left

    def next(self) -> list[Any]:
        """On to the time at which something is due."""
        return self.at(self.market.due_s())

    def report(self, task_id: str, state: Any, robot_id: str = "robot-1", epoch: int = 1, **more: Any) -> bool:
        return self.market.report(task_id, Report(robot_id=robot_id, epoch=epoch, state=state, **more), self.now_s).keep

    def permit(
        self, task_id: str, act: Any = "water", robot_id: str = "robot-1", epoch: int = 1, key: str = "", **more: Any
    ) -> Permit:
        return self.market.permit(task_id, PermitRequest(robot_id=robot_id, epoch=epoch, act=act, **more), key, self.now_s)

    def restarted(self, now_s: float) -> Plant:
        document = MarketDocument.model_validate_json(self.market.document().model_dump_json())
        return Plant(document.by_clock(now_s), now_s, **self.costs_s)

    def task(self, task_id: str) -> Task:
        return self.market.task(task_id)

    def story(self, task_id: str) -> list[str]:
        return [f"{e.t_s:g} {e.robot_id or '-'}/{e.epoch} {e.what}" for e in self.task(task_id).events]


def of(kind: type, effects: list[Any]) -> list[Any]:
    return [effect for effect in effects if isinstance(effect, kind)]


T = "plant-1:1:1"


def test_a_watering_from_the_question_to_the_measured_rise() -> None:
    plant = Plant().wet()
    assert plant.ask(priority=7) == T
    assert plant.market.due_s() == 0.0
    asked, grant = (effect for effect in plant.at(0.0) if isinstance(effect, (Solicit, Grant)))
    assert (asked.round_number, asked.robots, asked.announcement.holder) == (1, ("robot-1",), "")
    assert (asked.announcement.dose_ml, asked.announcement.priority, asked.announcement.within_s) == (150.0, 7, None)
    assert (grant.award.epoch, grant.award.lease_s, grant.award.cost_s, grant.award.at_most_s) == (1, 8.0, 5.0, None)
    assert grant.award.announcement.holder == "robot-1"
    assert plant.market.due_s() == 1.0, "the award is sent again"
    plant.market.award_answered(T, 1, "", 0.5)
    assert plant.market.due_s() == 8.0, "the lease ends"
    plant.now_s = 1.0
    assert plant.report(T, "running", phase="navigate", progress=0.3)
    assert (plant.task(T).phase, plant.task(T).progress, plant.market.due_s()) == ("navigate", 0.3, 9.0)
    plant.now_s = 4.0
    given = plant.permit(T, amount_ml=120.0)
    assert (given.permit_id, given.dose_ml, given.valid_for_s, given.epoch) == ("plant-1:1:p2", 120.0, 15.0, 1)
    assert (plant.market.due_s(), plant.market.left_ml(4.0), plant.market.given_ml(4.0)) == (12.0, 1380.0, 120.0)
    assert (plant.task(T).state, plant.task(T).permit_id, plant.task(T).permits) == ("running", given.permit_id, 1)
    plant.now_s = 11.0
    assert plant.report(T, "running", phase="act", progress=0.9)
    assert (plant.task(T).phase, plant.task(T).progress, plant.market.soaking) == ("act", 0.9, False)
    plant.now_s = 20.0
    for _ in range(2):
        assert plant.report(T, "done", delivered_ml=118.0)
    assert plant.task(T).phase == "soaking: the plant measures whether the dose arrived"
    assert (plant.market.soaking, plant.market.given_ml(20.0), plant.market.due_s()) == (True, 118.0, math.inf)
    assert plant.market.waiting(25.0) == "measuring again in 5 s, when the last dose has soaked in"
    assert (plant.market.waiting(30.0), plant.market.permit_open) == ("", True)
    plant.market.soil(0.158, "", 29.9)
    assert plant.market.permit_open
    plant.market.soil(0.158, "", 30.0)
    assert not plant.market.permit_open
    assert not plant.market.soaking
    done = plant.task(T)
    assert (done.state, done.phase, done.permit_id, done.delivered_ml) == ("done", "", "", 118.0)
    assert plant.story(T) == [
        "0 -/0 asked for by anna: dry",
        "0 robot-1/1 awarded to robot-1, epoch 1: cheapest of 1: 5.0 s",
        "1 robot-1/1 navigate",
        "4 robot-1/1 permit plant-1:1:p2 for 120 ml",
        "20 robot-1/1 robot-1 reports done: no remark",
        "30 robot-1/1 done: soil went from 0.150 to 0.158",
    ]
    notes = of(Note, plant.carried_out())
    assert [(note.kind, note.what) for note in notes if note.data] == [("measured", "soil went from 0.150 to 0.158")]
    assert notes[-1] == Note("done", "done: soil went from 0.150 to 0.158", T, "robot-1")
    assert plant.market.due_s() == math.inf


def test_the_day_s_doses_are_written_down_with_the_time_of_the_clock_they_are_told_by() -> None:
    plant = awarded()
    assert plant.market.document().doses_at_s == 0.0
    plant.now_s = 4.0
    plant.permit(T)
    document = plant.market.document()
    assert (document.doses_at_s, [(dose.t_s, dose.ml) for dose in document.doses]) == (4.0, [(4.0 + 15.0 + 35.0, 150.0)])
    plant.market.soil(0.15, "", 7.0)
    assert plant.market.document().doses_at_s == 7.0
    again = plant.restarted(1000.0)
    assert [(dose.t_s, dose.ml) for dose in again.market.document().doses] == [(1047.0, 150.0)]
    assert again.market.document().doses_at_s == 1000.0
    assert (again.market.left_ml(1000.0), again.market.left_ml(1047.0 + 86400.0)) == (1350.0, 1500.0)
    again.market.limits.day_cap_ml = 100.0
    assert again.market.left_ml(1000.0) == 0.0


def test_with_thirty_millilitres_left_a_dose_is_given_and_with_less_none() -> None:
    for cap_ml, left in ((30.0, True), (29.9, False)):
        plant = Plant().wet()
        plant.market.limits.day_cap_ml = cap_ml
        if left:
            plant.ask()
        else:
            with pytest.raises(Refused, match="the day's 30 ml are given"):
                plant.ask()
    silent = Plant()
    with pytest.raises(Refused, match="the soil probe is not measured yet: a dose could not be verified"):
        silent.ask()


def test_nobody_can_is_asked_less_and_less_often_and_written_down_once() -> None:
    plant = Plant(**{"robot-1": None}).wet()
    plant.ask()
    times = []
    while len(times) < 6:
        plant.next()
        times.append(plant.now_s)
    assert times == [0.0, 1.0, 3.0, 7.0, 15.0, 23.0]
    assert plant.market.waiting(23.0) == f"nobody can take {T}: robot-1: unable"
    plant.why = "no pump"
    plant.next()
    assert plant.story(T) == [
        "0 -/0 asked for by anna: dry",
        "0 -/0 nobody can take it: robot-1: unable",
        "31 -/0 nobody can take it: robot-1: no pump",
    ]
    assert [(r.t_s, r.epoch, r.winner, r.why) for r in plant.task(T).rounds] == [
        (0.0, 0, "", "robot-1: unable"),
        (31.0, 0, "", "robot-1: no pump"),
    ]
    plant.costs_s["robot-1"] = 3.0
    plant.next()
    assert (plant.now_s, plant.task(T).robot_id, plant.market.waiting(39.0)) == (39.0, "robot-1", "")


def test_without_any_robot_the_round_is_over_at_once() -> None:
    plant = Plant().wet()
    plant.ask()
    plant.robots = ()
    assert of(Solicit, plant.at(0.0)) == []
    assert plant.market.waiting(0.0) == f"nobody can take {T}: no robot is known"
    assert plant.market.due_s() == 1.0


def test_failures_are_waited_after_for_longer_and_longer_and_the_eighth_ends_it() -> None:
    plant = Plant().wet()
    plant.ask()
    times = []
    while plant.task(T).state != "failed":
        plant.next()
        times.append(plant.now_s)
        assert plant.report(T, "failed", epoch=len(times), reason="cannot dock")
        assert plant.task(T).reason.startswith("robot-1 failed: cannot dock")
    assert times == [0.0, 1.0, 3.0, 7.0, 15.0, 31.0, 61.0, 91.0]
    assert plant.task(T).reason == "robot-1 failed: cannot dock (8 failures)"
    assert plant.market.gave_up_s("water") == 91.0


def test_an_award_that_is_refused_is_a_failure_and_an_old_answer_is_none() -> None:
    plant = Plant().wet()
    plant.ask()
    plant.at(0.0)
    before = plant.task(T)
    plant.market.award_answered(T, 2, "full", 0.1)
    plant.market.award_answered("plant-1:1:9", 1, "full", 0.1)
    assert plant.task(T) == before
    assert plant.market.due_s() == 1.0
    plant.market.award_answered(T, 1, "full", 0.5)
    task = plant.task(T)
    assert (task.state, task.robot_id, task.reason) == ("announced", "", "robot-1 refused the award: full")
    assert plant.market.due_s() == 1.5
    plant.market.award_answered(T, 1, "full", 0.6)
    assert plant.market.document().failures == {T: 1}


def test_whoever_runs_it_already_cannot_refuse_it_nor_decline_it_any_more() -> None:
    plant = Plant().wet()
    plant.ask()
    plant.at(0.0)
    plant.report(T, "running")
    for overtaken in (False, True):
        plant.market.award_answered(T, 1, "full", 0.5, overtaken=overtaken)
        assert plant.task(T).state == "running"
    assert plant.market.due_s() == 8.0


def test_an_unanswered_award_leaves_every_second_until_the_lease_ends_and_others_are_asked_at_once() -> None:
    plant = Plant().wet()
    plant.ask()
    plant.at(0.0)
    sent = []
    while plant.task(T).state == "awarded":
        sent += [(plant.now_s, grant.award.epoch, grant.award.cost_s) for grant in of(Grant, plant.next())]
    assert sent == [(float(t), 1, 5.0) for t in range(1, 8)]
    assert plant.now_s == 8.0
    assert Kill("robot-1", T, 1) in plant.effects
    assert plant.task(T).reason == "robot-1 fell silent for 8 s"
    assert (plant.market.due_s(), plant.market.document().failures) == (8.0, {T: 0})


def awarded(**costs_s: float | None) -> Plant:
    plant = Plant(**costs_s).wet()
    plant.ask()
    plant.at(0.0)
    plant.market.award_answered(T, 1, "", 0.1)
    return plant


def test_after_ten_seconds_others_are_asked_and_a_much_better_price_moves_it_once() -> None:
    plant = awarded(a=10.0, b=30.0)
    plant.now_s = 5.0
    plant.report(T, "awarded", "a")
    plant.costs_s["b"] = 7.9
    plant.next()
    assert plant.now_s == 10.0
    (asked,) = [effect for effect in of(Solicit, plant.effects) if effect.round_number == 2]
    assert (asked.announcement.holder, asked.robots) == ("a", ("a", "b"))
    assert [(grant.robot_id, grant.award.epoch, grant.award.cost_s) for grant in of(Grant, plant.effects)][-1] == (
        "b",
        2,
        7.9,
    )
    assert of(Kill, plant.effects) == [Kill("a", T, 1)]
    moved = plant.task(T)
    assert (moved.robot_id, moved.epoch, moved.phase, moved.progress) == ("b", 2, "", 0.0)
    assert moved.rounds[-1].why == "moved from a, now 10.0 s, to b at 7.9 s"
    plant.market.award_answered(T, 2, "", 10.1)
    plant.now_s = 15.0
    plant.report(T, "awarded", "b", 2)
    plant.costs_s["a"] = 0.5
    plant.next()
    assert (plant.now_s, plant.task(T).robot_id) == (20.0, "b"), "it moves for a price only once"
    plant.now_s = 25.0
    plant.report(T, "awarded", "b", 2)
    plant.costs_s["b"] = None
    plant.next()
    assert (plant.now_s, plant.task(T).robot_id) == (30.0, "a")
    assert plant.task(T).rounds[-1].why == "moved from b, now no bid (unable), to a at 0.5 s"


def test_a_holder_that_is_alone_is_not_asked_again() -> None:
    plant = awarded()
    plant.now_s = 5.0
    plant.report(T, "awarded")
    assert of(Solicit, plant.next()) == []
    assert (plant.now_s, plant.market.due_s()) == (10.0, 13.0)
    plant.now_s = 12.0
    plant.report(T, "awarded")
    assert plant.market.due_s() == 20.0


def test_what_began_while_others_were_asked_stays_where_it_is() -> None:
    plant = awarded(a=10.0, b=30.0)
    plant.now_s = 9.0
    del plant.costs_s["a"]
    plant.costs_s["b"] = None
    plant.report(T, "awarded", "a")
    plant.at(10.0)
    assert plant.market.due_s() == 12.0
    plant.now_s = 11.0
    plant.report(T, "running", "a")
    plant.at(12.0)
    assert (plant.task(T).robot_id, plant.task(T).state, plant.market.due_s()) == ("a", "running", 19.0)


def test_a_lease_that_ends_while_others_are_asked_waits_for_their_bids() -> None:
    plant = awarded(a=10.0, b=30.0)
    plant.now_s = 3.0
    plant.report(T, "awarded", "a")
    del plant.costs_s["a"], plant.costs_s["b"]
    plant.at(10.0)
    assert plant.market.due_s() == 11.0
    plant.at(11.0)
    assert plant.task(T).state == "announced"


def test_a_robot_that_keeps_it_a_quarter_of_an_hour_without_acting_loses_it() -> None:
    plant = awarded()
    for now_s in range(1, 901, 6):
        plant.now_s = float(now_s)
        assert plant.report(T, "running")
    plant.at(900.9)
    assert (plant.task(T).state, plant.market.due_s()) == ("running", 901.0)
    plant.at(901.0)
    assert plant.task(T).reason == "robot-1 kept it 900 s without acting"
    assert (Kill("robot-1", T, 1) in plant.effects, plant.market.due_s()) == (True, 902.0)


def test_silence_under_a_permit_is_waited_out_and_measured() -> None:
    plant = awarded()
    plant.now_s = 4.0
    plant.permit(T)
    plant.at(12.0)
    assert of(Kill, plant.effects) == [Kill("robot-1", T, 1)]
    assert plant.story(T)[-1] == "12 robot-1/1 robot-1 fell silent under a permit: measuring before anything else"
    assert (plant.task(T).state, plant.market.due_s()) == ("running", math.inf)
    assert plant.market.waiting(54.0) == "measuring again in 10 s, when the last dose has soaked in"
    plant.market.soil(0.15, "", 63.9)
    assert plant.market.permit_open
    plant.market.soil(0.15, "", 64.0, stamp_s=63.9)
    assert plant.market.permit_open, "taken before the dose can have soaked in"
    plant.market.soil(None, "stuck", 64.0)
    assert plant.market.waiting(64.0) == "cannot tell whether the last dose arrived: the soil probe is stuck"
    plant.market.soil(0.15, "", 65.0, stamp_s=64.0)
    assert plant.task(T).reason == "soil went from 0.150 to 0.150: the dose did not arrive, asking again"
    assert (plant.task(T).delivered_ml, plant.task(T).permits, plant.market.document().failures) == (None, 1, {T: 0})
    assert plant.market.due_s() == 65.0


def test_who_speaks_again_under_its_permit_goes_on() -> None:
    plant = awarded()
    plant.now_s = 4.0
    plant.permit(T)
    plant.at(12.0)
    plant.now_s = 13.0
    assert plant.report(T, "running")
    assert plant.market.due_s() == 21.0


def dosed(plant: Plant, epoch: int, ratio: float) -> None:
    """One dose is given, told and measured as `ratio`."""
    plant.next()
    plant.permit(T, epoch=epoch)
    plant.report(T, "done", epoch=epoch, delivered_ml=150.0)
    plant.now_s += 25.0
    plant.market.soil(ratio, "", plant.now_s)


def test_three_doses_without_a_rise_end_it_and_a_wet_soil_needs_none() -> None:
    plant = Plant().wet()
    plant.ask()
    dosed(plant, 1, 0.15)
    dosed(plant, 2, 0.15)
    assert plant.task(T).state == "announced"
    dosed(plant, 3, 0.15)
    reason = "soil went from 0.150 to 0.150 after 3 doses: look at nozzle, tank and probe"
    assert (plant.task(T).state, plant.task(T).reason) == ("failed", reason)
    wet = Plant().wet(0.24)
    wet.ask()
    dosed(wet, 1, 0.24)
    assert (wet.task(T).state, wet.task(T).reason) == ("done", "soil went from 0.240 to 0.240: no rise, but wet enough")


def test_a_dose_is_never_more_than_asked_for_allowed_or_left() -> None:
    for amount_ml, cap_ml, dose_ml in (
        (0.0, 1500.0, 150.0),
        (500.0, 1500.0, 150.0),
        (60.0, 1500.0, 60.0),
        (0.0, 90.0, 90.0),
    ):
        plant = awarded()
        plant.market.limits.day_cap_ml = cap_ml
        assert plant.permit(T, amount_ml=amount_ml).dose_ml == dose_ml


def test_the_same_question_for_a_permit_gets_the_same_answer_and_another_one_none() -> None:
    plant = awarded()
    plant.now_s = 4.0
    given = plant.permit(T, key="k")
    plant.now_s = 6.0
    assert plant.permit(T, key="k") == given.model_copy(update={"valid_for_s": 13.0})
    for key in ("", "other"):
        with pytest.raises(Refused, match="is not settled"):
            plant.permit(T, key=key)
    for who in ({"robot_id": "robot-2"}, {"epoch": 2}):
        with pytest.raises(Refused, match="held by robot-1 under epoch 1, running"):
            plant.permit(T, key="k", **who)
    assert plant.task(T).permits == 1


def test_a_permit_is_given_to_the_last_moment_of_the_lease_and_renews_it() -> None:
    plant = awarded()
    plant.now_s = 8.0
    plant.permit(T)
    assert plant.market.due_s() == 16.0
    late = awarded()
    late.now_s = 8.01
    with pytest.raises(Refused, match="the lease on plant-1:1:1 has ended"):
        late.permit(T)


def test_who_holds_what_is_said_to_all_others() -> None:
    plant = Plant().wet()
    plant.ask()

    def told(robot_id: str = "robot-1", epoch: int = 1, state: Any = "running") -> tuple[bool, str, float]:
        answer = plant.market.report(T, Report(robot_id=robot_id, epoch=epoch, state=state), plant.now_s)
        return answer.keep, answer.reason, answer.lease_s

    assert told() == (False, f"{T} is being announced", 8.0)
    with pytest.raises(Refused, match="held by nobody under epoch 0, announced"):
        plant.permit(T)
    plant.at(0.0)
    assert told("robot-2") == (False, f"{T} is held by robot-1 under epoch 1", 8.0)
    assert told(epoch=0) == (False, f"{T} is held by robot-1 under epoch 1", 8.0)
    assert told() == (True, "", 8.0)
    plant.permit(T)
    plant.report(T, "done")
    plant.market.soil(0.3, "", 100.0)
    assert told(state="done") == (True, f"{T} is done", 8.0)
    assert told(state="running") == (False, f"{T} is done", 8.0)
    assert told("robot-2", state="done") == (False, f"{T} is done", 8.0)
    assert told(epoch=0, state="done") == (False, f"{T} is done", 8.0)


def test_a_restart_gives_holders_a_whole_lease_and_sends_awards_again() -> None:
    plant = awarded()
    plant.market._failures[T] = 3
    again = plant.restarted(100.0)
    assert (again.market.document().boot, again.market.document().failures) == (2, {T: 3})
    assert (again.market.due_s(), again.market.dirty) == (100.0, True)
    assert [(grant.award.epoch, grant.award.cost_s) for grant in of(Grant, again.at(100.0))] == [(1, 0.0)]
    again.market.award_answered(T, 1, "", 100.1)
    assert again.market.due_s() == 108.0
    again.now_s = 107.0
    again.report(T, "awarded")
    assert again.market.due_s() == 110.0, "others are asked ten seconds after the restart"
    assert again.market.ask("inventory", 0.0, "anna", "", 107.0).task_id == "plant-1:2:1"


def test_a_restart_finds_what_ran_running_and_what_was_announced_to_be_asked_for() -> None:
    plant = awarded()
    plant.report(T, "running")
    again = plant.restarted(100.0)
    again.at(100.0)
    again.market.award_answered(T, 1, "", 100.0)
    for now_s in range(101, 1000, 6):
        again.now_s = float(now_s)
        again.report(T, "running")
    assert again.market.due_s() == 1000.0, "a quarter of an hour from the restart"
    waiting = Plant().wet()
    waiting.ask()
    assert waiting.restarted(50.0).wet().market.due_s() == 50.0


@pytest.mark.parametrize("finished", [True, False])
def test_a_restart_waits_for_an_open_dose_as_if_it_had_just_been_given(finished: bool) -> None:
    plant = awarded()
    plant.now_s = 4.0
    plant.permit(T)
    if finished:
        plant.report(T, "done")
    again = plant.restarted(1000.0).wet(0.15)
    assert again.market.soaking == finished
    if not finished:
        again.at(1008.0)
    settled_s = 1000.0 + 15.0 + 10.0 if finished else 1000.0 + 15.0 + 35.0 + 10.0
    again.market.soil(0.15, "", settled_s - 0.1)
    assert again.market.permit_open
    again.market.soil(0.15, "", settled_s)
    assert not again.market.permit_open


@pytest.mark.parametrize("finished", [True, False])
def test_a_change_that_could_not_be_saved_leaves_the_times_of_an_open_dose_as_they_are(finished: bool) -> None:
    plant = awarded()
    request = PermitRequest(robot_id="robot-1", epoch=1, act="water")
    given = plant.market.permit(T, request, "k", 4.0)
    if finished:
        plant.now_s = 10.0
        plant.report(T, "done")
    document = plant.market.document()
    same = Market(CARD, document, 12.0, Rules(), Limits(soak_s=10.0))
    assert same.permit(T, request, "k", 12.0) == given.model_copy(update={"valid_for_s": 7.0})
    assert same.given_ml(86400.0) == given.dose_ml
    assert same.given_ml(86400.0 + 54.0) == 0.0
    late = Market(CARD, document, 100.0, Rules(), Limits(soak_s=10.0))
    assert late.permit(T, request, "k", 100.0).valid_for_s == 0.0
    late.soil(0.15, "", 109.9)
    assert late.permit_open, "its act may have ended just now"
    late.soil(0.15, "", 110.0)
    assert late.permit_open != finished


def test_a_dose_of_a_cancelled_task_is_settled_all_the_same() -> None:
    plant = awarded()
    plant.now_s = 4.0
    plant.permit(T)
    plant.market.cancel(T, "anna", "enough", 5.0)
    assert plant.task(T).reason == "cancelled by anna: enough"
    assert Kill("robot-1", T, 1) in plant.carried_out()
    again = plant.restarted(1000.0).wet(0.15)
    assert again.market.soaking, "nobody will tell"
    for made, settled_s in ((plant, 64.0), (again, 1060.0)):
        made.market.soil(0.15, "", settled_s - 0.1)
        assert made.market.permit_open
        made.market.soil(0.15, "", settled_s)
        assert not made.market.permit_open
        assert made.task(T).state == "cancelled"


def test_what_is_cancelled_says_by_whom_and_what_has_ended_cannot_be() -> None:
    plant = Plant().wet()
    plant.ask()
    assert plant.market.cancel(T, "anna", "", 1.0).reason == "cancelled by anna"
    assert of(Kill, plant.carried_out()) == []
    failed = Plant().wet()
    failed.ask(within_s=5.0)
    failed.at(5.0)
    assert failed.task(T).reason == "not begun within 5 s, its deadline"
    with pytest.raises(Conflict, match="is failed already"):
        failed.market.cancel(T, "anna", "", 6.0)


def test_nothing_a_robot_or_a_person_says_is_longer_than_a_document_may_be() -> None:
    plant = Plant(**{"robot-1": None, "robot-2": None}).wet()
    plant.why = LONG[:500]
    plant.market.ask("water", 150.0, "anna", LONG, 0.0)
    plant.at(0.0)
    assert len(plant.market.waiting(0.0)) <= 500
    plant.costs_s["robot-1"] = 5.0
    plant.at(1.0)
    plant.market.award_answered(T, 1, LONG, 1.0)
    plant.next()
    plant.market.award_answered(T, 2, LONG, plant.now_s, overtaken=True)
    plant.next()
    plant.report(T, "awarded", epoch=3)
    plant.now_s += 5.0
    plant.report(T, "awarded", epoch=3)
    plant.costs_s |= {"robot-1": None, "robot-2": 5.0}
    plant.next()
    assert plant.task(T).robot_id == "robot-2"
    plant.report(T, "running", "robot-2", 4, phase=LONG[:500])
    plant.report(T, "failed", "robot-2", 4, reason=LONG[:500])
    plant.market.cancel(T, "anna", LONG, plant.now_s)
    plant.carried_out()
    assert all(len(note.what) <= 500 for note in of(Note, plant.effects))
    assert max(len(note.what) for note in of(Note, plant.effects)) == 500
    assert MarketDocument.model_validate(plant.market.document().model_dump()) == plant.market.document()
    texts = [text for task in plant.market.tasks() for text in (task.why, task.reason, *(e.what for e in task.events))]
    assert sorted({len(text) for text in texts})[-1] == 500


def test_only_the_newest_of_a_story_is_kept() -> None:
    plant = Plant(**{"robot-1": None}).wet()
    plant.ask()
    for number in range(50):
        plant.why = f"reason {number}"
        plant.next()
    task = plant.task(T)
    assert (len(task.rounds), len(task.events)) == (6, 40)
    assert (task.rounds[-1].why, task.events[-1].what) == ("robot-1: reason 49", "nobody can take it: robot-1: reason 49")
    for number in range(21):
        made = plant.market.ask("inventory", 0.0, "anna", "", 1000.0 + number)
        plant.market.cancel(made.task_id, "anna", "", 1000.0 + number)
    ended = [task.task_id for task in plant.market.tasks() if task.state == "cancelled"]
    assert (len(ended), ended[0], ended[-1]) == (20, "plant-1:1:3", "plant-1:1:22")
    assert plant.market.document().failures == {}


def test_a_plant_has_sixteen_open_tasks_at_most() -> None:
    plant = Plant()
    names = [f"f{number}" for number in range(17)]
    plant.market.fruits([fruit(name) for name in names], 0.0)
    for name in names[:16]:
        plant.ask("harvest", 0.0, fruit_ids=[name], count=1)
    with pytest.raises(Conflict, match="has 16 open tasks"):
        plant.ask("harvest", 0.0, fruit_ids=[names[16]], count=1)


def test_the_times_and_bounds_of_the_market_are_these() -> None:
    rules = Rules()
    assert (rules.bid_window_s, rules.lease_s, rules.reallocate_s, rules.margin_ratio) == (2.0, 8.0, 10.0, 0.2)
    assert (rules.moves_max, rules.declines_max, rules.decline_s, rules.permit_valid_s) == (1, 6, 0.05, 15.0)
    assert (rules.backoff_s_min, rules.backoff_s_max, rules.ask_again_s_max, rules.resend_s) == (1.0, 30.0, 8.0, 1.0)
    assert (rules.run_s_max, rules.doses_max, rules.failures_max) == (900.0, 3, 8)
    assert (rules.rounds_kept, rules.events_kept, rules.finished_kept) == (6, 40, 20)
    assert (rules.open_max, rules.auctions_max) == (16, 4)
    assert (Limits().soak_s, Limits().day_cap_ml, Limits().target_ratio) == (60.0, 1500.0, 0.24)


def test_an_unknown_task_names_its_own_plant_or_says_where_to_look() -> None:
    plant = Plant()
    for task_id, hint in (("plant-9:1:1", "ask plant-9"), ("plant-1:1:7", "GET /tasks"), ("nonsense", "GET /tasks")):
        with pytest.raises(NotFound, match="plant-1 has no task") as unknown:
            plant.market.task(task_id)
        assert hint in unknown.value.hint


def test_a_late_or_foreign_answer_changes_nothing() -> None:
    plant = Plant(**{"robot-1": 5.0, "robot-2": 9.0}).wet()
    plant.ask()
    plant.costs_s = {}
    plant.at(0.0)
    for task_id, number in (("plant-1:1:9", 1), (T, 2), (T, 0)):
        for robot_id in plant.robots:
            plant.market.bid(task_id, number, robot_id, Bid(task_id=task_id, robot_id=robot_id, cost_s=1.0), 0.5)
    assert plant.task(T).state == "announced"
    plant.market.bid(T, 1, "robot-2", Bid(task_id=T, robot_id="robot-2", cost_s=9.0), 1.0)
    assert (plant.task(T).state, plant.market.due_s()) == ("announced", 2.0)
    plant.at(1.9)
    assert plant.task(T).state == "announced"
    plant.at(2.0)
    assert plant.task(T).robot_id == "robot-2"
    plant.market.bid(T, 1, "robot-1", Bid(task_id=T, robot_id="robot-1", cost_s=1.0), 2.1)
    assert plant.task(T).robot_id == "robot-2"


def test_each_decline_in_a_row_waits_twice_as_long_each_task_at_a_moment_of_its_own() -> None:
    plant = Plant(a=10.0, b=30.0).wet()
    plant.ask()
    for declines in range(6):
        plant.next()
        assert of(Grant, plant.effects)[-1].award.at_most_s == 30.0
        plant.market.award_answered(T, declines + 1, "90 s by now", plant.now_s, overtaken=True)
        spread = 0.5 + crc32(f"{T} {declines + 1}".encode()) / 2**32
        assert plant.market.due_s() - plant.now_s == pytest.approx(spread * 0.05 * 2**declines)
        assert plant.task(T).reason == "a declined the award: 90 s by now"
    plant.next()
    assert of(Grant, plant.effects)[-1].award.at_most_s is None, "now it takes it at any price"


def test_a_task_that_moved_for_a_price_and_was_declined_does_not_move_for_a_price_again() -> None:
    plant = awarded(a=10.0, b=30.0)
    plant.now_s = 5.0
    plant.report(T, "awarded", "a")
    plant.costs_s["b"] = 5.0
    plant.next()
    plant.market.award_answered(T, 2, "busy", plant.now_s, overtaken=True)
    plant.next()
    assert plant.task(T).robot_id == "b"
    plant.market.award_answered(T, 3, "", plant.now_s)
    plant.now_s += 5.0
    plant.report(T, "awarded", "b", 3)
    plant.costs_s["a"] = 0.5
    plant.next()
    assert (len(plant.task(T).rounds), plant.task(T).robot_id) == (3, "b")


def test_the_most_urgent_is_asked_for_first() -> None:
    plant = Plant(**{"robot-1": None})
    plant.market.fruits([fruit(f"f{number}") for number in range(3)], 0.0)
    for number, priority in enumerate((3, 9, 5)):
        plant.ask("harvest", 0.0, fruit_ids=[f"f{number}"], count=1, priority=priority)
    assert [asked.announcement.priority for asked in of(Solicit, plant.at(0.0))] == [9, 5, 3]


def test_a_declined_task_is_nobodys() -> None:
    plant = awarded(a=10.0, b=30.0)
    plant.market.award_answered(T, 1, "90 s by now", 1.0, overtaken=True)
    assert plant.task(T).robot_id == ""


def test_a_task_without_a_deadline_outlives_a_clock_that_began_anew() -> None:
    plant = Plant(now_s=500.0).wet()
    plant.ask()
    assert plant.restarted(3.0).task(T).deadline_s is None


def test_only_who_holds_the_permit_can_end_its_dose_and_that_is_written_down() -> None:
    plant = awarded()
    plant.permit(T)
    plant.market.dirty = False
    for who in ({"robot_id": "robot-2"}, {"epoch": 0}):
        plant.report(T, "done", delivered_ml=1.0, **who)
        assert (plant.market.soaking, plant.market.given_ml(0.0), plant.market.dirty) == (False, 150.0, False)
    assert plant.market._water.acted(140.0, 1.0)
    assert not plant.market._water.acted(130.0, 2.0)
    assert plant.market.given_ml(2.0) == 140.0


# Fruit


def harvesting(names: str = "f1 f2 f3", count: int = 2) -> Plant:
    plant = Plant()
    plant.market.fruits([fruit(name) for name in names.split()], 0.0)
    plant.ask("harvest", 0.0, fruit_ids=names.split(), count=count, order_id="order-1")
    plant.at(0.0)
    plant.market.award_answered(T, 1, "", 0.1)
    return plant


def picked(name: str, outcome: Any = "picked", permit_id: str = "", reason: str = "") -> Pick:
    return Pick(fruit_id=name, outcome=outcome, permit_id=permit_id, reason=reason)


def test_a_harvest_from_the_question_to_the_last_fruit() -> None:
    plant = harvesting()
    (asked,) = of(Solicit, plant.effects)
    assert ([f.fruit_id for f in asked.announcement.fruits], asked.announcement.count) == (["f1", "f2", "f3"], 2)
    assert asked.announcement.order_id == "order-1"
    plant.now_s = 2.0
    plant.report(T, "running", phase="dock")
    first = plant.permit(T, "pick", fruit_id="f1")
    assert (first.permit_id, first.fruit_id, first.valid_for_s, first.act) == ("plant-1:1:p2", "f1", 15.0, "pick")
    assert plant.market.due_s() == 10.0
    plant.now_s = 6.0
    one = picked("f1", permit_id=first.permit_id)
    assert plant.report(T, "running", picks=[one], phase="act", progress=0.5)
    assert (plant.task(T).permit_id, plant.task(T).phase, plant.market.due_s()) == ("", "act", 14.0)
    two = picked("f2", "unreachable", reason="too high")
    plant.now_s = 7.0
    plant.report(T, "running", picks=[one, two])
    again = plant.permit(T, "pick", fruit_id="f3")
    plant.now_s = 12.0
    three = picked("f3", permit_id=again.permit_id)
    assert plant.report(T, "done", picks=[one, two, three], reason="home")
    assert (plant.task(T).state, plant.task(T).permits) == ("done", 2)
    assert plant.story(T) == [
        "0 -/0 asked for by anna: dry",
        "0 robot-1/1 awarded to robot-1, epoch 1: cheapest of 1: 5.0 s",
        "2 robot-1/1 dock",
        "2 robot-1/1 permit plant-1:1:p2 for f1",
        "6 robot-1/1 f1 picked",
        "7 robot-1/1 f2 unreachable: too high",
        "7 robot-1/1 permit plant-1:1:p3 for f3",
        "12 robot-1/1 f3 picked",
        "12 robot-1/1 done: 2 of 2 picked; f2 unreachable: too high; home",
    ]


def test_an_announcement_tells_how_many_are_still_wanted_and_names_64_at_most() -> None:
    plant = harvesting("f1 f2 f3", 2)
    given = plant.permit(T, "pick", fruit_id="f1")
    plant.report(T, "failed", picks=[picked("f1", permit_id=given.permit_id)], reason="arm")
    assert plant.task(T).reason == "robot-1 failed: arm"
    (asked,) = of(Solicit, plant.next())
    assert ([f.fruit_id for f in asked.announcement.fruits], asked.announcement.count) == (["f2", "f3"], 1)
    many = Plant()
    names = [f"f{number}" for number in range(70)]
    many.market.fruits([fruit(name) for name in names], 0.0)
    many.ask("harvest", 0.0, fruit_ids=names, count=70)
    look = many.ask("inventory", 0.0)
    harvest, scan = of(Solicit, many.at(0.0))
    assert (len(harvest.announcement.fruits), harvest.announcement.count) == (64, 64)
    assert (scan.announcement.task_id, len(scan.announcement.fruits), scan.announcement.count) == (look, 64, 0)


def test_one_harvest_after_the_other_and_none_while_a_pick_is_in_doubt() -> None:
    plant = Plant()
    plant.market.fruits([fruit("f1"), fruit("f2")], 0.0)
    first = plant.ask("harvest", 0.0, fruit_ids=["f1"], count=1)
    second = plant.ask("harvest", 0.0, fruit_ids=["f2"], count=1)
    with pytest.raises(Conflict):
        plant.ask("harvest", 0.0, fruit_ids=["f2", "f3"], count=1)
    asked = of(Solicit, plant.at(0.0))
    assert asked[0].announcement.task_id == first
    plant.market.cancel(second, "anna", "", 0.0)
    third = plant.ask("harvest", 0.0, fruit_ids=["f2"], count=1)
    holder, epoch = plant.task(first).robot_id, plant.task(first).epoch
    plant.market.award_answered(first, epoch, "", 0.0)
    assert (holder, plant.market.due_s()) == ("robot-1", 8.0), "the other waits for its end"
    plant.permit(first, "pick", fruit_id="f1")
    plant.at(8.0)
    assert (plant.market.doubts, plant.market.due_s()) == (["f1"], math.inf)
    assert plant.story(first)[-2:] == [
        "8 robot-1/1 nobody told how the pick of f1 ended: a scan comes first",
        "8 -/1 robot-1 fell silent for 8 s",
    ]
    look = plant.ask("inventory", 0.0)
    assert plant.market.due_s() == 75.0, "when every act must be over"
    plant.next()
    plant.market.scanned(look, "robot-1", "s1", 80.0)
    plant.now_s = 80.0
    plant.market.settle({"f1": False, "f2": True}, 80.0)
    assert [n.what for n in of(Note, plant.market._effects) if n.kind == "settled"] == ["a scan finds f1 gone"]
    assert (plant.task(first).state, plant.task(first).reason) == ("done", "1 of 1 picked")
    assert plant.task(first).picks == [picked("f1", permit_id="plant-1:1:p4", reason="nobody told; a scan found it gone")]
    assert plant.task(third).state == "announced"
    assert plant.market.due_s() <= 80.0


def test_a_scan_that_finds_a_doubtful_fruit_hanging_says_so_and_it_is_asked_for_again() -> None:
    plant = harvesting("f1", 1)
    plant.permit(T, "pick", fruit_id="f1")
    plant.at(8.0)
    plant.market.dirty = False
    plant.market.settle({"f9": True}, 90.0)
    assert not plant.market.dirty
    plant.market.settle({"f1": True}, 90.0)
    assert plant.market.dirty
    (note,) = [n for n in of(Note, plant.market.take_effects()) if n.kind == "settled"]
    assert (note.what, note.task_id, note.robot_id) == ("a scan finds f1 still hanging", T, "robot-1")
    assert (plant.task(T).state, plant.market.doubts, plant.market.due_s()) == ("announced", [], 8.0)


def test_a_holder_keeps_its_harvest_when_a_scan_of_another_settles_a_doubt() -> None:
    """What the scan finds gone ends an announced harvest only: a held one ends by its holder's word."""
    plant = harvesting("f1", 1)
    plant.permit(T, "pick", fruit_id="f1")
    plant.now_s = 5.0
    plant.market._doubt_pick_of(plant.task(T), 5.0)
    plant.market.settle({"f1": False}, 6.0)
    assert (plant.task(T).state, [pick.fruit_id for pick in plant.task(T).picks]) == ("running", ["f1"])


def test_a_harvest_is_not_ended_by_new_fruit_lists_unless_it_waits_and_has_nothing_left() -> None:
    plant = harvesting("f1 f2", 1)
    plant.market.fruits([], 1.0)
    assert plant.task(T).state == "awarded", "its holder will tell"
    look = plant.ask("inventory", 0.0)
    plant.market.fruits([], 2.0)
    assert plant.task(look).state == "announced"
    plant.report(T, "failed", reason="nothing there")
    assert (plant.task(T).state, plant.task(T).reason) == ("failed", "none of its fruit is left to pick; nothing there")


def test_a_holder_without_a_word_of_its_pick_loses_it_when_the_act_must_be_over() -> None:
    plant = harvesting()
    plant.now_s = 2.0
    plant.permit(T, "pick", fruit_id="f1")
    for now_s in range(3, 76, 4):
        plant.now_s = float(now_s)
        plant.report(T, "running")
    assert plant.market.due_s() == 77.0
    plant.at(76.9)
    assert plant.task(T).state == "running"
    plant.report(T, "running")
    plant.at(77.0)
    assert (plant.task(T).state, plant.market.doubts) == ("announced", ["f1"])
    assert plant.task(T).reason == "robot-1 did not tell how its pick ended"
    assert (Kill("robot-1", T, 1) in plant.effects, plant.market.document().failures) == (True, {T: 1})


def test_a_harvest_that_ends_without_a_word_of_its_pick_leaves_a_doubt_and_is_no_failure() -> None:
    plant = harvesting()
    plant.permit(T, "pick", fruit_id="f1")
    plant.report(T, "done")
    assert (plant.market.doubts, plant.task(T).state, plant.market.document().failures) == (["f1"], "announced", {T: 0})
    assert plant.task(T).reason == "robot-1 ended without telling how a pick ended"


def test_a_harvest_left_unfinished_says_what_is_left() -> None:
    plant = harvesting()
    plant.report(T, "done")
    assert plant.task(T).reason == "robot-1 left 0 of 2 picked"
    assert plant.market.document().failures == {T: 1}


def test_what_a_report_adds_is_what_was_not_known() -> None:
    plant = harvesting()
    given = plant.permit(T, "pick", fruit_id="f1")

    def new(*picks: Pick, robot_id: str = "robot-1", epoch: int = 1) -> list[str]:
        report = Report(robot_id=robot_id, epoch=epoch, state="running", picks=list(picks))
        return [pick.fruit_id for pick in plant.market.verdicts(T, report)]

    mine = picked("f1", permit_id=given.permit_id)
    assert new(mine, picked("f2", "failed")) == ["f1", "f2"]
    assert new(mine, robot_id="robot-2") == []
    assert new(mine, epoch=0) == ["f1"], "a permit's end is the truth, late or not"
    assert new(picked("f2", "failed"), epoch=0) == []
    assert new(picked("f2", "failed"), robot_id="robot-2") == []
    assert new(picked("f2")) == []
    assert new(picked("f9", "failed")) == []
    assert new(picked("f2", "failed", permit_id="plant-1:1:p9")) == []
    plant.report(T, "running", picks=[mine])
    assert new(mine) == []


def test_a_restart_puts_a_pick_in_doubt_whose_task_has_ended_and_keeps_that_of_a_holder() -> None:
    plant = harvesting()
    plant.permit(T, "pick", fruit_id="f1")
    document = plant.market.document()
    assert Plant(document, 5.0).market.doubts == []
    gone = document.model_copy(update={"tasks": []})
    assert Plant(gone, 5.0).market.doubts == ["f1"]
    free = document.model_copy(
        update={"tasks": [document.tasks[0].model_copy(update={"state": "announced", "robot_id": ""})]}
    )
    assert Plant(free, 5.0).market.doubts == ["f1"]


def test_each_pick_that_is_told_begins_the_quarter_of_an_hour_anew() -> None:
    plant = harvesting()
    for now_s in range(1, 1400, 6):
        plant.now_s = float(now_s)
        plant.report(T, "running", picks=[picked("f2", "failed", reason="slipped")] if now_s > 500 else [])
        plant.carried_out()
    assert plant.task(T).state == "running"
    plant.at(1404.9)
    assert plant.task(T).state == "running"
    plant.at(1405.0)
    assert plant.task(T).reason == "robot-1 kept it 900 s without acting"


def test_a_pick_that_is_told_before_anything_runs_begins_no_quarter_of_an_hour() -> None:
    plant = harvesting()
    plant.report(T, "awarded", picks=[picked("f2", "failed", reason="slipped")])
    for now_s in range(1, 1200, 6):
        plant.now_s = float(now_s)
        assert plant.report(T, "awarded")
        plant.carried_out()
    plant.at(1200.0)
    assert plant.task(T).state == "awarded"


def test_an_open_pick_holds_up_no_other_task() -> None:
    plant = harvesting()
    plant.wet()
    plant.permit(T, "pick", fruit_id="f1")
    water = plant.ask()
    plant.at(0.5)
    plant.now_s = 1.0
    plant.report(T, "running")
    assert plant.market.due_s() == 1.5, "its award is sent again"
    assert [grant.award.announcement.task_id for grant in of(Grant, plant.next())] == [water]


def test_a_dose_whose_task_is_long_forgotten_is_settled_all_the_same() -> None:
    plant = awarded()
    plant.permit(T)
    forgotten = Plant(plant.market.document().model_copy(update={"tasks": []}), 100.0).wet()
    forgotten.market.soil(0.3, "", 160.0)
    assert not forgotten.market.permit_open
    (note,) = [note for note in of(Note, forgotten.market.take_effects()) if note.kind == "measured"]
    assert (note.task_id, note.robot_id, note.data) == (T, "robot-1", {"rise_ratio": pytest.approx(0.15)})


# Scans


def test_a_scan_counts_once_from_its_holder_alone_and_outlives_a_restart() -> None:
    plant = Plant()
    plant.ask("inventory", 0.0)
    with pytest.raises(Refused, match="held by nobody, announced: its scan is too late"):
        plant.market.scanned(T, "robot-1", "s1", 0.0)
    plant.at(0.0)
    with pytest.raises(Refused, match="held by robot-1, awarded: its scan is too late"):
        plant.market.scanned(T, "robot-2", "s1", 0.0)
    plant.market.scanned(T, "robot-1", "s1", 3.0)
    plant.market.scanned(T, "robot-1", "s2", 4.0)
    assert (plant.market.document().scanned, plant.story(T)[-1]) == ({T: "s1"}, "3 robot-1/1 robot-1 has scanned")
    again = plant.restarted(20.0)
    assert again.market.document().scanned == {T: "s1"}
    again.at(28.0)
    assert (again.task(T).state, again.task(T).reason) == ("done", "scanned")
    assert Kill("robot-1", T, 1) in again.effects
    with pytest.raises(Refused, match="held by robot-1, done"):
        again.market.scanned(T, "robot-1", "s3", 29.0)


@pytest.mark.parametrize(("state", "reason", "ends"), [("done", "", "scanned"), ("failed", "arm stuck", "arm stuck")])
def test_what_has_sent_its_scan_is_done_however_it_ends(state: Any, reason: str, ends: str) -> None:
    plant = Plant()
    plant.ask("inventory", 0.0)
    plant.at(0.0)
    plant.market.scanned(T, "robot-1", "s1", 3.0)
    plant.report(T, state, reason=reason)
    assert (plant.task(T).state, plant.task(T).reason) == ("done", ends)


@pytest.mark.parametrize(
    ("state", "reason"), [("done", "robot-1 reports done but sent no scan"), ("failed", "robot-1 failed: no reason given")]
)
def test_without_its_scan_an_inventory_is_asked_for_again(state: Any, reason: str) -> None:
    plant = Plant()
    plant.ask("inventory", 0.0)
    plant.at(0.0)
    plant.report(T, state)
    assert (plant.task(T).reason, plant.market.document().failures, plant.market.due_s()) == (reason, {T: 1}, 1.0)


def test_a_scan_that_came_before_the_deadline_ends_its_task_well() -> None:
    for sent, state in ((True, "done"), (False, "failed")):
        plant = Plant()
        plant.ask("inventory", 0.0, within_s=5.0)
        plant.at(0.0)
        if sent:
            plant.market.scanned(T, "robot-1", "s1", 3.0)
        plant.at(5.0)
        assert plant.task(T).state == state


def test_a_scan_for_another_kind_of_task_is_taken_but_ends_nothing() -> None:
    plant = harvesting()
    plant.market.scanned(T, "robot-1", "s1", 1.0)
    assert plant.market.document().scanned == {}
