"""The plant's market as a pure machine: unit claims, and invariants I1, I2, I6 and I10 over random orders of events."""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import dataclass, field
from typing import Any

import pytest

from core.allocation import permits
from core.allocation.auction import Round, better_than_holder, cheapest, no_bid, told, worth_s
from core.allocation.epochs import Names, owner_of
from core.allocation.permits import DAY_S, Dose, OpenPermit, given_ml, revived, rise_needed
from core.allocation.plant_side import Market
from core.allocation.plant_state import Grant, Keyed, Kill, Limits, MarketDocument, Note, Solicit
from core.allocation.watering import Measured
from core.errors import Conflict, NotFound, Refused, Unprocessable
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, Permit, PermitRequest, PlantCard, Report

CARD = PlantCard(
    plant_id="plant-1", url="http://plant-1", stem=Point3(x_m=0.0, y_m=0.0, z_m=0.25),
    dock=Pose2(x_m=0.5, y_m=0.0, yaw_rad=3.0), nozzle=Point3(x_m=0.06, y_m=0.0, z_m=0.06),
)  # fmt: skip
ROBOTS = ("robot-1", "robot-2", "robot-3")


def bid(robot_id: str, cost_s: float | None, task_id: str = "t") -> Bid:
    return Bid(task_id=task_id, robot_id=robot_id, cost_s=cost_s, reason="" if cost_s is not None else "unable")


def market(document: MarketDocument | None = None, now_s: float = 0.0) -> Market:
    made = Market(CARD, document and document.by_clock(now_s), now_s, limits=Limits(soak_s=10.0))
    made.soil(0.15, "", now_s)
    return made


def awarded(made: Market, now_s: float = 0.0) -> str:
    """A water task held by robot-1."""
    task_id = made.ask("water", 150.0, "soil", "dry", now_s).task_id
    made.tick(now_s, ROBOTS[:1])
    (ask,) = [e for e in made.take_effects() if isinstance(e, Solicit)]
    made.bid(task_id, ask.round_number, "robot-1", bid("robot-1", 5.0, task_id), now_s)
    return task_id


def report(made: Market, task_id: str, state: Any, now_s: float, epoch: int = 1, **more: Any) -> bool:
    return made.report(task_id, Report(robot_id="robot-1", epoch=epoch, state=state, **more), now_s).keep


def request(epoch: int = 1, robot_id: str = "robot-1") -> PermitRequest:
    return PermitRequest(robot_id=robot_id, epoch=epoch, act="water", amount_ml=150.0)


def unasked(made: Market) -> list[str]:
    return [e.what for e in made.take_effects() if isinstance(e, Note) and e.kind == "unasked"]


def test_water_that_nobody_had_a_permit_for_is_told_of_once() -> None:
    made = market()
    for t_s, ratio in ((20.0, 0.150), (30.0, 0.149), (40.0, 0.178)):
        made.soil(ratio, "", t_s)
        assert not unasked(made), t_s
    made.soil(0.180, "", 50.0)
    assert unasked(made) == ["soil went from 0.149 to 0.180 without a dose: a leak, or somebody watered by hand"]
    made.soil(0.182, "", 60.0)
    assert not unasked(made)
    made.soil(0.212, "", 70.0)
    assert len(unasked(made)) == 1, "it goes on"


def test_a_dose_and_what_of_it_soaks_in_later_is_not_taken_for_a_leak() -> None:
    made = market()
    made.soil(0.150, "", 20.0)
    task_id = awarded(made, 20.0)
    made.award_answered(task_id, 1, "", 20.0)
    valid_s = made.permit(task_id, request(), "k", 21.0).valid_for_s
    made.soil(0.190, "", 40.0)
    report(made, task_id, "done", 50.0, delivered_ml=150.0)
    over_s = 21.0 + valid_s + 50.0
    for t_s, ratio in ((55.0, 0.195), (over_s, 0.200), (over_s + 9.0, 0.240)):
        made.soil(ratio, "", t_s)
    assert not unasked(made)
    made.soil(0.240, "", over_s + 11.0)
    made.soil(0.275, "", over_s + 12.0)
    assert len(unasked(made)) == 1


def test_after_a_restart_only_what_rises_from_then_on_is_told() -> None:
    made = market()
    made.soil(0.150, "", 20.0)
    again = Market(CARD, made.document().by_clock(30.0), 30.0, limits=Limits(soak_s=10.0))
    for t_s, ratio in ((31.0, 0.150), (39.0, 0.200), (41.0, 0.200), (42.0, 0.229)):
        again.soil(ratio, "", t_s)
    assert not unasked(again)
    again.soil(None, "silent", 43.0)
    again.soil(0.231, "", 44.0)
    assert len(unasked(again)) == 1


