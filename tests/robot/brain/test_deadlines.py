"""Bids under deadlines, by the made-up garden of `test_bidding`: nothing is promised that would be late."""

import random
from dataclasses import replace

from standin import in_garden
from test_bidding import ME, asked

from core.allocation.bidding import Stop, done_s, insertion, price, work_s
from core.allocation.deadlines import offer, place

NEAR, FAR = asked("near", task_id="near:1"), asked("far", task_id="far:1")


def due(task, within_s, **more):
    return task.model_copy(update={"within_s": within_s, **more})


def stop(task, **more):
    labour_s = work_s(task.kind, task.dose_ml)
    return Stop(dock=task.plant.plant_id, work_s=labour_s, dose_ml=task.dose_ml, task_id=task.task_id, **more)


def test_without_any_deadline_the_bid_is_the_price():
    busy = replace(ME, queue=(stop(FAR),))
    assert offer(NEAR, busy) == price(NEAR, busy)
    assert place(NEAR, busy) == insertion(NEAR, busy)


def test_a_task_that_can_be_done_in_time_costs_what_it_costs():
    assert offer(due(NEAR, 300.0), ME) == price(NEAR, ME)


def test_a_robot_that_would_be_late_says_by_how_much():
    bid = offer(due(FAR, 60.0), ME)
    would_s = done_s(price(FAR, ME).breakdown)
    assert bid.cost_s is None
    assert bid.reason == f"done in {would_s:.0f} s, the deadline is in 60 s"


def test_a_near_deadline_goes_before_what_is_equally_urgent_but_not_before_what_is_more():
    task = due(FAR, done_s(price(FAR, ME).breakdown) + 5.0)
    busy = replace(ME, queue=(stop(NEAR),))
    assert place(FAR, busy) == 1, "where it adds least"
    assert place(task, busy) == 0
    assert offer(task, busy).cost_s > price(FAR, busy).cost_s
    assert offer(task, replace(ME, queue=(stop(NEAR, priority=7),))).cost_s is None
    assert offer(task, replace(ME, queue=(stop(NEAR, settled=True),))).cost_s is None


def test_no_other_task_makes_a_promised_one_late():
    busy = replace(ME, queue=(stop(FAR),))
    alone_s = done_s(price(FAR, ME).breakdown)
    assert place(NEAR, busy) == 0, "on the way it adds least"
    assert place(NEAR, busy, [due(FAR, alone_s + 5.0)]) == 1
    assert place(NEAR, busy, [due(FAR, alone_s + 100.0)]) == 0
    assert place(NEAR, busy, [due(FAR, alone_s - 5.0)]) == 0, "it is late whatever we do"
    both = offer(due(NEAR, 60.0), busy, [due(FAR, alone_s + 5.0)])
    assert both.cost_s is None, "one of the two would be late"


def test_what_is_held_is_not_moved_and_what_runs_is_finished():
    busy = replace(ME, queue=(stop(NEAR), stop(FAR)))
    assert place(due(FAR, 5.0), busy, [due(FAR, 5.0)]) == 1
    assert "the deadline is in 5 s" in offer(due(FAR, 5.0), busy, [due(FAR, 5.0)]).reason
    assert offer(due(NEAR, 0.0), replace(ME, current=stop(NEAR))).cost_s is not None


def test_no_promise_is_broken_in_any_queue():
    seed = 4
    print(f"seed {seed}")
    rng = random.Random(seed)
    late = taken = 0
    for _ in range(300):
        me, promised = ME, []
        for number in range(5):
            task = asked(rng.choice(["near", "far", "tap", "spare"]), 60.0, f"t:{number}")
            task = due(task, rng.uniform(30.0, 400.0) if rng.random() < 0.6 else None, priority=rng.choice([3, 5, 7]))
            if offer(task, me, promised).cost_s is None:
                late += 1
                continue
            at = place(task, me, promised)
            entry = stop(task, priority=task.priority)
            me = replace(me, queue=(*me.queue[:at], entry, *me.queue[at:]))
            promised += [task] if task.within_s is not None else []
            taken += 1
        for task in promised:
            at = next(i for i, s in enumerate(me.queue) if s.task_id == task.task_id)
            fixed = tuple(replace(s, settled=True) for s in me.queue[:at])
            assert done_s(price(task, replace(me, queue=fixed)).breakdown) <= task.within_s
    assert taken > 700
    assert late > 100


