"""Two robots in one garden: the work is shared, the bodies are not."""

from __future__ import annotations

import asyncio

import pytest

from core.scenario import find
from lab import story
from robot_service.navigator import STUCK_S


def test_two_dry_pots_are_served_at_once_by_two_robots_that_never_touch():
    async def told(garden):
        nearest = []
        watch = asyncio.create_task(story.keep_apart(garden, nearest))
        tasks = [await story.served(garden, plant_id) for plant_id in ("plant-1", "plant-4")]
        watch.cancel()
        assert {task["robot_id"] for task in tasks} == {"robot-1", "robot-2"}
        assert max(task["updated_s"] for task in tasks) < 150.0
        assert nearest[0] >= story.TOUCHING_M
        story.unhurt(garden)

    story.tell(story.garden_of(("plant-1", "plant-4")), told)


def crossing(rooms: int) -> tuple[dict[str, tuple[float, float]], ...]:
    """Errands whose straight lines cross in the middle, or that lead two robots head on."""
    return (
        {"robot-1": (1.4, -0.2), "robot-2": (-1.4, 0.2)},
        {"robot-1": (0.0, -1.2), "robot-2": (0.0, 1.2)},
        {"robot-1": (0.3, -1.2), "robot-2": (0.0, 1.25)},
    )[:rooms]


async def cross(garden, goals) -> float:
    """Send both; the smallest distance between them until both have arrived."""
    nearest = []
    watch = asyncio.create_task(story.keep_apart(garden, nearest))
    jobs = {}
    for name, (x_m, y_m) in goals.items():
        answer = await garden.post(name, "/jobs", {"kind": "goto", "x_m": x_m, "y_m": y_m})
        assert answer.status_code == 202, answer.text
        jobs[name] = answer.headers["location"]

    async def over():
        states = [(await garden.get(name, place))["state"] for name, place in jobs.items()]
        return all(state in ("done", "failed", "cancelled") for state in states)

    assert await garden.until(over, STUCK_S), await story.standing(garden)
    watch.cancel()
    for name, place in jobs.items():
        job = await garden.get(name, place)
        assert job["state"] == "done", job
    return nearest[0]


def both_ready(garden):
    async def ready():
        return all([(await garden.get(r.id, "/state"))["pose"] is not None for r in garden.scenario.robots])

    return garden.until(ready, 10.0)


@pytest.mark.parametrize("seed", [1])
def test_crossing_robots_give_way_and_both_arrive(seed):
    async def told(garden):
        assert await both_ready(garden)
        for goals in crossing(2):
            assert await cross(garden, goals) >= story.TOUCHING_M
        story.unhurt(garden)

    story.tell(story.garden_of((), ("plant-1", "plant-2", "plant-3", "plant-4")), told, seed)


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(2, 14))
def test_crossing_robots_give_way_whatever_the_seed(seed):
    async def told(garden):
        assert await both_ready(garden)
        for goals in crossing(3):
            assert await cross(garden, goals) >= story.TOUCHING_M
        story.unhurt(garden)

    story.tell(story.garden_of((), tuple(p.id for p in find("garden").plants)), told, seed)
