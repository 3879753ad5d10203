"""A pot's metrics move with what they are about."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from core.clock import VirtualClock
from core.errors import StorageError
from core.store import Disk, DurableDocument
from core.virtual import run_virtual
from plant_service.keeper import Keeper
from plant_service.metrics import stores
from plant_service.station import Meter, TapDocument

Play = Callable[[Any], None]
TREE = {(0.1, 0.06 * i - 0.15, 0.2): "green" for i in range(6)}
_LINE = re.compile(r"^(\w+)(?:\{(.*)\})? (\S+)$")


async def read(garden: Any, plant_id: str = "plant-1") -> dict[str, float]:
    """`name{a="b"}` -> value."""
    text = (await garden.call(plant_id, "GET", "/metrics")).text
    found = (_LINE.match(line) for line in text.splitlines())
    return {f"{m[1]}{{{m[2]}}}" if m[2] else m[1]: float(m[3]) for m in found if m is not None}


def test_a_watering_shows_in_tasks_permits_doses_soil_stores_and_messages(play: Play) -> None:
    async def story(garden: Any) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.195)
        before = await read(garden)
        assert before['garden_soil_state{state="unknown"}'] == 1
        assert "garden_soil_ratio" not in before
        await garden.until_task("running")
        asked = await read(garden)
        assert asked['garden_tasks_open{kind="water",state="running"}'] == 1
        assert asked['garden_soil_state{state="good"}'] == 1
        await garden.clock.sleep(5.0)
        later = await read(garden)
        name = 'garden_tasks_oldest_seconds{kind="water",state="running"}'
        assert abs(later[name] - asked[name] - 5.0) < 0.1
        await garden.until_task("done")
        after = await read(garden)
        assert after["garden_market_awards_total"] == after["garden_market_permits_total"] == 1
        assert after['garden_tasks_ended_total{state="done"}'] == 1
        assert after['garden_tasks_open{kind="water",state="running"}'] == 0
        assert after["garden_dosed_today_ml"] == robot.poured_ml > 0
        assert after["garden_soil_ratio"] > asked["garden_soil_ratio"]
        assert after['garden_store_commits_total{store="market"}'] > asked['garden_store_commits_total{store="market"}']
        assert after['garden_store_commit_seconds_total{store="market"}'] > 0
        assert after['garden_mesh_requests_total{outcome="answered",peer="robot-1"}'] >= 2
        assert after['garden_events_total{kind="done"}'] == 1
        assert after["garden_market_leases_lost_total"] == after["garden_market_reawards_total"] == 0

    play(story)


def test_a_robot_that_dies_shows_as_a_lost_lease_a_kill_and_silence(play: Play) -> None:
    async def story(garden: Any) -> None:
        robot = garden.robot("robot-1")
        robot.die_before_act = True
        garden.pot()
        await garden.until_task("running")
        await garden.clock.sleep(60.0)
        told = await read(garden)
        assert told["garden_market_leases_lost_total"] == told["garden_market_kills_total"] == 1
        assert told["garden_permit_open"] == 1
        assert told['garden_mesh_requests_total{outcome="silent",peer="robot-1"}'] >= 1
        assert told["garden_waiting"] == 1

    play(story)


def test_a_cheaper_robot_shows_as_a_re_award_and_a_refused_award_as_that(play: Play) -> None:
    async def story(garden: Any) -> None:
        first, second = garden.robot("robot-1", 3.0), garden.robot("robot-2", 4.0)
        first.start_s = 60.0
        second.refuse_awards = "busy"
        garden.pot()
        await garden.until_task("awarded")
        first.cost = lambda _: 7.0
        await garden.clock.sleep(15.0)
        told = await read(garden)
        assert told["garden_market_reawards_total"] >= 1
        assert told["garden_market_awards_refused_total"] >= 1
        assert told["garden_market_rounds_total"] >= 2

    play(story)


def test_a_dose_that_does_not_arrive_a_held_dock_and_a_broken_probe_show(play: Play) -> None:
    async def story(garden: Any) -> None:
        robot = garden.robot("robot-1")
        robot.pump_blocked = True
        garden.pot()
        wish = {"robot_id": "robot-1", "for_s": 600.0}
        await garden.until_task("awarded")
        await garden.call("plant-1", "POST", "/dock/reservations", who="robot-1", role="robot", json=wish)
        other = wish | {"robot_id": "robot-2"}
        await garden.call("plant-1", "POST", "/dock/reservations", who="robot-2", role="robot", json=other)
        told = await read(garden)
        assert told['garden_dock_held{dock="plant-1"}'] == told['garden_dock_wanted{dock="plant-1"}'] == 1
        await garden.clock.sleep(120.0)
        assert (await read(garden))["garden_market_doses_lost_total"] >= 1
        garden.soils["plant-1"].fault = lambda: 5.0
        await garden.clock.sleep(20.0)
        told = await read(garden)
        assert told['garden_soil_state{state="short"}'] == 1
        assert told['garden_soil_state{state="good"}'] == 0
        assert "garden_soil_ratio" not in told

    play(story)


def test_a_disk_that_fails_shows_as_a_failure_and_a_store_that_acknowledges_nothing(tmp_path: Path) -> None:
    class BadDisk(Disk):
        def fsync(self, fd: int) -> None:
            raise OSError(5, "Input/output error")

    async def told() -> dict[str, float]:
        file = DurableDocument(tmp_path / "tap.json", "tap/1", VirtualClock(), BadDisk())
        meter = Keeper(file, TapDocument, Meter)
        with pytest.raises(StorageError):
            await meter.change(lambda machine: machine.debit(5.0))
        meter.close()
        assert meter.machine.dispensed_ml == 0.0
        return {one.name: one.value for one in stores([meter]) if one.labels == {"store": "tap"}}

    values = run_virtual(told())
    assert values["garden_store_broken"] == values["garden_store_failures_total"] == 1


def test_a_fruit_that_scans_do_not_find_any_more_is_counted_as_lost(play: Play) -> None:
    async def story(garden: Any) -> None:
        robot = garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True)

        async def scanned(times: int) -> bool:
            return bool(robot.scans >= times)

        await garden.until(lambda: scanned(1), 200.0)
        assert 'garden_fruit_lost_total{colour="green"}' in await read(garden)
        assert (await read(garden))['garden_fruit_lost_total{colour="green"}'] == 0
        robot.tree.popitem()
        lost = 0.0
        for number in range(2, 8):
            await garden.call("plant-1", "POST", "/tasks", json={"kind": "inventory"})
            await garden.until(lambda n=number: scanned(n), 200.0)
            await garden.clock.sleep(5.0)
            lost = (await read(garden))['garden_fruit_lost_total{colour="green"}']
            if lost:
                break
        assert lost == 1
        assert (await read(garden))['garden_fruit{colour="green"}'] == 5

    play(story)