def test_the_cheapest_bid_wins_and_ties_go_by_id() -> None:
    assert cheapest([bid("b", 3.0), bid("a", 3.0), bid("c", None)]) == bid("a", 3.0)
    assert cheapest([bid("c", None)]) is None
    assert cheapest([]) is None


def test_a_task_moves_only_for_more_than_the_margin() -> None:
    assert better_than_holder([bid("a", 10.0), bid("b", 8.0)], "a", 0.2) is None
    assert better_than_holder([bid("a", 10.0), bid("b", 7.9)], "a", 0.2) == bid("b", 7.9)
    assert better_than_holder([bid("a", None), bid("b", 70.0)], "a", 0.2) == bid("b", 70.0)
    assert better_than_holder([no_bid("t", "a", "did not answer"), bid("b", 1.0)], "a", 0.2) is None
    assert better_than_holder([bid("a", 10.0)], "a", 0.2) is None


def test_a_round_counts_the_first_answer_of_those_it_asked() -> None:
    asked = Round(number=1, asked=frozenset({"a", "b"}), deadline_s=2.0)
    asked.take("a", bid("a", 5.0), "t")
    asked.take("a", bid("a", 1.0), "t")
    asked.take("z", bid("z", 0.0), "t")
    asked.take("b", bid("a", 0.0), "t")
    assert asked.complete
    assert [b.cost_s for b in asked.bids("t")] == [5.0, None]


@pytest.mark.parametrize(("text", "owner"), [("plant-1:3:17", "plant-1"), ("nonsense", ""), ("a:b:c", "")])
def test_an_id_tells_its_plant(text: str, owner: str) -> None:
    assert owner_of(text) == owner


@pytest.mark.parametrize("now_s", [1000.0, 90000.0, 1e6])
def test_doses_count_for_a_day_of_the_plants_own_life_whatever_clock_it_wakes_to(now_s: float) -> None:
    doses = [Dose(permit_id="a", t_s=89000.0, ml=100.0), Dose(permit_id="b", t_s=90000.0, ml=50.0)]
    woken = revived(doses, 90010.0, now_s)
    assert given_ml(woken, now_s + DAY_S - 1011.0) == 150.0
    assert given_ml(woken, now_s + DAY_S - 1009.0) == 50.0
    assert given_ml(woken, now_s + DAY_S - 9.0) == 0.0


def test_doses_of_an_old_document_count_for_a_day_also_when_the_clock_began_anew() -> None:
    doses = [Dose(permit_id="a", t_s=0.0, ml=100.0), Dose(permit_id="b", t_s=90000.0, ml=50.0)]
    woken = revived(doses, None, 1000.0)
    assert given_ml(woken, 1000.0) == 150.0
    assert given_ml(woken, 1000.0 + DAY_S - 1.0) == 50.0
    assert given_ml(woken, 1000.0 + DAY_S + 1.0) == 0.0


def test_the_rise_asked_for_is_below_what_a_dose_does() -> None:
    assert all(rise_needed(ml) <= 0.5 * ml / 3000.0 for ml in (30.0, 60.0, 150.0, 500.0))
    assert rise_needed(500.0) == 0.01


def test_a_dose_counts_for_a_day_to_the_second_and_is_corrected_by_its_permit() -> None:
    doses = [Dose(permit_id="a", t_s=100.0, ml=100.0), Dose(permit_id="b", t_s=200.0, ml=50.0)]
    assert (given_ml(doses, 100.0 + DAY_S), given_ml(doses, 99.0 + DAY_S)) == (50.0, 150.0)
    assert (permits.recent(doses, 100.0 + DAY_S), permits.recent(doses, 99.0 + DAY_S)) == (doses[1:], doses)
    assert [dose.ml for dose in permits.corrected(doses, "b", 10.0)] == [100.0, 10.0]
    assert DAY_S == 24 * 3600


def test_a_dose_that_was_in_the_future_counts_from_now_when_nobody_knows_the_clock_of_before() -> None:
    doses = [Dose(permit_id="a", t_s=50.0, ml=100.0), Dose(permit_id="b", t_s=5000.0, ml=50.0)]
    assert [dose.t_s for dose in revived(doses, None, 100.0)] == [50.0, 100.0]
    assert [dose.t_s for dose in revived(doses, 6000.0, 100.0)] == [-5850.0, -900.0]


