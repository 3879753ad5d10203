"""A brain that was stopped between its permit and the pump, or while it poured: what it had leave for may be over."""

from types import SimpleNamespace

import pytest

from core.virtual import run_virtual
from core.wire.market import Permit
from robot_service.failed import SkillFailed
from robot_service.skills.water import Poured, _pour

PERMIT = Permit(permit_id="p", task_id="t", epoch=1, act="water", dose_ml=60.0, valid_for_s=15.0)


class Sleeper:
    """A robot whose pump gives 2 ml a turn from the second on, and which sleeps after one of its turns."""

    def __init__(self, sleeps_after, sleeps_s):
        self.now_s, self.turns, self.wanted_s = 0.0, 0, []
        self._after, self._sleeps_s = sleeps_after, sleeps_s
        self.clock = SimpleNamespace(now=lambda: self.now_s)
        self.body = SimpleNamespace(want=lambda **more: self.wanted_s.append(self.now_s))

    async def tick(self):
        self.turns += 1
        self.now_s += self._sleeps_s if self.turns == self._after else 0.2
        poured_ml = max(0.0, 2.0 * (self.turns - 1))
        return SimpleNamespace(permit_id="p", pumped_ml=poured_ml, tank_ml=500.0, docked=True, refusal="")


def test_a_robot_that_slept_before_the_pump_began_does_not_begin_when_its_permit_is_over():
    robot = Sleeper(sleeps_after=1, sleeps_s=4.0)
    with pytest.raises(SkillFailed, match="ran out before the pump"):
        run_virtual(_pour(robot, PERMIT, -12.0, Poured()))
    assert robot.wanted_s == [0.0]


def test_a_robot_that_slept_long_while_it_poured_does_not_pour_on():
    robot, poured = Sleeper(sleeps_after=5, sleeps_s=40.0), Poured()
    run_virtual(_pour(robot, PERMIT, 0.0, poured))
    assert poured.delivered_ml == 8.0
    assert "the pump stopped at 8 ml" in poured.why
    assert max(robot.wanted_s) < 1.0


def test_a_robot_that_slept_a_moment_pours_on():
    robot, poured = Sleeper(sleeps_after=5, sleeps_s=3.0), Poured()
    run_virtual(_pour(robot, PERMIT, 0.0, poured))
    assert (poured.delivered_ml, poured.why) == (60.0, "")
