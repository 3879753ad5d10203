"""The square of 85 cm (paper 000, section 8.2): odometry alone drifts away, ceiling markers hold the robot in place.

One robot's body, drivers, wires and world; this experiment is its brain. It drives the square by a pose filter's estimate
and is judged by where the world says the robot stands after each loop.
"""

from __future__ import annotations

import asyncio
import math
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from core.estimation.ekf import PoseFilter
from core.estimation.filters import ExponentialFilter, PoseEstimator
from core.estimation.markers import world_pose
from core.geometry.planar import Pose
from core.planning.follow import PathFollower
from core.robots import gardener
from core.robots.markers import ceiling_markers
from core.scenario import Arena, Plant, Robot, Scenario, Station, StationDock
from core.virtual import run_virtual
from core.wire.body import BodyState
from lab.garden import Garden
from lab.results import Result, held
from robot_service.bodylink import BodyLink

SIDE_M = 0.85
LOOPS = 20
TRIALS = 3
PERIOD_S = 0.04
SETTLE_S = 3.0
"""Standing still at the end of a loop, as somebody with a tape measure would have it."""
ARM_FOLD_S = 2.0
LOOP_WITHIN_S = 180.0

Tell = Callable[[str], None]
MakeFilter = Callable[[float, Pose], PoseEstimator]
"""(wheelbase [m], start pose) -> a pose filter."""


def with_markers(wheelbase_m: float, start: Pose) -> PoseEstimator:
    return PoseFilter(wheelbase_m, start)


def odometry_alone(wheelbase_m: float, start: Pose) -> PoseEstimator:
    return _Blind(wheelbase_m, start)


class _Blind(ExponentialFilter):
    """Wheels only."""

    def correct(self, x_m: float, y_m: float, yaw_rad: float, stamp_s: float) -> bool:
        return False


def bare_arena() -> Scenario:
    """Nine metres square of turf, one robot in the middle, everything else out of the way."""
    arena = Arena(length_m=9.0, width_m=9.0)
    plant = Plant(id="plant-1", x_m=4.0, y_m=4.0, dock_yaw_deg=180.0, moisture_ratio=0.35)
    station = Station(docks=(StationDock(id="tap", x_m=4.4, y_m=-4.0, dock_yaw_deg=180.0, tap=True),))
    robot = Robot(id="robot-1", x_m=-SIDE_M / 2, y_m=-SIDE_M / 2, yaw_deg=0.0)
    return Scenario(name="square", arena=arena, plants=(plant,), robots=(robot,), station=station)


class Driver:
    """The experiment's brain: a pose filter on the body's stream, and setpoints back."""

    def __init__(self, garden: Garden, make: MakeFilter) -> None:
        robot = garden.scenario.robots[0]
        self._garden, self._clock = garden, garden.clock
        self._places = {number: (p.x_m, p.y_m, p.yaw_rad) for number, p in ceiling_markers(garden.scenario.arena).items()}
        start = (robot.home.x_m, robot.home.y_m, robot.home.yaw_rad)
        self._filter = make(gardener.WHEELBASE_M[robot.create], start)
        self._last: BodyState | None = None
        secret = (garden.folder / "keys" / robot.id / "body.secret").read_text().strip()
        self.link = BodyLink(f"memory://{robot.id}.body", secret, garden.net.open, garden.clock)
        self.link.listeners.append(self._take)

    @property
    def pose(self) -> Pose:
        pose = self._filter.pose
        assert pose is not None
        return pose

    def _take(self, state: BodyState) -> None:
        last, self._last = self._last, state
        if last is None or state.odometry_epoch != last.odometry_epoch:
            return
        self._filter.predict(state.left_m - last.left_m, state.right_m - last.right_m, state.stamp_s)
        marker = state.marker
        if marker is not None and (last.marker is None or last.marker.count != marker.count):
            fix = world_pose((marker.x_m, marker.y_m, marker.yaw_rad), self._places[marker.marker_id])
            self._filter.correct(*fix, state.stamp_s - marker.age_s)

    async def ready(self) -> None:
        async with self._clock.timeout(30.0):
            while self._last is None or self._last.down:
                self._garden.check()
                await self._clock.sleep(0.1)
        await self.settle(SETTLE_S)

    async def leg(self, start: tuple[float, float], end: tuple[float, float], yaw_rad: float) -> None:
        """Drive one side by the estimate and turn to face the next."""
        follower = PathFollower(np.array([start, end]), yaw_rad)
        while True:
            step = follower.step(self.pose, self._clock.now())
            if step.done:
                return
            self.link.want("drive", step.v_mps, step.omega_radps, arm=gardener.ARM_HOME_RAD, arm_s=ARM_FOLD_S)
            await self._clock.sleep(PERIOD_S)

    async def settle(self, seconds: float) -> None:
        end_s = self._clock.now() + seconds
        while self._clock.now() < end_s:
            self.link.want("stop", arm=gardener.ARM_HOME_RAD, arm_s=ARM_FOLD_S)
            await self._clock.sleep(PERIOD_S)