def test_the_times_of_a_dose_are_reckoned_from_its_permit() -> None:
    assert permits.longest_act_s(150.0) == 150.0 / 5.0 + 5.0
    held = OpenPermit(permit=Permit(permit_id="p", task_id="t", epoch=1, act="water", dose_ml=150.0, valid_for_s=15.0),
                      robot_id="robot-1", issued_s=1000.0, before_ratio=0.1)  # fmt: skip
    assert (held.valid_until_s(), held.act_over_s()) == (1015.0, 1050.0)
    assert [held.again(now_s).valid_for_s for now_s in (990.0, 1000.0, 1004.0, 1020.0)] == [15.0, 15.0, 11.0, 0.0]
    assert (held.key, held.finished, permits.PERMIT_VALID_S, permits.DOSE_ML_MIN) == ("", False, 15.0, 30.0)


@pytest.mark.parametrize(("dose_ml", "rise"), [(30.0, 0.004), (60.0, 0.004), (90.0, 0.006), (120.0, 0.008), (500.0, 0.01)])
def test_a_rise_is_a_fifth_of_what_a_dose_does_between_two_bounds(dose_ml: float, rise: float) -> None:
    assert rise_needed(dose_ml) == pytest.approx(rise)


def test_a_rise_that_is_just_enough_is_enough() -> None:
    held = OpenPermit(permit=Permit(permit_id="p", task_id="t", epoch=1, act="water", dose_ml=500.0, valid_for_s=15.0),
                      robot_id="robot-1", issued_s=0.0, before_ratio=0.0)  # fmt: skip
    assert Measured(held, 0.01).arrived
    assert not Measured(held, 0.0099).arrived
    assert (Measured(held, 0.01).rise, Measured(held, 0.01).told) == (0.01, "soil went from 0.000 to 0.010")


def test_names_count_up_and_an_id_is_known_by_its_form() -> None:
    names = Names("plant-1", 3)
    assert [names.next(), names.next("p"), names.next()] == ["plant-1:3:1", "plant-1:3:p2", "plant-1:3:3"]
    assert [owner_of(text) for text in ("plant-1:3:p2", "plant-1:x:2", "plant-1:3:", "plant-1:3", "")] == [
        "plant-1",
        "",
        "",
        "",
        "",
    ]


def test_a_bid_for_another_task_or_in_another_name_is_none_and_says_so() -> None:
    asked = Round(number=1, asked=frozenset({"a", "b", "c"}), deadline_s=2.0)
    asked.take("b", bid("a", 1.0), "t")
    asked.take("a", bid("a", 1.0, "other"), "t")
    assert not asked.complete
    told_ = [(each.robot_id, each.cost_s, each.reason) for each in asked.bids("t")]
    wrong = "answered for another robot or task"
    assert told_ == [("a", None, wrong), ("b", None, wrong), ("c", None, "did not answer")]
    assert no_bid("t", "a", "x" * 600).reason == "x" * 500
    assert asked.purpose == "award"


def test_nobody_can_is_told_robot_by_robot() -> None:
    silent = Bid(task_id="t", robot_id="c", cost_s=None)
    assert told([bid("a", None), bid("b", 1.0), silent]) == "a: unable; c: no reason given"
    assert told([]) == "no robot is known"


def test_a_bid_of_nothing_at_all_is_a_bid() -> None:
    assert cheapest([bid("a", 0.0), bid("b", 1.0)]) == bid("a", 0.0)
    assert better_than_holder([bid("a", 10.0), bid("b", 0.0)], "a", 0.2) == bid("b", 0.0)
    assert better_than_holder([bid("a", 0.0), bid("b", 0.0)], "a", 0.2) is None
    assert better_than_holder([bid("b", 0.0)], "a", 0.2) is None
    assert better_than_holder([bid("a", 5.0), bid("b", None)], "a", 0.2) is None
    assert worth_s([bid("a", 0.0), bid("b", 0.0)], bid("a", 0.0), 0.2) == 0.0


def test_an_award_waits_for_nobody_but_the_disk() -> None:
    made = market()
    made.dirty = False
    task_id = awarded(made)
    assert made.dirty
    (grant,) = [e for e in made.take_effects() if isinstance(e, Grant)]
    assert (grant.robot_id, grant.award.epoch, made.task(task_id).epoch) == ("robot-1", 1, 1)
    assert made.document().tasks[0].epoch == 1


def test_the_round_closes_at_the_window_without_the_silent_one() -> None:
    made = market()
    task_id = made.ask("water", 150.0, "soil", "dry", 0.0).task_id
    made.tick(0.0, ROBOTS[:2])
    (ask,) = [e for e in made.take_effects() if isinstance(e, Solicit)]
    made.bid(task_id, ask.round_number, "robot-2", bid("robot-2", 9.0, task_id), 0.5)
    assert made.task(task_id).state == "announced"
    made.tick(made.due_s(), ROBOTS[:2])
    assert made.task(task_id).robot_id == "robot-2"
    assert made.task(task_id).rounds[0].bids[0].reason == "did not answer"


