"""What a hand keeps away from: fruit of the inventory, and strangers that more than one picture shows."""

from __future__ import annotations

import numpy as np

from core.manipulation.eye import beside, camera_pose
from core.manipulation.servo import Target
from core.wire.fruit import Fruit
from lab.orchard import lens
from robot_service.skills.seek import STRANGER_SIGMA_M, Neighbour, Sight

PLACE = (0.42, 0.05, 0.50)


def sight_of(near):
    fruit = Fruit(fruit_id="f1", colour="red", x_m=0.1, y_m=0.05, z_m=0.25, radius_m=0.0135)
    return Sight(fruit=fruit, place=PLACE, target=Target.expected(np.array(PLACE), 0.007, 0.0135), near=near)


def test_a_stranger_is_kept_away_from_once_several_pictures_tell_where_it_hangs():
    p = np.array([0.40, 0.02, 0.47])
    known = Neighbour(Target.expected(p + 0.05, 0.007, 0.0135), "green")
    stranger = Neighbour(Target.expected(p, STRANGER_SIGMA_M, 0.0135), "green", stranger=True)
    sight = sight_of([known, stranger])
    assert len(sight.obstacles) == 1
    for q in beside(PLACE)[:2]:
        T = camera_pose(q)
        stranger.target.see(lens(), T, stranger.target.features(lens(), T))
    assert len(sight.obstacles) == 2
