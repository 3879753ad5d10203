"""The body on virtual time with stand-in devices: what the brain stops asking for stops, and nothing is over-dosed."""

from __future__ import annotations

import asyncio
import importlib.util
import math
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from core.errors import ConfigError, StorageError
from core.geometry.planar import Pose, compose, invert
from core.robots import gardener
from core.robots.fence import KEEP_M, Fence
from core.virtual import run_virtual
from core.wire.body import Setpoint
from core.wire.geometry import Pose2
from hw.ports import BaseReading, MarkerFix
from robot_service.body.body import KEEP_AGAIN_S
from robot_service.body.whereabouts import Whereabouts

_spec = importlib.util.spec_from_file_location("body_stand_ins", Path(__file__).with_name("stand_ins.py"))
assert _spec is not None
assert _spec.loader is not None
stand_ins = sys.modules.setdefault("body_stand_ins", importlib.util.module_from_spec(_spec))
_spec.loader.exec_module(stand_ins)
Rig, DOCKED, DOWN, UP = stand_ins.Rig, stand_ins.DOCKED, stand_ins.DOWN, stand_ins.UP

LIFE_S = 0.3
DRIVE = Setpoint(seq=0, base="drive", v_mps=0.3, omega_radps=0.2)
SEEK = Setpoint(seq=0, base="seek_dock")
PUMP = Setpoint(seq=0, pump=True, permit_id="plant-1/p1", dose_ml=30.0)


def story(folder: Path, tell: Callable[[Any], Awaitable[None]], **how: Any) -> None:
    async def main() -> None:
        async with Rig(folder, **how) as rig:
            await tell(rig)

    run_virtual(main())


async def pumping(rig: Any, setpoint: Setpoint = PUMP) -> Any:
    rig.base.sense = dict(DOCKED)
    brain = await rig.brain()
    brain.wish = setpoint
    await rig.until(lambda: rig.servos.pump)
    return brain


