"""Water: the nozzle over the soil, a permit, a measured dose, the drip, the arm home. Done at the dock."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from core.allocation.bidding import DRIP_S
from core.allocation.permits import longest_act_s
from core.errors import Refused
from core.manipulation.approach import Obstacle
from core.manipulation.pouring import Pouring, pouring
from core.manipulation.swing import Leg
from core.robots import gardener
from core.wire.fruit import Fruit
from core.wire.market import Permit, PlantCard
from robot_service.fitness import PUMP
from robot_service.robot import Robot, SkillFailed
from robot_service.skills.arm import fold_arm, move_arm, reach, withdraw
from robot_service.skills.hand import FAST_SHARE, Grip, go_along, swing_to
from robot_service.skills.plantframe import mapped, plant_in_base

STALL_S = 5.0
DOSE_END_ML = 0.1
ENOUGH_ML, SHORT_S = 2.0, 0.5
"""A dose this near to its end that does not grow any more is done."""
DRY_ML = 4.0
"""The tank's sensor reads this little when nothing comes any more."""
WAY_COST_S = 0.05
"""To find the way of the nozzle among twenty fruit."""
ARRIVE_S = 0.1
LEVEL_ERROR_ML = 20.0
"""Two readings of the tank's level differ by this much at most without any water having gone."""

PUMP_TOLERANCE = 1.1
"""What comes out beyond what the running time says, at most."""

TakePermit = Callable[[], Awaitable[tuple[Permit, float]]]
"""Asks the plant; returns the permit and when it was asked for [garden s]."""


@dataclass(slots=True)
class Poured:
    """What came out, and why it was less than asked; empty `why` when it was not."""

    delivered_ml: float = 0.0
    why: str = ""
    pump_failed: bool = False
    """The pump is why."""


async def water(
    robot: Robot, plant: PlantCard, take_permit: TakePermit, poured: Poured, known: Sequence[Fruit] = ()
) -> None:
    """Deliver one dose, past the fruit that are `known` to hang there.

    `poured` tells what came out whatever happens; raises SkillFailed when nothing could be begun.
    """
    await _nozzle_over_soil(robot, plant, known)
    full_ml = robot.state().tank_ml
    permit, asked_s = await take_permit()
    await _pour(robot, permit, asked_s, poured)
    await _drip(robot, DRIP_S)
    _believe(poured, full_ml, robot.state().tank_ml)
    if poured.pump_failed:
        robot.fitness.failed(PUMP, f"the pump has failed: {poured.why}")
    elif not poured.why:
        robot.fitness.worked(PUMP)
    await fold_arm(robot)


async def _nozzle_over_soil(robot: Robot, plant: PlantCard, known: Sequence[Fruit]) -> None:
    """Straight to where the plant would have it; where fruit hang, along the way with the most room."""
    T = plant_in_base(robot.pose(), plant)
    nozzle, stem = mapped(T, (plant.nozzle.x_m, plant.nozzle.y_m, plant.nozzle.z_m)), mapped(T, (0.0, 0.0, 0.0))
    if not known:
        await reach(robot, nozzle)
        return
    fruit = [Obstacle(centre=mapped(T, (each.x_m, each.y_m, each.z_m)), radius_m=each.radius_m) for each in known]
    try:
        way: Pouring = await robot.clock.offload(lambda: pouring(nozzle, stem, fruit), WAY_COST_S)
        if robot.state().arm_rad is None:
            await fold_arm(robot)
        await withdraw(robot)
        await swing_to(robot, way.path[0], Grip(0.0))
    except SkillFailed:
        raise
    except Refused as error:
        raise SkillFailed(f"the nozzle cannot reach the soil: {error}") from error
    await go_along(robot, way.path[1:], FAST_SHARE, Grip(0.0))
    await move_arm(robot, [Leg(q=way.path[-1], duration_s=ARRIVE_S)])


def _believe(poured: Poured, before_ml: float | None, after_ml: float | None) -> None:
    """The pump's running time says what came out; the tank's level must agree that it came."""
    if before_ml is None or after_ml is None:
        return
    gone_ml = max(0.0, before_ml - after_ml)
    too_little = poured.delivered_ml > 2 * LEVEL_ERROR_ML and gone_ml < poured.delivered_ml / 2
    too_much = gone_ml > PUMP_TOLERANCE * poured.delivered_ml + 2 * LEVEL_ERROR_ML
    if too_little or too_much:
        said_ml, poured.delivered_ml = poured.delivered_ml, gone_ml
        poured.why = f"the pump ran for {said_ml:.0f} ml, but the tank's level fell by {gone_ml:.0f} ml"
        poured.pump_failed = True


async def _pour(robot: Robot, permit: Permit, asked_s: float, poured: Poured) -> None:
    began_s = grown_s = robot.clock.now()
    longest_s = permit.dose_ml / gardener.PUMP_MLPS * 2 + STALL_S
    while True:
        # Looked at before every turn: this process may have slept since the last.
        since_s = robot.clock.now() - asked_s
        if since_s > permit.valid_for_s and poured.delivered_ml == 0.0:
            raise SkillFailed("the permit ran out before the pump could start")
        if since_s > permit.valid_for_s + longest_act_s(permit.dose_ml):
            poured.why = f"the act took too long and was ended at {poured.delivered_ml:.0f} ml"
            return
        robot.body.want(pump=True, permit_id=permit.permit_id, dose_ml=permit.dose_ml)
        state = await robot.tick()
        if state.permit_id == permit.permit_id and state.pumped_ml > poured.delivered_ml:
            poured.delivered_ml, grown_s = state.pumped_ml, robot.clock.now()
        left_ml = permit.dose_ml - poured.delivered_ml
        if left_ml <= DOSE_END_ML or (left_ml <= ENOUGH_ML and robot.clock.now() - grown_s > SHORT_S):
            return
        if robot.clock.now() - grown_s > STALL_S or robot.clock.now() - began_s > longest_s:
            poured.why = f"the pump stopped at {poured.delivered_ml:.0f} ml: {state.refusal or 'no more came'}"
            poured.pump_failed = state.docked and not state.refusal
            return
        if state.tank_ml is not None and state.tank_ml < DRY_ML:
            poured.why = f"the tank ran dry after {poured.delivered_ml:.0f} ml"
            return


async def _drip(robot: Robot, seconds: float) -> None:
    until_s = robot.clock.now() + seconds
    while robot.clock.now() < until_s:
        robot.body.want()
        await robot.tick()
