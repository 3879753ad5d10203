"""The Create driver against the emulator: driving, docking, resting, faults and recovery."""

import math
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from hw.ports import ChargingState
from hw.protocols.create import Mode, Model
from sim.devices.bench import Pose

sys.path.insert(0, str(Path(__file__).parent))
from garden_bench import Bench, play

both = pytest.mark.parametrize("model", list(Model))


@both
def test_a_connected_base_streams_readings_every_tick(model: Model) -> None:
    async def story(bench: Bench) -> None:
        first = await bench.driver.wait_reading()
        for _ in range(66):
            last = await bench.driver.wait_reading()
        assert last.stamp_s - first.stamp_s == pytest.approx(66 * 0.015, abs=0.02)
        assert last.oi_mode == Mode.PASSIVE
        assert last.battery_ratio == pytest.approx(5.0 / 6.77, abs=0.01)

    play(story, model)


@both
def test_driving_moves_the_base_and_odometry_follows(model: Model) -> None:
    async def story(bench: Bench) -> None:
        await bench.drive_for(2.0, 0.2, 0.5)
        bench.driver.drive(0.0, 0.0)
        await bench.clock.sleep(0.8)
        reading = bench.driver.reading
        assert reading.oi_mode == Mode.FULL
        assert 0.5 * (reading.left_m + reading.right_m) == pytest.approx(0.4, abs=0.01)
        assert bench.body.pose.yaw_rad == pytest.approx(1.0, abs=0.04)
        yaw = (reading.right_m - reading.left_m) / bench.emulator._wheelbase_m
        assert yaw == pytest.approx(bench.body.pose.yaw_rad, abs=0.03)
        assert bench.body.wheels == (0.0, 0.0)

    play(story, model)


def test_too_fast_a_setpoint_keeps_its_curvature() -> None:
    async def story(bench: Bench) -> None:
        await bench.drive_for(0.1, 1.0, 2.0)
        left, right = bench.body.wheels
        assert right == 0.5
        assert (right - left) / 0.235 / (0.5 * (right + left)) == pytest.approx(2.0, rel=0.01)

    play(story)


def test_numbers_that_are_not_finite_are_refused() -> None:
    async def story(bench: Bench) -> None:
        with pytest.raises(ValueError, match="cannot drive"):
            bench.driver.drive(math.nan, 0.0)
        with pytest.raises(ValueError, match="cannot drive"):
            bench.driver.drive(0.0, math.inf)

    play(story)


def test_an_unchanged_setpoint_is_written_four_times_a_second() -> None:
    async def story(bench: Bench) -> None:
        written: list[bytes] = []
        receive = bench.emulator.receive
        bench.emulator.receive = lambda data, now_s: (written.append(data), receive(data, now_s))
        await bench.drive_for(2.0, 0.2, 0.0)
        assert 7 <= b"".join(written).count(b"\x91\x00\xc8\x00\xc8") <= 9

    play(story)


@both
def test_seek_dock_ends_mated_with_current_flowing(model: Model) -> None:
    async def story(bench: Bench) -> None:
        bench.driver.seek_dock()
        while not bench.driver.reading.mated:
            await bench.driver.wait_reading()
        assert bench.emulator.mode is Mode.PASSIVE
        assert bench.driver.reading.charging is ChargingState.FULL_CHARGING
        assert not bench.driver.seeking

    play(story, model, Pose(-0.8, 0.15, 0.3), within_s=30)


def test_a_drive_or_a_stop_ends_the_seek() -> None:
    async def story(bench: Bench) -> None:
        for take_over in (bench.driver.stop, lambda: bench.driver.drive(0.0, 0.0)):
            bench.driver.seek_dock()
            await bench.clock.sleep(1.0)
            assert bench.emulator.seeking
            take_over()
            await bench.clock.sleep(0.05)
            assert not bench.emulator.seeking
            assert bench.body.wheels == (0.0, 0.0)

    play(story, pose=Pose(-1.0, 0.1, 0.0))


