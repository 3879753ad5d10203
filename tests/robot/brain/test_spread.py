"""Idle robots spread over the garden, on stand-ins and virtual time."""

from standin import in_garden

from core.errors import Conflict
from core.wire.market import ReservationRequest

SOON = {"spread_after_s": 20.0}
LEFT, RIGHT = {"plant-1", "plant-3"}, {"plant-2", "plant-4", "station/spare"}


async def rest_side_by_side(garden):
    """Both robots have watered on the left, and rest there."""
    await garden.award("plant-1", "robot-1")
    await garden.award("plant-3", "robot-2")
    await garden.until(lambda: garden.plants["plant-1"].ended and garden.plants["plant-3"].ended, 200.0)
    assert docks(garden) == {"robot-1": "plant-1", "robot-2": "plant-3"}


def docks(garden):
    return {name: brain.robot.where.docked_at for name, brain in garden.brains.items()}


def movers(garden):
    """The brain of every decision to move, as often as it moved."""
    return [brain for brain in garden.brains.values() for e in brain.events.since(0) if e.kind == "spread"]


def test_two_robots_that_rest_on_one_side_spread_and_then_stay():
    async def story(garden):
        await rest_side_by_side(garden)
        await garden.until(lambda: len(set(docks(garden).values()) & RIGHT) == 1, 150.0)
        where = docks(garden)
        assert set(where.values()) & LEFT
        await garden.clock.sleep(150.0)
        assert docks(garden) == where
        assert len(movers(garden)) == 1

    in_garden(story, robots=2, **SOON)


def test_a_robot_alone_does_not_roam():
    async def story(garden):
        await garden.award("plant-1")
        await garden.until(lambda: garden.plants["plant-1"].ended, 200.0)
        await garden.clock.sleep(150.0)
        assert docks(garden) == {"robot-1": "plant-1"}, "no place is nearer to all by a fifth"
        assert movers(garden) == []

    in_garden(story, **SOON)


def test_without_the_setting_everybody_stays():
    async def story(garden):
        await rest_side_by_side(garden)
        await garden.clock.sleep(100.0)
        assert docks(garden) == {"robot-1": "plant-1", "robot-2": "plant-3"}

    in_garden(story, robots=2, spread_after_s=0.0)


def test_an_award_on_the_way_is_begun_at_once():
    async def story(garden):
        await rest_side_by_side(garden)
        await garden.until(lambda: movers(garden), 150.0)
        (brain,) = movers(garden)
        name = brain.settings.id
        await garden.until(lambda: brain.robot.activity.job == "navigate" and brain.robot.moving, 60.0)
        bid = await garden.bid("plant-4", name)
        assert bid.cost_s is not None
        assert (await garden.award("plant-4", name, number=9)).status_code == 201
        await garden.until(lambda: brain.queue.entries and brain.queue.entries[0].running, 0.2)
        await garden.until(lambda: garden.plants["plant-4"].ended, 150.0)
        assert garden.plants["plant-4"].ended.state == "done"

    in_garden(story, robots=2, **SOON)


def test_a_robot_on_its_way_to_rest_leaves_the_dock_to_who_works_there():
    async def story(garden):
        await rest_side_by_side(garden)
        await garden.until(lambda: movers(garden), 150.0)
        (brain,) = movers(garden)
        goal = next(name for name in brain.docks.holds if name in RIGHT)
        plant = garden.plants[goal]
        wish = ReservationRequest(robot_id="robot-9", for_s=30.0)

        def granted():
            try:
                plant.docks.reserve(wish, garden.clock.now())
            except Conflict:
                return False
            return True

        await garden.until(granted, 30.0)
        assert brain.robot.where.docked_at != goal

    in_garden(story, robots=2, **SOON)


def test_a_robot_low_on_charge_stays_on_its_dock():
    async def story(garden):
        await rest_side_by_side(garden)
        for body in garden.bodies.values():
            body.battery_ratio = 0.3
        await garden.clock.sleep(100.0)
        assert movers(garden) == []

    in_garden(story, robots=2, **SOON)
