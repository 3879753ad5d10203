"""Dock: reserve, drive to the launch point, approach under the watchdog rectangle, and be sure it is the right dock."""

from __future__ import annotations

from core.allocation.right_of_way import KEEP_M, route_gap_m
from core.errors import GardenError
from core.geometry.planar import Pose
from core.planning.docking import BeamDocking, WatchdogRectangle
from core.robots.garden_map import KnownDock
from robot_service.docks import Docks
from robot_service.robot import RANK_BUSY, RANK_DRIVING, Robot, SkillFailed, launch_of, tuple_of
from robot_service.skills.drive import drive_to, undock

TRIES = 4
APPROACH_S = 75.0
ASK_AGAIN_S = 2.0
WRONG_AFTER_S = 1.0


async def dock_at(robot: Robot, docks: Docks, name: str, *, yielding: bool = False, rank: int = RANK_DRIVING) -> None:
    """Stand on dock `name` with charge current flowing. Raises SkillFailed with the last reason after `TRIES`."""
    dock = robot.dock(name)
    if robot.where.docked_at == name:
        await insist(robot, docks, dock, yielding=yielding)
        return
    if robot.where.docked_at:
        await undock(robot, docks)
    await docks.release_others(name)
    gate = Gate(robot, docks, dock, yielding)
    why = ""
    for attempt in range(TRIES):
        robot.activity.job = "navigate"
        await gate.ask()
        await _to_launch(robot, gate, rank)
        robot.activity.job = "dock"
        why = await _approach(robot, docks, dock)
        if not why:
            return
        robot.note("dock", f"docking at {name} failed: {why}", attempt=attempt + 1)
        if robot.where.docked_at and robot.where.docked_at != name:
            await undock(robot, docks)
    raise SkillFailed(f"could not dock at {name} in {TRIES} tries: {why}")


async def insist(robot: Robot, docks: Docks, dock: KnownDock, *, yielding: bool = False) -> None:
    """Reserve the dock we stand on already; leaving it is the owner's to ask for."""
    why = await docks.ask(dock, yielding=yielding)
    if why:
        robot.note("dock", f"stands at {dock.name} without a reservation: {why}")


class Gate:
    """Asks for the dock again and again while the robot drives; the last metre waits for it."""

    def __init__(self, robot: Robot, docks: Docks, dock: KnownDock, yielding: bool) -> None:
        self._robot, self._docks, self.dock, self._yielding = robot, docks, dock, yielding
        self._asked_s = -1e9
        self.why = ""

    async def ask(self) -> None:
        if self._docks.held(self.dock.name) or self._robot.clock.now() - self._asked_s < ASK_AGAIN_S:
            return
        self._asked_s = self._robot.clock.now()
        why = await self._docks.ask(self.dock, yielding=self._yielding)
        self.why = f"waits for dock {self.dock.name}: {why}" if why else ""

    def closed(self) -> str:
        """Why the approach may not be entered; empty when it may."""
        if self._docks.held(self.dock.name):
            return ""
        return self.why or f"waits for dock {self.dock.name}"


async def _to_launch(robot: Robot, gate: Gate, rank: int) -> None:
    """Drive to the launch point, asking for the dock meanwhile."""
    async with robot.beside(_asking(robot, gate)):
        launch, dock = launch_of(gate.dock), gate.dock.pose
        zone = ((launch[0], launch[1]), (dock.x_m, dock.y_m))
        await drive_to(robot, launch, rank=rank, may_enter=gate.closed, zone=zone)


async def _asking(robot: Robot, gate: Gate) -> None:
    while True:
        await robot.clock.sleep(0.5)
        try:
            await gate.ask()
        except GardenError as error:
            gate.why = str(error)


async def _approach(robot: Robot, docks: Docks, dock: KnownDock) -> str:
    """From the launch point onto the contacts; empty when docked at the right dock, else why not."""
    place = tuple_of(dock.pose)
    robot.activity.rank = RANK_BUSY
    rectangle = WatchdogRectangle(dock=place)
    beam = BeamDocking(place, robot.settings.wheelbase_m) if robot.settings.docking == "beam" else None
    until_s = robot.clock.now() + APPROACH_S
    try:
        while robot.clock.now() < until_s:
            state = await robot.tick()
            pose = robot.pose()
            if state.docked:
                return await _arrived(robot, dock)
            if not rectangle.inside(pose):
                return "left the rectangle before the dock"
            if not docks.held(dock.name):
                return f"lost the reservation of {dock.name}"
            robot.activity.route = [(pose[0], pose[1]), (place[0], place[1])]
            if by := _crowd(robot, pose, place):
                robot.activity.waiting = f"{by} is too near"
                robot.body.want("stop")
                until_s += 0.04
                continue
            robot.activity.waiting = ""
            if beam is None:
                robot.body.want("seek_dock")
                continue
            command = beam.step(state, pose, robot.clock.now())
            if command.status in ("outside", "failed"):
                return command.why
            robot.body.want("drive", command.v_mps, command.omega_radps)
        return f"no charge current within {APPROACH_S:.0f} s"
    finally:
        robot.activity.route, robot.activity.waiting = [], ""
        robot.body.want("stop")


async def _arrived(robot: Robot, dock: KnownDock) -> str:
    """Charge current flows: stop, let the estimate settle, and see which dock it is."""
    robot.body.want("stop")
    robot.activity.v_mps = 0.0
    until_s = robot.clock.now() + WRONG_AFTER_S
    while not robot.where.docked_at and robot.clock.now() < until_s:
        robot.body.want("stop")
        await robot.tick()
    if robot.where.docked_at == dock.name:
        return ""
    return f"docked at {robot.where.docked_at}" if robot.where.docked_at else "docked, but at no dock of the map"


def _crowd(robot: Robot, pose: Pose, place: Pose) -> str:
    """Who stands so near to the rest of the approach that going on could touch; empty when nobody."""
    route = [(pose[0], pose[1]), (place[0], place[1])]
    for other in robot.neighbours.others():
        if route_gap_m((other.x_m, other.y_m), route) < KEEP_M - 0.04:
            return other.robot_id
    return ""