def test_driving_onto_the_contacts_in_full_mode_ends_in_passive_and_charging() -> None:
    async def story(bench: Bench) -> None:
        await bench.drive_for(3.0, 0.1, 0.0)
        assert bench.body.contacts
        assert not bench.driver.reading.mated
        await bench.drive_for(1.0, 0.0, 0.0)
        assert bench.driver.reading.mated
        await bench.drive_for(2.0, -0.1, 0.0)
        assert bench.driver.reading.oi_mode == Mode.FULL
        assert bench.body.pose.x_m < -0.1

    play(story, pose=Pose(-0.25, 0.0, 0.0))


def test_at_rest_it_reads_once_a_second_and_wakes_at_once() -> None:
    async def story(bench: Bench) -> None:
        bench.driver.rest(True)
        await bench.clock.sleep(1.2)
        stamps = [(await bench.driver.wait_reading()).stamp_s for _ in range(5)]
        assert all(0.9 < b - a < 1.2 for a, b in pairwise(stamps))
        assert bench.emulator.due_s() - bench.clock.now() > 0.5
        bench.driver.rest(False)
        await bench.clock.sleep(0.1)
        assert bench.clock.now() - bench.driver.reading.stamp_s < 0.03

    assert [entry["event"] for entry in play(story)] == ["link up"]


@both
def test_travel_counts_through_rest(model: Model) -> None:
    async def story(bench: Bench) -> None:
        bench.driver.rest(True)
        await bench.clock.sleep(2.0)
        bench.body._travel = [0.2, 0.1]
        await bench.clock.sleep(2.0)
        assert bench.driver.reading.left_m == pytest.approx(0.2, abs=0.003)
        assert bench.driver.reading.right_m == pytest.approx(0.1, abs=0.003)

    play(story, model)


def test_ten_minutes_of_rest_do_not_put_the_base_to_sleep() -> None:
    async def story(bench: Bench) -> None:
        for resting in (True, False):
            bench.driver.rest(resting)
            await bench.clock.sleep(600)
            assert bench.driver.link.up
            assert bench.emulator.mode is Mode.PASSIVE

    assert len(play(story, within_s=2000, step_s=0.1)) == 1


# Faults: each ends with recovery


@both
def test_noise_costs_frames_but_neither_the_link_nor_the_odometer(model: Model) -> None:
    async def story(bench: Bench) -> None:
        bench.host.noise(0.002)
        await bench.drive_for(5.0, 0.2, 0.0)
        bench.host.noise(0.0)
        await bench.drive_for(1.0, 0.0, 0.0)
        reading = bench.driver.reading
        assert bench.driver.skipped_bytes > 0
        lost_m = bench.body.pose.x_m + 2.0 - 0.5 * (reading.left_m + reading.right_m)
        assert abs(lost_m) < (0.01 if model is Model.CREATE2 else 0.3)

    play(story, model)


def test_pure_garbage_takes_the_link_down_and_it_comes_back() -> None:
    async def story(bench: Bench) -> None:
        bench.host.noise(0.6)
        await bench.driver.wait_link(False)
        await bench.clock.sleep(20)
        bench.host.noise(0.0)
        await bench.driver.wait_link()
        await bench.drive_for(1.0, 0.1, 0.0)
        assert bench.body.wheels == (0.1, 0.1)

    events = [entry["event"] for entry in play(story)]
    assert events[:2] == ["link up", "link down"]
    assert events[-1] == "link up"


