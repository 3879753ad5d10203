"""Harvest (paper 000, section 6, Algorithm 3): look, servo, permit, grasp, pull, check, basket. Done at the dock.

The hand comes in and goes out along its own axis. Success is what force and camera both say: something is held, and the
fruit is gone from where it hung.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from core.errors import Refused
from core.manipulation.approach import (
    READY_M,
    ROOM_M_MIN,
    ROOM_SHY_M,
    Approach,
    Obstacle,
    approaches,
    opening_for,
    roomiest,
    turn_m,
    varied,
    way_in,
    way_out,
)
from core.manipulation.arm import Point3
from core.manipulation.servo import Target
from core.robots.gardener import GRIP_N_MAX
from core.wire.fruit import Fruit, Pick
from core.wire.market import Permit, PlantCard
from robot_service.eye import Look
from robot_service.robot import Robot, SkillFailed
from robot_service.skills.arm import SETTLE_S, fold_arm, joints_now
from robot_service.skills.hand import (
    ADVANCE_SHARE,
    HELD_N,
    PULL_SHARE,
    Grip,
    close_gripper,
    come_before,
    feels,
    go_along,
    open_gripper,
    rolls,
    to_basket,
    turn_fingers,
)
from robot_service.skills.plantframe import mapped, plant_in_base
from robot_service.skills.seek import Neighbour, Sight, look_aside, servo, shows

WAYS_MAX = 3
"""From so many directions a fruit is looked for before it is looked at from aside."""
KNOWN_WAYS_MAX = 2
"""And so many are tried after that."""
WAYS_COST_S = 0.012
"""To find and price the ways to one fruit among twenty."""
DOCKING_SIGMA_M = 0.006
"""The plant's frame is known this well from a dock: the robot's own pose error."""
PLACES_MAX = 2
"""The dock, and once a little beside it."""
SHIFT_MPS, SHIFT_RADPS, SHIFT_S, SHIFT_SHARE = 0.08, 0.15, 2.0, 0.7
FIRM_N, FURTHER_M = 5.75, 0.010
"""What lies between the pads is squeezed with the gripper's 6 N. Less is felt where only their tips hold it, and it would
slip out of them: so much further in they hold it."""
DEEPER_M = (0.003, 0.013)
"""How far beyond the fruit's middle the fingers close, at the first grasp and at the next: a fruit that hangs nearer than it
was thought slides further in between them, one that hangs further off is not reached."""
IN_THE_WAY = "other fruit hangs in the way of the hand"

TakePermit = Callable[[str], Awaitable[tuple[Permit, float]]]
"""Asks the plant for leave to pick this fruit; returns the permit and when it was asked for [garden s]."""
KeepPicture = Callable[[Permit, str, Look], Awaitable[None]]
"""Sends the picture `before` or `after` a pick to the plant; must not fail."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What a harvest hands to each pick."""

    robot: Robot
    plant: PlantCard
    take_permit: TakePermit
    keep_picture: KeepPicture


async def harvest(
    robot: Robot,
    plant: PlantCard,
    fruits: Sequence[Fruit],
    count: int,
    take_permit: TakePermit,
    keep_picture: KeepPicture,
    ended: Callable[[Pick], None],
    known: Sequence[Fruit] = (),
) -> None:
    """Pick up to `count` of `fruits`, those with the most room first. `ended` hears of each as soon as it is over."""
    task = Task(robot=robot, plant=plant, take_permit=take_permit, keep_picture=keep_picture)
    left = list(fruits)
    hanging = {fruit.fruit_id: fruit for fruit in (*known, *fruits)}
    picked = 0
    while left and picked < count:
        fruit, ways = await _outermost(task, left, list(hanging.values()))
        left.remove(fruit)
        others = [other for other in hanging.values() if other.fruit_id != fruit.fruit_id]
        robot.activity.waiting = f"picks {fruit.fruit_id}, {picked} of {count} in the basket"
        began_s = robot.clock.now()
        pick = await _pick(task, fruit, others, ways)
        ended(pick.model_copy(update={"took_s": robot.clock.now() - began_s}))
        if pick.outcome == "picked":
            picked += 1
            del hanging[fruit.fruit_id]
    robot.activity.waiting = ""
    await fold_arm(robot)


