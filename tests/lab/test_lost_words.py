"""Replies that get lost round the irreversible act: a dose is never poured twice without a measurement between."""

from __future__ import annotations

import pytest

from lab import story

HEARS, IS_HEARD = ("plant-1", "robot-1"), ("robot-1", "plant-1")


def on_dock(garden) -> bool:
    return story.robot(garden).docked_at == "plant-1"


def pumps(garden) -> bool:
    return story.robot(garden).pumping


def nearly_done(garden) -> bool:
    return story.robot(garden).pumped_ml > 0.9 * story.DOSE_ML


@pytest.mark.parametrize("way", [HEARS, IS_HEARD], ids=["no answers", "no requests"])
@pytest.mark.parametrize(
    ("moment", "for_s"),
    [
        pytest.param(on_dock, 4.0, marks=pytest.mark.soak),
        (on_dock, 25.0),
        pytest.param(pumps, 25.0, marks=pytest.mark.soak),
        (nearly_done, 6.0),
    ],
)
def test_silence_round_the_act_never_becomes_a_second_dose(way, moment, for_s):
    async def told(garden):
        await story.when(garden, lambda: moment(garden))
        leg = garden.mesh.leg(*way)
        leg.cut = True
        await garden.clock.sleep(for_s)
        leg.cut = False
        task = await story.served(garden, "plant-1", 400.0)
        poured_ml = garden.truth().plant("plant-1").poured_ml
        assert poured_ml <= story.allowed_ml(task)
        # One dose makes this pot content: a second may only follow a measurement that found the first one missing.
        assert poured_ml == pytest.approx(story.DOSE_ML, rel=story.PUMP_ERROR_RATIO)
        story.unhurt(garden)

    story.tell(story.one_pot(), told)


def test_a_mesh_that_loses_every_fifth_message_still_waters():
    async def told(garden):
        for source, target in (HEARS, IS_HEARD):
            garden.mesh.leg(source, target).loss_ratio = 0.2
        task = await story.served(garden, "plant-1", 400.0)
        assert garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
        story.unhurt(garden)

    story.tell(story.one_pot(), told)
