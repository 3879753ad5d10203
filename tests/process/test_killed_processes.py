"""Real processes and real signals: what a kill stops, and what it cannot take away."""

from __future__ import annotations

import os
from pathlib import Path
from signal import SIGCONT, SIGKILL, SIGSTOP

import pytest
from real_garden import RealGarden, UpGarden

from core.robots import gardener
from lab import story
from sim.clockwork import TICK_S
from sim.keeping import EVERY_S

pytestmark = pytest.mark.alone

FAST = 6.0
SLOW = 0.25
"""Looking over HTTP takes little garden time at this speed."""
RESTING = 20.0
"""While nothing moves."""
STOP_WITHIN_S = story.STOP_WITHIN_S + TICK_S
"""The world is looked at between two of its ticks."""
LOST_S = 2 * EVERY_S
"""Of the world's life, at most, when it is killed: a checkpoint's distance and the time to write it [wall s]."""
SOAK = {"plant-1": {"PLANT_SOAK_S": "10"}}


def drives(garden: RealGarden) -> bool:
    return all(abs(v) > 0.1 for v in garden.robot().wheels_mps)


def docks(garden: RealGarden) -> bool:
    return bool(garden.get("robot-1", "/state")["job"] == "dock")


def seeks(garden: RealGarden) -> bool:
    """On the way from the launch point to the dock, driven by the Create itself."""
    truth = garden.robot()
    on_the_way = truth.v_mps > 0.02 and -1.5 < truth.pose.x_m < -1.2 and abs(truth.pose.y_m - 0.75) < 0.2
    return on_the_way and docks(garden)


def pumps(garden: RealGarden) -> bool:
    """Well into the dose: so much arrived that the pot can see it, and a broken dose counts as given."""
    truth = garden.robot()
    return truth.pumping and truth.pumped_ml > 0.35 * story.DOSE_ML


def test_a_brain_that_hangs_stops_its_wheels_and_a_killed_pot_keeps_its_word(tmp_path):
    scenario = story.water_only(story.garden_of(("plant-1",), ("plant-3",), (story.near_robot(),)))
    with RealGarden(tmp_path / "g", scenario, FAST) as garden:
        garden.start("sim", "plant-1", "plant-3", "robot-1-body", "robot-1")
        garden.until(lambda: drives(garden), 60.0)
        garden.run_at(SLOW)
        garden.until(lambda: drives(garden), 60.0)
        told_s, _ = garden.stops_after("robot-1", SIGSTOP)
        assert told_s <= STOP_WITHIN_S
        garden.signal("robot-1", SIGCONT)
        garden.until(lambda: drives(garden), 60.0)

        answer = garden.post("plant-3", "/tasks", {"kind": "water", "dose_ml": 50.0})
        assert answer.status_code in (201, 202), answer.text
        garden.signal("plant-3", SIGKILL)
        garden.start("plant-3")
        known = []
        garden.until(lambda: known.extend(garden.get("plant-3", "/tasks")) or bool(known), 20.0)
        assert [task["task_id"] for task in known] == [answer.json()["task_id"]]
        assert known[0]["state"] in ("announced", "awarded")


def test_a_brain_killed_while_it_drives_docks_or_pumps_stops_and_the_pot_gets_one_dose(tmp_path):
    with RealGarden(tmp_path / "g", story.water_only(story.one_pot()), FAST, SOAK) as garden:
        garden.start("sim", "plant-1", "robot-1-body", "robot-1")
        for soon, moment in ((drives, drives), (docks, seeks), (pumps, pumps)):
            garden.until(lambda soon=soon: soon(garden), 120.0)
            garden.run_at(SLOW)
            garden.until(lambda moment=moment: moment(garden), 60.0)
            _, stood_s = garden.stops_after("robot-1", SIGKILL)
            print(f"killed while it {moment.__name__}: stood after {stood_s:.3f} s")
            assert stood_s <= STOP_WITHIN_S
            garden.run_at(FAST)
            garden.start("robot-1")
        begun_ml = garden.poured_ml("plant-1")
        garden.run_at(RESTING)
        task = garden.served("plant-1", 90.0)
        assert begun_ml <= 0.5 * story.DOSE_ML
        assert task["permits"] == 1
        # Still dry, the pot may have asked again meanwhile; beyond the broken dose comes only what the new task permits.
        poured_ml = garden.poured_ml("plant-1")
        later_ml = sum(story.allowed_ml(later) for later in garden.get("plant-1", "/tasks")[1:])
        assert poured_ml == begun_ml or poured_ml <= begun_ml + later_ml
        garden.until(lambda: len(garden.get("plant-1", "/tasks")) > 1, 60.0)
        assert garden.get("plant-1", "/tasks")[1]["asked_by"] == "soil"
        garden.unhurt()


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for processes in /proc")
def test_a_killed_world_comes_back_both_pots_are_served_and_all_ends_on_sigint(tmp_path):
    robots = (story.near_robot(), story.near_robot(id="robot-2", x_m=1.60, y_m=-0.42, yaw_deg=-90.0))
    pots = ("plant-1", "plant-4")
    with UpGarden(tmp_path / "g", story.water_only(story.garden_of(pots, robots=robots)), FAST) as garden:
        garden.ready(90.0)
        assert len(garden.pids()) == len(garden.listed) + 1
        garden.until(lambda: pumps(garden), 120.0)
        known = {name: garden.get(name, "/tasks")[0] for name in pots}
        before = garden.truth()
        os.kill(garden.pids("sim")[0], SIGKILL)
        garden.until(lambda: garden.truth().time_s >= before.time_s, 60.0)
        back = garden.truth()
        # The world remembers itself as of its last checkpoint, and nothing runs that nobody asked for since.
        for plant_id in pots:
            lost_ml = before.plant(plant_id).poured_ml - back.plant(plant_id).poured_ml
            assert lost_ml <= LOST_S * garden.speed * gardener.PUMP_MLPS * (1 + story.PUMP_ERROR_RATIO)
        assert all(story.stands(robot) for robot in back.robots)

        for plant_id, task in known.items():
            ended = garden.served(plant_id, 240.0)
            assert (ended["task_id"], ended["created_s"]) == (task["task_id"], task["created_s"])
            assert ended["epoch"] >= task["epoch"]
            assert ended["permits"] >= task["permits"]
            assert 0.0 < garden.poured_ml(plant_id) <= story.allowed_ml(ended)
        assert '"process": "sim"' in garden.told()
        garden.unhurt()
        garden.ends()
        assert garden.pids() == []
