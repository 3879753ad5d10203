"""A radio without routing: pots reach robots that only their neighbours' neighbours hear, and tasks are done as ever."""

from __future__ import annotations

import json
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from itertools import permutations
from pathlib import Path
from random import Random
from typing import Any

import pytest

from console.processes import peers_of
from core.scenario import Scenario
from core.virtual import run_virtual
from lab import story
from lab.garden import Garden
from lab.quiet import hush

LINE = [("plant-1", "plant-2"), ("plant-2", "plant-3"), ("plant-3", "robot-1"), ("robot-1", "station")]
RING = [
    ("plant-1", "plant-2"),
    ("plant-2", "robot-1"),
    ("robot-1", "plant-3"),
    ("plant-3", "plant-1"),
    ("robot-1", "station"),
]
NODES = ("plant-1", "plant-2", "plant-3", "robot-1", "station")
Told = Callable[[Garden], Awaitable[None]]


def scenario() -> Scenario:
    """One dry pot, two moist ones that pass on, a robot near the dry one that hears it only through them."""
    return story.garden_of(("plant-1",), ("plant-2", "plant-3"), (story.near_robot(),))


def settings(links: list[tuple[str, str]], hops: int) -> dict[str, dict[str, str]]:
    """Everybody lists those it hears."""
    peers = peers_of(scenario(), lambda name: "127.0.0.1")

    def listed(name: str) -> str:
        reach = {b if a == name else a for a, b in links if name in (a, b)}
        return json.dumps([peer.model_dump() for peer in peers if peer.id in reach])

    care = story.WATER_ONLY | {"PLANT_SOAK_S": f"{story.SOAK_S:g}"}
    radio = {name: {"GARDEN_PEERS": listed(name), "GARDEN_FLOOD_HOPS": str(hops)} for name in NODES}
    return {name: env | (care if name.startswith("plant") else {}) for name, env in radio.items()}


@asynccontextmanager
async def radio(links: list[tuple[str, str]], hops: int) -> AsyncIterator[Garden]:
    """The garden, whose nodes hear one another only where there is a link."""
    with tempfile.TemporaryDirectory() as folder:
        async with Garden(scenario(), Path(folder), settings=settings(links, hops)) as garden:
            for one, other in permutations(NODES, 2):
                garden.mesh.leg(one, other).cut = (one, other) not in links and (other, one) not in links
            yield garden
            garden.check()


def tell(links: list[tuple[str, str]], hops: int, told: Told) -> None:
    hush()
    print(f"seed {scenario().seed}")

    async def play() -> None:
        async with radio(links, hops) as garden:
            await told(garden)

    run_virtual(play())


def lossy(garden: Garden, ratio: float, seed: int) -> None:
    """From now on every message between nodes is lost so often, there and back, on each link."""
    garden.mesh._rng = Random(seed)
    for one, other in permutations(NODES, 2):
        garden.mesh.leg(one, other).loss_ratio = ratio


async def known(garden: Garden, name: str) -> dict[str, Any]:
    return {peer["id"]: (peer["source"], peer["hops"], peer["way"]) for peer in await garden.get(name, "/peers")}


def test_a_pot_is_served_by_a_robot_three_hops_away() -> None:
    async def told(garden: Garden) -> None:
        task = await story.served(garden, "plant-1")
        assert task["robot_id"] == "robot-1"
        assert (task["permits"], task["epoch"]) == (1, 1)
        assert (await known(garden, "plant-1"))["robot-1"] == ("flood", 3, ["plant-2", "plant-3", "robot-1"])
        assert (await known(garden, "robot-1"))["plant-1"] == ("flood", 3, ["plant-3", "plant-2", "plant-1"])
        assert 0.0 < garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
        story.unhurt(garden)

    tell(LINE, 3, told)


def test_beyond_the_hop_limit_nobody_is_asked() -> None:
    async def told(garden: Garden) -> None:
        await garden.clock.sleep(60.0)
        assert "robot-1" not in await known(garden, "plant-1")
        (task,) = await story.tasks(garden, "plant-1")
        assert (task["state"], task["epoch"]) == ("announced", 0)
        assert [e for e in await garden.get("robot-1", "/history") if e["task_id"]] == []

    tell(LINE, 2, told)


def test_a_relay_dies_in_the_middle_of_a_task_and_it_is_done_once_by_the_other_way() -> None:
    async def told(garden: Garden) -> None:
        await story.phase(garden, "plant-1", "navigate")
        way = (await known(garden, "robot-1"))["plant-1"][2]
        await garden.kill(way[0])
        task = await story.served(garden, "plant-1")
        other = next(name for name in ("plant-2", "plant-3") if name != way[0])
        assert (await known(garden, "robot-1"))["plant-1"] == ("flood", 2, [other, "plant-1"])
        assert (task["robot_id"], task["permits"], task["epoch"]) == ("robot-1", 1, 1)
        assert 0.0 < garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
        story.unhurt(garden)

    tell(RING, 3, told)


@pytest.mark.soak
def test_a_pot_that_is_killed_under_its_permit_and_begins_anew_is_watered_once() -> None:
    async def told(garden: Garden) -> None:
        await story.phase(garden, "plant-1", "act")
        await garden.kill("plant-1")
        await garden.clock.sleep(2.0)
        garden.start("plant-1")
        task = await story.served(garden, "plant-1")
        assert (task["robot_id"], task["permits"]) == ("robot-1", 1)
        assert 0.0 < garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
        story.unhurt(garden)

    tell(LINE, 3, told)


@pytest.mark.soak
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("links", [LINE, RING], ids=["line", "ring"])
def test_where_each_link_loses_one_message_in_seven_a_pot_is_still_watered_once(
    links: list[tuple[str, str]], seed: int
) -> None:
    async def told(garden: Garden) -> None:
        lossy(garden, 0.15, seed)
        task = await story.served(garden, "plant-1", 600.0)
        print(f"seed {seed}: {task['updated_s'] - task['created_s']:.0f} s, {task['epoch']} awards")
        assert task["permits"] == 1
        assert 0.0 < garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
        story.unhurt(garden)

    tell(links, 3, told)