@dataclass(frozen=True, slots=True)
class Drive:
    """Where the robot really stood at the end of each loop, relative to where it was to stand [m]."""

    errors_m: tuple[tuple[float, float], ...]

    @property
    def steps_m(self) -> list[float]:
        """How much further off each loop put it."""
        before = ((0.0, 0.0), *self.errors_m)
        return [math.dist(a, b) for a, b in zip(before, self.errors_m, strict=False)]


async def drive_square(seed: int, make: MakeFilter, loops: int, folder: Path, tell: Tell) -> Drive:
    """Drive the square `loops` times by the filter's estimate; the world's truth gives the errors."""
    scenario = bare_arena()
    without = ("plant-1", "station", "robot-1", "console")
    async with Garden(scenario, folder, seed=seed, without=without) as garden:
        driver = Driver(garden, make)
        listening = asyncio.create_task(driver.link.run())
        try:
            await driver.ready()
            return Drive(await _loops(garden, driver, loops, tell))
        finally:
            listening.cancel()


async def _loops(garden: Garden, driver: Driver, loops: int, tell: Tell) -> tuple[tuple[float, float], ...]:
    half = SIDE_M / 2
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    yaws = [math.pi / 2, math.pi, -math.pi / 2, 0.0]
    errors: list[tuple[float, float]] = []
    for loop in range(loops):
        async with garden.clock.timeout(LOOP_WITHIN_S):
            for side in range(4):
                await driver.leg(corners[side], corners[(side + 1) % 4], yaws[side])
            await driver.settle(SETTLE_S)
        garden.check()
        pose = garden.truth().robots[0].pose
        errors.append((pose.x_m - corners[0][0], pose.y_m - corners[0][1]))
        tell(f"  loop {loop + 1}: {math.hypot(*errors[-1]):.3f} m off")
    return tuple(errors)


def square_loop(trials: int | None, seed: int, swap: MakeFilter | None, progress: Tell) -> Result:
    """Each trial: 20 loops by odometry, 20 with markers, in a world of its own seed. `swap` replaces the pose filter."""
    trials = trials or TRIALS
    blind: list[Drive] = []
    seeing: list[Drive] = []
    for trial in range(trials):
        for make, drives, name in ((odometry_alone, blind, "odometry"), (swap or with_markers, seeing, "markers")):
            progress(f"seed {seed + trial}: {LOOPS} loops with {name}")
            with tempfile.TemporaryDirectory() as folder:
                drives.append(run_virtual(drive_square(seed + trial, make, LOOPS, Path(folder), progress)))
    return _judge(seed, trials, blind, seeing)


def _judge(seed: int, trials: int, blind: list[Drive], seeing: list[Drive]) -> Result:
    loop_m = 4 * SIDE_M
    drifts = [step / loop_m for drive in blind for step in drive.steps_m]
    blind_m = [math.hypot(*drive.errors_m[-1]) for drive in blind]
    marker_m = [math.hypot(*drive.errors_m[-1]) for drive in seeing]
    ours = {
        "odometry_drift_ratio": statistics.fmean(drifts),
        "odometry_drift_min": min(drifts),
        "odometry_drift_max": max(drifts),
        "odometry_error_m": statistics.fmean(blind_m),
        "marker_error_m": max(marker_m),
        "marker_error_worst_loop_m": max(math.hypot(*error) for drive in seeing for error in drive.errors_m),
        "improvement": min(b / m for b, m in zip(blind_m, marker_m, strict=True)),
    }
    promises = (
        ("odometry_drift_ratio", ">=", 0.05),
        ("odometry_drift_ratio", "<=", 0.15),
        ("marker_error_m", "<=", 0.02),
        ("improvement", ">=", 10.0),
    )
    named = {"odometry": blind, "markers": seeing}
    paper = {"odometry_drift_ratio": 0.10, "marker_error_m": "no accumulated error over 20 loops"}
    series = {f"{name}, seed {seed}": [math.hypot(*e) for e in drives[0].errors_m] for name, drives in named.items()}
    return Result(
        name="square-loop",
        seed=seed,
        trials=trials,
        paper=paper,
        ours=ours,
        bars=held(ours, *promises),
        series=series,
        axes=("loop", "distance from the start [m]"),
    )
