"""A dry pot is watered: from its probe's bytes to the water in its soil, judged by the world."""

from __future__ import annotations

import pytest

from core.virtual import run_virtual
from lab import story


def told_by(seed: int) -> tuple[str, float]:
    """The trace of one watering, and how many millilitres it took."""

    async def play() -> tuple[str, float]:
        async with story.growing(story.one_pot(), seed) as garden:
            await story.phase(garden, "plant-1", "soaking")
            return await story.trace(garden), garden.truth().plant("plant-1").poured_ml

    return run_virtual(play())


def test_a_dry_pot_asks_is_served_once_and_measures_that_it_was():
    async def told(garden):
        before = garden.truth().plant("plant-1")
        task = await story.served(garden, "plant-1")
        after = garden.truth().plant("plant-1")
        assert after.poured_ml == pytest.approx(story.DOSE_ML, rel=story.PUMP_ERROR_RATIO)
        assert after.moisture_ratio - before.moisture_ratio == pytest.approx(story.DOSE_ML / 3000.0, abs=0.002)
        assert task["permits"] == 1
        assert task["delivered_ml"] == pytest.approx(story.DOSE_ML, abs=1.0)
        assert "soil went from" in task["reason"]
        state = await garden.get("plant-1", "/state")
        assert state["soil"]["ratio"] == pytest.approx(after.moisture_ratio, abs=0.01)
        assert (state["thirsty"], state["open_tasks"]) == (False, [])
        story.unhurt(garden)

    story.tell(story.one_pot(), told)


def test_the_same_seed_tells_the_same_story_to_the_last_bit_and_another_seed_another():
    first, again, other = told_by(7), told_by(7), told_by(8)
    assert first == again
    assert first[0] != other[0]


@pytest.mark.parametrize("variant", [{"docking": "beam"}, {"create": "create1"}])
def test_every_base_and_way_of_docking_waters(variant):
    async def told(garden):
        await story.phase(garden, "plant-1", "soaking")
        assert garden.truth().plant("plant-1").poured_ml == pytest.approx(story.DOSE_ML, rel=story.PUMP_ERROR_RATIO)
        story.unhurt(garden)

    story.tell(story.one_pot(**variant), told)
