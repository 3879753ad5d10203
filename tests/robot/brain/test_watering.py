"""A whole watering on stand-ins."""

import pytest
from standin import in_garden


def test_an_awarded_watering_is_driven_docked_poured_and_reported():
    async def story(garden):
        bid = await garden.bid("plant-1")
        assert bid.cost_s is not None
        began_s = garden.clock.now()
        assert (await garden.award("plant-1")).status_code == 201
        plant = garden.plants["plant-1"]
        await garden.until(lambda: plant.ended, 150.0)
        print("took", garden.clock.now() - began_s, "bid", bid.cost_s)
        assert plant.ended.state == "done", plant.ended
        assert plant.ended.delivered_ml == pytest.approx(150.0, abs=1.5)
        assert sum(ml for dock, ml in garden.bodies["robot-1"].poured_at if dock == "plant-1") == pytest.approx(
            150.0, abs=1.5
        )

    in_garden(story)
