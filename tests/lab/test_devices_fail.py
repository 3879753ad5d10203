"""Devices that fail: what cannot be done stops and says why, and goes on when the fault is over."""

from __future__ import annotations

import pytest

from lab import story


def drives(garden) -> bool:
    return story.robot(garden).v_mps > 0.1


def docked(garden) -> bool:
    return story.robot(garden).docked_at == "plant-1"


async def served_rightly(garden, within_s=400.0):
    """The task ends done, whatever it took, within its permits and without harm."""
    task = await story.served(garden, "plant-1", within_s)
    assert garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
    story.unhurt(garden)
    return task


def test_a_base_that_falls_silent_while_it_drives_is_told_to_stop_and_the_task_goes_on_after():
    async def told(garden):
        await story.when(garden, lambda: drives(garden))
        story.fault(garden, "serial_silence", "robot-1.create", 6.0)
        await story.said(garden, "robot-1", "base", within_s=4.0)
        await garden.clock.sleep(8.0)
        await served_rightly(garden)

    story.tell(story.one_pot(), told)


@pytest.mark.parametrize("device", ["ssc32", "stargazer"])
def test_a_robot_whose_other_devices_fall_silent_stands_within_their_patience(device):
    async def told(garden):
        await story.when(garden, lambda: drives(garden))
        story.fault(garden, "serial_silence", f"robot-1.{device}", 10.0)
        await story.when(garden, lambda: story.stands(story.robot(garden)), 6.0)
        state = await garden.get("robot-1", "/state")
        assert state["waiting"] or state["down"], state
        await served_rightly(garden)

    story.tell(story.one_pot(), told)


@pytest.mark.parametrize(
    "device", ["create", *(pytest.param(name, marks=pytest.mark.soak) for name in ("ssc32", "stargazer"))]
)
def test_noise_on_a_wire_costs_time_and_nothing_else(device):
    async def told(garden):
        story.fault(garden, "serial_noise", f"robot-1.{device}", 120.0, 0.002)
        await served_rightly(garden)

    story.tell(story.one_pot(), told)


def test_a_base_nobody_can_understand_is_named_and_works_again_after():
    async def told(garden):
        await story.when(garden, lambda: drives(garden))
        story.fault(garden, "serial_noise", "robot-1.create", 20.0, 0.3)
        await story.said(garden, "robot-1", "base", within_s=10.0)
        await served_rightly(garden)

    story.tell(story.one_pot(), told)


def test_a_robot_that_sees_no_marker_stops_and_says_so_until_it_sees_one():
    async def told(garden):
        story.fault(garden, "marker_blindness", "robot-1", 40.0)
        await story.said(garden, "robot-1", "marker", within_s=30.0)
        assert story.stands(story.robot(garden))
        await served_rightly(garden)

    story.tell(story.one_pot(), told)


def test_wheels_that_slip_still_bring_the_robot_to_its_dock():
    async def told(garden):
        story.fault(garden, "wheel_slip", "robot-1", 300.0, 4.0)
        await served_rightly(garden)

    story.tell(story.one_pot(), told)


def test_a_pump_that_does_not_start_fails_with_the_reason_and_the_pot_asks_again():
    async def told(garden):
        fault = story.fault(garden, "pump_stuck", "robot-1", strength=0.0)
        task = await story.phase(garden, "plant-1", "soaking")
        assert "robot-1 reports failed: the pump ran for 90 ml, but the tank" in task["events"][-1]["what"], task["events"]
        assert garden.truth().plant("plant-1").poured_ml == 0.0
        garden.rig.faults.remove(fault.id)
        task = await served_rightly(garden)
        assert task["permits"] == 2

    story.tell(story.one_pot(), told)


def test_a_pump_that_does_not_stop_is_told_by_the_tank_and_no_other_dose_is_promised():
    async def told(garden):
        story.fault(garden, "pump_stuck", "robot-1", strength=1.0)
        await story.said(garden, "robot-1", "the tank lost", within_s=120.0)
        entries = await garden.get("robot-1", "/history")
        assert any(entry["kind"] == "alarm" and "while the pump was off" in entry["what"] for entry in entries)

    story.tell(story.one_pot(), told)


@pytest.mark.parametrize(("kind", "doses"), [("soil_stuck", 3), ("soil_open", 0), ("soil_short", 0)])
def test_a_pot_whose_probe_lies_stops_asking_and_says_why(kind, doses):
    """A stuck probe is known by sixty readings that do not differ; until then no more than three doses are tried."""

    async def told(garden):
        fault = story.fault(garden, kind, "plant-1")
        state = await story.said(garden, "plant-1", "not watering: the soil probe is", within_s=900.0)
        assert state["soil"]["ratio"] is None
        await garden.clock.sleep(60.0)
        poured_ml = garden.truth().plant("plant-1").poured_ml
        await garden.clock.sleep(30.0)
        assert garden.truth().plant("plant-1").poured_ml == poured_ml <= doses * story.DOSE_ML * (1 + story.PUMP_ERROR_RATIO)
        garden.rig.faults.remove(fault.id)
        assert (await story.ended(garden, "plant-1"))["state"] in ("done", "cancelled")
        story.unhurt(garden)

    story.tell(story.one_pot(), told)


def test_a_dead_pack_leaves_the_robot_standing_and_its_task_with_the_market():
    async def told(garden):
        await story.when(garden, lambda: drives(garden))
        fault = story.fault(garden, "dead_battery", "robot-1")
        await story.phase(garden, "plant-1", "announced", within_s=30.0)
        await story.said(garden, "plant-1", "battery flat at 0%", within_s=30.0)
        assert story.stands(story.robot(garden))
        garden.rig.faults.remove(fault.id)
        await served_rightly(garden)

    story.tell(story.one_pot(), told)
