"""Stories of fruit: gardens to tell them in, a pot that already knows its fruit, and the judge's questions afterwards."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from core.errors import Refused
from core.manipulation.approach import Obstacle, approaches
from core.scenario import Plant, Robot, Scenario, find
from core.virtual import run_virtual
from core.wire.market import FINAL_STATES
from lab import story
from lab.garden import Garden
from lab.orchard import COUNTED_CONFIDENCE, MOIST_RATIO, PLANT, SAME_FRUIT_M, START, in_base, matched
from lab.quiet import hush
from sim.truth import FruitTruth

TOLD_SIGMA_M = 0.006
PEEK_S = 0.1


@dataclass(slots=True)
class Orchard:
    """A garden, and its fruit as they hung when the story began."""

    garden: Garden
    at_first: dict[str, FruitTruth] = field(default_factory=dict)
    names: dict[tuple[str, str], str] = field(default_factory=dict)
    """(plant, id in its inventory) -> id in the world, of the fruit that `inform` told of."""

    def now(self) -> dict[str, FruitTruth]:
        return {fruit.id: fruit for plant in self.garden.truth().plants for fruit in plant.fruit}

    def where(self, where: str) -> set[str]:
        return {fruit.id for fruit in self.now().values() if fruit.where == where}

    def meant(self, plant_id: str, known: Mapping[str, Any]) -> str:
        """Which fruit of the world an inventory's entry or a ledger's line stands for, as it hung at first; or empty."""
        at = (known["x_m"], known["y_m"], known["z_m"])
        near = [
            (math.dist(at, (f.position_plant.x_m, f.position_plant.y_m, f.position_plant.z_m)), f.id)
            for f in self.garden_fruit(plant_id)
        ]
        gap_m, fruit_id = min(near, default=(math.inf, ""))
        return fruit_id if gap_m <= SAME_FRUIT_M else ""

    def garden_fruit(self, plant_id: str) -> list[FruitTruth]:
        return [fruit for name, fruit in self.at_first.items() if name.startswith(f"{plant_id}-")]


Story = Callable[[Orchard], Awaitable[None]]


def tell(scenario: Scenario, told: Story, seed: int, pots: Mapping[str, str] = story.WATER_ONLY) -> None:
    """Play a story of fruit on virtual time. `pots`: settings of every pot; else it scans only when in doubt."""
    hush()
    print(f"seed {seed}")

    async def play(folder: Path) -> None:
        settings = {plant.id: dict(pots) for plant in scenario.plants}
        async with Garden(scenario, folder, seed=seed, settings=settings) as garden:
            orchard = Orchard(garden)
            orchard.at_first = orchard.now()
            await told(orchard)
            garden.check()

    with tempfile.TemporaryDirectory() as name:
        run_virtual(play(Path(name)))


def two_pots(fruit: int) -> Scenario:
    """Two neighbouring moist pots that bear `fruit` each, and a robot near each dock."""
    garden = find("garden")

    def potted(plant: Plant) -> Plant:
        return plant.model_copy(update={"moisture_ratio": MOIST_RATIO, "fruit": fruit})

    def near(robot: Robot, y_sign: float) -> Robot:
        return robot.model_copy(update=START | {"y_m": y_sign * START["y_m"], "yaw_deg": y_sign * START["yaw_deg"]})

    plants = tuple(potted(plant) for plant in garden.plants if plant.id in NEIGHBOURS)
    first, second = garden.robots
    return garden.model_copy(update={"plants": plants, "robots": (near(first, 1.0), near(second, -1.0))})


NEIGHBOURS = (PLANT, "plant-3")
"""On one side of the garden, their docks one and a half metres apart."""

# ------------------------------------------------------------------ fruit and tasks


def ripe_with_room(orchard: Orchard, plant_id: str = PLANT) -> list[FruitTruth]:
    """Red fruit that a docked hand can come to without touching another; those with the most room first."""
    dock = next(plant.dock for plant in orchard.garden.scenario.plants if plant.id == plant_id)
    fruit = orchard.garden_fruit(plant_id)

    def room_m(one: FruitTruth) -> float:
        others = [Obstacle(centre=in_base(dock, other), radius_m=other.radius_m) for other in fruit if other.id != one.id]
        try:
            return max(way.room_m for way in approaches(in_base(dock, one), one.radius_m, others))
        except Refused:
            return -1.0

    roomy = {one.id: room_m(one) for one in fruit if one.colour == "red"}
    return sorted((one for one in fruit if roomy.get(one.id, -1.0) > 0.0), key=lambda one: -roomy[one.id])


async def inform(orchard: Orchard, plant_id: str = PLANT) -> None:
    """Tell a pot of all its fruit, as a scan without an error would: for stories that are not about scans."""
    for fruit in orchard.garden_fruit(plant_id):
        at = fruit.position_plant
        told = {
            "x_m": at.x_m, "y_m": at.y_m, "z_m": at.z_m, "radius_m": fruit.radius_m, "colour": fruit.colour,
            "sigma_m": TOLD_SIGMA_M, "confidence": 0.95,
        }  # fmt: skip
        answer = await orchard.garden.post(plant_id, "/inventory/fruits", told)
        orchard.names[plant_id, answer.raise_for_status().json()["fruit_id"]] = fruit.id


async def ask_for(orchard: Orchard, *fruit: FruitTruth, plant_id: str = PLANT) -> str:
    """Ask the pot, which was informed, to have these fruit picked; the task's id."""
    world = {true: name for (plant, name), true in orchard.names.items() if plant == plant_id}
    wish = {"kind": "harvest", "fruit_ids": [world[one.id] for one in fruit], "count": len(fruit)}
    answer = await orchard.garden.post(plant_id, "/tasks", wish)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["task_id"])