def test_a_setpoint_moves_the_wheels_and_silence_stops_them_within_the_life(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = DRIVE
        await rig.until(lambda: rig.base.doing == ("drive", 0.3, 0.2))
        brain.wish = None
        assert await rig.until(lambda: rig.base.doing == ("stop",)) <= LIFE_S

    story(tmp_path, tell)


@pytest.mark.parametrize("setpoint", [DRIVE, SEEK, PUMP], ids=["driving", "seeking", "pumping"])
@pytest.mark.parametrize("how", ["killed", "blocked"])
def test_everything_stops_when_the_brain_is_killed_or_blocked(tmp_path: Path, setpoint: Setpoint, how: str) -> None:
    async def tell(rig: Any) -> None:
        if setpoint.pump:
            rig.base.sense = dict(DOCKED)
        brain = await rig.brain()
        brain.wish = setpoint
        await rig.until(lambda: rig.servos.pump or rig.base.doing[0] in ("drive", "seek_dock"))
        await rig.clock.sleep(0.5)
        if how == "killed":
            await brain.link.close()
        brain.wish = None
        stopped_s = await rig.until(lambda: not rig.servos.pump and rig.base.doing == ("stop",))
        assert stopped_s <= (0.05 if how == "killed" else LIFE_S)
        assert rig.servos.pumped_ml <= PUMP.dose_ml

    story(tmp_path, tell)


def test_a_fresh_body_has_its_outputs_latched_off_until_a_brain_of_its_own_sends_a_valid_setpoint(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        await rig.clock.sleep(3.0)
        stranger = await rig.brain("not the secret of this robot")
        stranger.wish = DRIVE
        await rig.clock.sleep(1.0)
        brain = await rig.brain()
        for order in ("wake", "resume", "rest", "wake"):
            brain.order(order)
        await rig.clock.sleep(3.0)
        assert not brain.state.stopped, "a start presses no e-stop"
        assert {what for _, what in rig.base.log} == {("stop",)}
        assert (rig.servos.moves, rig.servos.pump_log) == ([], [])
        assert rig.servos.stops > 0
        brain.wish = DRIVE
        await rig.until(lambda: rig.base.doing[0] == "drive")

    story(tmp_path, tell)


def test_a_moving_arm_is_stopped_when_the_brain_goes(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = Setpoint(seq=0, arm=(0.5, 1.5, -1.5, 0.0), arm_s=4.0)
        await rig.until(lambda: rig.servos.moves != [])
        await rig.clock.sleep(0.5)
        stops = rig.servos.stops
        await brain.link.close()
        brain.wish = None
        assert await rig.until(lambda: rig.servos.stops > stops) <= 0.05
        assert [d for _, _, d in rig.servos.moves] == [4.0]

    story(tmp_path, tell)


@pytest.mark.parametrize("device", ["base", "servos"])
def test_a_lost_link_stops_the_other_device(tmp_path: Path, device: str) -> None:
    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = DRIVE
        await rig.until(lambda: rig.base.doing[0] == "drive")
        getattr(rig, device).link = DOWN
        assert await rig.until(lambda: rig.base.doing == ("stop",)) <= LIFE_S
        await rig.clock.sleep(0.1)
        assert "link is down" in brain.state.refusal
        assert brain.state.down == (f"{device}: unplugged",)
        getattr(rig, device).link = UP
        await rig.until(lambda: rig.base.doing[0] == "drive")

    story(tmp_path, tell)


def test_a_dose_is_pumped_once_and_to_the_millilitre(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        brain = await pumping(rig)
        await rig.until(lambda: not rig.servos.pump, 10.0)
        await rig.clock.sleep(3.0)
        assert rig.servos.pumped_ml == pytest.approx(30.0, abs=0.1)
        assert brain.state.pumped_ml == pytest.approx(30.0, abs=0.1)
        assert (brain.state.permit_id, brain.state.pump) == ("plant-1/p1", False)
        assert brain.state.refusal == "the dose is delivered"

    story(tmp_path, tell)


def test_the_off_timer_stops_the_pump_although_the_control_loop_hangs(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        await pumping(rig)
        rig.body.tick = lambda: None
        await rig.clock.sleep(10.0)
        assert rig.servos.pumped_ml == pytest.approx(30.0, abs=0.2)

    story(tmp_path, tell)


def test_the_dose_is_on_disk_before_the_pump_starts(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        seen = []
        rig.servos.output, real = (
            (lambda c, high: (seen.append(b"plant-1/p1" in _bytes(tmp_path)), real(c, high))),
            (rig.servos.output),
        )
        await pumping(rig)
        assert seen[-1]

    story(tmp_path, tell)


def _bytes(folder: Path) -> bytes:
    path = folder / "doses.json"
    return path.read_bytes() if path.exists() else b""


def test_a_restarted_brain_cannot_dose_again_under_the_same_permit(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        first = await pumping(rig)
        await rig.clock.sleep(1.0)
        first.wish = None
        await first.link.close()
        await rig.clock.sleep(1.0)
        pumped_ml = rig.servos.pumped_ml
        second = await rig.brain()
        second.wish = PUMP
        await rig.clock.sleep(3.0)
        assert rig.servos.pumped_ml == pumped_ml < 30.0
        assert second.state.refusal == "the permit plant-1/p1 is spent"

    story(tmp_path, tell)


def test_spent_permits_and_caps_survive_a_restart_of_the_body(tmp_path: Path) -> None:
    caps = {"command_ml": 40.0, "hour_ml": 50.0, "day_ml": 100.0}

    async def once(rig: Any) -> None:
        await pumping(rig)

    async def again(rig: Any) -> None:
        rig.base.sense = dict(DOCKED)
        brain = await rig.brain()
        for permit_id, why in (("plant-1/p1", "is spent"), ("plant-1/p2", "ml an hour")):
            brain.wish = Setpoint(seq=0, pump=True, permit_id=permit_id, dose_ml=30.0)
            await rig.clock.sleep(0.5)
            assert why in brain.state.refusal
            assert not rig.servos.pump_log

    story(tmp_path, once, caps=caps)
    story(tmp_path, again, caps=caps)


def test_pausing_within_a_permit_counts_on(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        brain = await pumping(rig)
        await rig.clock.sleep(1.0)
        brain.wish = Setpoint(seq=0)
        await rig.until(lambda: not rig.servos.pump)
        await rig.clock.sleep(1.0)
        brain.wish = PUMP
        await rig.clock.sleep(8.0)
        assert rig.servos.pumped_ml == pytest.approx(30.0, abs=0.2)

    story(tmp_path, tell)


def test_a_full_disk_means_no_water_until_there_is_room_again(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        def fail(doc: object) -> int:
            raise StorageError("no space left")

        document = rig.body.ledger._document
        real, document.commit = document.commit, fail
        rig.base.sense = dict(DOCKED)
        brain = await rig.brain()
        brain.wish = PUMP
        await rig.clock.sleep(1.0)
        assert not rig.servos.pump_log
        assert "no space left" in brain.state.refusal
        document.commit = real
        await rig.clock.sleep(1.0)
        assert not rig.servos.pump_log
        brain.wish = Setpoint(seq=0, pump=True, permit_id="plant-1/p2", dose_ml=30.0)
        await rig.until(lambda: rig.servos.pump)

    story(tmp_path, tell)


def test_the_e_stop_stops_latches_and_survives_a_restart(tmp_path: Path) -> None:
    async def press(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = DRIVE
        await rig.until(lambda: rig.base.doing[0] == "drive")
        brain.order("stop", "operator anna")
        assert await rig.until(lambda: rig.base.doing == ("stop",)) <= 0.05
        await rig.clock.sleep(0.5)
        assert (brain.state.stopped, brain.state.stopped_by) == (True, "operator anna")
        assert brain.state.refusal == "stopped by operator anna"
        assert brain.state.stop_number == 1

    async def release(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = DRIVE
        await rig.clock.sleep(0.5)
        assert rig.base.doing == ("stop",)
        assert (brain.state.stopped, brain.state.stop_number) == (True, 1)
        brain.order("resume", "operator anna", 1)
        await rig.until(lambda: rig.base.doing[0] == "drive")
        assert brain.state.stop_number == 0

    async def moves(rig: Any) -> None:
        (await rig.brain()).wish = DRIVE
        await rig.until(lambda: rig.base.doing[0] == "drive")

    for part in (press, release, moves):
        story(tmp_path, part)


def test_a_release_of_an_earlier_stop_releases_no_later_one(tmp_path: Path) -> None:
    async def press(rig: Any) -> None:
        brain = await rig.brain()
        brain.order("stop", "anna")
        await rig.until(lambda: brain.state.stop_number == 1)
        brain.order("resume", "anna", 1)
        await rig.until(lambda: not brain.state.stopped)

    async def say_it_again(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = DRIVE
        for number in (2, 3):
            brain.order("stop", "a child")
            await rig.until(lambda number=number: brain.state.stop_number == number)
        for older in (0, 1, 2, 4):
            brain.order("resume", "anna", older)
        await rig.clock.sleep(1.0)
        assert (rig.base.doing, brain.state.stopped, brain.state.stop_number) == (("stop",), True, 3)
        brain.order("resume", "anna", 3)
        await rig.until(lambda: rig.base.doing[0] == "drive")

    for part in (press, say_it_again):
        story(tmp_path, part)


def test_a_stop_that_a_full_disk_did_not_take_is_written_down_later_and_can_then_be_released(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        def fail(doc: object) -> int:
            raise StorageError("no space left")

        document = rig.body.latch._document
        real, document.commit = document.commit, fail
        brain = await rig.brain()
        brain.wish = DRIVE
        await rig.until(lambda: rig.base.doing[0] == "drive")
        brain.order("stop", "anna")
        await rig.clock.sleep(3 * KEEP_AGAIN_S)
        assert (brain.state.stopped, brain.state.stop_kept, brain.state.stop_number) == (True, False, 0)
        document.commit = real
        await rig.clock.sleep(KEEP_AGAIN_S + 1.0)
        assert (brain.state.stopped, brain.state.stop_kept, brain.state.stop_number) == (True, True, 1)
        brain.order("resume", "anna", 1)
        await rig.until(lambda: rig.base.doing[0] == "drive")

    story(tmp_path, tell)


def test_a_damaged_latch_refuses_to_start(tmp_path: Path) -> None:
    (tmp_path / "stop.json").write_text("{")

    async def main() -> None:
        with pytest.raises(StorageError):
            await Rig(tmp_path).__aenter__()

    run_virtual(main())


def test_a_wrong_secret_is_shown_the_door_and_the_newest_brain_wins(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        stranger = await rig.brain("not-the-secret-at-all")
        assert stranger.closed
        assert stranger.states == []
        first, second = await rig.brain(), await rig.brain()
        first.wish = DRIVE
        await rig.clock.sleep(0.5)
        assert first.closed
        assert rig.base.doing == ("stop",)
        second.wish = DRIVE
        await rig.until(lambda: rig.base.doing[0] == "drive")

    story(tmp_path, tell)


@pytest.mark.parametrize("junk", [b"\xff\xfe\n", b'{"t":"set","seq":1,"v_mps":NaN}\n', b"[]\n", b"x" * 20000])
def test_a_brain_that_talks_nonsense_is_let_go_and_nothing_moves(tmp_path: Path, junk: bytes) -> None:
    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = DRIVE
        await rig.until(lambda: rig.base.doing[0] == "drive")
        brain.link.write(junk)
        await rig.until(lambda: rig.base.doing == ("stop",))
        await rig.until(lambda: brain.closed)
        assert not rig.ended
        (await rig.brain()).wish = DRIVE
        await rig.until(lambda: rig.base.doing[0] == "drive")

    story(tmp_path, tell)


def test_states_come_at_50_hz_in_motion_and_at_2_hz_at_rest_and_a_setpoint_wakes_at_once(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = DRIVE
        await rig.clock.sleep(1.0)
        before = len(brain.states)
        await rig.clock.sleep(2.0)
        assert len(brain.states) - before == pytest.approx(100, abs=3)
        brain.wish = None
        await rig.clock.sleep(4.0)
        assert rig.base.resting
        before = len(brain.states)
        await rig.clock.sleep(10.0)
        assert len(brain.states) - before == pytest.approx(20, abs=2)
        brain.wish = DRIVE
        assert await rig.until(lambda: rig.base.doing[0] == "drive") < 1.2
        assert not rig.base.resting

    story(tmp_path, tell)


def test_a_marker_fix_keeps_its_instant(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.order("wake")
        rig.localizer.fix = MarkerFix(stamp_s=rig.clock.now() - 0.2, marker_id=7, x_m=0.1, y_m=0.2, yaw_rad=0.3)
        await rig.clock.sleep(0.3)
        marker = brain.state.marker
        assert (marker.marker_id, marker.count) == (7, 1)
        assert brain.state.stamp_s - marker.age_s == pytest.approx(rig.localizer.fix.stamp_s, abs=0.001)
        rig.localizer.fix = MarkerFix(stamp_s=rig.clock.now(), marker_id=None)
        await rig.clock.sleep(0.1)
        assert brain.state.marker.count == 1

    story(tmp_path, tell)


def test_the_arm_must_be_folded_first_when_nobody_knows_where_it_is(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = Setpoint(seq=0, arm=(0.5, 1.5, -1.5, 0.0))
        await rig.clock.sleep(0.5)
        assert rig.servos.moves == []
        assert brain.state.arm_rad is None
        brain.wish = Setpoint(seq=0, arm=gardener.ARM_HOME_RAD)
        await rig.until(lambda: brain.state.arm_rad is not None)
        assert brain.state.arm_rad == pytest.approx(gardener.ARM_HOME_RAD, abs=0.01)
        await rig.until(lambda: not brain.state.arm_moving)
        brain.wish = Setpoint(seq=0, arm=(0.5, 1.5, -1.5, 0.0))
        await rig.until(lambda: len(rig.servos.moves) == 2)

    story(tmp_path, tell, folded=False)


FENCE = Fence(x_m_min=-1.0, x_m_max=1.0, y_m_min=-1.0, y_m_max=1.0, markers={400: Pose2(x_m=0.5, y_m=0.0, yaw_rad=1.0)})
MARKER = (0.5, 0.0, 1.0)


async def watched(rig: Any, start: Pose, far: list[Pose]) -> None:
    """The truth from the wheels, and a marker's fix of it twice a second, told 0.06 s later; every seventh jumps."""
    wheelbase_m, was, pose, count = gardener.WHEELBASE_M["create2"], (0.0, 0.0), start, 0
    while True:
        count += 1
        fix = invert(compose(invert(pose), MARKER))
        jump_m = 0.6 if count % 7 == 0 else 0.0
        seen_s = rig.clock.now()
        for step in range(10):
            await rig.clock.sleep(0.05)
            left_m, right_m = rig.base.left_m, rig.base.right_m
            ahead_m, turn_rad = (left_m + right_m - sum(was)) / 2, (right_m - left_m - was[1] + was[0]) / wheelbase_m
            was = left_m, right_m
            pose = compose(pose, (ahead_m, 0.0, turn_rad))
            far.append(pose)
            if step == 1:
                x_m, y_m, yaw_rad = fix
                rig.localizer.fix = MarkerFix(stamp_s=seen_s, marker_id=400, x_m=x_m + jump_m, y_m=y_m, yaw_rad=yaw_rad)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7, -2.5])
def test_a_brain_that_drives_on_for_ever_is_stopped_at_the_fence_and_may_come_back(tmp_path: Path, yaw_rad: float) -> None:
    async def tell(rig: Any) -> None:
        far: list[Pose] = []
        rig.tasks.append(asyncio.create_task(watched(rig, (0.0, 0.0, yaw_rad), far)))
        brain = await rig.brain()
        rig.servos.tank_v = 3.0
        await rig.clock.sleep(1.0)
        brain.wish = Setpoint(seq=0, base="drive", v_mps=0.5)
        await rig.clock.sleep(20.0)
        furthest = max(max(abs(x), abs(y)) for x, y, _ in far)
        assert 0.8 < furthest < 1.0 - KEEP_M + 0.05
        assert "fence" in brain.state.refusal
        brain.wish = Setpoint(seq=0, base="drive", v_mps=-0.3)
        await rig.clock.sleep(2.0)
        assert max(abs(far[-1][0]), abs(far[-1][1])) < furthest - 0.3
        assert brain.state.refusal == ""

    story(tmp_path, tell, fence=FENCE)


def test_without_markers_or_without_a_fence_the_body_judges_no_place(tmp_path: Path) -> None:
    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = Setpoint(seq=0, base="drive", v_mps=0.5)
        await rig.clock.sleep(6.0)
        assert rig.base.left_m > 2.0

    story(tmp_path, tell, fence=FENCE)
    story(tmp_path, tell)


def test_a_lifted_robot_or_a_new_link_knows_its_place_only_by_a_marker() -> None:
    where = Whereabouts(FENCE.markers, 0.235)
    for n in range(20):
        where.look(BaseReading(stamp_s=n * 0.02, left_m=0.01 * n, right_m=0.01 * n), None)
    assert where.place is None
    seen = MarkerFix(stamp_s=0.2, marker_id=400)
    where.look(BaseReading(stamp_s=0.4, left_m=0.2, right_m=0.2), seen)
    assert where.place == pytest.approx((0.5 + 0.1 * math.cos(1.0), 0.1 * math.sin(1.0), 1.0))
    assert where.seen_s == 0.2
    unknown = MarkerFix(stamp_s=0.41, marker_id=999)
    where.look(BaseReading(stamp_s=0.42, left_m=0.3, right_m=0.3), unknown)
    assert where.place == pytest.approx((0.5 + 0.2 * math.cos(1.0), 0.2 * math.sin(1.0), 1.0))
    where.forget()
    where.look(BaseReading(stamp_s=0.44, left_m=0.0, right_m=0.0), unknown)
    assert where.place is None


def test_no_secret_no_body(tmp_path: Path) -> None:
    async def main() -> None:
        rig = Rig(tmp_path)
        object.__setattr__(rig.settings, "secret", "short")
        with pytest.raises(ConfigError):
            await rig.__aenter__()

    run_virtual(main())


@pytest.mark.alone
def test_the_control_loop_costs_at_most_8_ms_of_cpu_per_garden_second(tmp_path: Path) -> None:
    import time

    async def tell(rig: Any) -> None:
        brain = await rig.brain()
        brain.wish = DRIVE
        rig.localizer.fix = MarkerFix(stamp_s=rig.clock.now(), marker_id=7)
        await rig.until(lambda: rig.base.doing[0] == "drive")
        best = math.inf
        for _ in range(5):
            began = time.process_time()
            for _ in range(50):
                rig.body.tick()
            best = min(best, time.process_time() - began)
        print(f"{best * 1000:.2f} ms for 50 ticks")
        assert best <= 0.008

    story(tmp_path, tell)
