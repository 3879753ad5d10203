"""A brain that dies under a permit, words that get lost: a scan comes first, nothing is picked twice, no phantom stays."""

from __future__ import annotations

import pytest

from lab import harvest, story
from lab.orchard import PLANT, ROBOT, one_plant

FRUIT = 12
SEED = 3
DEAD_S = 3.0


async def asked(orchard):
    """A harvest of the fruit with the most room, under way; (task's id, the fruit)."""
    await harvest.inform(orchard)
    fruit = harvest.ripe_with_room(orchard)[0]
    return await harvest.ask_for(orchard, fruit), fruit


async def in_hand(orchard, task_id):
    await harvest.when(orchard, lambda: bool(orchard.where("hand")))


async def order_of_events(orchard):
    """(what, task's kind, time) of awards and permits, in order."""
    found = []
    for task in await story.tasks(orchard.garden, PLANT):
        for event in task["events"]:
            for word in ("awarded", "permit"):
                if event["what"].startswith(word):
                    found.append((event["t_s"], word, task["kind"]))
    return [(word, kind) for _, word, kind in sorted(found)]


@pytest.mark.parametrize("moment", [pytest.param(harvest.permitted, marks=pytest.mark.soak), in_hand])
def test_after_a_brain_died_under_a_permit_a_scan_comes_before_anything_is_picked(moment):
    async def told(orchard):
        garden = orchard.garden
        task_id, fruit = await asked(orchard)
        await moment(orchard, task_id)
        await garden.kill(ROBOT)
        await story.stops(garden)
        await garden.clock.sleep(DEAD_S)
        garden.start(ROBOT)
        task = await harvest.over(orchard, task_id)
        told_of = [event["what"] for event in task["events"]]
        assert any("a scan comes first" in what for what in told_of), told_of
        happened = await order_of_events(orchard)
        assert happened[:3] == [("awarded", "harvest"), ("permit", "harvest"), ("awarded", "inventory")], happened
        first = (await harvest.ledger(orchard))[0]
        assert (first["outcome"], task["permits"]) in (("gone", 1), ("hanging", 2)), told_of
        assert orchard.where("basket") == {fruit.id}, "what was in the hand is laid into the basket"
        await harvest.honest(orchard)
        harvest.whole(orchard, fruit.id)

    harvest.tell(one_plant(FRUIT), told, SEED)


@pytest.mark.parametrize(
    ("way", "for_s"),
    [
        pytest.param((ROBOT, PLANT), 6.0, id="reports late"),
        pytest.param((ROBOT, PLANT), 150.0, id="reports lost", marks=pytest.mark.soak),
        pytest.param((PLANT, ROBOT), 150.0, id="answers lost", marks=pytest.mark.soak),
    ],
)
def test_a_report_that_does_not_come_never_becomes_a_second_pick_or_a_phantom(way, for_s):
    async def told(orchard):
        task_id, fruit = await asked(orchard)
        await in_hand(orchard, task_id)
        leg = orchard.garden.mesh.leg(*way)
        leg.cut = True
        await orchard.garden.clock.sleep(for_s)
        leg.cut = False
        task = await harvest.over(orchard, task_id)
        await orchard.garden.clock.sleep(5.0)
        assert task["permits"] == 1
        assert await harvest.honest(orchard) <= {fruit.id}
        assert orchard.where("basket") == {fruit.id}
        harvest.whole(orchard, fruit.id)

    harvest.tell(one_plant(FRUIT), told, SEED)
