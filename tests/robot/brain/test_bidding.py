"""The price of a task, by a made-up garden of known distances."""

import random
from dataclasses import replace

import pytest

from core.allocation.bidding import (
    DOCKING_S,
    REST_MIN_S,
    UNDOCKING_S,
    Condition,
    Stop,
    charge_s,
    done_s,
    insertion,
    price,
    queue_s,
    refill_s,
    ride_s,
    total_s,
    work_s,
)
from core.robots import gardener
from core.wire.geometry import Point3, Pose2
from core.wire.market import Announcement, Breakdown, PlantCard

PLACES = {"here": 0.0, "near": 10.0, "far": 40.0, "tap": 20.0, "spare": 30.0}


def travel(place, dock):
    return abs(PLACES[place] - PLACES[dock]) if dock in PLACES else None


def asked(plant="near", dose_ml=150.0, task_id="near:1"):
    card = PlantCard(
        plant_id=plant,
        url="http://x",
        stem=Point3(x_m=0.0, y_m=0.0, z_m=0.25),
        dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0),
        nozzle=Point3(x_m=0.0, y_m=0.0, z_m=0.0),
    )
    return Announcement(task_id=task_id, kind="water", plant=card, dose_ml=dose_ml)


ME = Condition(
    robot_id="robot-1",
    can=frozenset({"water"}),
    travel=travel,
    battery_ratio=0.9,
    tank_ml=1000.0,
    taps=("tap",),
    chargers=("spare",),
)


def test_a_free_robot_asks_for_the_way_and_the_work():
    bid = price(asked(), ME)
    assert bid.breakdown.travel_s == pytest.approx(10.0 + DOCKING_S)
    assert bid.breakdown.work_s == pytest.approx(work_s("water", 150.0))
    assert bid.cost_s == pytest.approx(total_s(bid.breakdown))


def test_a_watering_of_150_ml_takes_about_the_papers_twenty_seconds_and_the_arm():
    assert work_s("water", 150.0) == pytest.approx(33.5, abs=5.0)


def test_a_robot_on_that_very_dock_only_asks_for_the_work():
    assert price(asked(), replace(ME, docked_at="near")).breakdown.travel_s == 0.0


def test_a_docked_robot_has_to_undock_first():
    bid = price(asked(), replace(ME, docked_at="spare"))
    assert bid.breakdown.travel_s == pytest.approx(UNDOCKING_S + 20.0 + DOCKING_S)


def test_the_queue_comes_first_and_moves_where_the_robot_starts_from():
    busy = replace(ME, current=Stop(dock="far", work_s=25.0), queue=(Stop(dock="spare", work_s=7.0),))
    bid = price(asked(), busy)
    assert bid.breakdown.current_s == pytest.approx(40.0 + DOCKING_S + 25.0)
    assert bid.breakdown.queue_s == pytest.approx(UNDOCKING_S + 10.0 + DOCKING_S + 7.0)
    assert bid.breakdown.travel_s == pytest.approx(UNDOCKING_S + 20.0 + DOCKING_S)


def test_of_what_is_running_only_the_rest_is_asked_for():
    at_it = replace(ME, docked_at="far", current=Stop(dock="far", work_s=25.0, task_id="far:1"))
    assert price(asked(), replace(at_it, at_work_s=15.0)).breakdown.current_s == pytest.approx(10.0)
    assert price(asked(), replace(at_it, at_work_s=60.0)).breakdown.current_s == REST_MIN_S


@pytest.mark.parametrize("where", ["here", "tap"])
def test_an_errand_that_began_costs_what_it_was_said_to_cost_on_the_way(where):
    """A bid that needs a refill first, and the same bid once the robot is on its way to the tap."""
    thirsty = replace(ME, tank_ml=100.0, docked_at="" if where == "here" else where)
    before = price(asked(), thirsty)
    begun = price(asked(), replace(thirsty, current=Stop(dock="", refill=True)))
    assert before.breakdown.refill_s > 0.0
    assert begun.breakdown.refill_s == 0.0
    assert done_s(begun.breakdown) == pytest.approx(done_s(before.breakdown))


