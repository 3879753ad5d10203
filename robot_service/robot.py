"""What every skill works with: the body, the pose, the ground, the neighbours and the mesh of one robot."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

from core.allocation.right_of_way import RANK_BUSY, RANK_DRIVING, RANK_IDLE
from core.clock import Clock
from core.errors import GardenError
from core.geometry.planar import Point, Pose
from core.mesh.client import Mesh
from core.mesh.events import EventLog
from core.mesh.peers import Peers
from core.robots.garden_map import KnownDock
from core.scenario import launch_pose
from core.wire.body import BodyState
from core.wire.geometry import Pose2
from robot_service.bodylink import BodyLink
from robot_service.eye import Eye
from robot_service.failed import SkillFailed
from robot_service.fitness import Fitness
from robot_service.ground import Ground
from robot_service.localisation import Localisation
from robot_service.neighbours import Neighbours
from robot_service.settings import RobotSettings

TICK_S = 0.04
DEVICE_PATIENCE_S = 15.0
"""A device may be unplugged and plugged in again within this time without failing the task."""

__all__ = ["RANK_BUSY", "RANK_DRIVING", "RANK_IDLE", "Activity", "Halted", "Robot", "SkillFailed"]


class Halted(SkillFailed):
    """The e-stop is latched."""


@dataclass(slots=True)
class Activity:
    """What the robot does now, for people and neighbours."""

    job: str = "idle"
    waiting: str = ""
    rank: int = RANK_IDLE
    route: list[Point] = field(default_factory=list)
    v_mps: float = 0.0


@dataclass(slots=True)
class Robot:
    settings: RobotSettings
    clock: Clock
    rng: random.Random
    body: BodyLink
    where: Localisation
    ground: Ground
    neighbours: Neighbours
    mesh: Mesh
    peers: Peers
    events: EventLog
    eye: Eye
    fitness: Fitness
    activity: Activity = field(default_factory=Activity)
    _last: BodyState | None = None
    _felt: BodyState | None = None

    def watch(self, state: BodyState) -> None:
        """Speed from the wheels, for the neighbours; touches, however short."""
        if state.bump_left or state.bump_right or any(state.cliff):
            self._felt = state
        last, self._last = self._last, state
        if last is not None and (dt_s := state.stamp_s - last.stamp_s) > 0 and state.odometry_epoch == last.odometry_epoch:
            travel_m = max(abs(state.left_m - last.left_m), abs(state.right_m - last.right_m))
            self.activity.v_mps += 0.5 * (min(travel_m / dt_s, 1.0) - self.activity.v_mps)

    def felt(self) -> BodyState | None:
        """The newest state in which a bumper or cliff sensor felt something, once."""
        felt, self._felt = self._felt, None
        return felt

    @property
    def moving(self) -> bool:
        return self.activity.v_mps > 0.01

    def pose(self) -> Pose:
        """Raises SkillFailed while the robot does not know where it is."""
        if (pose := self.where.pose) is None:
            raise SkillFailed(self.where.lost or "does not know where it is")
        return pose

    def state(self) -> BodyState:
        """The newest state, unless the robot may not act: raises Halted or SkillFailed."""
        state = self.body.state
        if state is None or self.body.down:
            raise SkillFailed(self.body.down or "the body is silent")
        if state.stopped:
            raise Halted(f"stopped by {state.stopped_by or 'the e-stop'}")
        if state.battery_ratio <= 0.0 and not state.docked:
            raise SkillFailed("the battery is empty: carry the robot to a dock")
        if state.wheel_drop:
            raise SkillFailed("a wheel hangs in the air: put the robot down")
        return state

    async def tick(self) -> BodyState:
        """Let one control period pass. Waits a while for a device that went down; raises SkillFailed when it stays so."""
        await self.clock.sleep(TICK_S)
        if self.body.down or (self.body.state is not None and self.body.state.down):
            await self._wait_for_devices()
        return self.state()

    async def _wait_for_devices(self) -> None:
        since_s = self.clock.now()
        while why := self.down():
            self.activity.waiting = why
            if self.clock.now() - since_s > DEVICE_PATIENCE_S:
                raise SkillFailed(why)
            await self.clock.sleep(0.2)
        self.activity.waiting = ""

    def down(self) -> str:
        """Which device is down, as a sentence; empty when all are up."""
        if self.body.down:
            return self.body.down
        assert self.body.state is not None
        return "; ".join(self.body.state.down)

    async def pause(self, seconds: float, every_s: float = 0.5) -> None:
        """Wait while nothing moves, yet notice an e-stop within `every_s`."""
        until_s = self.clock.now() + seconds
        while self.clock.now() < until_s:
            await self.clock.sleep(min(every_s, max(0.01, until_s - self.clock.now())))
            self.state()

    @asynccontextmanager
    async def beside(self, work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
        """Run `work` while the body of the `async with` runs; it ends with it."""
        task = asyncio.create_task(work)
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    def taps(self) -> dict[str, str]:
        """Docks with a tap by name, and why each is not counted on now; empty for those that are."""
        return {dock.name: self.fitness.why_not(dock.name) for dock in self.settings.map.docks if dock.tap}

    def dock(self, name: str) -> KnownDock:
        if (dock := self.settings.map.dock(name)) is None:
            raise SkillFailed(f"no dock {name} on the map")
        return dock

    def note(self, kind: str, what: str, task_id: str = "", **data: object) -> None:
        self.events.add(kind, what, task_id=task_id, robot_id=self.settings.id, **data)


def tuple_of(pose: Pose2) -> Pose:
    return pose.x_m, pose.y_m, pose.yaw_rad


def launch_of(dock: KnownDock) -> Pose:
    """Where docking begins, facing the dock."""
    return tuple_of(launch_pose(dock.pose))


def reason_of(error: BaseException) -> str:
    return str(error)[:400] or type(error).__name__ if isinstance(error, GardenError) else repr(error)[:400]