def test_silence_is_noticed_in_half_a_second_and_the_wheels_stand_on_return() -> None:
    async def story(bench: Bench) -> None:
        await bench.drive_for(1.0, 0.2, 0.0)
        bench.host.silence(True)
        begun_s = bench.clock.now()
        await bench.driver.wait_link(False)
        assert bench.clock.now() - begun_s < 0.6
        bench.driver.drive(0.2, 0.0)
        assert bench.body.wheels == (0.2, 0.2), "a Create has no watchdog"
        await bench.clock.sleep(3)
        bench.host.silence(False)
        await bench.driver.wait_link()
        assert bench.body.wheels == (0.0, 0.0)
        await bench.clock.sleep(1)
        assert bench.body.wheels == (0.0, 0.0), "an old setpoint is never replayed"

    assert [entry["event"] for entry in play(story)] == ["link up", "link down", "link up"]


@both
def test_unplugging_and_replugging_sets_the_base_up_again(model: Model) -> None:
    async def story(bench: Bench) -> None:
        await bench.drive_for(1.0, 0.2, 0.0)
        await bench.host.unplug()
        await bench.driver.wait_link(False)
        await bench.clock.sleep(10)
        bench.host.plug()
        await bench.driver.wait_link()
        await bench.drive_for(1.0, -0.1, 0.0)
        assert bench.body.wheels == (-0.1, -0.1)
        assert bench.driver.reading.oi_mode == Mode.FULL

    assert [entry["event"] for entry in play(story, model)] == ["link up", "link down", "link up"]


def test_a_base_that_lost_power_is_started_again() -> None:
    async def story(bench: Bench) -> None:
        await bench.drive_for(1.0, 0.2, 0.0)
        bench.emulator._off()
        await bench.driver.wait_link(False)
        await bench.driver.wait_link()
        assert bench.body.wheels == (0.0, 0.0)

    play(story)


async def deaf(bench: Bench, act: Callable[[], None]) -> None:
    """Do something while the wire is out for a moment."""
    bench.host.silence(True)
    act()
    await bench.clock.sleep(0.1)
    bench.host.silence(False)


def test_a_stop_that_was_lost_is_repeated() -> None:
    async def story(bench: Bench) -> None:
        await bench.drive_for(1.0, 0.2, 0.0)
        await deaf(bench, bench.driver.stop)
        assert bench.body.wheels == (0.2, 0.2)
        await bench.clock.sleep(0.5)
        assert bench.body.wheels == (0.0, 0.0)

    play(story)


@both
def test_a_lost_end_of_a_seek_is_repeated(model: Model) -> None:
    async def story(bench: Bench) -> None:
        bench.driver.seek_dock()
        await bench.clock.sleep(1.0)
        await deaf(bench, bench.driver.stop)
        assert bench.emulator.seeking
        await bench.clock.sleep(0.5)
        assert not bench.emulator.seeking

    play(story, model, Pose(-1.0, 0.0, 0.0))


def test_a_seek_or_a_mode_that_was_lost_is_told_again() -> None:
    async def story(bench: Bench) -> None:
        await bench.drive_for(0.5, 0.2, 0.0)
        await deaf(bench, bench.driver.seek_dock)
        assert not bench.emulator.seeking
        await bench.clock.sleep(0.4)
        bench.driver.seek_dock()
        await bench.clock.sleep(0.1)
        assert bench.emulator.seeking
        await deaf(bench, lambda: bench.driver.drive(0.1, 0.0))
        await bench.drive_for(0.5, 0.1, 0.0)
        assert bench.body.wheels == (0.1, 0.1)

    play(story, pose=Pose(-1.5, 0.0, 0.0))


def test_safe_mode_gives_up_at_a_cliff_and_takes_the_wheels_again_to_back_off() -> None:
    async def story(bench: Bench) -> None:
        bench.driver._active_mode = Mode.SAFE
        await bench.drive_for(0.5, 0.2, 0.0)
        bench.body.extra = {"cliff_left": True}
        await bench.clock.sleep(0.1)
        assert bench.driver.reading.oi_mode == Mode.PASSIVE
        assert bench.body.wheels == (0.0, 0.0)
        await bench.drive_for(0.5, -0.1, 0.0)
        assert bench.body.wheels == (-0.1, -0.1)

    play(story)
