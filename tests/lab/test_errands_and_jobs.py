"""A robot's own errands, an operator's jobs, and the e-stop."""

from __future__ import annotations

import math

import pytest

from lab import story


async def job(garden, **wish):
    """Post a job and wait for its end."""
    answer = await garden.post("robot-1", "/jobs", wish)
    assert answer.status_code == 202, answer.text
    seen = {}

    async def over():
        seen.update(await garden.get("robot-1", answer.headers["location"]))
        return seen["state"] in ("done", "failed", "cancelled")

    assert await garden.until(over, 120.0), await story.standing(garden)
    return seen


def resting(**changes):
    """A garden in which nobody is thirsty."""
    return story.garden_of((), ("plant-1",), robots=(story.near_robot(**changes),))


async def ready(garden):
    async def so():
        return (await garden.get("robot-1", "/state"))["pose"] is not None

    assert await garden.until(so, 10.0)


def test_a_robot_with_too_little_water_prices_the_tap_and_goes_there_first():
    async def told(garden):
        task = await story.phase(garden, "plant-1", "awarded", "running")
        assert task["rounds"][-1]["bids"][0]["breakdown"]["refill_s"] > 30.0
        await story.when(garden, lambda: story.robot(garden).docked_at == "station/tap", 60.0)
        await story.served(garden, "plant-1", 300.0)
        assert garden.truth().tap_ml > 1000.0
        assert story.robot(garden).tank_ml > 1300.0
        story.unhurt(garden)

    story.tell(story.one_pot(tank_ml=60.0), told)


def test_a_robot_that_has_long_rested_at_the_tap_fills_its_tank_to_the_brim_and_no_further():
    async def told(garden):
        await ready(garden)
        assert (await job(garden, kind="dock", at="station/tap"))["state"] == "done"
        await garden.clock.sleep(180.0)
        assert story.robot(garden).docked_at == "station/tap"
        answer = await garden.post("plant-1", "/tasks", {"kind": "water", "dose_ml": 100.0})
        assert answer.status_code == 201, answer.text
        await story.served(garden, "plant-1")
        assert garden.truth().tap_ml > 1340.0
        story.unhurt(garden)

    story.tell(resting(tank_ml=60.0, spread_after_s=0.0), told)


def test_a_robot_whose_battery_is_low_charges_by_itself():
    async def told(garden):
        await story.when(garden, lambda: story.robot(garden).charging, 120.0)
        at_first = story.robot(garden).battery_ratio
        await garden.clock.sleep(3.0)
        assert (await garden.get("robot-1", "/state"))["job"] == "charge"
        await garden.clock.sleep(120.0)
        assert story.robot(garden).battery_ratio > at_first
        story.unhurt(garden)

    story.tell(resting(battery_ratio=0.2), told)


def test_a_supervisor_sends_a_robot_about():
    async def told(garden):
        await ready(garden)
        assert (await job(garden, kind="goto", x_m=-1.2, y_m=0.3, yaw_rad=0.0))["state"] == "done"
        at = story.robot(garden).pose
        assert math.hypot(at.x_m + 1.2, at.y_m - 0.3) < 0.06
        assert abs(at.yaw_rad) < 0.15
        await garden.clock.sleep(10.0)
        assert story.robot(garden).pose.x_m == pytest.approx(at.x_m, abs=0.01), "it stays where it was sent"
        assert (await job(garden, kind="dock", at="station/tap"))["state"] == "done"
        assert story.robot(garden).docked_at == "station/tap"
        assert (await job(garden, kind="undock"))["state"] == "done"
        assert story.robot(garden).docked_at is None
        assert (await job(garden, kind="home"))["state"] == "done"
        home, at = garden.scenario.robots[0].home, story.robot(garden).pose
        assert math.hypot(at.x_m - home.x_m, at.y_m - home.y_m) < 0.06
        story.unhurt(garden)

    story.tell(resting(), told)


def test_an_e_stop_stops_at_once_latches_through_restarts_and_ends_only_by_resume():
    async def told(garden):
        await story.when(garden, lambda: story.robot(garden).v_mps > 0.1)
        assert (await garden.post("robot-1", "/stop", {"reason": "a cat"})).status_code == 200
        await story.stops(garden)
        for name in ("robot-1", "robot-1-body"):
            await garden.kill(name)
            await garden.clock.sleep(0.5)
            garden.start(name)
        await garden.clock.sleep(8.0)
        state = await garden.get("robot-1", "/state")
        assert (state["stopped"], state["job"]) == (True, "stopped")
        assert "a cat" in state["stopped_by"]
        assert "stopped by" in (await garden.get("plant-1", "/state"))["waiting"]
        assert story.stands(story.robot(garden))
        assert (await garden.post("robot-1", "/resume", {"stop_number": state["stop_number"]})).status_code == 200
        await story.served(garden, "plant-1")
        story.unhurt(garden)

    story.tell(story.one_pot(), told)


def test_a_stop_while_it_pumps_is_the_end_of_that_dose():
    async def told(garden):
        await story.when(garden, lambda: story.robot(garden).pumped_ml > 30.0)
        stopped = (await garden.post("robot-1", "/stop", {})).json()
        await story.stops(garden)
        poured_ml = garden.truth().plant("plant-1").poured_ml
        await garden.clock.sleep(5.0)
        assert garden.truth().plant("plant-1").poured_ml == poured_ml < 45.0
        await garden.post("robot-1", "/resume", {"stop_number": stopped["stop_number"]})
        task = await story.served(garden, "plant-1", 400.0)
        assert garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
        story.unhurt(garden)

    story.tell(story.one_pot(), told)
