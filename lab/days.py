"""Days in a garden that tends its fruit itself: they ripen, are looked for, picked and forecast, and the world judges.

The plants ask for scans and picks of their own accord; nobody orders anything. A person empties the baskets.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from core.growth.stages import DAY_S
from core.scenario import Robot, Scenario, find
from core.virtual import run_virtual
from core.wire.geometry import Pose2
from lab import stand_in
from lab.garden import Garden
from lab.orchard import COUNTED_CONFIDENCE, MOIST_RATIO, ROBOT, START, matched, reachable, visible
from lab.quiet import hush
from sim.truth import FruitTruth

BUSY_S, REST_S = 1.0, 5.0
"""How often a busy and a resting garden is looked at."""
PROBE_EVERY_S = 60.0
"""The pots are moist and nobody waters: they look at their soil, and think, once a minute instead of every ten seconds."""
LOOK_S = 600.0
"""How often the judge goes round."""
FORECAST_S = DAY_S / 4
BASKET_FULL = 8
SETTLED_SCANS = 3
"""An inventory is held to its bar after so many scans."""


@dataclass(slots=True, kw_only=True)
class Ripened:
    """A fruit that turned red while it hung."""

    plant_id: str
    fruit_id: str
    red_s: float
    """When; 0 when it was red from the beginning."""
    reach: bool
    """Whether a docked robot's joints could bring the hand to it then."""
    basket_s: float | None = None
    end: str = "hangs"
    """Where it is now, or how it left."""

    @property
    def in_time(self) -> bool:
        """Harvested within a day."""
        return self.basket_s is not None and self.basket_s - self.red_s <= DAY_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Scanned:
    """The inventory after one scan."""

    plant_id: str
    number: int
    at_s: float
    visible: int
    missed: tuple[str, ...]
    """Fruit that could be seen and are not in the inventory."""
    phantom: tuple[str, ...]
    """Entries of the inventory that stand for no fruit."""
    doubled: tuple[str, ...]
    """Those of `phantom` whose centre lies within a fruit that has an entry of its own."""

    @property
    def error_ratio(self) -> float:
        return (len(self.missed) + len(self.phantom)) / max(1, self.visible)


@dataclass(frozen=True, slots=True, kw_only=True)
class Foretold:
    """One forecast of the ripe fruit a day ahead, and how many there were to be if nobody picked."""

    plant_id: str
    at_s: float
    ripe: float
    least: int
    most: int
    true: int

    @property
    def covered(self) -> bool:
        return self.least <= self.true <= self.most


@dataclass(slots=True)
class Days:
    """What became of a garden."""

    seed: int
    days: float
    ripened: list[Ripened] = field(default_factory=list)
    scans: list[Scanned] = field(default_factory=list)
    foretold: list[Foretold] = field(default_factory=list)
    picked_twice: list[str] = field(default_factory=list)
    """Fruit of the plants' ledgers that are said to be picked more than once."""
    said_picked: int = 0
    in_baskets: int = 0
    torn_green: int = 0
    torn_other: int = 0
    dropped: int = 0
    history: list[str] = field(default_factory=list)

    def due(self) -> list[Ripened]:
        """Fruit that ripened within reach and whose day is over, or who are harvested."""
        return [r for r in self.ripened if r.reach and (r.basket_s is not None or r.red_s <= (self.days - 1.0) * DAY_S)]

    def settled(self) -> list[Scanned]:
        return [scan for scan in self.scans if scan.number > SETTLED_SCANS]


def garden_of(plants: int = 1, fruit: int = 18, growth: float = 1.0) -> Scenario:
    """The default garden's first pots, moist, each with `fruit` places, and one robot."""
    base = find("garden")
    pots = tuple(p.model_copy(update={"moisture_ratio": MOIST_RATIO, "fruit": fruit}) for p in base.plants[:plants])
    climate = base.climate.model_copy(update={"growth": growth})
    return base.model_copy(update={"plants": pots, "robots": (base.robots[0].model_copy(update=START),), "climate": climate})


