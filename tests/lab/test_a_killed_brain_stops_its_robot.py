"""SIGKILL of a robot's brain, whatever it does: the body stops everything in time, and the task is not lost."""

from __future__ import annotations

import pytest

from lab import story


def drives(truth) -> bool:
    return truth.v_mps > 0.1


def seeks(truth) -> bool:
    """On the way from the launch point to the dock, driven by the Create itself."""
    return truth.v_mps > 0.02 and -1.5 < truth.pose.x_m < -1.2 and abs(truth.pose.y_m - 0.75) < 0.2


def swings(truth) -> bool:
    return truth.docked_at is not None and abs(truth.omega_radps) < 0.01 and _turned(truth)


def pumps(truth) -> bool:
    return truth.pumping and truth.pumped_ml > 30.0


def _turned(truth) -> bool:
    from core.robots.gardener import ARM_HOME_RAD

    return max(abs(a - b) for a, b in zip(truth.arm_rad, ARM_HOME_RAD, strict=True)) > 0.3


@pytest.mark.parametrize("moment", [drives, seeks, swings, pumps])
def test_everything_stands_in_0_3_s_and_the_pot_gets_no_more_than_its_permits(moment):
    async def told(garden):
        await story.when(garden, lambda: moment(story.robot(garden)))
        await garden.kill("robot-1")
        await story.stops(garden)
        await garden.clock.sleep(3.0)
        assert story.stands(story.robot(garden))
        assert garden.truth().plant("plant-1").poured_ml <= story.DOSE_ML * (1 + story.PUMP_ERROR_RATIO)
        garden.start("robot-1")
        task = await story.served(garden, "plant-1")
        assert garden.truth().plant("plant-1").poured_ml <= story.allowed_ml(task)
        story.unhurt(garden)

    story.tell(story.one_pot(), told)


def test_while_one_brain_is_dead_the_other_robot_serves_both_pots():
    async def told(garden):
        await story.when(garden, lambda: drives(story.robot(garden, "robot-1")))
        await garden.kill("robot-1")
        tasks = [await story.served(garden, plant_id, 400.0) for plant_id in ("plant-1", "plant-4")]
        assert [task["robot_id"] for task in tasks] == ["robot-2", "robot-2"]
        story.unhurt(garden)

    story.tell(story.garden_of(("plant-1", "plant-4")), told)
