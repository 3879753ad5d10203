"""A pot gets dry, asks, is served, and sees its moisture rise."""

from __future__ import annotations

from typing import Any

Play = Any
Garden = Any


def test_a_dry_pot_is_watered_by_the_cheaper_robot_and_sees_its_moisture_rise(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.robot("robot-1", 30.0)
        cheap = garden.robot("robot-2", 12.0)
        garden.pot(ratio=0.195)
        task = await garden.until_task("done")
        assert task["robot_id"] == "robot-2"
        assert task["asked_by"] == "soil"
        assert task["delivered_ml"] == 150.0
        assert {bid["robot_id"]: bid["cost_s"] for bid in task["rounds"][0]["bids"]} == {"robot-1": 30.0, "robot-2": 12.0}
        assert cheap.poured_ml == 150.0
        await garden.clock.sleep(30.0)
        state = await garden.state()
        assert state["soil"]["state"] == "good"
        assert state["soil"]["ratio"] > 0.235
        assert not state["thirsty"]
        assert state["open_tasks"] == []
        assert state["watered_today_ml"] == 150.0

    play(story)


def test_a_pot_keeps_asking_until_its_target_is_reached(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.12)
        await garden.clock.sleep(400.0)
        assert robot.poured_ml == 450.0
        assert not (await garden.state())["thirsty"]

    play(story)


def test_a_pot_above_its_threshold_asks_for_nothing(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.21)
        await garden.clock.sleep(120.0)
        assert robot.asked == 0
        assert (await garden.state())["waiting"] == ""

    play(story)


def test_an_idle_pot_costs_nearly_nothing(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.robot("robot-1")
        garden.pot(ratio=0.3)
        await garden.clock.sleep(60.0)
        before = garden.requests
        await garden.clock.sleep(600.0)
        assert garden.requests == before

    play(story)


def test_the_day_cap_stops_the_watering_and_says_so(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.10, day_cap_ml=220.0)
        await garden.clock.sleep(400.0)
        assert robot.poured_ml == 220.0
        state = await garden.state()
        assert state["thirsty"]
        assert "220 ml" in state["waiting"]
        await garden.call("plant-1", "PATCH", "/settings", json={"day_cap_ml": 300.0})
        await garden.clock.sleep(120.0)
        assert robot.poured_ml == 300.0

    play(story)


def test_water_by_hand_takes_the_asking_back(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.robot("robot-1", None)
        garden.pot(ratio=0.19)
        await garden.until_task("announced")
        garden.soils["plant-1"].ratio = 0.3
        task = await garden.until_task("cancelled")
        assert "moist again" in task["reason"]

    play(story)


def test_a_blocked_nozzle_ends_in_a_failed_task_that_says_so(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        robot.pump_blocked = True
        garden.pot(ratio=0.15)
        task = await garden.until_task("failed", within_s=300.0)
        assert "3 doses" in task["reason"]
        assert robot.poured_ml == 450.0
        await garden.clock.sleep(15.0)
        assert "asking again" in (await garden.state())["waiting"]

    play(story)