# ------------------------------------------------------------------ ways to a fruit


def _place(task: Task, fruit: Fruit) -> Point3:
    """Where the inventory has the fruit, seen from where the base is now."""
    return mapped(plant_in_base(task.robot.pose(), task.plant), (fruit.x_m, fruit.y_m, fruit.z_m))


def _obstacles(task: Task, fruits: Sequence[Fruit]) -> list[Obstacle]:
    return [Obstacle(centre=_place(task, fruit), radius_m=fruit.radius_m) for fruit in fruits]


Ways = list[Approach] | Refused
"""How the hand can go, the best way first, or why it cannot."""


async def _outermost(task: Task, left: Sequence[Fruit], hanging: Sequence[Fruit]) -> tuple[Fruit, Ways]:
    """The fruit with the most room about it, and the ways to it; ties by the order asked for."""
    asked = [
        (_place(task, fruit), fruit.radius_m, _obstacles(task, [o for o in hanging if o.fruit_id != fruit.fruit_id]))
        for fruit in left
    ]
    ways = await _ways(task, asked)
    room_m = [found[0].room_m if isinstance(found, list) else -1.0 for found in ways]
    best = room_m.index(max(room_m))
    return left[best], ways[best]


async def _ways(task: Task, asked: Sequence[tuple[Point3, float, list[Obstacle]]]) -> list[Ways]:
    """The ways to each fruit (place, radius [m]) among its neighbours. Off the loop: it takes time."""
    turns = rolls(task.robot)

    def priced() -> list[Ways]:
        return [_ways_or_why(place, radius_m, others, turns) for place, radius_m, others in asked]

    return await task.robot.clock.offload(priced, WAYS_COST_S * len(asked))


def _ways_or_why(place: Point3, radius_m: float, others: Sequence[Obstacle], rolls_rad: Sequence[float]) -> Ways:
    try:
        return approaches(place, radius_m, others, rolls_rad)
    except Refused as refusal:
        return refusal


def _expected(task: Task, fruit: Fruit) -> Target:
    sigma_m = math.hypot(fruit.sigma_m, DOCKING_SIGMA_M)
    return Target.expected(np.array(_place(task, fruit)), sigma_m, fruit.radius_m)


def _unseen(task: Task, fruit: Fruit, others: Sequence[Fruit]) -> Sight:
    """What the inventory tells, before the first picture."""
    near = [Neighbour(_expected(task, other), other.colour) for other in others]
    return Sight(fruit=fruit, place=_place(task, fruit), target=_expected(task, fruit), near=near)


# ------------------------------------------------------------------ one fruit


async def _pick(task: Task, fruit: Fruit, others: Sequence[Fruit], ways: Ways) -> Pick:
    """One fruit, from looking for it to the basket: from other sides, then from another place, then given up."""
    why = ""
    for place in range(PLACES_MAX):
        if place:
            await _shift(task.robot, _place(task, fruit)[1])
            ways = await _ways_to(task, _unseen(task, fruit, others))
        if isinstance(ways, Refused):
            if place:
                break
            return Pick(fruit_id=fruit.fruit_id, outcome="unreachable", reason=str(ways)[:500])
        found = await _pick_from_here(task, fruit, others, ways)
        if isinstance(found, Pick):
            return found
        why = found
    why = f"looked from {PLACES_MAX} places and several sides: {why}"
    return Pick(fruit_id=fruit.fruit_id, outcome="failed", reason=why[:500])