def test_prices_that_sway_move_a_task_once_and_a_holder_that_cannot_always_loses_it() -> None:
    made = market()
    task_id = awarded(made)

    def asked_again(now_s: float, one: float | None, other: float | None) -> str:
        holder, epoch = made.task(task_id).robot_id, made.task(task_id).epoch
        made.report(task_id, Report(robot_id=holder, epoch=epoch, state="awarded"), now_s)
        made.tick(now_s, ROBOTS[:2])
        (ask,) = [e for e in made.take_effects() if isinstance(e, Solicit)]
        for robot_id, cost_s in (("robot-1", one), ("robot-2", other)):
            made.bid(task_id, ask.round_number, robot_id, bid(robot_id, cost_s, task_id), now_s)
        return made.task(task_id).robot_id

    assert asked_again(11.0, 9.0, 4.0) == "robot-2"
    assert asked_again(22.0, 1.0, 9.0) == "robot-2"
    assert asked_again(33.0, 1.0, None) == "robot-1"


def test_a_holder_that_does_not_answer_is_asked_ever_more_seldom_until_it_does() -> None:
    made = market()
    task_id, asked_s, now_s = awarded(made), [0.0], 0.0
    made.award_answered(task_id, 1, "", 0.0)
    while len(asked_s) < 7:
        made.take_effects()
        report(made, task_id, "awarded", now_s)
        made.tick(now_s, ROBOTS[:2])
        if asks := [e for e in made.take_effects() if isinstance(e, Solicit)]:
            asked_s.append(now_s)
            for robot_id in ROBOTS[0 if len(asked_s) == 6 else 1 : 2]:
                made.bid(task_id, asks[0].round_number, robot_id, bid(robot_id, 5.0, task_id), now_s)
        now_s += 1.0
    waits_s = [after - before for before, after in itertools.pairwise(asked_s)]
    window_s, again_s = made.rules.bid_window_s, made.rules.reallocate_s
    assert waits_s == [again_s, *(window_s + again_s * times for times in (2, 4, 8, 8)), again_s]
    assert made.task(task_id).robot_id == "robot-1"


def test_nobody_is_asked_about_what_runs_until_it_waits_again() -> None:
    made = market()
    task_id = awarded(made)
    report(made, task_id, "running", 1.0)

    def asked(first_s: int, last_s: int, state: str) -> list[int]:
        times_s = []
        for now_s in range(first_s, last_s):
            made.take_effects()
            report(made, task_id, state, float(now_s))
            made.tick(float(now_s), ROBOTS[:2])
            times_s += [now_s for e in made.take_effects() if isinstance(e, Solicit)]
        return times_s

    assert asked(2, 30, "running") == []
    assert asked(30, 31, "awarded") == [30]


def test_a_holder_that_is_known_no_more_is_left_to_its_lease() -> None:
    made = market()
    task_id = awarded(made)
    report(made, task_id, "awarded", 10.0)
    made.tick(10.0, ROBOTS[1:])
    (ask,) = [e for e in made.take_effects() if isinstance(e, Solicit)]
    for robot_id in ROBOTS[1:]:
        made.bid(task_id, ask.round_number, robot_id, bid(robot_id, 1.0, task_id), 10.0)
    assert made.task(task_id).robot_id == "robot-1"


def test_an_unacknowledged_award_is_sent_again_until_the_lease_ends() -> None:
    made = market()
    task_id = awarded(made)
    made.take_effects()
    sent = 0
    while made.task(task_id).state == "awarded":
        made.tick(made.due_s(), ROBOTS[:1])
        sent += sum(isinstance(e, Grant) for e in made.take_effects())
    assert 5 <= sent <= 9
    assert "fell silent" in made.task(task_id).reason


def test_a_stale_epoch_is_told_to_drop_it_and_changes_nothing() -> None:
    made = market()
    task_id = awarded(made)
    before = made.document()
    assert not report(made, task_id, "done", 1.0, epoch=0)
    assert not made.report(task_id, Report(robot_id="robot-2", epoch=1, state="failed"), 1.0).keep
    assert made.document() == before


def test_a_report_twice_is_a_report_once() -> None:
    made = market()
    task_id = awarded(made)
    report(made, task_id, "running", 1.0)
    made.permit(task_id, request(), "k", 1.0)
    assert report(made, task_id, "done", 20.0, delivered_ml=140.0)
    once = made.document()
    assert report(made, task_id, "done", 20.0, delivered_ml=140.0)
    assert made.document() == once
    assert made.given_ml(20.0) == 140.0