def test_a_bid_is_the_seconds_until_it_is_done_and_those_that_all_behind_it_wait_longer():
    busy = replace(ME, queue=(Stop(dock="far", work_s=30.0, task_id="far:1"),))
    assert insertion(asked("near"), busy) == 0
    bid = price(asked("near"), busy)
    own_s = (10.0 + DOCKING_S) + work_s("water", 150.0)
    later_s = own_s + (UNDOCKING_S + 30.0 + DOCKING_S) - (40.0 + DOCKING_S)
    assert done_s(bid.breakdown) == pytest.approx(own_s)
    assert bid.breakdown.delay_s == pytest.approx(2 * later_s), "the task behind it, and whoever asks next"
    assert bid.cost_s == pytest.approx(total_s(bid.breakdown))


def test_a_free_robot_bids_the_seconds_until_it_is_done():
    bid = price(asked(), ME)
    assert bid.breakdown.delay_s == 0.0
    assert bid.cost_s == pytest.approx(10.0 + DOCKING_S + work_s("water", 150.0))


def test_whoever_asks_a_busy_robot_next_waits_longer_as_well():
    bid = price(asked(), replace(ME, docked_at="spare", battery_ratio=0.3, current=Stop(dock="", charge=True)))
    added_s = bid.breakdown.travel_s + bid.breakdown.work_s
    assert bid.breakdown.delay_s == pytest.approx(added_s)


def test_a_task_goes_where_everybody_together_waits_least():
    far, near = Stop(dock="far", work_s=30.0, task_id="far:1"), Stop(dock="near", work_s=30.0, task_id="near:0")
    assert insertion(asked("near"), replace(ME, queue=(far,))) == 0
    assert insertion(asked("far", task_id="far:1"), replace(ME, queue=(near,))) == 1


def test_nothing_overtakes_what_is_settled_or_more_urgent_and_the_urgent_overtakes():
    far, settled = Stop(dock="far", work_s=30.0), Stop(dock="far", work_s=30.0, settled=True)
    assert insertion(asked("near"), replace(ME, queue=(settled,))) == 1
    near = Stop(dock="near", work_s=30.0)
    assert insertion(asked("spare"), replace(ME, queue=(far, near))) == 0
    assert insertion(asked("spare"), replace(ME, queue=(far, settled, near))) == 2
    assert insertion(asked("near"), replace(ME, queue=(replace(far, priority=7),))) == 1
    urgent = asked("far").model_copy(update={"priority": 9})
    assert insertion(urgent, replace(ME, queue=(Stop(dock="near", work_s=30.0), far))) == 0


def test_a_task_that_is_held_is_priced_where_it_stands():
    near, far = Stop(dock="near", work_s=30.0, task_id="near:1"), Stop(dock="far", work_s=30.0, task_id="far:1")
    held, free = price(asked("near"), replace(ME, queue=(near, far))), price(asked("near"), replace(ME, queue=(far,)))
    assert held == free
    assert done_s(held.breakdown) == done_s(price(asked("near"), ME).breakdown)
    assert insertion(asked("near"), replace(ME, queue=(far, near))) == 1


def test_a_charging_robot_is_free_once_it_has_enough():
    charging = replace(ME, docked_at="spare", battery_ratio=0.3, current=Stop(dock="", charge=True))
    assert price(asked(), charging).breakdown.current_s == pytest.approx(charge_s(0.3))


def test_a_task_in_the_queue_already_is_priced_where_it_stands():
    first = Stop(dock="near", work_s=30.0, dose_ml=150.0, task_id="near:1")
    later = Stop(dock="far", work_s=30.0, dose_ml=150.0, task_id="far:1")
    assert price(asked(), replace(ME, queue=(first, later))).breakdown.queue_s == 0.0
    assert price(asked(), replace(ME, queue=(later, first))).breakdown.queue_s > 0.0


def test_water_promised_to_earlier_tasks_is_not_there_for_later_ones():
    thirsty = replace(ME, tank_ml=200.0, queue=(Stop(dock="far", work_s=1.0, dose_ml=150.0),))
    bid = price(asked(), thirsty)
    assert insertion(asked(), thirsty) == 0
    assert bid.breakdown.refill_s == 0.0
    assert bid.breakdown.delay_s > 2 * (UNDOCKING_S + 10.0 + DOCKING_S + refill_s(50.0)), "the other has to fetch its water"
    assert bid.cost_s == pytest.approx(total_s(bid.breakdown))
    settled = replace(thirsty, queue=(replace(thirsty.queue[0], settled=True),))
    assert price(asked(), settled).breakdown.refill_s == pytest.approx(UNDOCKING_S + 20.0 + DOCKING_S + refill_s(50.0))
    assert price(asked(), replace(ME, tank_ml=200.0)).breakdown.refill_s == 0.0


