"""Charge and refill: errands of the robot's own, at whatever dock or tap is to be had."""

from __future__ import annotations

from collections.abc import Callable

from core.allocation.bidding import BATTERY_FULL_RATIO, Travel
from core.errors import GardenError
from core.robots import gardener
from core.robots.garden_map import KnownDock
from core.wire.plant import TapGrant, TapRequest
from robot_service.docks import Docks
from robot_service.robot import Robot, SkillFailed
from robot_service.skills.dock import dock_at, insist

LOOK_EVERY_S = 2.0
AIM_ML = gardener.TANK_ML - 20.0
"""Fill to here: the sensor's steps and noise stay below the brim."""
FULL_ML = AIM_ML - 20.0
READ_S = 2.0
"""So long after the tap has closed the level is told."""
FIRST_OPEN_S = 10.0
TAP_STALL_S = 15.0
CHARGE_S_MAX = 4 * 3600.0


async def charge(robot: Robot, docks: Docks, travel: Travel, enough: Callable[[float], bool]) -> None:
    """Stand on any dock until the pack is full, or `enough(battery_ratio)`, or somebody needs the dock."""
    await _find_charger(robot, docks, travel)
    robot.activity.job = "charge"
    until_s = robot.clock.now() + CHARGE_S_MAX
    robot.body.rest(True)
    while robot.clock.now() < until_s:
        ratio = robot.state().battery_ratio
        if ratio >= BATTERY_FULL_RATIO or enough(ratio):
            return
        if not robot.where.docked_at:
            raise SkillFailed("charge current stopped")
        hold = docks.holds.get(robot.where.docked_at)
        if hold is not None and hold.wanted_by:
            return
        await robot.pause(LOOK_EVERY_S, every_s=LOOK_EVERY_S)


async def _find_charger(robot: Robot, docks: Docks, travel: Travel) -> None:
    """Stay on the dock we are on, else take the nearest that its owner lets us have: spare docks before pots' and taps."""
    if robot.where.docked_at:
        await insist(robot, docks, robot.dock(robot.where.docked_at), yielding=True)
        return
    why = "no dock can be reached"
    for dock in chargers(robot.settings.map.docks, travel):
        why = await docks.ask(dock, yielding=True)
        if not why:
            await dock_at(robot, docks, dock.name, yielding=True)
            return
    raise SkillFailed(f"no dock to charge at: {why}")


def chargers(known: list[KnownDock], travel: Travel) -> list[KnownDock]:
    """Docks in the order to be tried."""
    spare = {dock.name: (dock.tap, not dock.dock_id) for dock in known}
    times = {dock.name: travel("here", dock.name) for dock in known}
    reachable = [dock for dock in known if times[dock.name] is not None]
    return sorted(reachable, key=lambda d: (spare[d.name][1], spare[d.name][0], times[d.name] or 0.0, d.name))


async def refill(robot: Robot, docks: Docks, travel: Travel) -> None:
    """Dock at the nearest tap that is not known to be dry, and fill the tank by its own sensor."""
    known = robot.taps()
    times = {name: travel("here", name) for name, dry in known.items() if not dry}
    taps = sorted((time_s, name) for name, time_s in times.items() if time_s is not None)
    if not taps:
        raise SkillFailed("; ".join(filter(None, known.values())) or "no tap can be reached")
    dock = robot.dock(taps[0][1])
    await dock_at(robot, docks, dock.name)
    robot.activity.job = "refill"
    # A body that rests tells the level too seldom: by an old one the tank runs over, or the tap seems dry.
    robot.body.rest(False)
    await _fill(robot, dock)


async def _fill(robot: Robot, dock: KnownDock) -> None:
    level_ml = _tank(robot)
    risen_s, open_s, dry = robot.clock.now(), FIRST_OPEN_S, ""
    while level_ml < FULL_ML:
        try:
            grant = await _open(robot, dock, open_s)
        except GardenError as error:
            dry = f"the tap refuses: {error}"
            grant = None
        await robot.pause((grant.open_s if grant else 0.0) + READ_S)
        now_ml = _tank(robot)
        if now_ml > level_ml + 2.0:
            risen_s = robot.clock.now()
        level_ml = max(level_ml, now_ml)
        if robot.clock.now() - risen_s > TAP_STALL_S:
            why = dry or f"the tank does not fill beyond {level_ml:.0f} ml"
            robot.fitness.failed(dock.name, f"no water at {dock.name}: {why}")
            raise SkillFailed(why)
        if grant is not None:
            open_s = min(30.0, max(0.5, (AIM_ML - level_ml) / grant.flow_mlps))
    robot.fitness.worked(dock.name)


async def _open(robot: Robot, dock: KnownDock, open_s: float) -> TapGrant:
    station = robot.peers.get(dock.owner)
    wish = TapRequest(robot_id=robot.settings.id, open_s=open_s)
    return await robot.mesh.call(station, "POST", "/tap", wish, expect=TapGrant)


def _tank(robot: Robot) -> float:
    if (level_ml := robot.state().tank_ml) is None:
        raise SkillFailed("the tank's sensor is silent")
    return level_ml
