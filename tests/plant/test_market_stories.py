"""The market between one or two pots and scripted robots: auction, re-allocation, silence, permits."""

from __future__ import annotations

import json
from typing import Any

import pytest

from core.mesh.client import Answer

Play = Any
Garden = Any


def test_figure_13_a_task_moves_when_its_holder_says_seven_and_another_four(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one, two = garden.robot("robot-1", 3.0), garden.robot("robot-2", 4.0)
        one.start_s = 1000.0
        garden.pot(ratio=0.19)
        task = await garden.until_task("awarded")
        assert (task["robot_id"], task["epoch"]) == ("robot-1", 1)
        await garden.clock.sleep(2.0)
        one.cost = lambda _: 7.0
        await garden.clock.sleep(12.0)
        task = await garden.task()
        assert (task["robot_id"], task["epoch"]) == ("robot-2", 2)
        assert [what for _, what in one.log] == [f"award {task['task_id']} 1", f"kill {task['task_id']}"]
        assert two.log[0][1] == f"award {task['task_id']} 2"
        killed_s, awarded_s = one.log[-1][0], two.log[0][0]
        assert abs(awarded_s - killed_s) < 0.1
        done = await garden.until_task("done")
        assert done["robot_id"] == "robot-2"

    play(story)


def test_a_task_stays_for_a_bid_within_the_margin_and_once_it_runs(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one, two = garden.robot("robot-1", 10.0), garden.robot("robot-2", 20.0)
        one.start_s, one.work_s = 25.0, 40.0
        garden.pot(ratio=0.19)
        await garden.until_task("awarded")
        two.cost = lambda _: 8.5
        await garden.clock.sleep(20.0)
        assert (await garden.task())["robot_id"] == "robot-1"
        await garden.until_task("running")
        two.cost = lambda _: 1.0
        done = await garden.until_task("done")
        assert (done["robot_id"], done["epoch"]) == ("robot-1", 1)

    play(story)


def test_the_window_closes_early_when_all_robots_have_answered(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.robot("robot-1"), garden.robot("robot-2")
        garden.pot(ratio=0.19)
        task = await garden.until_task("awarded")
        asked_s, awarded_s = task["events"][0]["t_s"], task["events"][1]["t_s"]
        assert awarded_s - asked_s < 0.1

    play(story)


def test_nobody_able_is_said_with_reasons_and_asked_for_again(play: Play) -> None:
    async def story(garden: Garden) -> None:
        dry = garden.robot("robot-1", None)
        gone = garden.robot("robot-2")
        gone.down = True
        garden.pot(ratio=0.19)
        await garden.clock.sleep(200.0)
        waiting = (await garden.state())["waiting"]
        assert "robot-1: no water" in waiting
        assert "robot-2: did not answer" in waiting
        assert 20 < dry.asked < 35, "at first quickly, then every eight seconds"
        dry.cost = lambda _: 5.0
        done = await garden.until_task("done")
        assert done["robot_id"] == "robot-1"

    play(story)


@pytest.mark.parametrize("cost", ['9.0, "cost_s": 1.0', "NaN", "1e999", '"1"', "-1.0"])
def test_a_price_that_is_not_plain_json_is_no_bid_and_the_others_go_on(play: Play, cost: str) -> None:
    async def story(garden: Garden) -> None:
        liar, honest = garden.robot("robot-1"), garden.robot("robot-2", 60.0)
        said = liar.answer

        async def answer(method: str, path: str, body: bytes) -> Answer:
            if path != "/bids":
                return await said(method, path, body)
            task_id = json.loads(body)["task_id"]
            return Answer(200, f'{{"task_id": "{task_id}", "robot_id": "robot-1", "cost_s": {cost}}}'.encode())

        liar.answer = answer
        garden.pot(ratio=0.195)
        task = await garden.until_task("running")
        assert task["robot_id"] == "robot-2"
        bids = {bid["robot_id"]: bid for bid in task["rounds"][0]["bids"]}
        assert (bids["robot-1"]["cost_s"], bids["robot-2"]["cost_s"]) == (None, 60.0)
        assert honest.epochs
        assert not liar.epochs

    play(story)


def test_a_pot_that_knows_no_robot_says_so(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.19)
        await garden.clock.sleep(20.0)
        assert "no robot is known" in (await garden.state())["waiting"]

    play(story)


def test_a_robot_that_falls_silent_loses_the_task_to_another(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one, two = garden.robot("robot-1", 5.0), garden.robot("robot-2", 9.0)
        garden.pot(ratio=0.19)
        await garden.until_task("running")
        one.die()
        done = await garden.until_task("done")
        assert (done["robot_id"], done["epoch"]) == ("robot-2", 2)
        assert (one.poured_ml, two.poured_ml) == (0.0, 150.0)
        assert any("fell silent" in event["what"] for event in done["events"])

    play(story)


def test_a_robot_cut_off_and_healed_is_told_to_drop_the_task(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one = garden.robot("robot-1", 5.0)
        two = garden.robot("robot-2", 9.0)
        one.work_s = 60.0
        garden.pot(ratio=0.19)
        await garden.until_task("running")
        garden.cut.add("robot-1")
        await garden.clock.sleep(12.0)
        garden.cut.clear()
        done = await garden.until_task("done")
        assert done["robot_id"] == "robot-2"
        assert any(what.startswith(("dropped", "kill")) for _, what in one.log)
        assert (one.poured_ml, two.poured_ml) == (0.0, 150.0)

    play(story)


def test_death_after_the_dose_does_not_water_twice(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one, two = garden.robot("robot-1", 5.0), garden.robot("robot-2", 9.0)
        one.die_after_act = True
        garden.pot(ratio=0.195)
        done = await garden.until_task("done", within_s=200.0)
        assert done["permits"] == 1
        assert (one.poured_ml, two.poured_ml) == (150.0, 0.0)

    play(story)


def test_death_before_the_dose_is_found_out_by_measuring_and_served_again(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one, two = garden.robot("robot-1", 5.0), garden.robot("robot-2", 9.0)
        one.die_before_act = True
        garden.pot(ratio=0.195)
        await garden.clock.sleep(60.0)
        assert "measuring again" in (await garden.state())["waiting"]
        done = await garden.until_task("done", within_s=200.0)
        assert (done["robot_id"], done["permits"]) == ("robot-2", 2)
        assert (one.poured_ml, two.poured_ml) == (0.0, 150.0)

    play(story)


def test_a_lost_done_report_costs_time_but_no_second_dose(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one = garden.robot("robot-1", 5.0)
        one.lose_done = 30
        garden.pot(ratio=0.195)
        done = await garden.until_task("done", within_s=300.0)
        assert (done["permits"], one.poured_ml) == (1, 150.0)

    play(story)


def test_a_refused_award_goes_to_the_market_again(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one = garden.robot("robot-1", 5.0)
        one.refuse_awards = "queue is full"
        garden.pot(ratio=0.19)
        await garden.clock.sleep(5.0)
        assert "queue is full" in (await garden.task())["reason"]
        one.refuse_awards = ""
        assert (await garden.until_task("done"))["robot_id"] == "robot-1"

    play(story)


def test_an_award_that_is_declined_goes_to_the_next_at_once(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one, two = garden.robot("robot-1", 5.0), garden.robot("robot-2", 50.0)
        one.overtaken = True
        one.cost = lambda _: 5.0 if one.asked < 2 else 90.0
        garden.pot(ratio=0.19)
        done = await garden.until_task("done")
        assert (done["robot_id"], done["epoch"]) == ("robot-2", 2)
        told = {event["what"]: event["t_s"] for event in done["events"]}
        declined_s = told["robot-1 declined the award: 90 s by now"]
        awarded_s = next(t_s for what, t_s in told.items() if what.startswith("awarded to robot-2"))
        assert awarded_s - declined_s < 0.5
        assert two.poured_ml == 150.0

    play(story)


def test_an_operators_cancel_kills_the_robots_job(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one = garden.robot("robot-1", 5.0)
        garden.pot(ratio=0.19)
        task = await garden.until_task("running")
        answer = await garden.call("plant-1", "DELETE", f"/tasks/{task['task_id']}")
        assert answer.json()["state"] == "cancelled"
        await garden.clock.sleep(1.0)
        assert one.log[-1][1] == f"kill {task['task_id']}"

    play(story)


def test_a_cancel_under_a_permit_holds_the_next_dose_until_the_soil_was_measured(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one = garden.robot("robot-1", 5.0)
        garden.pot(ratio=0.195)

        async def permitted() -> bool:
            tasks = (await garden.call("plant-1", "GET", "/tasks")).json()
            return bool(tasks) and tasks[-1]["permits"] == 1

        await garden.until(permitted, 60.0)
        task = await garden.task()
        await garden.call("plant-1", "DELETE", f"/tasks/{task['task_id']}")
        cancelled_s = garden.clock.now()
        await garden.until_task("done", within_s=200.0)
        second = await garden.task()
        assert second["task_id"] != task["task_id"]
        assert second["created_s"] - cancelled_s > 20.0
        assert one.poured_ml == 150.0

    play(story)


def test_two_pots_share_two_robots(play: Play) -> None:
    async def story(garden: Garden) -> None:
        one, two = garden.robot("robot-1"), garden.robot("robot-2")
        one.cost = lambda ask: 5.0 + 100.0 * len(one.jobs)
        two.cost = lambda ask: 6.0 + 100.0 * len(two.jobs)
        garden.pot("plant-1", ratio=0.19)
        await garden.clock.sleep(1.0)
        garden.pot("plant-2", ratio=0.19)
        first = await garden.until_task("done", plant_id="plant-1")
        second = await garden.until_task("done", plant_id="plant-2")
        assert {first["robot_id"], second["robot_id"]} == {"robot-1", "robot-2"}

    play(story)


def test_an_operators_deadline_ends_a_task_that_nobody_begins_and_the_pot_goes_on_asking_for_itself(play: Play) -> None:
    async def story(garden: Garden) -> None:
        busy = garden.robot("robot-1", None)
        busy.reason = "done in 80 s, the deadline is in 60 s"
        garden.pot(ratio=0.23)
        await garden.clock.sleep(2.0)
        wish = {"kind": "water", "dose_ml": 50.0, "within_s": 60.0, "priority": 8}
        made = (await garden.call("plant-1", "POST", "/tasks", json=wish)).json()
        assert (made["deadline_s"] - made["created_s"], made["priority"]) == (60.0, 8)
        failed = await garden.until_task("failed")
        assert 60.0 <= failed["updated_s"] - failed["created_s"] < 60.1
        assert "the deadline is in 60 s" in failed["reason"]
        garden.soils["plant-1"].ratio = 0.19
        busy.cost = lambda _: 5.0
        done = await garden.until_task("done", within_s=200.0)
        assert (done["asked_by"], done["deadline_s"]) == ("soil", None)

    play(story)