def test_a_way_to_the_tap_that_shortens_the_ways_of_others_delays_nobody_less_than_nothing():
    dry, wet = (
        Stop(dock="far", work_s=1.0, task_id="far:1"),
        Stop(dock="spare", work_s=1.0, dose_ml=500.0, task_id="spare:1"),
    )
    thirsty = replace(ME, tank_ml=100.0, queue=(dry, wet))
    bid = price(asked(plant="tap", dose_ml=1.0, task_id="tap:1"), thirsty)
    assert bid.breakdown.delay_s >= 0.0
    assert bid.cost_s == pytest.approx(total_s(bid.breakdown))


def test_a_nearly_empty_pack_is_charged_first_and_paid_for():
    bid = price(asked(), replace(ME, battery_ratio=0.12))
    assert bid.breakdown.charge_s >= charge_s(0.12)
    assert bid.cost_s == pytest.approx(total_s(bid.breakdown))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"can": frozenset({"charge"})}, "no pump"),
        ({"unfit": {"water": "the pump has failed"}}, "the pump has failed"),
        ({"stopped_by": "operator"}, "stopped by operator"),
        ({"down": ("base: silent",)}, "base: silent"),
        ({"lost": "lost: no markers"}, "lost"),
        ({"battery_ratio": 0.02}, "battery flat"),
        ({"tank_ml": None}, "sensor is silent"),
        ({"tank_ml": 10.0, "taps": ("nowhere",)}, "no tap"),
        ({"battery_ratio": 0.1, "chargers": ()}, "no charging dock"),
    ],
)
def test_whoever_cannot_says_why(change, word):
    bid = price(asked(), replace(ME, **change))
    assert bid.cost_s is None
    assert word in bid.reason


def test_who_is_unfit_for_one_kind_takes_others():
    assert price(asked(), replace(ME, unfit={"inventory": "the eye is dirty"})) == price(asked(), ME)


def test_an_unreachable_dock_is_refused():
    assert "no way" in price(asked("nowhere"), ME).reason


def test_the_largest_dose_is_taken_but_more_than_a_tankful_is_refused():
    largest = asked(dose_ml=500.0)
    assert price(largest, ME).cost_s is not None
    assert "tank holds" in price(largest.model_copy(update={"dose_ml": 2 * gardener.TANK_ML}), ME).reason


def test_the_figures_that_prices_are_made_of():
    assert work_s("water", 150.0) == pytest.approx(6.0 + 6.0 + 20.0 + 1.5)
    assert work_s("inventory", 0.0) == 30.0
    assert [work_s("harvest", 0.0, count) for count in (0, 1, 3)] == [27.0, 27.0, 57.0]
    assert ride_s(3.0) == pytest.approx(1.15 * 10.0 + 3.0)
    assert charge_s(0.1) == pytest.approx((0.40 - 0.1) * 130.0 * 3600.0 / 60.0)
    assert charge_s(0.1, 0.2) == pytest.approx(0.1 * 130.0 * 3600.0 / 60.0)
    assert (charge_s(0.4), charge_s(0.9)) == (0.0, 0.0)
    assert [refill_s(tank_ml) for tank_ml in (1500.0, 1440.0, 1501.0)] == [0.0, 2.0, 0.0]
    assert (DOCKING_S, UNDOCKING_S, REST_MIN_S) == (12.0, 6.0, 5.0)


def test_a_pack_is_flat_below_a_twentieth_and_charged_first_below_fifteen_hundredths():
    assert "battery flat at 4%" in price(asked(), replace(ME, battery_ratio=0.0449)).reason
    assert price(asked(), replace(ME, battery_ratio=0.05)).breakdown.charge_s > 0.0
    assert price(asked(), replace(ME, battery_ratio=0.01, docked_at="spare")).breakdown.charge_s > 0.0
    assert price(asked(), replace(ME, battery_ratio=0.1499)).breakdown.charge_s > 0.0
    assert price(asked(), replace(ME, battery_ratio=0.15)).breakdown.charge_s == 0.0