def test_done_at_the_very_deadline_is_in_time():
    alone_s = done_s(price(NEAR, ME).breakdown)
    assert offer(due(NEAR, alone_s), ME) == price(NEAR, ME)
    assert offer(due(NEAR, alone_s - 1e-6), ME).cost_s is None
    busy = replace(ME, queue=(stop(FAR),))
    far_s = done_s(price(FAR, ME).breakdown)
    both_s = done_s(price(FAR, replace(ME, queue=(stop(NEAR, settled=True),))).breakdown)
    assert place(NEAR, busy, [due(FAR, both_s)]) == 0, "both are in time, one of them just so"
    assert place(NEAR, busy, [due(FAR, both_s - 1e-6)]) == 1
    assert place(NEAR, busy, [due(FAR, far_s)]) == 1
    assert place(NEAR, busy, [due(FAR, far_s - 1e-6)]) == 0


def test_what_is_promised_before_a_task_is_no_concern_of_it():
    """Only what stands behind the place could come later for it."""
    first = stop(NEAR, settled=True)
    busy = replace(ME, queue=(first, stop(FAR)))
    spare = asked("spare", task_id="spare:1")
    assert place(spare, busy, [due(NEAR, 60.0)]) == place(spare, busy)


def test_what_is_not_urgent_goes_behind_all_promises_and_keeps_their_order():
    tap = asked("tap", task_id="tap:1")
    busy = replace(ME, queue=(stop(NEAR), stop(FAR)))
    at_s = [done_s(price(task, replace(ME, queue=busy.queue[:i])).breakdown) for i, task in enumerate((NEAR, FAR))]
    promised = [due(NEAR, at_s[0] + 100.0), due(FAR, at_s[1] + 1.0)]
    assert place(tap, busy) == 1, "on the way it adds least"
    assert place(tap, busy, promised) == 2
    assert place(tap, busy, promised[:1]) == 1, "that one is not behind it"


def test_a_task_with_a_deadline_hurries_only_past_its_equals():
    tap = asked("tap", task_id="tap:1")
    soon = due(tap, done_s(price(tap, ME).breakdown) + 1.0)
    for priority, fits in ((4, True), (5, True), (6, False)):
        busy = replace(ME, queue=(stop(NEAR, priority=priority),))
        assert (offer(soon, busy).cost_s is not None) == fits
        if fits:
            assert place(soon, busy) == 0


def test_what_cannot_be_done_says_why_and_not_when():
    nowhere = due(asked("nowhere", task_id="n:1"), 60.0)
    assert offer(nowhere, ME) == price(nowhere, ME)
    assert "no way" in offer(nowhere, ME).reason
    assert offer(due(NEAR, 60.0), replace(ME, can=frozenset())).reason == "no pump"


def test_a_robot_reckons_with_the_time_that_is_left_of_what_it_promised():
    async def story(garden):
        brain = garden.brains["robot-1"]
        await garden.award("plant-3")
        await garden.until(lambda: brain.robot.activity.job == "act", 60.0)
        award = garden.award_of("plant-1", number=2)
        asked_for = award.announcement.model_copy(update={"within_s": 200.0})
        award = award.model_copy(update={"announcement": asked_for})
        assert (await garden.call("robot-1", "POST", "/tasks", award, as_="plant-1")).status_code == 201
        await garden.clock.sleep(10.0)
        (left,) = brain._promised()
        assert 189.0 < left.within_s < 190.1
        hopeless = asked_for.model_copy(update={"task_id": "plant-1:3", "within_s": 5.0})
        answer = await garden.call("robot-1", "POST", "/bids", hopeless, as_="plant-1")
        assert "the deadline is in 5 s" in answer.json()["reason"]

    in_garden(story)