async def _pick_from_here(task: Task, fruit: Fruit, others: Sequence[Fruit], ways: list[Approach]) -> Pick | str:
    """By what is seen on a way with room; else by what is seen from aside as well. Or why not."""
    why, roomy = IN_THE_WAY, _roomy(ways, WAYS_MAX, ROOM_SHY_M)
    for way in roomy:
        found = await _come_and_take(task, way, _unseen(task, fruit, others))
        if isinstance(found, Pick):
            return found
        why = found
    sight = _unseen(task, fruit, others)
    missed = await look_aside(task.robot, sight)
    if missed and roomy:
        return missed
    seen_ways = await _ways_to(task, sight)
    if isinstance(seen_ways, Refused):
        return str(seen_ways)
    for way in _roomy(seen_ways, KNOWN_WAYS_MAX, ROOM_M_MIN):
        found = await _come_and_take(task, way, sight)
        if isinstance(found, Pick):
            return found
        why = found
    return why


async def _ways_to(task: Task, sight: Sight) -> Ways:
    return (await _ways(task, [(sight.at, sight.target.radius_m, sight.obstacles)]))[0]


def _roomy(ways: Sequence[Approach], count: int, least_m: float) -> list[Approach]:
    return varied([way for way in ways if way.room_m >= least_m], count)


async def _come_and_take(task: Task, way: Approach, sight: Sight) -> Pick | str:
    """Along one way: look, come near, and pick; or why nothing was begun."""
    robot = task.robot
    try:
        await come_before(robot, way)
        why = await servo(robot, way, sight, turn_m(sight.at, way, sight.obstacles))
        if not why:
            way_in(sight.at, way.pitch_rad, READY_M, -DEEPER_M[0])
    except Refused as error:
        why = reason_unless_halted(error)
    if why:
        return why
    turned = _turned(robot, way, sight)
    return await _take(task, turned, sight) if turned.room_m >= ROOM_M_MIN else f"seen from near, {IN_THE_WAY}"


def _turned(robot: Robot, way: Approach, sight: Sight) -> Approach:
    """The way with the fingers opened and turned as is best by what was seen on it of the fruit and its neighbours."""
    opening_m = opening_for(sight.target.radius_m)
    roll_rad, room_m = roomiest(sight.at, way.pitch_rad, opening_m, sight.obstacles, rolls(robot))
    return replace(way, opening_m=opening_m, roll_rad=roll_rad, room_m=room_m)


def reason_unless_halted(error: Refused) -> str:
    """Why a way did not work; an e-stop or a dead device ends everything instead."""
    if isinstance(error, SkillFailed):
        raise error
    return str(error)


async def _shift(robot: Robot, side_m: float) -> None:
    """Move the base a hand's breadth towards the fruit's side: back in an arc, and most of the way forward again.

    What it bumps into on the way back shortens the way forward as well; what it bumps into there ends it.
    """
    await fold_arm(robot)
    turn = math.copysign(SHIFT_RADPS, side_m)
    back_s = await _drive(robot, -SHIFT_MPS, turn, SHIFT_S)
    await _drive(robot, SHIFT_MPS, -turn, SHIFT_SHARE * back_s)
    await robot.pause(SETTLE_S)


async def _drive(robot: Robot, v_mps: float, omega_radps: float, seconds: float) -> float:
    """Drive so long, or until something is bumped into; how long it was [s]."""
    began_s = robot.clock.now()
    while robot.clock.now() < began_s + seconds:
        robot.body.want("drive", v_mps, omega_radps)
        state = await robot.tick()
        if state.bump_left or state.bump_right:
            break
    return robot.clock.now() - began_s


# ------------------------------------------------------------------ the irreversible part


async def _take(task: Task, way: Approach, sight: Sight) -> Pick:
    """Grasp and pull: under a permit, and nothing of it is begun after the permit's validity."""
    robot, fruit_id = task.robot, sight.fruit.fruit_id
    before = await robot.eye.look()
    if feels(robot):
        raise SkillFailed(f"the force sensor feels {robot.state().force_n:.1f} N between open fingers: it is stuck")
    permit, asked_s = await task.take_permit(fruit_id)
    await task.keep_picture(permit, "before", before)
    why = ""
    for deeper_m in DEEPER_M:
        if robot.clock.now() - asked_s > permit.valid_for_s:
            why = why or "the permit ran out"
            break
        short_m = turn_m(sight.at, way, sight.obstacles)
        try:
            held = await _grasp(robot, way, sight.at, short_m, deeper_m)
        except Refused as error:
            why = reason_unless_halted(error)
            break
        if held:
            return await _carry(task, way, sight, permit)
        why = "nothing was held: the force sensor felt no fruit"
        try:
            await _let_go(robot, way, sight.at, short_m)
            lost = await servo(robot, way, sight, short_m)
        except Refused as error:
            lost = reason_unless_halted(error)
        if lost:
            why = f"{why}; then {lost}"
            break
    await task.keep_picture(permit, "after", await robot.eye.look())
    return Pick(fruit_id=fruit_id, outcome="failed", reason=why[:500], permit_id=permit.permit_id)