def test_done_without_a_permit_is_not_done() -> None:
    made = market()
    task_id = awarded(made)
    report(made, task_id, "done", 1.0)
    assert made.task(task_id).state == "announced"
    assert "took no permit" in made.task(task_id).reason


def test_the_second_permit_waits_for_validity_act_soak_and_a_measurement() -> None:
    made = market()
    task_id = awarded(made)
    permit = made.permit(task_id, request(), "", 1.0)
    over_s = 1.0 + permit.valid_for_s + 150.0 / 5.0 + 5.0 + 10.0
    with pytest.raises(Refused, match="measure again"):
        made.permit(task_id, request(), "", 2.0)
    made.tick(made.due_s(), ROBOTS)
    made.soil(0.15, "", over_s - 0.1)
    assert made.permit_open
    made.soil(None, "stuck", over_s + 1.0)
    assert made.permit_open
    assert "stuck" in made.waiting(over_s + 2.0)
    made.soil(0.15, "", over_s + 3.0)
    assert not made.permit_open
    assert made.task(task_id).state == "announced"


def test_a_rise_makes_it_done_even_when_nobody_reported() -> None:
    made = market()
    task_id = awarded(made)
    made.permit(task_id, request(), "", 1.0)
    made.tick(made.due_s(), ROBOTS)
    made.soil(0.19, "", 100.0)
    done = made.task(task_id)
    assert (done.state, done.delivered_ml) == ("done", 150.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"robot_id": "robot-2"}, "held by robot-1"),
        ({"epoch": 0}, "under epoch 1"),
        ({"act": "pick"}, "does not pick"),
    ],
)
def test_a_permit_is_refused_and_says_why(change: dict[str, Any], why: str) -> None:
    made = market()
    task_id = awarded(made)
    with pytest.raises(Refused, match=why):
        made.permit(task_id, request().model_copy(update=change), "", 1.0)


def test_no_permit_after_the_lease_nor_without_a_measurement() -> None:
    made = market()
    task_id = awarded(made)
    with pytest.raises(Refused, match="lease"):
        made.permit(task_id, request(), "", 9.0)
    made.soil(None, "open", 1.0)
    with pytest.raises(Refused, match="could not be verified"):
        made.permit(task_id, request(), "", 1.0)


def test_a_failed_task_is_remembered_until_a_restart_and_not_over_it() -> None:
    made = market()
    made.ask("water", 150.0, "soil", "dry", 0.0)
    assert made.gave_up_s("water") == -math.inf
    made.limits.day_cap_ml = 0.0
    made.tick(5.0, ROBOTS)
    assert [task.state for task in made.tasks()] == ["failed"]
    assert made.gave_up_s("water") == 5.0
    assert made.gave_up_s("harvest") == -math.inf
    assert market(made.document(), now_s=6.0).gave_up_s("water") == -math.inf


def test_nobody_is_asked_to_water_while_the_soil_cannot_be_measured() -> None:
    made = market()
    made.ask("water", 150.0, "operator", "by hand", 0.0)
    made.soil(None, "open", 1.0)
    made.tick(5.0, ROBOTS)
    assert [e for e in made.take_effects() if isinstance(e, Solicit)] == []
    made.soil(0.15, "", 6.0)
    assert made.due_s() <= 6.0
    made.tick(6.0, ROBOTS)
    assert [e.robots for e in made.take_effects() if isinstance(e, Solicit)] == [ROBOTS]


def test_the_day_cap_cuts_the_dose_and_then_refuses() -> None:
    made = market()
    made.limits.day_cap_ml = 100.0
    task_id = awarded(made)
    assert made.permit(task_id, request(), "", 1.0).dose_ml == 100.0
    assert made.left_ml(1.0) == 0.0
    report(made, task_id, "failed", 2.0, delivered_ml=30.0)
    assert made.left_ml(2.0) == 70.0
    made.limits.day_cap_ml = 30.0
    made.soil(0.15, "", 60.0)
    made.cancel(task_id, "operator", "", 60.0)
    with pytest.raises(Refused, match="the day's"):
        made.ask("water", 150.0, "soil", "dry", 61.0)


def test_when_the_days_cap_is_reached_an_open_watering_ends_and_says_so_and_nobody_comes_for_it() -> None:
    made = market()
    made.limits.day_cap_ml = 170.0
    task_id = awarded(made)
    made.permit(task_id, request(), "", 1.0)
    report(made, task_id, "done", 2.0, delivered_ml=150.0)
    made.soil(0.15, "", 60.0)
    assert made.task(task_id).state == "announced"
    made.take_effects()
    made.tick(61.0, ROBOTS)
    assert (made.task(task_id).state, made.task(task_id).reason) == ("failed", "the day's 170 ml are given")
    assert not [e for e in made.take_effects() if isinstance(e, Solicit)]


