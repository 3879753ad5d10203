"""Two rooms, and between them an aisle that one robot fits through: whoever meets there, all get through."""

import math

import pytest
from plane import TOUCH_M, walk
from standin import in_garden

from core.robots.garden_map import GardenMap, KnownPot
from core.scenario import Arena, Plant, Robot, Scenario, Station, StationDock

ROOM_M, WIDTH_M, GAP_M = 1.9, 2.4, 0.52
"""A room's length, the garden's width, and how wide the aisle is free: a robot's 0.35 m, what planning keeps, no more."""


def posts(long_m):
    """The aisle's walls as discs, so near to one another that nobody passes between them."""
    count = math.ceil(long_m / 0.3)
    xs = [long_m * (i / count - 0.5) for i in range(count + 1)]
    rows = [GAP_M / 2 + 0.2 + 0.3 * row for row in range(3)]
    return [
        KnownPot(plant_id=f"post-{x:.1f}/{s * y:.2f}", x_m=x, y_m=s * y, radius_m=0.2)
        for x in xs
        for y in rows
        for s in (-1, 1)
    ]


def rooms(long_m):
    """The map, and places in the rooms: (side, y) to a pose that looks towards the aisle, or away from it."""
    garden = GardenMap(length_m=long_m + 2 * ROOM_M, width_m=WIDTH_M, pots=posts(long_m))
    x_m = long_m / 2 + ROOM_M / 2
    return garden, lambda side, y_m: (side * x_m, y_m, 0.0 if side < 0 else math.pi)


WEST, EAST = -1, 1
MEETINGS = {
    "one against one": [(WEST, 0.3, EAST, 0.3), (EAST, -0.3, WEST, -0.3)],
    "two against one": [(WEST, 0.6, EAST, 0.6), (WEST, -0.6, EAST, -0.6), (EAST, 0.0, WEST, 0.0)],
    "two against two": [(WEST, 0.6, EAST, 0.6), (EAST, -0.6, WEST, -0.6), (WEST, -0.6, EAST, -0.6), (EAST, 0.6, WEST, 0.6)],
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("long_m", [1.2, 3.6])
@pytest.mark.parametrize("who", MEETINGS)
def test_robots_that_meet_in_an_aisle_all_arrive_and_never_touch(who, long_m, seed):
    print(f"seed {seed}")
    garden, place = rooms(long_m)
    tasks = [(place(side, y_m), place(to, to_y_m)) for side, y_m, to, to_y_m in MEETINGS[who]]
    took_s, closest_m, walkers = walk(garden, tasks, seed, 250.0, 0.05)
    assert closest_m > TOUCH_M + 0.03, f"{closest_m:.3f} m apart"
    assert took_s < 250.0, [(w.name, w.arrived_s, w.pose, w.why) for w in walkers]


def test_robots_that_begin_inside_the_aisle_face_to_face_get_out_again():
    garden, place = rooms(3.6)
    tasks = [((-0.3, 0.0, 0.0), place(EAST, 0.0)), ((0.3, 0.0, math.pi), place(WEST, 0.0))]
    took_s, closest_m, walkers = walk(garden, tasks, 1, 250.0, 0.05)
    assert closest_m > TOUCH_M + 0.03
    assert took_s < 250.0, [(w.name, w.arrived_s, w.pose, w.why) for w in walkers]


def aisle_garden(long_m):
    """A pot with its dock in either room, a tap in the west, a robot at home in each room."""
    half_m = long_m / 2 + ROOM_M
    plants = (
        Plant(id="plant-west", x_m=-half_m + 0.3, y_m=0.45, dock_yaw_deg=0.0),
        Plant(id="plant-east", x_m=half_m - 0.3, y_m=-0.45, dock_yaw_deg=180.0),
    )
    robots = (
        Robot(id="robot-1", x_m=-long_m / 2 - 0.5, y_m=-0.85),
        Robot(id="robot-2", x_m=long_m / 2 + 0.5, y_m=0.85, yaw_deg=180.0),
    )
    station = Station(docks=(StationDock(id="tap", x_m=-half_m + 0.3, y_m=-0.75, dock_yaw_deg=0.0, tap=True),))
    return Scenario(arena=Arena(length_m=2 * half_m, width_m=WIDTH_M), plants=plants, robots=robots, station=station)


LOST = [pytest.param(seed, 0.2, marks=pytest.mark.soak) for seed in range(1, 7)]
HEARD = [(1, 0.0), *(pytest.param(seed, 0.0, marks=pytest.mark.soak) for seed in range(2, 9))]


@pytest.mark.parametrize(("seed", "loss_ratio"), [*HEARD, *LOST])
def test_robots_with_tasks_at_the_other_ends_of_an_aisle_do_them_and_change_places_again(seed, loss_ratio):
    """Whole brains: first from their homes, then each from the dock that the other one is awarded.

    `loss_ratio` of what one robot asks the other is lost, and as much of the answers.
    """

    async def story(garden):
        for way in (("robot-1", "robot-2"), ("robot-2", "robot-1")):
            garden.mesh.leg(*way).loss_ratio = loss_ratio
        for number, (first, second) in enumerate((("plant-east", "plant-west"), ("plant-west", "plant-east")), 1):
            plants = garden.plants[first], garden.plants[second]
            await garden.award(first, "robot-1", number, dose_ml=30.0)
            await garden.award(second, "robot-2", number, dose_ml=30.0)
            await garden.until(lambda p=plants, n=number: all(len(done(plant)) == n for plant in p), 400.0)
            assert [done(plant)[-1].state for plant in plants] == ["done", "done"]
        assert garden.plane.closest_m > TOUCH_M + 0.02

    in_garden(story, seed, scenario=aisle_garden(2.4), robots=2, walls=posts(2.4), spread_after_s=0.0)


def done(plant):
    """The ends that a plant was told of, one a robot."""
    ends = {}
    for report in plant.reports:
        if report.state in ("done", "failed"):
            ends.setdefault((report.robot_id, report.epoch), report)
    return list(ends.values())
