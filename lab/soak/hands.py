"""Eye and hand without pictures or physics: a scan sees what hangs, a grip takes it, in about the time they really take.

They stand in for `robot_service.skills.scan` and `.pick` behind the planner's `Hand`; the order of permit, act and word is
theirs. What they leave out (servoing, force, failed grips) has its own tests.
"""

from __future__ import annotations

import math
import random
from collections.abc import Awaitable, Callable, Sequence

from core.wire.fruit import Direction, Fruit, Pick, Scan, Sighting, View
from core.wire.market import Permit, PlantCard
from lab.soak.world import Truth
from robot_service.planner import Hand
from robot_service.robot import Robot, SkillFailed

SCAN_S, LOOK_S, GRIP_S, CARRY_S = 25.0, 8.0, 3.0, 6.0
SEEN_SHARE = 0.97
COLOUR_ERROR = 0.01
VIEWS = 4


class SoakHand:
    """One robot's eye and hand in the truth. `acted` hears of every pick the moment the fruit lies in the basket."""

    def __init__(self, robot_id: str, truth: Truth, rng: random.Random, acted: Callable[[str, str], None]) -> None:
        self._id, self._truth, self._rng, self._acted = robot_id, truth, rng, acted

    def skills(self) -> Hand:
        return Hand(scan=self.scan, harvest=self.harvest, empty=self.empty)

    async def empty(self, robot: Robot) -> None:
        """A hand that is always empty."""

    async def scan(self, robot: Robot, plant: PlantCard, scan_id: str, task_id: str) -> Scan:
        await robot.pause(SCAN_S)
        self._at(robot, plant)
        seen = [fruit for fruit in self._truth.grow(plant.plant_id) if self._rng.random() < SEEN_SHARE]
        now_s = self._truth.now()
        return Scan(
            scan_id=scan_id,
            task_id=task_id,
            robot_id=self._id,
            views=[_view(0.45 + 0.02 * number) for number in range(VIEWS)],
            sightings=[
                Sighting(
                    x_m=fruit.at[0] + self._rng.gauss(0.0, 0.002),
                    y_m=fruit.at[1] + self._rng.gauss(0.0, 0.002),
                    z_m=fruit.at[2] + self._rng.gauss(0.0, 0.002),
                    sigma_m=0.004,
                    radius_m=0.022,
                    colour=fruit.colour(now_s) if self._rng.random() > COLOUR_ERROR else "turning",
                    confidence=0.9,
                    views=list(range(VIEWS)),
                )
                for fruit in seen
            ],
        )

    async def harvest(
        self,
        robot: Robot,
        plant: PlantCard,
        fruits: Sequence[Fruit],
        count: int,
        take_permit: Callable[[str], Awaitable[tuple[Permit, float]]],
        keep_picture: object,
        ended: Callable[[Pick], None],
        known: Sequence[Fruit] = (),
    ) -> None:
        picked = 0
        for fruit in fruits:
            if picked >= count:
                return
            began_s = robot.clock.now()
            pick = await self._pick(robot, plant, fruit, take_permit)
            ended(pick.model_copy(update={"took_s": robot.clock.now() - began_s}))
            picked += pick.outcome == "picked"

    async def _pick(
        self, robot: Robot, plant: PlantCard, fruit: Fruit, take_permit: Callable[[str], Awaitable[tuple[Permit, float]]]
    ) -> Pick:
        await robot.pause(LOOK_S)
        now_s, at = self._truth.now(), (fruit.x_m, fruit.y_m, fruit.z_m)
        if not any(math.dist(f.at, at) < 0.03 and f.hangs(now_s) for f in self._truth.grow(plant.plant_id)):
            return Pick(fruit_id=fruit.fruit_id, outcome="failed", reason="looked from several sides: not seen")
        permit, asked_s = await take_permit(fruit.fruit_id)
        end = Pick(fruit_id=fruit.fruit_id, permit_id=permit.permit_id, outcome="failed")
        if robot.clock.now() - asked_s > permit.valid_for_s:
            return end.model_copy(update={"reason": "the permit ran out"})
        await robot.pause(GRIP_S)
        self._at(robot, plant)
        came = self._truth.pick(plant.plant_id, at, permit.permit_id)
        self._acted(self._id, permit.permit_id)
        await robot.pause(CARRY_S)
        if not came:
            return end.model_copy(update={"reason": "nothing was held: the force sensor felt no fruit"})
        return end.model_copy(update={"outcome": "picked"})

    def _at(self, robot: Robot, plant: PlantCard) -> None:
        if robot.where.docked_at != plant.plant_id or self._truth.look(self._id).dock != plant.plant_id:
            raise SkillFailed(f"no longer at the dock of {plant.plant_id}")


def _view(x_m: float) -> View:
    """A camera before the plant that sees all of it."""
    return View(
        x_m=x_m,
        y_m=0.0,
        z_m=0.45,
        look=Direction(x=-1.0, y=0.0, z=0.0),
        up=Direction(x=0.0, y=0.0, z=1.0),
        fov_x_rad=1.6,
        fov_y_rad=1.6,
    )
