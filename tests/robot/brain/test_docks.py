"""A dock stays ours while we rest on it, and asking for it costs little while nobody can want it."""

import asyncio
from types import SimpleNamespace

import pytest

from core.clock import VirtualClock
from core.errors import PeerDown
from core.robots.garden_map import KnownDock
from core.virtual import run_virtual
from core.wire.geometry import Pose2
from core.wire.market import Reservation
from robot_service.docks import REST_FOR_S, Docks

DOCK = KnownDock(name="station/spare", pose=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0))
HOUR_S = 3600.0


class Owner:
    """Answers every wish, and keeps when each was asked; deaf between two times."""

    def __init__(self, clock, deaf=(0.0, 0.0)):
        self.clock, self.deaf, self.asked_s = clock, deaf, []

    async def call(self, peer, method, path, wish, *, expect):
        self.asked_s.append(self.clock.now())
        if self.deaf[0] < self.clock.now() < self.deaf[1]:
            raise PeerDown("station does not answer")
        return Reservation(
            reservation_id="station:spare:1", dock_id="spare", robot_id="robot-1", epoch=1, valid_for_s=wish.for_s
        )


def resting(*, yielding=True, calm=lambda now_s: True, deaf=(0.0, 0.0)):
    """An hour on a dock: when its owner was asked [s], and whether the dock was held all the time."""

    async def main():
        clock = VirtualClock()
        owner = Owner(clock, deaf)
        peers = SimpleNamespace(find=lambda name: name)
        docks = Docks("robot-1", owner, peers, clock, lambda: calm(clock.now()))
        assert await docks.ask(DOCK, yielding=yielding) == ""
        renewing = asyncio.create_task(docks.run())
        held = True
        while clock.now() < HOUR_S:
            await clock.sleep(1.0)
            held = held and docks.held(DOCK.name)
        renewing.cancel()
        return owner.asked_s, held

    return run_virtual(main())


def test_a_rest_while_nobody_moves_is_renewed_seldom_and_never_runs_out():
    asked_s, held = resting()
    assert held
    assert len(asked_s) == pytest.approx(HOUR_S / 24.0, abs=2)


@pytest.mark.parametrize("how", [{"yielding": False}, {"calm": lambda now_s: False}])
def test_a_dock_at_work_or_with_neighbours_about_is_renewed_every_eight_seconds(how):
    asked_s, held = resting(**how)
    assert held
    assert len(asked_s) == pytest.approx(HOUR_S / 8.0, abs=2)


def test_a_rest_learns_who_waits_within_eight_seconds_of_the_first_move():
    asked_s, _ = resting(calm=lambda now_s: now_s < 1001.0)
    assert min(at_s for at_s in asked_s if at_s > 1001.0) < 1009.0


def test_renewals_that_fail_are_repeated_before_the_rest_runs_out():
    asked_s, held = resting(deaf=(1000.0, 1000.0 + REST_FOR_S / 2.0))
    assert held
    assert len([at_s for at_s in asked_s if 1000.0 < at_s < 1000.0 + REST_FOR_S]) >= 3