def test_charging_on_the_way_costs_the_way_there_what_the_way_took_and_the_time_on_the_dock():
    bid = price(asked(), replace(ME, battery_ratio=0.12))
    left = 0.12 - (30.0 + 12.0) * (12.0 + 18.0) / (130.0 * 3600.0)
    assert bid.breakdown.charge_s == pytest.approx(30.0 + 12.0 + charge_s(left))
    assert bid.breakdown.travel_s == pytest.approx(6.0 + 20.0 + 12.0)


def test_work_takes_from_the_pack_as_well():
    """A quarter of an hour with the arm out, and the next task needs a charge first."""
    long = Stop(dock="near", work_s=900.0, settled=True)
    used = (22.0 * (12.0 + 18.0) + 900.0 * (12.0 + 6.0)) / (130.0 * 3600.0)
    enough, short = (replace(ME, battery_ratio=0.15 + used + spare, queue=(long,)) for spare in (1e-6, -1e-6))
    assert price(asked("spare"), enough).breakdown.charge_s == 0.0
    assert price(asked("spare"), short).breakdown.charge_s > 0.0


def test_a_dose_leaves_a_reserve_in_the_tank():
    assert price(asked(dose_ml=150.0), replace(ME, tank_ml=180.0)).breakdown.refill_s == 0.0
    assert price(asked(dose_ml=150.0), replace(ME, tank_ml=179.0)).breakdown.refill_s == pytest.approx(
        20.0 + 12.0 + refill_s(179.0)
    )
    fullest = asked(dose_ml=1.0).model_copy(update={"dose_ml": gardener.TANK_ML - 30.0})
    assert price(fullest, ME).cost_s is not None
    assert price(fullest.model_copy(update={"dose_ml": gardener.TANK_ML - 29.0}), ME).cost_s is None


def test_what_is_no_watering_needs_no_water_and_no_sensor_of_it():
    scan = asked(dose_ml=0.0).model_copy(update={"kind": "inventory"})
    me = replace(ME, can=frozenset({"inventory"}), tank_ml=None)
    assert price(scan, me).breakdown.refill_s == 0.0
    assert price(scan, me).breakdown.work_s == 30.0
    assert price(scan, ME).reason == "cannot inventory: not fitted for it"


def test_an_errand_takes_as_long_as_tank_and_pack_need():
    tap, spare = Stop(dock="", refill=True, work_s=1000.0), Stop(dock="", charge=True, work_s=1000.0)
    assert queue_s(replace(ME, tank_ml=900.0), [tap]) == pytest.approx(20.0 + 12.0 + 20.0)
    charged = replace(ME, battery_ratio=0.3)
    left = 0.3 - 42.0 * 30.0 / (130.0 * 3600.0)
    assert queue_s(charged, [spare]) == pytest.approx(30.0 + 12.0 + charge_s(left))
    assert queue_s(charged, [spare, spare]) == pytest.approx(30.0 + 12.0 + charge_s(left)), "it has enough, and is there"
    assert queue_s(replace(ME, tank_ml=900.0), [tap, tap]) == pytest.approx(20.0 + 12.0 + 20.0)
    assert queue_s(ME, [Stop(dock="nowhere", work_s=1.0)]) is None
    assert queue_s(replace(ME, taps=()), [Stop(dock="near", dose_ml=990.0, work_s=1.0)]) is None


def test_the_nearest_tap_is_soonest_reached_and_ties_go_by_name():
    thirsty = replace(ME, tank_ml=0.0, taps=("far", "nowhere", "spare", "tap"))
    assert price(asked(), thirsty).breakdown.refill_s == pytest.approx(20.0 + 12.0 + 50.0)
    there = replace(thirsty, docked_at="far")
    assert price(asked(), there).breakdown.refill_s == pytest.approx(50.0), "it stands there"


def test_a_queue_that_cannot_be_done_takes_nothing_more_and_says_what_it_cannot_reach():
    barred = replace(ME, queue=(Stop(dock="nowhere", work_s=1.0, task_id="x"),))
    assert price(asked(), barred).reason == "no way to nowhere, which is in the queue"


