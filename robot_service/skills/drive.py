"""Navigate: drive to a pose among pots and other robots, recover from bumps, look around when lost. Undock: back out."""

from __future__ import annotations

import math
from collections.abc import Callable

from core.allocation.right_of_way import speed_limit_mps
from core.geometry.planar import Point, Pose, between, wrap
from core.robots import gardener
from core.wire.body import BodyState
from robot_service.docks import Docks
from robot_service.navigator import Navigator
from robot_service.robot import RANK_BUSY, RANK_DRIVING, Robot, SkillFailed, launch_of
from robot_service.skills.arm import fold_arm

BACK_OFF_MPS = 0.08
BACK_OFF_M = 0.13
BACK_OFF_S = 4.0
LOOK_RADPS = 0.5
LOOK_S = 40.0
UNDOCK_MPS = 0.15
UNDOCK_S = 45.0
BUMPS_MAX = 12


async def drive_to(
    robot: Robot,
    goal: Pose,
    *,
    yaw_matters: bool = True,
    rank: int = RANK_DRIVING,
    may_enter: Callable[[], str] = lambda: "",
    zone: tuple[Point, ...] = (),
) -> None:
    """Drive until the robot stands at `goal`. Raises SkillFailed with the reason when it cannot."""
    await fold_arm(robot)
    navigator = Navigator(robot.ground, robot.settings.id, goal, rank, yaw_matters, may_enter, zone)
    robot.activity.rank = rank
    robot.body.rest(False)
    await robot.neighbours.fresh()
    robot.felt()
    bumps = 0
    try:
        while True:
            await robot.tick()
            felt = robot.felt()
            if robot.where.lost:
                await look_around(robot)
            elif felt is not None and (why := touched(felt)):
                bumps += 1
                if bumps > BUMPS_MAX:
                    raise SkillFailed(f"bumped {bumps} times on the way: {why}")
                await back_off(robot, felt, why)
                navigator.bumped()
            elif _step(robot, navigator):
                return
    finally:
        robot.activity.route, robot.activity.waiting = [], ""
        robot.body.want("stop")


def _step(robot: Robot, navigator: Navigator) -> bool:
    """One control period; True on arrival."""
    going = navigator.step(robot.pose(), robot.clock.now(), robot.neighbours.others())
    robot.activity.route, robot.activity.waiting = navigator.route(), going.waiting
    if going.failed:
        raise SkillFailed(going.failed)
    robot.body.want("drive" if going.v_mps or going.omega_radps else "stop", going.v_mps, going.omega_radps)
    return going.done


def touched(state: BodyState) -> str:
    """What the bumper or a cliff sensor feels, as a sentence; empty when nothing."""
    if state.bump_left or state.bump_right:
        side = "ahead" if state.bump_left and state.bump_right else "on the left" if state.bump_left else "on the right"
        return f"bumped into something {side}"
    return "an edge ahead" if any(state.cliff) else ""


async def back_off(robot: Robot, state: BodyState, why: str) -> None:
    """Stop, go back a little, and remember what was there."""
    pose = robot.pose()
    robot.note("bump", why)
    if state.bump_left or state.bump_right:
        angle = pose[2] + 0.6 * (state.bump_left - state.bump_right)
        reach_m = gardener.BODY_RADIUS_M + 0.06
        x_m, y_m = pose[0] + reach_m * math.cos(angle), pose[1] + reach_m * math.sin(angle)
        robot.ground.mark(x_m, y_m, robot.clock.now())
    robot.activity.waiting = why
    until_s = robot.clock.now() + BACK_OFF_S
    while robot.clock.now() < until_s:
        now = robot.pose()
        limit_mps, _ = speed_limit_mps(now, False, robot.neighbours.others())
        gone_m = math.hypot(now[0] - pose[0], now[1] - pose[1])
        if gone_m >= BACK_OFF_M or not _room_behind(robot, now):
            break
        robot.body.want("drive", -min(BACK_OFF_MPS, limit_mps), 0.0)
        await robot.tick()
    robot.body.want("stop")


def _room_behind(robot: Robot, pose: Pose) -> bool:
    x_m, y_m = pose[0] - 0.04 * math.cos(pose[2]), pose[1] - 0.04 * math.sin(pose[2])
    here_m, there_m = robot.ground.clear(pose[0], pose[1]), robot.ground.clear(x_m, y_m)
    return there_m > gardener.BODY_RADIUS_M or there_m > here_m


async def look_around(robot: Robot) -> None:
    """Stop, then turn slowly until the markers agree again. Raises SkillFailed when they do not."""
    since_s, why = robot.clock.now(), robot.where.lost
    robot.note("lost", why)
    robot.activity.waiting = why
    while robot.where.lost:
        waited_s = robot.clock.now() - since_s
        if waited_s > LOOK_S:
            raise SkillFailed(why)
        turning = waited_s > 2.0
        robot.body.want("drive" if turning else "stop", 0.0, LOOK_RADPS if turning else 0.0)
        await robot.tick()
    robot.body.want("stop")
    robot.activity.waiting = ""


async def undock(robot: Robot, docks: Docks, name: str = "") -> None:
    """Fold the arm and back straight out to the launch point; the dock is released once we are out."""
    dock = robot.dock(name or robot.where.docked_at or robot.where.dock_here() or _held_one(docks))
    robot.activity.rank = RANK_BUSY
    await fold_arm(robot)
    robot.body.rest(False)
    await robot.neighbours.fresh()
    goal = launch_of(dock)
    until_s = robot.clock.now() + UNDOCK_S
    try:
        while (pose := robot.pose()) and between(goal, pose)[0] > 0.01:
            limit_mps, by = speed_limit_mps(pose, False, robot.neighbours.others())
            robot.activity.route = [(pose[0], pose[1]), (goal[0], goal[1])]
            robot.activity.waiting = f"{by} stands behind the dock" if limit_mps < 0.01 else ""
            if limit_mps < 0.01:
                until_s += 0.04
            if robot.clock.now() > until_s:
                raise SkillFailed(f"could not leave dock {dock.name} within {UNDOCK_S:.0f} s")
            v_mps = -min(UNDOCK_MPS, limit_mps, 0.05 + 0.5 * between(goal, pose)[0])
            robot.body.want("drive" if v_mps < -0.01 else "stop", v_mps, _straighten(goal, pose) if v_mps < -0.01 else 0.0)
            await robot.tick()
    finally:
        robot.activity.route, robot.activity.waiting = [], ""
        robot.body.want("stop")
    await docks.release(dock.name)


def _held_one(docks: Docks) -> str:
    if len(docks.holds) != 1:
        raise SkillFailed("is not at a dock")
    return next(iter(docks.holds))


def _straighten(line: Pose, pose: Pose) -> float:
    """Yaw rate that keeps a backing robot on the line through `line`, pointing along it."""
    _, y_m, yaw_rad = between(line, pose)
    wanted = max(-0.3, min(0.3, 2.0 * y_m))
    return max(-0.5, min(0.5, 2.0 * wrap(wanted - yaw_rad)))