async def _grasp(robot: Robot, way: Approach, fruit: Point3, short_m: float, deeper_m: float) -> bool:
    """Turn the fingers, advance straight onto the fruit, as deep as the arm reaches, and close; whether it is felt."""
    grip = Grip(way.opening_m, way.roll_rad)
    try:
        path = way_in(fruit, way.pitch_rad, short_m, -deeper_m)
    except Refused:
        path = way_in(fruit, way.pitch_rad, short_m)
    await turn_fingers(robot, way.roll_rad, grip)
    await go_along(robot, path, ADVANCE_SHARE, grip)
    force_n = await _close(robot)
    if HELD_N < force_n < FIRM_N:
        try:
            further = way_in(fruit, way.pitch_rad, -deeper_m, -deeper_m - FURTHER_M)
        except Refused:
            return True
        await open_gripper(robot, way.opening_m)
        await go_along(robot, further, ADVANCE_SHARE, grip)
        force_n = await _close(robot)
    return force_n > HELD_N


async def _close(robot: Robot) -> float:
    """Close the fingers; what they squeeze with [N]."""
    await close_gripper(robot)
    force_n = robot.state().force_n
    if force_n is None:
        raise SkillFailed("the force sensor is silent: whether anything is held cannot be told")
    return force_n


async def _let_go(robot: Robot, way: Approach, fruit: Point3, short_m: float) -> None:
    """Back to where the fingers were turned, and level again: the eye sees past them."""
    await go_along(robot, way_in(fruit, way.pitch_rad, 0.0, short_m), PULL_SHARE, Grip(way.opening_m, way.roll_rad))
    await turn_fingers(robot, -way.roll_rad, Grip(way.opening_m))


async def _carry(task: Task, way: Approach, sight: Sight, permit: Permit) -> Pick:
    """Pull it off, see that it came, lay it into the basket."""
    robot, fruit = task.robot, sight.fruit
    feared = await _pull(robot, way, sight)
    after = await robot.eye.look()
    await task.keep_picture(permit, "after", after)
    held, still = feels(robot), shows(robot, after, sight)
    if not held:
        where = "it still hangs there" if still else "it fell"
        await open_gripper(robot, way.opening_m)
        return _lost(fruit, permit, f"slipped out of the fingers{feared}: {where}", gone=not still)
    if not await to_basket(robot):
        return _lost(fruit, permit, "slipped out of the fingers on the way to the basket: it fell", gone=not still)
    remark = "held by force; another fruit shows where it hung" if still else ""
    return Pick(fruit_id=fruit.fruit_id, outcome="picked", reason=remark, permit_id=permit.permit_id)


def _lost(fruit: Fruit, permit: Permit, reason: str, gone: bool) -> Pick:
    return Pick(fruit_id=fruit.fruit_id, outcome="failed", reason=reason, permit_id=permit.permit_id, gone=gone)


async def _pull(robot: Robot, way: Approach, sight: Sight) -> str:
    """Back, slowly, the hand tipping; a remark when the squeeze went beyond its limit."""
    path = way_out(sight.at, way, sight.target.radius_m, sight.obstacles)
    await go_along(robot, [joints_now(robot), *path], PULL_SHARE, Grip(0.0, way.roll_rad))
    force_n = robot.state().force_n
    return f" (squeezed with {force_n:.1f} N)" if force_n is not None and force_n > GRIP_N_MAX else ""