def test_a_chain_of_doses_is_reckoned_the_same_in_one_go_and_stop_by_stop():
    """Behind a task put in: while the tank lasts a sum is enough, after that each stop is walked to."""
    dry = [Stop(dock=dock, work_s=10.0, dose_ml=100.0, task_id=dock) for dock in ("far", "spare", "tap")]
    for tank_ml in (1500.0, 430.0, 429.0, 200.0):
        me = replace(ME, tank_ml=tank_ml, queue=tuple(dry))
        task = asked("near", dose_ml=100.0)
        bid = price(task, me)
        at, stop = insertion(task, me), Stop(dock="near", work_s=work_s("water", 100.0), dose_ml=100.0)
        with_it = queue_s(me, [*dry[:at], stop, *dry[at:]])
        put_off = len(dry) - at + 1
        assert bid.breakdown.delay_s == pytest.approx(put_off * (with_it - queue_s(me, dry))), tank_ml


def test_a_place_that_cannot_be_is_no_place_when_another_can():
    """Nothing reaches a charger by itself, but the queue goes to one: behind it all is well."""
    weak = replace(ME, battery_ratio=0.12, chargers=(), queue=(Stop(dock="spare", charge=True),))
    assert insertion(asked(), weak) == 1
    assert price(asked(), weak).cost_s is not None


def test_what_is_running_is_bid_for_with_its_rest_and_nothing_else():
    at_it = replace(ME, docked_at="near", current=Stop(dock="near", work_s=25.0, task_id="near:1"), at_work_s=5.0)
    bid = price(asked(), replace(at_it, queue=(Stop(dock="far", work_s=9.0, task_id="far:1"),)))
    assert (bid.cost_s, bid.breakdown.current_s, insertion(asked(), at_it)) == (20.0, 20.0, 0)
    assert bid.breakdown.model_dump() == Breakdown(current_s=20.0).model_dump()


def test_who_stands_behind_a_task_waits_for_its_charge_as_well():
    weak = replace(ME, battery_ratio=0.12, queue=(Stop(dock="far", work_s=30.0, priority=3),))
    bid = price(asked(), weak)
    assert insertion(asked(), weak) == 0
    later_s = done_s(bid.breakdown) + (6.0 + 30.0 + 12.0) - (40.0 + 12.0)
    assert bid.breakdown.charge_s > 1000.0
    assert bid.breakdown.delay_s == pytest.approx(2 * later_s)


def test_a_stop_without_a_dock_is_done_where_the_robot_is():
    here = replace(ME, queue=(Stop(dock="far", work_s=30.0), Stop(dock="", work_s=5.0)))
    assert queue_s(here, here.queue) == pytest.approx(40.0 + 12.0 + 30.0 + 5.0)
    bid = price(asked(), here)
    assert bid.cost_s == pytest.approx(total_s(bid.breakdown))


def test_whatever_stands_in_the_queue_the_bid_is_the_least_that_walking_through_it_can_cost():
    seed = 8
    print(f"seed {seed}")
    rng = random.Random(seed)
    for _ in range(400):
        kinds = (
            {"work_s": 20.0},
            {"work_s": 20.0, "dose_ml": rng.choice((100.0, 400.0))},
            {"refill": True},
            {"charge": True},
            {"dock": "", "refill": True},
            {"dock": "", "work_s": 7.0},
        )
        queue = [
            Stop(**({"dock": rng.choice(("near", "far", "spare", "tap"))} | rng.choice(kinds)))
            for _ in range(rng.randrange(5))
        ]
        me = replace(ME, tank_ml=rng.choice((150.0, 600.0, 1500.0)), queue=tuple(queue))
        task = asked(rng.choice(("near", "spare")), dose_ml=100.0, task_id="t:1")
        stop = Stop(dock=task.plant.plant_id, work_s=work_s("water", 100.0), dose_ml=100.0)
        costs_s = []
        for at in range(len(queue) + 1):
            later_s = queue_s(me, [*queue[:at], stop, *queue[at:]]) - queue_s(me, queue)
            put_off = len(queue) - at + 1 if queue else 0
            costs_s.append(queue_s(me, [*queue[:at], stop]) + put_off * max(0.0, later_s))
        assert price(task, me).cost_s == pytest.approx(min(costs_s)), me
        assert costs_s[insertion(task, me)] == pytest.approx(min(costs_s)), me
