"""Robots never touch, and always arrive."""

import math
import random

import pytest
from plane import TOUCH_M, free_poses, walk

from core.allocation.right_of_way import (
    BRAKE_S,
    CLEAR_M,
    KEEP_M,
    RANK_BUSY,
    RANK_DRIVING,
    RANK_IDLE,
    ROUTE_M,
    SILENT_S,
    Other,
    along,
    goes_first,
    growth_m,
    in_the_way_of,
    keep_m,
    route_gap_m,
    speed_limit_mps,
)
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


def other(**more):
    return Other(robot_id="robot-2", **({"x_m": 1.0, "y_m": 0.0} | more))


def test_the_distances_and_times_are_these():
    assert pytest.approx(2 * 0.174 + 0.10) == KEEP_M
    assert (SILENT_S, BRAKE_S, CLEAR_M, ROUTE_M) == (5.0, 0.6, 0.06, 1.5)
    assert (RANK_BUSY, RANK_DRIVING, RANK_IDLE) == (0, 1, 2)
    quiet = Other(robot_id="robot-2", x_m=0.0, y_m=0.0)
    assert (quiet.v_mps, quiet.moving, quiet.docked, quiet.rank, quiet.route, quiet.age_s) == (0.0, False, False, 2, (), 0.0)


def test_five_seconds_without_a_word_are_not_silence_yet():
    assert not other(age_s=5.0).silent
    assert other(age_s=5.01).silent


def test_ones_own_equal_does_not_go_second():
    assert not goes_first((2, "robot-2"), other(rank=2))


@pytest.mark.parametrize(
    ("told", "growth"),
    [
        ({"age_s": 1.0}, 0.15),
        ({"age_s": 1.9}, 0.285),
        ({"age_s": 2.1}, 0.30),
        ({"age_s": 0.5, "moving": True}, 0.15),
        ({"age_s": 0.5, "moving": True, "v_mps": 0.4}, 0.20),
        ({"age_s": 1.0, "docked": True}, 0.0),
        ({"age_s": 0.5, "docked": True, "moving": True}, 0.15),
        ({"age_s": 1.0, "v_mps": 0.4}, 0.15),
    ],
)
def test_how_far_it_may_have_come_by_now(told, growth):
    assert growth_m(other(**told)) == pytest.approx(growth)
    assert keep_m(other(**told)) == pytest.approx(KEEP_M + growth)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7, -2.0])
@pytest.mark.parametrize("forward", [True, False])
def test_the_speed_left_is_what_stops_within_the_braking_time_along_the_heading(yaw_rad, forward):
    heading = yaw_rad if forward else yaw_rad + math.pi
    for off_rad in (0.0, 0.3, -0.3):
        ahead = other(x_m=2.0 + math.cos(heading + off_rad), y_m=-1.0 + math.sin(heading + off_rad))
        limit_mps, by = speed_limit_mps((2.0, -1.0, yaw_rad), forward, [ahead])
        assert limit_mps == pytest.approx((1.0 - KEEP_M) / 0.6 / math.cos(off_rad))
        assert by == "robot-2"


def test_who_will_be_passed_at_a_distance_or_is_behind_limits_nobody():
    here = (0.0, 0.0, 0.0)
    assert speed_limit_mps(here, True, [other(y_m=KEEP_M + 1e-6)]) == (math.inf, "")
    assert speed_limit_mps(here, True, [other(y_m=KEEP_M - 0.001)])[0] < math.inf
    assert speed_limit_mps(here, True, [other(x_m=0.0, y_m=0.2)]) == (math.inf, "")
    assert speed_limit_mps(here, True, [other(x_m=-0.001, y_m=0.2)]) == (math.inf, "")
    assert speed_limit_mps(here, True, [other(x_m=0.0)]) == (math.inf, "")
    assert speed_limit_mps(here, True, []) == (math.inf, "")


def test_the_nearest_limits_most_whatever_the_order_and_those_passed_by_do_not_end_the_search():
    near, far = other(), Other(robot_id="robot-3", x_m=2.0, y_m=0.0)
    aside, behind = Other(robot_id="robot-4", x_m=1.0, y_m=2.0), Other(robot_id="robot-5", x_m=-1.0, y_m=0.0)
    for others in ([near, far], [far, near], [aside, behind, near]):
        assert speed_limit_mps((0.0, 0.0, 0.0), True, others) == (pytest.approx((1.0 - KEEP_M) / 0.6), "robot-2")
    twin = Other(robot_id="robot-9", x_m=1.0, y_m=0.0)
    assert speed_limit_mps((0.0, 0.0, 0.0), True, [near, twin])[1] == "robot-2"


@pytest.mark.parametrize(
    ("point", "gap_m"),
    [
        ((0.0, 0.0), 1.0),
        ((2.0, 1.0), 1.0),
        ((2.0, 2.5), 0.5),
        ((4.0, 5.0), 1.0),
        ((5.0, 5.0), math.sqrt(2.0)),
        ((3.0, 3.0), 0.0),
        ((2.5, 2.5), 0.5),
    ],
)
def test_the_distance_to_a_bent_route(point, gap_m):
    route = [(1.0, 0.0), (1.0, 1.0), (1.0, 2.0), (1.0, 3.0), (4.0, 3.0), (4.0, 4.0)]
    assert route_gap_m(point, route) == pytest.approx(gap_m)


def test_the_distance_to_a_route_of_one_point_or_of_one_point_twice_is_that_to_the_point():
    assert route_gap_m((4.0, 6.0), [(1.0, 2.0)]) == pytest.approx(5.0)
    assert route_gap_m((4.0, 6.0), [(1.0, 2.0), (1.0, 2.0)]) == pytest.approx(5.0)
    assert route_gap_m((0.0, 1.0), [(1.0, 2.0), (3.0, 3.0)]) == pytest.approx(math.sqrt(2.0))


@pytest.mark.parametrize(
    ("change", "in_way"),
    [
        ({}, True),
        ({"age_s": 6.0}, False),
        ({"docked": True}, True),
        ({"docked": True, "route": ()}, False),
        ({"route": ()}, False),
        ({"rank": 2, "robot_id": "robot-3"}, False),
        ({"rank": 2}, True),
        ({"route": ((0.0, KEEP_M), (1.0, KEEP_M))}, False),
        ({"route": ((0.0, KEEP_M - 0.001), (1.0, KEEP_M - 0.001))}, True),
    ],
)
def test_whose_route_one_must_leave(change, in_way):
    told = {"robot_id": "robot-1", "x_m": 1.0, "y_m": 0.0, "rank": 1, "route": ((1.0, 0.0), (0.0, 0.0))} | change
    passing = Other(**told)
    assert in_the_way_of((2, "robot-2"), (0.0, 0.0, 0.0), [passing]) is (passing if in_way else None)


def test_points_along_a_route_are_as_near_as_was_asked_and_end_where_it_ends():
    assert along([]) == []
    assert along([(1.0, 2.0)]) == [(1.0, 2.0)]
    assert along([(0.0, 0.0), (0.0, 0.0)]) == [(0.0, 0.0), (0.0, 0.0)]
    bent = along([(1.0, 1.0), (1.0, 1.25), (0.5, 1.25)], 0.125)
    assert bent == [(1.0, 1.0), (1.0, 1.125), (1.0, 1.25), (0.875, 1.25), (0.75, 1.25), (0.625, 1.25), (0.5, 1.25)]
    assert len(along([(0.0, 0.0), (1.0, 0.0)])) == 11
