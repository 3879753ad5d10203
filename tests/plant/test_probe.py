"""A silent or lying sensor is a state of its own, never a reason to water and never fine."""

from __future__ import annotations

from typing import Any

import pytest

Play = Any
Garden = Any

FAULTS = {"open": lambda: 0.0, "short": lambda: 5.0, "out_of_range": lambda: 4.2}


@pytest.mark.parametrize("state", FAULTS)
def test_a_faulty_probe_never_waters_and_is_told_then_the_pot_recovers(play: Play, state: str) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.15)
        garden.soils["plant-1"].fault = FAULTS[state]
        await garden.clock.sleep(60.0)
        seen = await garden.state()
        assert (seen["soil"]["state"], seen["soil"]["ratio"]) == (state, None)
        assert "soil probe" in seen["waiting"]
        assert robot.asked == 0
        kinds = (await garden.call("plant-1", "GET", "/history?kind=probe")).json()
        assert kinds[-1]["data"]["state"] == state
        garden.soils["plant-1"].fault = None
        await garden.until_task("done")
        assert (await garden.state())["soil"]["state"] == "good"

    play(story)


def test_a_stuck_probe_is_found_out(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.30)
        await garden.clock.sleep(20.0)
        garden.soils["plant-1"].fault = lambda: 1.62
        await garden.clock.sleep(620.0)
        state = await garden.state()
        assert state["soil"]["state"] == "stuck"
        assert "stuck" in state["waiting"]
        assert robot.asked == 0

    play(story)


def test_a_probe_that_always_says_dry_gets_no_more_than_three_doses(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.30)
        garden.soils["plant-1"].fault = lambda: 1.2
        await garden.clock.sleep(1200.0)
        assert 0.0 < robot.poured_ml <= 450.0

    play(story)


def test_a_board_that_is_gone_is_down_then_stale_never_fine(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.30)
        await garden.clock.sleep(5.0)
        assert (await garden.state())["soil"]["state"] == "good"
        await garden.kill_pot()
        garden.net.close("plant-1")
        garden.start_pot()
        await garden.clock.sleep(30.0)
        state = await garden.state()
        assert state["soil"]["state"] == "down"
        assert "nobody listens" in state["soil"]["why"]

    play(story)


def test_a_probe_that_fails_after_the_dose_leaves_the_task_open_and_says_why(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.195)

        async def soaking() -> bool:
            tasks = (await garden.call("plant-1", "GET", "/tasks")).json()
            return bool(tasks) and "soaking" in tasks[-1]["phase"]

        await garden.until(soaking, 120.0)
        garden.soils["plant-1"].fault = lambda: 0.0
        await garden.clock.sleep(120.0)
        task, state = await garden.task(), await garden.state()
        assert task["state"] == "running"
        assert "soil probe" in state["waiting"]
        garden.soils["plant-1"].fault = None
        await garden.until_task("done")
        assert robot.poured_ml == 150.0

    play(story)


def test_what_a_probe_said_before_it_fell_silent_does_not_tell_whether_a_dose_arrived(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        robot.pump_blocked = True
        garden.pot(ratio=0.195, soak_s=40.0)

        async def waits_to_measure() -> bool:
            return str((await garden.state())["waiting"]).startswith("measuring again in 5 s")

        await garden.until(waits_to_measure, 120.0)
        soil = garden.soils["plant-1"]
        soil.silent = True
        await garden.clock.sleep(20.0)
        seen = await garden.state()
        assert (seen["soil"]["state"], seen["soil"]["age_s"] > 15.0) == ("good", True)
        assert (await garden.task())["state"] == "running"
        robot.pump_blocked = soil.silent = False
        await garden.until_task("done")
        told = [event["what"] for event in (await garden.task())["events"]]
        assert sum("the dose did not arrive" in what for what in told) == 1

    play(story)


def test_a_fault_between_award_and_permit_stops_the_dose(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        robot.work_s = 30.0
        garden.pot(ratio=0.195)
        await garden.until_task("running")
        garden.soils["plant-1"].fault = lambda: 5.0
        await garden.clock.sleep(40.0)
        assert robot.poured_ml == 0.0
        assert "shorted" in (await garden.task())["reason"]

    play(story)


def test_the_ready_page_waits_for_the_first_measurement(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.30)
        assert (await garden.call("plant-1", "GET", "/readyz")).status_code == 503
        await garden.clock.sleep(3.0)
        assert (await garden.call("plant-1", "GET", "/readyz")).status_code == 200

    play(story)