async def task(orchard: Orchard, task_id: str) -> dict[str, Any]:
    found: dict[str, Any] = await orchard.garden.get(task_id.split(":")[0], f"/tasks/{task_id}")
    return found


async def over(orchard: Orchard, task_id: str, within_s: float = 400.0) -> dict[str, Any]:
    """The task once it has ended; fails with what is known when it does not end."""
    found: dict[str, Any] = {}

    async def so() -> bool:
        found.update(await task(orchard, task_id))
        return found["state"] in FINAL_STATES

    assert await orchard.garden.until(so, within_s), await story.standing(orchard.garden)
    return found


async def gives_up(orchard: Orchard, task_id: str, *words: str, within_s: float = 400.0) -> dict[str, Any]:
    """The task once one of its events tells `words`: why it cannot be done now. It may well be tried again."""
    found: dict[str, Any] = {}

    async def so() -> bool:
        found.update(await task(orchard, task_id))
        return any(word in event["what"] for event in found["events"] for word in words)

    assert await orchard.garden.until(so, within_s), f"never {words}: {await story.standing(orchard.garden)}"
    return found


async def when(orchard: Orchard, true: Callable[[], bool], within_s: float = 200.0) -> None:
    """Wait until the world says so."""

    async def so() -> bool:
        return true()

    assert await orchard.garden.until(so, within_s, every_s=PEEK_S), await story.standing(orchard.garden)


async def permitted(orchard: Orchard, task_id: str, within_s: float = 200.0) -> None:
    """Wait until a permit is open."""

    async def so() -> bool:
        return bool((await task(orchard, task_id))["permit_id"])

    assert await orchard.garden.until(so, within_s, every_s=PEEK_S), await story.standing(orchard.garden)


# ------------------------------------------------------------------ the judge


async def ledger(orchard: Orchard, plant_id: str = PLANT) -> list[dict[str, Any]]:
    return list(await orchard.garden.get(plant_id, "/ledger"))


async def known(orchard: Orchard, plant_id: str = PLANT) -> list[dict[str, Any]]:
    """The pot's fruit that count."""
    inventory = await orchard.garden.get(plant_id, "/inventory")
    return [fruit for fruit in inventory["fruits"] if fruit["confidence"] >= COUNTED_CONFIDENCE]


async def tried(orchard: Orchard, plant_id: str = PLANT) -> set[str]:
    """The fruit that the hand closed on under a permit, by their ids in the world."""
    return {orchard.meant(plant_id, line) for line in await ledger(orchard, plant_id) if line["permitted_s"] is not None}


def whole(orchard: Orchard, *but: str) -> None:
    """Every fruit hangs where it hung, but for those named; nobody struck anything."""
    missing = {name for name in orchard.at_first if name not in orchard.where("plant")}
    assert missing <= set(but), f"{missing - set(but)} came off: {[orchard.now().get(name) for name in missing]}"
    story.unhurt(orchard.garden)


async def honest(orchard: Orchard, plant_id: str = PLANT) -> set[str]:
    """What the ledger calls picked lies in the basket, each fruit once, and no inventory lists what has gone.

    Returns the fruit that were picked, by their ids in the world.
    """
    lines = [line for line in await ledger(orchard, plant_id) if line["outcome"] == "picked"]
    picked = [orchard.meant(plant_id, line) for line in lines]
    assert len(set(picked)) == len(picked), f"a second pick of the same fruit: {lines}"
    basket = {name for name in orchard.where("basket") if name.startswith(f"{plant_id}-")}
    assert set(picked) <= basket, f"not in the basket: {set(picked) - basket}"
    hang, listed = orchard.where("plant"), await known(orchard, plant_id)
    there = {index for index, _, _ in matched(listed, [f for f in orchard.garden_fruit(plant_id) if f.id in hang]).pairs}
    meant = [orchard.meant(plant_id, fruit) for index, fruit in enumerate(listed) if index not in there]
    assert not (phantoms := set(meant) - hang - {""}), f"still listed: {phantoms}"
    return set(picked)