def test_a_robot_that_keeps_a_task_without_acting_loses_it() -> None:
    made = market()
    task_id = awarded(made)
    now_s = 0.0
    while made.task(task_id).state in ("awarded", "running"):
        report(made, task_id, "running", now_s)
        now_s += 2.0
        made.tick(now_s, ROBOTS[:1])
    assert 890.0 < now_s < 910.0
    assert Kill("robot-1", task_id, 1) in made.take_effects()


def test_a_robot_that_fails_again_and_again_ends_the_task() -> None:
    made, now_s, epoch = market(), 0.0, 0
    task_id = made.ask("water", 150.0, "soil", "dry", 0.0).task_id
    while made.task(task_id).state != "failed":
        now_s = made.due_s()
        made.tick(now_s, ROBOTS[:1])
        for ask in [e for e in made.take_effects() if isinstance(e, Solicit)]:
            made.bid(task_id, ask.round_number, "robot-1", bid("robot-1", 5.0, task_id), now_s)
        epoch = made.task(task_id).epoch
        report(made, task_id, "running", now_s, epoch=epoch, progress=0.3)
        report(made, task_id, "failed", now_s, epoch=epoch, reason="cannot dock")
        assert made.task(task_id).progress == (0.0 if made.task(task_id).state == "announced" else 0.3)
    assert epoch == 8
    assert "cannot dock" in made.task(task_id).reason
    assert now_s > 60.0


def test_unknown_and_finished_tasks_answer_for_themselves() -> None:
    made = market()
    with pytest.raises(NotFound) as elsewhere:
        made.task("plant-9:1:1")
    assert "plant-9" in elsewhere.value.hint
    task_id = awarded(made)
    made.cancel(task_id, "operator", "", 1.0)
    assert made.cancel(task_id, "operator", "", 2.0).state == "cancelled"
    assert not report(made, task_id, "running", 2.0)
    with pytest.raises(Refused):
        made.permit(task_id, request(), "", 2.0)


def test_one_open_water_task() -> None:
    made = market()
    made.ask("water", 150.0, "soil", "dry", 0.0)
    with pytest.raises(Conflict):
        made.ask("water", 150.0, "operator", "now", 0.0)


def test_finished_tasks_are_forgotten_after_a_while() -> None:
    made = market()
    for n in range(40):
        made.cancel(made.ask("water", 10.0, "operator", "", float(n)).task_id, "operator", "", float(n))
    assert len(made.tasks()) == made.rules.finished_kept


def test_a_key_is_known_as_long_as_its_task_and_refused_for_a_while_after() -> None:
    made = market()

    def asked(n: int) -> Keyed:
        return Keyed.of("operator", f"k{n}", b"water")

    many = made.rules.finished_kept + made.rules.forgotten_keys_kept
    for n in range(many + 20):
        assert made.asked_before(asked(n)) is None
        task = made.ask("water", 10.0, "operator", "", float(n), asking=asked(n))
        made = market(made.document(), float(n))
        found = made.asked_before(asked(n))
        assert found is not None
        assert found.task_id == task.task_id
        made.cancel(task.task_id, "operator", "", float(n))
    with pytest.raises(Unprocessable):
        made.asked_before(Keyed.of("operator", f"k{many}", b"a scan"))
    assert made.asked_before(Keyed.of("anna", f"k{many}", b"water")) is None
    with pytest.raises(Conflict, match="ended long ago"):
        made.asked_before(asked(21))
    assert made.asked_before(asked(0)) is None
    assert len(made.document().keyed) <= many + 1


# Random orders of events


@dataclass
class Actor:
    """A robot that does what the protocol allows, at random moments, over a network that loses and repeats."""

    robot_id: str
    cost_s: float | None
    awards: dict[str, int] = field(default_factory=dict)
    permits: list[tuple[str, str, float, float]] = field(default_factory=list)
    """(task, permit, dose, start before)"""
    used: set[str] = field(default_factory=set)
    """A permit is one shot, also when its answer comes twice."""


