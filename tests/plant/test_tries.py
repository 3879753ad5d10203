"""A fruit that cannot be picked is tried again ever more seldom; told twice, a failure counts once."""

from __future__ import annotations

from core.growth.stages import DAY_S
from core.wire.fruit import NewFruit, Pick, Scan, Sighting
from plant_service.inventory import LOOK_AGAIN_S, LOOK_AGAIN_S_MAX, Fruits


def test_each_failed_pick_puts_the_next_look_off_twice_as_long_up_to_a_day() -> None:
    fruits = Fruits("plant-1", None)
    name = fruits.add(NewFruit(x_m=0.1, y_m=0.0, z_m=0.2, radius_m=0.013, colour="red", confidence=0.9), 0.0).fruit_id
    assert fruits.look_again_s(name) == 0.0
    waits_s = []
    for day in range(6):
        now_s = day * DAY_S
        sighting = Sighting(x_m=0.1, y_m=0.0, z_m=0.2, sigma_m=0.003, radius_m=0.013, colour="red", confidence=0.9)
        fruits.merge(Scan(scan_id=f"s{day}", sightings=[sighting]), now_s)
        for _ in range(2):
            fruits.picked([Pick(fruit_id=name, outcome="failed", reason="not seen")], now_s)
        waits_s.append(fruits.look_again_s(name) - now_s)
    assert waits_s[:3] == [LOOK_AGAIN_S, 2 * LOOK_AGAIN_S, 4 * LOOK_AGAIN_S]
    assert waits_s[-1] == LOOK_AGAIN_S_MAX
