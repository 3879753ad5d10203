"""SIGKILL of a pot, a body or a station at its worst instants: it comes back, and nothing acknowledged is lost.

A rehearsal of the same seed tells when a document became durable; the story is then played again up to a millisecond
before or after that instant.
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from core.robots import gardener
from core.virtual import run_virtual
from lab import story

DEAD_S = 2.0


def on_disk(folder: Path) -> dict:
    """The pot's market as a restarted pot would find it."""
    try:
        return json.loads((folder / "plant-1" / "market.json").read_text())["doc"]
    except FileNotFoundError:
        return {}


@pytest.fixture(scope="module")
def durable_s() -> dict[str, float]:
    """When each milestone of a watering became durable [garden s]."""
    seen: dict[str, float] = {}

    async def watch(garden):
        stamp = None
        while True:
            file = garden.folder / "plant-1" / "market.json"
            if file.exists() and (new := file.stat().st_mtime_ns) != stamp:
                stamp = new
                note(on_disk(garden.folder), garden.clock.now())
            await garden.clock.sleep(0.001)

    def note(document, now_s):
        permit = document.get("open_permit")
        for task in document.get("tasks", ()):
            seen.setdefault("asked", now_s)
            if task["state"] == "awarded":
                seen.setdefault("awarded", now_s)
        if permit:
            seen.setdefault("permitted", now_s)
            if permit["finished"]:
                seen.setdefault("reported", now_s)

    async def rehearse():
        async with story.growing(story.one_pot()) as garden:
            watching = asyncio.create_task(watch(garden))
            await story.phase(garden, "plant-1", "soaking")
            watching.cancel()

    run_virtual(rehearse())
    return seen


@pytest.mark.parametrize(
    ("milestone", "after_s"),
    [
        ("asked", -0.002),
        pytest.param("asked", 0.001, marks=pytest.mark.soak),
        ("awarded", -0.002),
        ("awarded", 0.001),
        pytest.param("awarded", 5.0, marks=pytest.mark.soak),
        ("permitted", -0.002),
        ("permitted", 0.001),
        ("permitted", 6.0),
        pytest.param("reported", -0.002, marks=pytest.mark.soak),
        ("reported", 0.001),
        ("reported", 20.0),
    ],
)
def test_a_pot_killed_at_a_worst_instant_finishes_what_it_began(durable_s, milestone, after_s):
    async def told(garden):
        await garden.clock.sleep(durable_s[milestone] + after_s)
        await garden.kill("plant-1")
        before = on_disk(garden.folder)
        await garden.clock.sleep(DEAD_S)
        garden.start("plant-1")
        await garden.clock.sleep(0.01)
        known = {task["task_id"]: task for task in await garden.get("plant-1", "/tasks")}
        for task in before.get("tasks", ()):
            assert known[task["task_id"]]["epoch"] >= task["epoch"]
            assert known[task["task_id"]]["permits"] == task["permits"]
        task = await story.served(garden, "plant-1")
        assert garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
        assert task["permits"] == 1
        story.unhurt(garden)

    story.tell(story.one_pot(), told)


def drives(garden) -> bool:
    return story.robot(garden).v_mps > 0.1


def seeks(garden) -> bool:
    truth = story.robot(garden)
    return truth.v_mps > 0.02 and truth.pose.x_m < -1.2 and abs(truth.pose.y_m - 0.75) < 0.2


def pumps(garden) -> bool:
    return story.robot(garden).pumped_ml > 30.0


@pytest.mark.parametrize("moment", [drives, seeks, pumps])
def test_a_body_that_comes_back_stops_its_devices_before_anything_else(moment):
    """While a body is dead nobody can tell its devices to stop; that is why it does so little and starts so fast."""
    dead_s = 0.3

    async def told(garden):
        await story.when(garden, lambda: moment(garden))
        await garden.kill("robot-1-body")
        await garden.clock.sleep(dead_s)
        garden.start("robot-1-body")
        await story.when(garden, lambda: story.stands(story.robot(garden)), story.STOP_WITHIN_S)
        task = await story.served(garden, "plant-1")
        extra_ml = gardener.PUMP_MLPS * (dead_s + story.STOP_WITHIN_S)
        assert garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task) + extra_ml
        assert garden.truth().spilt_ml == 0.0

    story.tell(story.one_pot(), told)


def test_a_station_killed_while_its_tap_runs_comes_back_and_the_robot_fills_its_tank():
    async def told(garden):
        await story.when(garden, lambda: garden.truth().tap_open, 60.0)
        await garden.kill("station")
        await garden.clock.sleep(DEAD_S)
        garden.start("station")
        task = await story.served(garden, "plant-1", 400.0)
        assert task["permits"] == 1
        assert story.robot(garden).tank_ml > 1000.0
        story.unhurt(garden)

    story.tell(story.one_pot(tank_ml=40.0), told)