@dataclass
class Play:
    """One garden of one pot, driven by dice; checks the invariants after every event."""

    rng: random.Random
    now_s: float = 0.0
    ratio: float = 0.15
    market: Market = field(default_factory=market)
    faults: dict[str, int] = field(default_factory=dict)
    awards: dict[str, list[int]] = field(default_factory=dict)
    doses: dict[str, list[tuple[str, float]]] = field(default_factory=dict)
    measured_s: float = -math.inf
    durable: MarketDocument = field(default_factory=MarketDocument)
    late: list[tuple[str, Report]] = field(default_factory=list)
    heard_s: dict[tuple[str, int], float] = field(default_factory=dict)
    """When the holder of an epoch last reached the pot."""

    def __post_init__(self) -> None:
        self.actors = {name: Actor(name, self.rng.uniform(3, 40)) for name in ROBOTS}
        self.market.limits.day_cap_ml = 1000.0

    def fault(self) -> None:
        for task in self.market.open_tasks():
            self.faults[task.task_id] = self.faults.get(task.task_id, 0) + 1

    def step(self) -> None:
        self.now_s += self.rng.choice((0.0, 0.1, 0.5, 2.0, 5.0))
        getattr(self, self.rng.choice(EVENTS))()
        self.settle()

    def settle(self) -> None:
        """Save, then let effects leave; sometimes the pot dies instead."""
        for task in self.market.open_tasks():
            held_s = self.heard_s.setdefault((task.task_id, task.epoch), self.now_s)
            if self.now_s - held_s >= self.market.rules.lease_s - 1e-6:
                self.fault()
        self.market.tick(self.now_s, ROBOTS)
        self.check()
        if self.market.dirty:
            self.durable = self.market.document()
            self.market.dirty = False
        effects = self.market.take_effects()
        if self.rng.random() < 0.02:
            self.restart()
            return
        for effect in effects:
            self.carry_out(effect)

    def carry_out(self, effect: Any) -> None:
        if isinstance(effect, Solicit):
            task_id = effect.announcement.task_id
            for name in effect.robots:
                cost_s = self.actors[name].cost_s
                if self.rng.random() < 0.1:
                    self.fault()
                    continue
                answer = bid(name, cost_s, task_id)
                self.market.bid(task_id, effect.round_number, name, answer, self.now_s)
            if self.market.dirty:
                self.settle()
        elif isinstance(effect, Grant):
            task_id = effect.award.announcement.task_id
            assert self.durable_epoch(task_id) >= effect.award.epoch, "an award left before its epoch was durable"
            if effect.award.epoch not in self.awards.setdefault(task_id, []):
                self.awards[task_id].append(effect.award.epoch)
            if self.rng.random() < 0.1:
                self.fault()
                return
            self.actors[effect.robot_id].awards[task_id] = effect.award.epoch
            self.market.award_answered(task_id, effect.award.epoch, "", self.now_s)
        elif isinstance(effect, Kill) and self.rng.random() < 0.5:
            actor = self.actors[effect.robot_id]
            if actor.awards.get(effect.task_id) == effect.epoch:
                del actor.awards[effect.task_id]

    def durable_epoch(self, task_id: str) -> int:
        return next(task.epoch for task in self.durable.tasks if task.task_id == task_id)

    # Events

    def thirst(self) -> None:
        if not self.market.open_tasks() and not self.market.permit_open and self.ratio < 0.2:
            try:
                self.market.ask("water", 150.0, "soil", "dry", self.now_s)
            except Refused:
                assert self.market.left_ml(self.now_s) < 5.0

    def measure(self) -> None:
        was_open = self.market.permit_open
        self.market.soil(self.ratio + self.rng.gauss(0, 0.001), "", self.now_s)
        if was_open and not self.market.permit_open:
            self.measured_s = self.now_s
            self.doses.clear()

    def dry(self) -> None:
        self.ratio = max(0.1, self.ratio - 0.004)

    def reports(self) -> None:
        for actor in self.actors.values():
            for task_id, epoch in list(actor.awards.items()):
                state = self.rng.choice(("awarded", "running", "running", "running", "failed"))
                if state == "failed":
                    if self.rng.random() < 0.9:
                        continue
                    self.fault()
                self.send(actor, task_id, Report(robot_id=actor.robot_id, epoch=epoch, state=state))

    def send(self, actor: Actor, task_id: str, told: Report) -> None:
        if self.rng.random() < 0.1:
            self.fault()
            return
        if self.rng.random() < 0.2:
            self.late.append((task_id, told))
        answer = self.market.report(task_id, told, self.now_s)
        if answer.keep:
            self.heard_s[task_id, told.epoch] = self.now_s
        if self.rng.random() < 0.1:
            self.fault()
            return
        if not answer.keep or told.state in ("done", "failed"):
            actor.awards.pop(task_id, None)

    def deliver_late(self) -> None:
        if self.late:
            task_id, told = self.late.pop(self.rng.randrange(len(self.late)))
            self.fault()
            self.market.report(task_id, told, self.now_s)

    def asks_permit(self) -> None:
        actor = self.actors[self.rng.choice(ROBOTS)]
        for task_id, epoch in list(actor.awards.items()):
            asked_s = self.now_s
            try:
                permit = self.market.permit(task_id, request(epoch, actor.robot_id), self.rng.choice(("", "k")), asked_s)
            except (Refused, NotFound):
                continue
            self.heard_s[task_id, epoch] = asked_s
            if self.rng.random() < 0.1:
                self.fault()
                continue
            if permit.permit_id not in actor.used:
                actor.used.add(permit.permit_id)
                actor.permits.append((task_id, permit.permit_id, permit.dose_ml, asked_s + permit.valid_for_s))

    def acts(self) -> None:
        actor = self.actors[self.rng.choice(ROBOTS)]
        while actor.permits:
            task_id, permit_id, dose_ml, before_s = actor.permits.pop()
            if self.now_s > before_s or self.rng.random() < 0.15:
                self.fault()
                continue
            self.ratio += dose_ml / 3000.0
            self.doses.setdefault("pot", []).append((permit_id, self.now_s))
            assert len(self.doses["pot"]) == 1, f"two doses without a measurement between: {self.doses}"
            if self.rng.random() < 0.3:
                self.fault()
                actor.awards.pop(task_id, None)
                continue
            epoch = actor.awards.get(task_id, 0)
            self.send(actor, task_id, Report(robot_id=actor.robot_id, epoch=epoch, state="done", delivered_ml=dose_ml))

    def robot_changes(self) -> None:
        actor = self.actors[self.rng.choice(ROBOTS)]
        actor.cost_s = self.rng.choice((None, self.rng.uniform(3, 40), self.rng.uniform(3, 40)))
        self.fault()

    def robot_restarts(self) -> None:
        actor = self.actors[self.rng.choice(ROBOTS)]
        actor.awards.clear()
        actor.permits.clear()
        self.fault()

    def silence(self) -> None:
        self.now_s += self.rng.choice((3.0, 10.0, 60.0))
        self.fault()

    def cancels(self) -> None:
        if self.rng.random() < 0.1:
            for task in self.market.open_tasks():
                self.market.cancel(task.task_id, "operator", "", self.now_s)

    def restart(self) -> None:
        self.fault()
        cap_ml = self.market.limits.day_cap_ml
        self.market = market(MarketDocument.model_validate_json(self.durable.model_dump_json()), self.now_s)
        self.market.limits.day_cap_ml = cap_ml
        self.market.soil(self.ratio, "", self.now_s)

    def check(self) -> None:
        assert len([t for t in self.market.open_tasks() if t.kind == "water"]) <= 1
        assert self.market.given_ml(self.now_s) <= self.market.limits.day_cap_ml + 1e-6
        for task in self.market.open_tasks():
            for entry in task.rounds[-1:]:
                self.check_round(entry)
        for task_id, epochs in self.awards.items():
            assert epochs == sorted(set(epochs)), "an epoch was awarded twice or out of order"
            assert len(epochs) <= 1 + self.faults.get(task_id, 0), f"I6: {task_id} awarded {epochs}"

    def check_round(self, entry: Any) -> None:
        if not entry.winner:
            return
        able = [(b.cost_s, b.robot_id) for b in entry.bids if b.cost_s is not None]
        if "moved from" in entry.why:
            holder = entry.why.split()[2].rstrip(",")
            able = [pair for pair in able if pair[1] != holder]
        assert entry.winner == min(able)[1], f"I10: {entry}"


