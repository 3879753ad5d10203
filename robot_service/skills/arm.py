"""Moving the arm open loop: legs that are clear of pot and dock, one after another."""

from __future__ import annotations

import math
from collections.abc import Iterable

from core.errors import Refused
from core.manipulation.approach import along
from core.manipulation.arm import Joints, hand_point, inverse, nozzle_goal
from core.manipulation.swing import Leg, fold, leg_s, swing
from core.robots import gardener
from core.wire.body import BodyState
from robot_service.robot import Robot, SkillFailed

FIRST_FOLD_S = 2.0
"""An arm whose place nobody knows jumps at its first move; it goes to the folded pose."""
SETTLE_S = 0.3
LEG_LATE_S = 5.0
IN_PLANT_M = 0.2
"""A hand nearer to the stem than this is among leaves and fruit."""
WITHDRAW_M, WITHDRAW_STEPS, WITHDRAW_SHARE = 0.15, 5, 0.15
NEAR_RAD = 0.03
"""The board tells its pulses to 10 us, which is half of this."""


def joints_now(robot: Robot) -> Joints:
    """Where the board commands the arm; the folded pose until it was ever driven."""
    state = robot.body.state
    if state is None or state.arm_rad is None or len(state.arm_rad) < 4:
        return gardener.ARM_HOME_RAD
    a, b, c, d = state.arm_rad[:4]
    return a, b, c, d


def is_folded(robot: Robot) -> bool:
    return robot.body.state is not None and not _away(robot.body.state, gardener.ARM_HOME_RAD)


def _away(state: BodyState, q: Joints) -> str:
    """Why the arm is not at `q`; empty when it is, as far as the board knows."""
    if state.arm_rad is None:
        return "the board does not know where it is"
    if state.arm_moving:
        return "it still moves"
    return "" if all(abs(a - b) < NEAR_RAD for a, b in zip(state.arm_rad, q, strict=False)) else "it stands elsewhere"


async def move_arm(robot: Robot, legs: Iterable[Leg]) -> None:
    """Run the legs; each ends when its time is over and the board says that it is there. Raises SkillFailed when late."""
    robot.body.rest(False)
    for leg in legs:
        began_s = robot.clock.now()
        while True:
            robot.body.want(arm=leg.q, arm_s=leg.duration_s)
            state = await robot.tick()
            spent_s, why = robot.clock.now() - began_s, _away(state, leg.q)
            if spent_s > leg.duration_s + SETTLE_S and not why:
                break
            if spent_s > leg.duration_s + LEG_LATE_S:
                raise SkillFailed(f"the arm did not get there: {state.refusal or why}")


async def fold_arm(robot: Robot) -> None:
    """Back over the body, as it must be before the base moves."""
    if is_folded(robot):
        return
    await withdraw(robot)
    now = joints_now(robot)
    try:
        legs = fold(now) if robot.state().arm_rad is not None else (Leg(q=now, duration_s=FIRST_FOLD_S),)
    except Refused:
        legs = (Leg(q=gardener.ARM_HOME_RAD, duration_s=2 * leg_s(now, gardener.ARM_HOME_RAD)),)
    await move_arm(robot, legs)


async def withdraw(robot: Robot) -> None:
    """Straight back out of the plant, as the hand came in: to swing aside among fruit would tear them off."""
    if robot.state().arm_rad is None:
        return
    q = joints_now(robot)
    tool, pitch_rad = hand_point(q), q[1] + q[2] + q[3]
    if math.hypot(tool[0] - gardener.DOCK_TO_STEM_M, tool[1]) > IN_PLANT_M:
        return
    legs = []
    for number in range(1, WITHDRAW_STEPS + 1):
        try:
            back = inverse(along(tool, pitch_rad, number * WITHDRAW_M / WITHDRAW_STEPS), pitch_rad)
        except Refused:
            break
        legs.append(Leg(q=back, duration_s=leg_s(q, back, WITHDRAW_SHARE, least_s=0.1)))
        q = back
    await move_arm(robot, legs)


async def reach(robot: Robot, point_base_m: tuple[float, float, float]) -> Joints:
    """Bring the nozzle to a point in the base frame; returns the joints held there. An arm of unknown place folds first."""
    if robot.state().arm_rad is None:
        await fold_arm(robot)
    await withdraw(robot)
    try:
        goal = nozzle_goal(point_base_m)
        legs = swing(joints_now(robot), goal)
    except Refused as error:
        raise SkillFailed(f"the nozzle cannot reach the soil: {error}") from error
    await move_arm(robot, legs)
    return goal
