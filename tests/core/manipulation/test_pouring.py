"""The nozzle comes over the soil past the fruit that hang about, where the arm can."""

from __future__ import annotations

import math

import pytest

from core.errors import Refused
from core.manipulation.approach import ROOM_ENOUGH_M, Obstacle
from core.manipulation.arm import hand_point
from core.manipulation.pouring import RIM_M, pouring
from core.manipulation.swing import obstruction
from core.robots.gardener import DOCK_TO_STEM_M, NOZZLE_IN_HAND_M, NOZZLE_POINT_M, SOIL_HEIGHT_M, SOIL_RADIUS_M

STEM = (DOCK_TO_STEM_M, 0.0, SOIL_HEIGHT_M)
NOZZLE = (STEM[0] - NOZZLE_POINT_M[0], STEM[1] - NOZZLE_POINT_M[1], STEM[2] + NOZZLE_POINT_M[2])
RADIUS_M = 0.0135


def fruit(*places):
    return [Obstacle(centre=(NOZZLE[0] + x, NOZZLE[1] + y, NOZZLE[2] + z), radius_m=RADIUS_M) for x, y, z in places]


def end(way):
    return hand_point(way.path[-1], NOZZLE_IN_HAND_M)


def test_where_nothing_hangs_the_nozzle_comes_to_the_place_that_the_plant_names():
    way = pouring(NOZZLE, STEM, [])
    assert end(way) == pytest.approx(NOZZLE)
    assert way.room_m == math.inf
    assert not any(obstruction(q) for q in way.path)


@pytest.mark.parametrize("aside_m", [-0.02, 0.0, 0.02])
def test_where_a_fruit_hangs_before_that_place_the_nozzle_goes_another_way_and_still_ends_over_the_soil(aside_m):
    in_the_way = fruit((-0.05, aside_m, 0.05), (-0.03, aside_m, 0.02))
    way = pouring(NOZZLE, STEM, in_the_way)
    assert way.room_m >= ROOM_ENOUGH_M
    x, y, z = end(way)
    assert math.hypot(x - STEM[0], y - STEM[1]) <= SOIL_RADIUS_M - RIM_M + 1e-9
    assert z >= NOZZLE[2] - 1e-9
    assert min(math.dist((x, y, z), f.centre) for f in in_the_way) > RADIUS_M


def test_a_thicket_leaves_the_way_with_the_most_room():
    thicket = fruit(*((-0.04 * i, 0.03 * j, 0.04 * k) for i in range(3) for j in range(-3, 4) for k in range(4)))
    way = pouring(NOZZLE, STEM, thicket)
    assert way.room_m < ROOM_ENOUGH_M
    assert math.isfinite(way.room_m)


def test_a_place_out_of_the_arms_reach_is_refused_with_the_reason():
    with pytest.raises(Refused, match="the nozzle cannot reach the soil"):
        pouring((1.5, 0.0, 0.3), (1.56, 0.0, 0.25), [])