EVENTS = (
    "thirst", "thirst", "measure", "measure", "dry", "reports", "reports", "reports", "reports", "deliver_late",
    "asks_permit", "asks_permit", "acts", "acts", "robot_changes", "robot_restarts", "silence", "cancels",
)  # fmt: skip


@pytest.mark.parametrize("block", range(4))
def test_the_invariants_hold_in_any_order_of_events(block: int) -> None:
    tasks = [task for play in play_many(range(block * 50, block * 50 + 50)) for task in play.market.tasks()]
    assert sum(task.state == "done" for task in tasks) > 10
    assert sum(task.permits for task in tasks) > 40


def test_a_market_that_forgets_the_permit_of_a_silent_robot_is_caught_by_the_same_play(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A test of the test: only the lease counts, as in a market without permits."""

    def fell_silent(self: Market, task: Any, live: Any, now_s: float) -> None:
        self._water.open, self._water.settle_at_s = None, math.inf
        self._release(task, f"{task.robot_id} fell silent", now_s, failed=False)

    monkeypatch.setattr(Market, "_silent", fell_silent)
    with pytest.raises(AssertionError, match="two doses"):
        play_many(range(200))


def play_many(seeds: range) -> list[Play]:
    plays = []
    for seed in seeds:
        print("seed", seed)
        plays.append(Play(random.Random(seed)))
        for _ in range(400):
            plays[-1].step()
    return plays
