"""A scenario file of one's own: a larger field, twelve dry pots, four robots of three makes."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from core import scenario
from lab import story

FIELD = Path(__file__).parent.parent / "fixtures" / "scenarios" / "twelve_pots.toml"


@pytest.mark.soak
@pytest.mark.parametrize("seed", [12, 13])
def test_four_robots_water_twelve_pots_and_never_touch(seed):
    async def told(garden):
        nearest = []
        watch = asyncio.create_task(story.keep_apart(garden, nearest))
        tasks = [await story.served(garden, plant.id, 900.0) for plant in garden.scenario.plants]
        watch.cancel()
        assert {task["robot_id"] for task in tasks} == {robot.id for robot in garden.scenario.robots}
        for task in tasks:
            assert garden.truth().plant(task["plant_id"]).poured_ml <= story.allowed_ml(task)
        assert nearest[0] >= story.TOUCHING_M
        print("all watered after", round(max(task["updated_s"] for task in tasks)), "s; nearest", round(nearest[0], 3), "m")
        story.unhurt(garden)

    story.tell(scenario.load(FIELD), told, seed)
