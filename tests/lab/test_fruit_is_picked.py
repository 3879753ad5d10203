"""Ripe fruit, from a pot that was never looked at to the basket: what the services say, judged by the world."""

from __future__ import annotations

import pytest

from lab import harvest, story
from lab.orchard import PLANT, one_plant

FRUIT = 12
SEED = 3


async def pictures(orchard, line):
    """The ledger's two pictures of a pick."""
    async with orchard.garden.operator() as client:
        url = orchard.garden.url(line["plant_id"])
        return [(await client.get(url + line[when])).raise_for_status().content for when in ("before", "after")]


def test_a_pot_has_its_fruit_scanned_and_asks_for_the_ripe_ones_which_end_in_the_basket():
    async def told(orchard):
        garden = orchard.garden
        scan = await story.ended(garden, PLANT)
        assert (scan["kind"], scan["asked_by"], scan["state"]) == ("inventory", "fruit", "done")
        seen = {orchard.meant(PLANT, fruit) for fruit in await harvest.known(orchard)}
        assert len(seen - {""}) >= 0.8 * FRUIT
        await story.phase(garden, PLANT, "awarded", "running")
        asked = (await story.tasks(garden, PLANT))[-1]
        assert (asked["kind"], asked["asked_by"]) == ("harvest", "fruit")
        done = await harvest.over(orchard, asked["task_id"])
        picked = await harvest.honest(orchard)
        assert picked, done
        assert picked == orchard.where("basket"), "nothing lies there that nobody tells of"
        assert {orchard.now()[name].torn_how for name in picked} == {"grip"}
        assert {orchard.at_first[name].colour for name in picked} == {"red"}
        for line in await harvest.ledger(orchard):
            assert (line["robot_id"], line["asked_by"]) == ("robot-1", "fruit")
            if line["outcome"] == "picked":
                assert line["bids"][0]["cost_s"] > 0.0
                before, after = await pictures(orchard, line)
                assert before != after
                assert all(jpeg.startswith(b"\xff\xd8\xff") for jpeg in (before, after))
        counts = (await garden.get(PLANT, "/state"))["fruit"]
        assert sum(counts.values()) == len(await harvest.known(orchard))
        harvest.whole(orchard, *await harvest.tried(orchard))

    harvest.tell(one_plant(FRUIT), told, SEED, pots={})


async def order(orchard, count, within_s=600.0):
    """`POST /orders` at the console; the order when it has ended."""
    await orchard.garden.open_console()
    placed = await orchard.garden.post("console", "/orders", {"count": count})
    assert placed.status_code == 201, placed.text
    found = placed.json()

    async def over():
        found.update(await orchard.garden.get("console", placed.headers["location"]))
        return found["state"] != "running"

    assert await orchard.garden.until(over, within_s), await story.standing(orchard.garden)
    return found


def test_an_order_is_split_over_two_pots_and_picked_by_two_robots_at_neighbouring_docks():
    async def told(orchard):
        for plant_id in harvest.NEIGHBOURS:
            await harvest.inform(orchard, plant_id)
        wanted = 2
        found = await order(orchard, wanted)
        picked = {plant_id: await harvest.honest(orchard, plant_id) for plant_id in harvest.NEIGHBOURS}
        assert found["delivered"] == sum(len(fruit) for fruit in picked.values()) >= 1
        assert found["state"] == ("done" if found["delivered"] == wanted else "partial")
        assert {part["plant_id"] for part in found["parts"]} == set(harvest.NEIGHBOURS)
        assert len({part["robot_id"] for part in found["parts"]}) == 2, found
        for plant_id, fruit in picked.items():
            lines = [line for line in await harvest.ledger(orchard, plant_id) if line["outcome"] == "picked"]
            assert {line["order_id"] for line in lines} <= {found["order_id"]}
            assert len(lines) == len(fruit)
        tried = [await harvest.tried(orchard, plant_id) for plant_id in harvest.NEIGHBOURS]
        harvest.whole(orchard, *set.union(*tried))

    harvest.tell(harvest.two_pots(FRUIT), told, SEED)


@pytest.mark.soak
def test_an_order_for_more_than_is_ripe_is_delivered_in_part_and_says_so():
    async def told(orchard):
        await harvest.inform(orchard)
        ripe = [fruit for fruit in orchard.at_first.values() if fruit.colour == "red"]
        found = await order(orchard, len(ripe) + 3)
        assert (found["state"], found["delivered"]) == ("partial", len(await harvest.honest(orchard)))
        assert f"only {len(ripe)} of {len(ripe) + 3} ripe fruit are known" in found["reason"]
        harvest.whole(orchard, *await harvest.tried(orchard))

    harvest.tell(one_plant(FRUIT), told, SEED)
