"""Scenario files are checked whole and every mistake is named."""

import math

import pytest

from core.errors import ConfigError
from core.scenario import SCENARIOS_DIR, find, launch_pose, load

GOOD = (SCENARIOS_DIR / "garden" / "scenario.toml").read_text()


def write(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_the_default_garden_is_the_papers():
    garden = find("garden")
    assert (garden.arena.length_m, garden.arena.width_m) == (4.0, 3.0)
    assert (len(garden.plants), len(garden.robots)) == (4, 2)
    assert any(plant.moisture_ratio < plant.threshold_ratio for plant in garden.plants)


def test_a_docked_robot_faces_its_stem_from_the_docks_side():
    garden = find("garden")
    for plant in garden.plants:
        bearing = math.atan2(plant.y_m - plant.dock.y_m, plant.x_m - plant.dock.x_m)
        assert math.isclose(math.remainder(bearing - plant.dock.yaw_rad, math.tau), 0.0, abs_tol=1e-9)


def test_the_launch_point_lies_behind_the_docked_pose():
    dock = find("garden").plants[0].dock
    launch = launch_pose(dock)
    assert launch.yaw_rad == dock.yaw_rad
    ahead = (dock.x_m - launch.x_m) * math.cos(dock.yaw_rad) + (dock.y_m - launch.y_m) * math.sin(dock.yaw_rad)
    assert ahead > 0.4


MISTAKES = {
    "not TOML": ("[[plants", "not TOML"),
    "an unknown key": (GOOD + "\nwater = true\n", "water"),
    "a pot outside": (GOOD.replace("y_m = 0.75", "y_m = 9.0", 1), "outside the arena"),
    "two pots of one name": (GOOD.replace('id = "plant-2"', 'id = "plant-1"'), "used twice"),
    "a target below the threshold": (GOOD.replace("moisture_ratio = 0.15", "target_ratio = 0.1"), "target_ratio"),
    "no tap": (GOOD.replace("tap = true", "tap = false"), "never refill"),
    "a robot in a pot": (GOOD.replace("x_m = 0.0\ny_m = 1.20", "x_m = -0.55\ny_m = 0.75"), "overlap"),
    "a dock over the edge": (GOOD.replace("dock_yaw_deg = 180.0", "dock_yaw_deg = 90.0", 1), "cannot reach dock plant-1"),
    "a word for a number": (GOOD.replace("speed = 3.0", 'speed = "fast"'), "speed"),
    "nan": (GOOD.replace("x_m = -0.55", "x_m = nan", 1), "plants.0.x_m"),
    "a negative speed": (GOOD.replace("speed = 3.0", "speed = -1"), "speed"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_a_scenario_is_named(tmp_path, mistake):
    text, told = MISTAKES[mistake]
    with pytest.raises(ConfigError, match=told):
        load(write(tmp_path, text))


def test_all_mistakes_are_told_at_once(tmp_path):
    text = GOOD.replace("tap = true", "tap = false").replace('id = "plant-2"', 'id = "plant-1"')
    with pytest.raises(ConfigError, match=r"used twice.*never refill"):
        load(write(tmp_path, text))


def test_a_missing_scenario_names_the_ones_there_are(tmp_path):
    with pytest.raises(ConfigError) as caught:
        find(str(tmp_path / "nowhere"))
    assert "garden" in caught.value.hint
