"""Eyes that fail, a hand that lies, fruit that slips and sways: each ends with a reason and a whole plant."""

from __future__ import annotations

import pytest

from lab import harvest, story
from lab.orchard import PLANT, ROBOT, one_plant

FRUIT = 12
SEED = 3

EYES = {
    "camera_silent": "answers 503",
    "camera_frozen": "repeats one picture",
    "camera_black": "the picture is black",
    "camera_overexposed": "burnt out",
}


async def scan_wanted(orchard):
    answer = await orchard.garden.post(PLANT, "/tasks", {"kind": "inventory"})
    assert answer.status_code == 201, answer.text
    return answer.json()["task_id"]


@pytest.mark.parametrize(
    "kind", ["camera_frozen", *(pytest.param(name, marks=pytest.mark.soak) for name in EYES if name != "camera_frozen")]
)
def test_a_scan_with_an_eye_that_fails_ends_with_the_reason_and_works_again_after(kind):
    async def told(orchard):
        fault = story.fault(orchard.garden, kind, ROBOT)
        task_id = await scan_wanted(orchard)
        await harvest.gives_up(orchard, task_id, EYES[kind])
        assert (await orchard.garden.get(PLANT, "/inventory"))["scans"] == 0
        orchard.garden.rig.faults.remove(fault.id)
        assert (await harvest.over(orchard, task_id))["state"] == "done"
        assert await harvest.known(orchard)
        harvest.whole(orchard)

    harvest.tell(one_plant(FRUIT), told, SEED)


def test_a_scan_with_an_eye_that_hangs_upside_down_says_so_and_tells_the_plant_nothing():
    async def told(orchard):
        story.fault(orchard.garden, "camera_upside_down", ROBOT)
        await harvest.gives_up(orchard, await scan_wanted(orchard), "mounted upside down")
        assert (await orchard.garden.get(PLANT, "/inventory"))["scans"] == 0
        harvest.whole(orchard)

    harvest.tell(one_plant(FRUIT), told, SEED)


async def pick_wanted(orchard, count=1):
    await harvest.inform(orchard)
    fruit = harvest.ripe_with_room(orchard)[:count]
    assert len(fruit) == count
    return await harvest.ask_for(orchard, *fruit), fruit


@pytest.mark.parametrize("kind", [pytest.param(name, marks=pytest.mark.soak) for name in (*EYES, "camera_upside_down")])
def test_a_pick_with_an_eye_that_fails_from_the_start_touches_nothing(kind):
    async def told(orchard):
        story.fault(orchard.garden, kind, ROBOT)
        task_id, _ = await pick_wanted(orchard)
        task = await harvest.over(orchard, task_id, 1200.0)
        assert (task["state"], task["permits"]) == ("failed", 0)
        assert task["reason"]
        harvest.whole(orchard)

    harvest.tell(one_plant(FRUIT), told, SEED)


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["camera_silent", "camera_black"])
def test_an_eye_that_fails_while_a_fruit_is_in_the_hand_does_not_lose_the_fruit(kind):
    async def told(orchard):
        task_id, fruit = await pick_wanted(orchard)
        await harvest.when(orchard, lambda: bool(orchard.where("hand")))
        story.fault(orchard.garden, kind, ROBOT, for_s=20.0)
        assert (await harvest.over(orchard, task_id))["permits"] == 1
        assert orchard.where("basket") == {fruit[0].id}
        await harvest.honest(orchard)
        harvest.whole(orchard, fruit[0].id)

    harvest.tell(one_plant(FRUIT), told, SEED)


@pytest.mark.soak
def test_a_force_sensor_stuck_at_nothing_lets_every_fruit_go_unharmed():
    async def told(orchard):
        story.fault(orchard.garden, "force_stuck", ROBOT)
        task_id, _ = await pick_wanted(orchard)
        task = await harvest.over(orchard, task_id)
        assert task["state"] == "failed"
        assert "the force sensor felt no fruit" in task["reason"]
        harvest.whole(orchard)

    harvest.tell(one_plant(FRUIT), told, SEED)


def test_a_force_sensor_stuck_at_a_squeeze_is_noticed_before_the_next_fruit():
    async def told(orchard):
        task_id, _ = await pick_wanted(orchard, 2)
        await harvest.when(orchard, lambda: bool(orchard.where("hand")))
        held = orchard.where("hand")
        fault = story.fault(orchard.garden, "force_stuck", ROBOT)
        await harvest.gives_up(orchard, task_id, "between open fingers: it is stuck")
        assert orchard.where("basket") == held
        harvest.whole(orchard, *held)
        orchard.garden.rig.faults.remove(fault.id)
        await harvest.over(orchard, task_id)
        await harvest.honest(orchard)
        harvest.whole(orchard, *await harvest.tried(orchard))

    harvest.tell(one_plant(FRUIT), told, SEED)


def test_fruit_that_slips_is_told_of_as_it_is_and_nothing_else_comes_off():
    async def told(orchard):
        story.fault(orchard.garden, "slippery_grip", ROBOT, strength=0.0)
        task_id, fruit = await pick_wanted(orchard)
        task = await harvest.over(orchard, task_id)
        assert task["state"] == "failed"
        assert "slipped out of the fingers" in task["reason"] or "felt no fruit" in task["reason"], task["reason"]
        assert await harvest.honest(orchard) == orchard.where("basket") == set()
        known = {orchard.names[PLANT, entry["fruit_id"]]: entry for entry in await harvest.known(orchard)}
        if fruit[0].id in orchard.where("plant"):
            assert known[fruit[0].id]["failed"]
        else:
            assert fruit[0].id not in known
        harvest.whole(orchard, fruit[0].id)

    harvest.tell(one_plant(FRUIT), told, SEED)


@pytest.mark.parametrize("far_m", [pytest.param(far_m, marks=pytest.mark.soak) for far_m in (0.01, 0.03)])
def test_fruit_on_swaying_branches_is_picked_or_given_up_with_a_reason(far_m):
    async def told(orchard):
        story.fault(orchard.garden, "branch_sway", PLANT, strength=far_m)
        task_id, _ = await pick_wanted(orchard)
        task = await harvest.over(orchard, task_id)
        picked = await harvest.honest(orchard)
        assert picked or task["reason"]
        assert picked == orchard.where("basket")
        harvest.whole(orchard, *await harvest.tried(orchard))

    harvest.tell(one_plant(FRUIT), told, SEED)