def live(scenario: Scenario, days: float, seed: int, detector: str = "best") -> Days:
    """Let a garden live for `days` on virtual time. `detector` as in ROBOT_DETECTOR, or `stand-in`."""
    hush()
    with tempfile.TemporaryDirectory() as folder:
        return run_virtual(_live(scenario, days, seed, detector, Path(folder)))


async def _live(scenario: Scenario, days: float, seed: int, detector: str, folder: Path) -> Days:
    name = stand_in.NAME if detector == "stand-in" else detector
    settings = {robot.id: {"ROBOT_DETECTOR": name} for robot in scenario.robots}
    settings |= {plant.id: {"PLANT_PROBE_EVERY_S": f"{PROBE_EVERY_S:g}"} for plant in scenario.plants}
    async with Garden(scenario, folder, seed=seed, settings=settings) as garden:
        with stand_in.looking_at(garden, ROBOT):
            judge = _Judge(garden, Days(seed, days))
            await judge.watch(days * DAY_S)
        garden.check()
        return judge.told


class _Judge:
    """Goes round a living garden."""

    def __init__(self, garden: Garden, told: Days) -> None:
        self.garden, self.told = garden, told
        self._docks: dict[str, Pose2] = garden.scenario.docks()
        self._ripened: dict[str, Ripened] = {}
        self._scans = dict.fromkeys((plant.id for plant in garden.scenario.plants), 0)
        self._looked_s, self._foretold_s, self._emptied_s = -LOOK_S, FORECAST_S, 0.0
        self._taken: set[str] = set()

    async def watch(self, seconds: float) -> None:
        was_busy = False
        while (now_s := self.garden.clock.now()) < seconds:
            self.garden.check()
            busy = any(map(self._busy, self.garden.scenario.robots))
            if busy or was_busy:
                await self._scanned(now_s)
            was_busy = busy
            if now_s >= self._looked_s + LOOK_S:
                self._looked_s = now_s
                self._look(now_s)
                await self._foretell(now_s)
                self._empty(now_s)
            await self.garden.clock.sleep(BUSY_S if busy else REST_S)
        self._look(seconds)
        self._empty(seconds, always=True)
        await self._end()

    def _busy(self, robot: Robot) -> bool:
        node = self.garden.running[robot.id].node
        return node is not None and node.app.state.brain.robot.activity.job == "act"

    async def _scanned(self, now_s: float) -> None:
        """Judge the inventories that a scan has changed since the last time."""
        for plant_id, before in self._scans.items():
            document = await self.garden.get(plant_id, "/inventory")
            if document["scans"] == before:
                continue
            self._scans[plant_id] = document["scans"]
            known = [f for f in document["fruits"] if f["confidence"] >= COUNTED_CONFIDENCE]
            truth = self._hanging(plant_id)
            seen = visible(self.garden.world, self._stood(plant_id), truth)
            pairs = matched(known, truth)
            entered = {index for index, _, _ in pairs.pairs}
            phantom = [fruit for index, fruit in enumerate(known) if index not in entered]
            own = [fruit for fruit in truth if fruit.id in pairs.ids]
            self.told.scans.append(
                Scanned(
                    plant_id=plant_id,
                    number=document["scans"],
                    at_s=now_s,
                    visible=len(seen),
                    missed=tuple(f"{f.id} {f.colour} {f.radius_m * 1e3:.0f} mm" for f in truth if f.id in seen - pairs.ids),
                    phantom=tuple(_described(f, self._anywhere(plant_id)) for f in phantom),
                    doubled=tuple(f["fruit_id"] for f in phantom if _within(f, own)),
                )
            )

    def _stood(self, plant_id: str) -> Pose2:
        """Where the robot stands that has scanned; one that has just left stood at the dock."""
        docked = (robot.pose for robot in self.garden.truth().robots if robot.docked_at == plant_id)
        return next(docked, self._docks[plant_id])

    def _hanging(self, plant_id: str) -> list[FruitTruth]:
        return [fruit for fruit in self.garden.truth().plant(plant_id).fruit if fruit.where == "plant"]

    def _anywhere(self, plant_id: str) -> tuple[FruitTruth, ...]:
        return self.garden.truth().plant(plant_id).fruit

    def _look(self, now_s: float) -> None:
        """Who has ripened, who lies in a basket, who is lost."""
        for plant in self.garden.truth().plants:
            for fruit in plant.fruit:
                if fruit.where == "plant" and fruit.colour == "red" and fruit.id not in self._ripened:
                    reach = reachable(self._docks[plant.id], fruit)
                    ripened = Ripened(plant_id=plant.id, fruit_id=fruit.id, red_s=now_s, reach=reach)
                    self._ripened[fruit.id] = ripened
                    self.told.ripened.append(ripened)
                if (known := self._ripened.get(fruit.id)) is not None:
                    known.end = fruit.where if fruit.where != "ground" else f"ground, by {fruit.torn_how}"
                    if fruit.where == "basket" and known.basket_s is None:
                        known.basket_s = now_s

    async def _foretell(self, now_s: float) -> None:
        if now_s < self._foretold_s:
            return
        self._foretold_s += FORECAST_S
        for plant_id in self._scans:
            said = await self.garden.get(plant_id, "/forecast")
            growth = self.garden.scenario.climate.growth
            true = 0
            for spot in self.garden.world.orchard.spots:
                if spot.plant_id == plant_id and spot.hangs:
                    age_days = spot.growing.age_days + growth
                    red_days = spot.growing.green_days + spot.growing.turning_days
                    true += red_days <= age_days < red_days + spot.growing.red_days
            self.told.foretold.append(
                Foretold(
                    plant_id=plant_id,
                    at_s=now_s,
                    ripe=said["ripe"],
                    least=said["ripe_min"],
                    most=said["ripe_max"],
                    true=true,
                )
            )

    def _empty(self, now_s: float, *, always: bool = False) -> None:
        """A person takes what is in the baskets when the day is over or a basket is full."""
        evening = now_s >= self._emptied_s + DAY_S
        for robot in self.garden.scenario.robots:
            inside = [
                f for p in self.garden.truth().plants for f in p.fruit if f.where == "basket" and f.robot_id == robot.id
            ]
            if inside and (always or evening or len(inside) >= BASKET_FULL):
                self._taken.update(self.garden.world.take(robot.id))
        if evening:
            self._emptied_s += DAY_S

    async def _end(self) -> None:
        truth, told = self.garden.truth(), self.told
        told.in_baskets = len(self._taken)
        told.dropped = sum(p.dropped.green + p.dropped.turning + p.dropped.red for p in truth.plants)
        for robot in truth.robots:
            touched, gripped = robot.torn_touched, robot.torn_gripped
            told.torn_green += touched.green + gripped.green
            told.torn_other += touched.turning + touched.red
        for plant_id in self._scans:
            picked = [li["fruit_id"] for li in await self.garden.get(plant_id, "/ledger") if li["outcome"] == "picked"]
            told.said_picked += len(picked)
            told.picked_twice += [f"{plant_id}/{name}" for name in set(picked) if picked.count(name) > 1]
            for task in await self.garden.get(plant_id, "/tasks"):
                told.history.append(f"{plant_id} {task['task_id']} {task['kind']} {task['state']} {task['reason']}")


def _gap_m(entry: dict[str, Any], fruit: FruitTruth) -> float:
    at = fruit.position_plant
    return math.dist((entry["x_m"], entry["y_m"], entry["z_m"]), (at.x_m, at.y_m, at.z_m))


def _described(entry: dict[str, Any], fruits: Sequence[FruitTruth]) -> str:
    """What the plant says of a fruit that is none, and what is nearest to it."""
    near = min(fruits, key=lambda fruit: _gap_m(entry, fruit))
    seen, missed = entry["seen_count"], entry["missed_count"]
    return (
        f"{entry['fruit_id']} {entry['colour']} {entry['confidence']:.2f} seen {seen} missed {missed} times,"
        f" {_gap_m(entry, near) * 1e3:.0f} mm from {near.id} {near.colour} {near.where}"
    )


def _within(entry: dict[str, Any], fruits: list[FruitTruth]) -> bool:
    """Whether the entry's centre lies inside one of these fruit."""
    return any(_gap_m(entry, fruit) <= fruit.radius_m for fruit in fruits)
