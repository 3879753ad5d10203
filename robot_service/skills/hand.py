"""The hand among fruit: its fingers, straight ways in and out of the plant, what it feels, and the basket."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from core.manipulation.approach import ROLLS_RAD, Approach
from core.manipulation.arm import Joints
from core.manipulation.swing import leg_s, swing
from core.robots import gardener
from robot_service.robot import Robot, SkillFailed
from robot_service.skills.arm import SETTLE_S, fold_arm, joints_now, withdraw

HELD_N = 0.8
"""Squeeze above which something is between the fingers."""
CLOSE_S = 0.6
RELEASE_S = 0.4
FAST_SHARE, ADVANCE_SHARE, PULL_SHARE = 0.5, 0.2, 0.15
"""Of a servo's top speed: through the air, in among the fruit, and with one in hand."""


@dataclass(frozen=True, slots=True)
class Grip:
    """What the fingers do on a way: their opening [m] and their turn about the hand's axis [rad]."""

    opening_m: float
    roll_rad: float = 0.0


def rolls(robot: Robot) -> tuple[float, ...]:
    """The turns that the fingers have."""
    return ROLLS_RAD if robot.settings.wrist == "roll" else (0.0,)


def _roll(robot: Robot, grip: Grip) -> float | None:
    """The turn for a wrist that rolls; None for one that cannot."""
    return grip.roll_rad if robot.settings.wrist == "roll" else None


async def go_along(robot: Robot, path: Sequence[Joints], share: float, grip: Grip) -> None:
    """Run a path without stopping between its points; the fingers as told all the while."""
    robot.body.rest(False)
    now = joints_now(robot)
    for q in path:
        duration_s = max(0.08, leg_s(now, q, share, least_s=0.0))
        until_s = robot.clock.now() + duration_s
        while robot.clock.now() < until_s:
            robot.body.want(arm=q, arm_s=duration_s, gripper_m=grip.opening_m, roll_rad=_roll(robot, grip))
            await robot.tick()
        now = q
    await _hold(robot, now, SETTLE_S, grip.opening_m, _roll(robot, grip))


async def _hold(robot: Robot, q: Joints, seconds: float, opening_m: float, roll_rad: float | None = None) -> None:
    """The arm holds still while the fingers do as told; without a turn they keep theirs."""
    until_s = robot.clock.now() + seconds
    while robot.clock.now() < until_s:
        robot.body.want(arm=q, arm_s=0.1, gripper_m=opening_m, roll_rad=roll_rad)
        await robot.tick()


async def turn_fingers(robot: Robot, by_rad: float, grip: Grip) -> None:
    """Turn them by so much, to what `grip` says, while the arm holds still."""
    if by_rad:
        seconds = abs(by_rad) / (FAST_SHARE * gardener.ROLL_SERVO.speed_radps_max)
        await _hold(robot, joints_now(robot), seconds, grip.opening_m, _roll(robot, grip))


async def come_before(robot: Robot, way: Approach) -> None:
    """Before the fruit, the fingers level: out of the plant first, aside where nothing hangs, and straight in."""
    grip = Grip(way.opening_m)
    await withdraw(robot)
    await swing_to(robot, way.back, grip)
    await go_along(robot, (way.look,), FAST_SHARE, grip)


async def swing_to(robot: Robot, goal: Joints, grip: Grip) -> None:
    """To a pose by clear legs, the gripper opening on the way."""
    for leg in swing(joints_now(robot), goal):
        await go_along(robot, (leg.q,), FAST_SHARE, grip)


async def close_gripper(robot: Robot) -> None:
    """Close until the force sensor feels something firmly, or the fingers meet."""
    await _hold(robot, joints_now(robot), CLOSE_S + SETTLE_S, 0.0)


async def open_gripper(robot: Robot, opening_m: float = gardener.GRIPPER_OPEN_M) -> None:
    await _hold(robot, joints_now(robot), RELEASE_S, opening_m)


async def to_basket(robot: Robot) -> bool:
    """Over the basket without letting go, and open; whether something was held until there."""
    for leg in swing(joints_now(robot), gardener.ARM_BASKET_RAD):
        await go_along(robot, (leg.q,), FAST_SHARE, Grip(0.0, 0.0))
    held = feels(robot)
    await open_gripper(robot)
    return held


def feels(robot: Robot) -> bool:
    """Whether the force sensor feels something between the fingers."""
    force_n = robot.state().force_n
    return force_n is not None and force_n > HELD_N


async def empty_hand(robot: Robot) -> None:
    """What a brain before this one left in the hand goes into the basket. Raises SkillFailed when the hand stays full."""
    if not feels(robot):
        return
    robot.note("pick", "something is in the hand from before: it goes into the basket")
    await withdraw(robot)
    await to_basket(robot)
    await fold_arm(robot)
    if feels(robot):
        raise SkillFailed(f"the force sensor feels {robot.state().force_n:.1f} N between open fingers: it is stuck")
