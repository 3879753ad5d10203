"""Robots never touch, and always arrive."""

import math
import random

import pytest
from plane import TOUCH_M, free_poses, walk

from core.allocation.right_of_way import KEEP_M, Other, goes_first, growth_m, in_the_way_of, route_gap_m, speed_limit_mps
from core.robots.garden_map import GardenMap, KnownPot, map_of
from core.scenario import find

GARDEN = map_of(find("garden"))
GATE = GardenMap(
    length_m=4.0,
    width_m=2.4,
    pots=[
        KnownPot(plant_id=f"post-{i}", x_m=0.0, y_m=s * y, radius_m=0.2)
        for i, y in enumerate((0.46, 0.8, 1.1))
        for s in (-1, 1)
    ],
)
"""Two rooms and one gap that a single robot fits through."""
WEST, EAST, NORTH, SOUTH = (-1.5, 0.0, 0.0), (1.5, 0.0, math.pi), (0.0, 1.2, -math.pi / 2), (0.0, -1.2, math.pi / 2)


def check(garden, tasks, seed, within_s=120.0, **how):
    print(f"seed {seed}")
    took_s, closest_m, walkers = walk(garden, tasks, seed, within_s, **how)
    assert closest_m > TOUCH_M + 0.03, f"seed {seed}: {closest_m:.3f} m apart"
    assert took_s < within_s, f"seed {seed}: {[(w.name, w.arrived_s, w.pose, w.why) for w in walkers]}"


@pytest.mark.parametrize("seed", range(5))
def test_two_robots_pass_one_gap_head_on(seed):
    check(GATE, [(WEST, EAST), (EAST, WEST)], seed)


@pytest.mark.parametrize("seed", range(5))
def test_two_robots_swap_places_across_the_corridor_between_the_pots(seed):
    check(GARDEN, [(NORTH, SOUTH), (SOUTH, NORTH)], seed)


@pytest.mark.parametrize("seed", range(3))
def test_three_robots_change_places_in_a_ring(seed):
    check(GARDEN, [(NORTH, SOUTH), (SOUTH, EAST), (EAST, NORTH)], seed)


@pytest.mark.parametrize("seed", range(3))
def test_an_idle_robot_on_the_only_way_makes_room_and_comes_back(seed):
    check(GATE, [(WEST, EAST), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))], seed)


def test_a_silent_robot_stays_an_obstacle_at_its_last_place():
    check(GARDEN, [(NORTH, SOUTH), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))], 1, silent=frozenset({1}))


def test_two_robots_with_random_goals_never_touch_and_always_arrive():
    for seed in range(160):
        rng = random.Random(seed)
        starts, goals = free_poses(GARDEN, 2, rng, 0.5), free_poses(GARDEN, 2, rng, 0.6)
        check(GARDEN, list(zip(starts, goals, strict=True)), seed)


def test_three_robots_with_random_goals_never_touch_and_always_arrive():
    for seed in range(40):
        rng = random.Random(seed)
        starts, goals = free_poses(GARDEN, 3, rng, 0.5), free_poses(GARDEN, 3, rng, 0.6)
        check(GARDEN, list(zip(starts, goals, strict=True)), seed, cell_m=0.05)


def test_the_lower_rank_goes_first_and_ids_break_ties():
    other = Other(robot_id="robot-2", x_m=0, y_m=0, rank=1)
    assert goes_first((0, "robot-9"), other)
    assert goes_first((1, "robot-1"), other)
    assert not goes_first((1, "robot-3"), other)


def test_nobody_counts_on_a_silent_or_docked_robot_to_give_way():
    assert not goes_first((0, "robot-1"), Other(robot_id="robot-2", x_m=0, y_m=0, rank=2, age_s=10.0))
    assert not goes_first((0, "robot-1"), Other(robot_id="robot-2", x_m=0, y_m=0, rank=2, docked=True))


def test_a_robot_may_not_drive_towards_where_another_may_be_but_away_from_it():
    near = Other(robot_id="robot-2", x_m=KEEP_M + 0.1, y_m=0.0, moving=True, v_mps=0.3, age_s=0.5)
    assert speed_limit_mps((0.0, 0.0, 0.0), True, [near]) == (0.0, "robot-2")
    assert speed_limit_mps((0.0, 0.0, math.pi), True, [near])[0] == math.inf
    assert speed_limit_mps((0.0, 0.0, 0.0), False, [near])[0] == math.inf


def test_what_is_known_of_a_moving_neighbour_grows_with_age_and_ends():
    ages = [growth_m(Other(robot_id="a", x_m=0, y_m=0, moving=True, v_mps=0.3, age_s=age)) for age in (0.0, 0.5, 5.0)]
    assert ages == sorted(ages)
    assert ages[0] == 0.0
    assert ages[2] == pytest.approx(0.3)


def test_who_stands_on_an_earlier_robots_route_is_in_its_way():
    passing = Other(robot_id="robot-1", x_m=-1, y_m=0, rank=1, route=((-1.0, 0.0), (0.5, 0.0)))
    assert in_the_way_of((2, "robot-2"), (0.0, 0.3, 0.0), [passing]) is passing
    assert in_the_way_of((2, "robot-2"), (0.0, 0.6, 0.0), [passing]) is None
    assert in_the_way_of((0, "robot-2"), (0.0, 0.3, 0.0), [passing]) is None


def test_the_distance_to_a_route_is_that_to_its_nearest_point():
    assert route_gap_m((0.5, 0.2), [(0.0, 0.0), (1.0, 0.0)]) == pytest.approx(0.2)
    assert route_gap_m((2.0, 0.0), [(0.0, 0.0), (1.0, 0.0)]) == pytest.approx(1.0)
    assert route_gap_m((0.0, 0.0), []) == math.inf
