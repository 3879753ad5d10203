"""Harvest (paper 000, section 6, Algorithm 3): look, servo, permit, grasp, pull, check, basket. Done at the dock.

The hand comes in and goes out along its own axis. Success is what force and camera both say: something is held, and the
fruit is gone from where it hung.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from core.errors import Refused, Unprocessable
from core.inventory.matching import assign
from core.inventory.sightings import lift_fixed_radius
from core.manipulation.approach import (
    READY_M,
    RETREAT_M,
    ROLLS_RAD,
    ROOM_M_MIN,
    Approach,
    Obstacle,
    along,
    approaches,
    roomiest,
    way_in,
)
from core.manipulation.arm import Joints, Point3, inverse
from core.manipulation.eye import camera_pose
from core.manipulation.kinematics import Array
from core.manipulation.servo import FRUIT_RADIUS_M, GATE_CHI2, Target, interaction_matrix, servo_step
from core.manipulation.swing import Leg, leg_s, swing
from core.perception.detection import Detection
from core.robots import gardener
from core.wire.fruit import Fruit, Pick
from core.wire.market import Permit, PlantCard
from robot_service.eye import Look
from robot_service.robot import Robot, SkillFailed
from robot_service.skills.arm import SETTLE_S, fold_arm, joints_now, move_arm, withdraw
from robot_service.skills.plantframe import mapped, plant_in_base

WAYS_MAX = 3
"""From so many directions a fruit is looked for before it is given up."""
WAYS_COST_S = 0.012
"""To find and price the ways to one fruit among twenty."""
LOOKS_MAX = 10
"""Of one servo run."""
BLIND_MAX = 2
"""Pictures in a row without the fruit."""
DOCKING_SIGMA_M = 0.006
"""The plant's frame is known this well from a dock: the robot's own pose error."""
PLACES_MAX = 2
"""The dock, and once a little beside it."""
SHIFT_MPS, SHIFT_RADPS, SHIFT_S, SHIFT_SHARE = 0.08, 0.15, 2.0, 0.7
NEAR_SIDE_M, NEAR_DEPTH_M = 0.004, 0.008
"""The servo is content when the fruit is this near to the middle between the fingers, and to its distance."""
FAR_OFF_M, FAR_OFF_SIGMAS = 0.016, 1.5
"""A fruit further than this from where the inventory has it, or than so many of its standard deviations beyond, is another
one: neighbours hang two to four centimetres apart."""
OPPOSITE = {"red": "green", "green": "red"}
"""No detector takes one of these for the other; turning goes for both."""
STRANGE_RATIO = 0.6
"""A circle whose centre is further from all others than this part of both radii is a fruit of its own."""
STRANGER_SIGMA_M = 0.015
HELD_N = 0.8
"""Squeeze above which something is between the fingers."""
GRIP_N_MAX = 9.0
CLOSE_S = 0.6
DEEPER_M = (0.003, 0.013)
"""How far beyond the fruit's middle the fingers close, at the first grasp and at the next: a fruit that hangs nearer than it
was thought slides further in between them, one that hangs further off is not reached."""
FAST_SHARE, ADVANCE_SHARE, PULL_SHARE = 0.5, 0.2, 0.15
"""Of a servo's top speed: through the air, in among the fruit, and with one in hand."""
TWIST_RAD = 0.30
"""The hand tips up while it pulls: the stalk bends over its knuckle and breaks at less force."""
RELEASE_S = 0.4

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


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A fruit that is not wanted now: what is known of it, better with every picture."""

    target: Target
    colour: str


@dataclass(frozen=True, slots=True)
class Grip:
    """What the fingers do on a way: their opening [m] and their turn about the hand's axis [rad]."""

    opening_m: float
    roll_rad: float


def _roll(robot: Robot, grip: Grip) -> float | None:
    """The turn for a wrist that rolls; None for one that cannot."""
    return grip.roll_rad if robot.settings.wrist == "roll" else None


def _rolls(robot: Robot) -> tuple[float, ...]:
    return ROLLS_RAD if robot.settings.wrist == "roll" else (0.0,)


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


def _place(task: Task, fruit: Fruit) -> Point3:
    """Where the inventory has the fruit, seen from where the base is now."""
    return mapped(plant_in_base(task.robot.pose(), task.plant), (fruit.x_m, fruit.y_m, fruit.z_m))


def _obstacles(task: Task, fruits: Sequence[Fruit]) -> list[Obstacle]:
    return [Obstacle(centre=_place(task, fruit), radius_m=fruit.radius_m) for fruit in fruits]


Ways = list[Approach] | Refused
"""How the hand can go, the best way first, or why it cannot."""


async def _outermost(task: Task, left: Sequence[Fruit], hanging: Sequence[Fruit]) -> tuple[Fruit, Ways]:
    """The fruit with the most room about it, and the ways to it; ties by the order asked for."""
    ways = await _ways(task, left, hanging)
    room_m = [found[0].room_m if isinstance(found, list) else -1.0 for found in ways]
    best = room_m.index(max(room_m))
    return left[best], ways[best]


async def _ways(task: Task, fruits: Sequence[Fruit], hanging: Sequence[Fruit]) -> list[Ways]:
    """The ways to each of `fruits` among all that hang. Off the loop: it takes time."""
    rolls_rad = _rolls(task.robot)
    asked = [
        (_place(task, fruit), fruit.radius_m, _obstacles(task, [o for o in hanging if o.fruit_id != fruit.fruit_id]))
        for fruit in fruits
    ]

    def priced() -> list[Ways]:
        return [_ways_or_why(place, radius_m, others, rolls_rad) for place, radius_m, others in asked]

    return await task.robot.clock.offload(priced, WAYS_COST_S * len(asked))


def _ways_or_why(place: Point3, radius_m: float, others: Sequence[Obstacle], rolls_rad: Sequence[float]) -> Ways:
    try:
        return approaches(place, radius_m, others, rolls_rad)
    except Refused as refusal:
        return refusal


async def _pick(task: Task, fruit: Fruit, others: Sequence[Fruit], ways: Ways) -> Pick:
    """One fruit, from looking for it to the basket: from other sides, then from another place, then given up."""
    why = ""
    for place in range(PLACES_MAX):
        if place:
            await _shift(task.robot, _place(task, fruit)[1])
            ways = (await _ways(task, [fruit], others))[0]
        if isinstance(ways, Refused):
            if place:
                break
            return Pick(fruit_id=fruit.fruit_id, outcome="unreachable", reason=str(ways)[:500])
        roomy = [way for way in ways if way.room_m >= ROOM_M_MIN]
        why = why if roomy else "other fruit hangs in the way of the hand"
        for way in roomy[:WAYS_MAX]:
            target, near = _expected(task, fruit), [Neighbour(_expected(task, o), o.colour) for o in others]
            try:
                await _swing_before(task.robot, way)
                why = await servo(task.robot, way.pitch_rad, target, fruit, _place(task, fruit), near)
            except Refused as error:
                why = reason_unless_halted(error)
            if not why:
                turned = _turned(task.robot, way, target, near)
                if turned.room_m >= ROOM_M_MIN:
                    return await _take(task, fruit, turned, target, near)
                why = "seen from near, other fruit hangs in the way of the hand"
    why = f"looked from {PLACES_MAX} places and several sides: {why}"
    return Pick(fruit_id=fruit.fruit_id, outcome="failed", reason=why[:500])


def _turned(robot: Robot, way: Approach, target: Target, near: Sequence[Neighbour]) -> Approach:
    """The way with the fingers turned as is best by what was seen on it of the fruit and its neighbours."""
    fruit = _point(target.p_base)
    others = [Obstacle(centre=_point(other.target.p_base), radius_m=other.target.radius_m) for other in near]
    roll_rad, room_m = roomiest(fruit, way.pitch_rad, way.opening_m, others, _rolls(robot))
    return replace(way, roll_rad=roll_rad, room_m=room_m)


def _told_apart(
    robot: Robot, circles: Sequence[Detection], target: Target, colour: str, near: Sequence[Neighbour], T_base_cam: Array
) -> dict[int, Detection]:
    """Which circle is the target's (0) and which its neighbours' (1, 2, ...): the likeliest for all of them together."""
    hanging = [(target, colour), *((other.target, other.colour) for other in near)]
    costs = {
        (row, column): _distance2(robot, known, circle, T_base_cam)
        for row, (known, its_colour) in enumerate(hanging)
        for column, circle in enumerate(circles)
        if circle.colour != OPPOSITE.get(its_colour)
    }
    return {row: circles[column] for row, column in assign(costs, len(hanging), GATE_CHI2).items()}


def _learn(robot: Robot, circles: Sequence[Detection], mine: dict[int, Detection], near: list[Neighbour], T: Array) -> None:
    """Take what was seen of the neighbours into account; circles that belong to no known fruit are neighbours too."""
    camera = robot.eye.camera
    for row, circle in mine.items():
        if row > 0:
            near[row - 1].target.see(camera, T, circle.features)
    known = [(circle.u_px, circle.v_px, circle.radius_px) for circle in mine.values()]
    for circle in circles:
        if all(math.hypot(circle.u_px - u, circle.v_px - v) > STRANGE_RATIO * (circle.radius_px + r) for u, v, r in known):
            p = lift_fixed_radius(camera, T, circle)
            near.append(Neighbour(Target.expected(p, STRANGER_SIGMA_M, FRUIT_RADIUS_M), circle.colour))


def _distance2(robot: Robot, target: Target, circle: Detection, T: Array) -> float:
    try:
        return target.distance2(robot.eye.camera, T, circle.features)
    except Unprocessable:
        return math.inf


def reason_unless_halted(error: Refused) -> str:
    """Why a way did not work; an e-stop or a dead device ends everything instead."""
    if isinstance(error, SkillFailed):
        raise error
    return str(error)


def _expected(task: Task, fruit: Fruit) -> Target:
    sigma_m = math.hypot(fruit.sigma_m, DOCKING_SIGMA_M)
    return Target.expected(np.array(_place(task, fruit)), sigma_m, fruit.radius_m)


async def _shift(robot: Robot, side_m: float) -> None:
    """Move the base a hand's breadth towards the fruit's side: back in an arc, and most of the way forward again."""
    await fold_arm(robot)
    turn = math.copysign(SHIFT_RADPS, side_m)
    for v_mps, omega_radps, seconds in ((-SHIFT_MPS, turn, SHIFT_S), (SHIFT_MPS, -turn, SHIFT_SHARE * SHIFT_S)):
        until_s = robot.clock.now() + seconds
        while robot.clock.now() < until_s:
            robot.body.want("drive", v_mps, omega_radps)
            state = await robot.tick()
            if state.bump_left or state.bump_right:
                break
    await robot.pause(SETTLE_S)


async def servo(robot: Robot, pitch_rad: float, target: Target, fruit: Fruit, place: Point3, near: list[Neighbour]) -> str:
    """Bring the hand to `READY_M` before the fruit by what the camera sees; why it did not, or empty.

    Image-based: the features' error through the inverse interaction matrix gives the camera's next step; the distance in
    it comes from all pictures so far, not from the radius alone. Raises Refused when a step leaves the arm's reach.
    """
    blind = 0
    for _ in range(LOOKS_MAX):
        look = await robot.eye.look()
        T_base_cam = camera_pose(joints_now(robot))
        mine = _told_apart(robot, look.detections, target, fruit.colour, near, T_base_cam)
        _learn(robot, look.sure, mine, near, T_base_cam)
        if (circle := mine.get(0)) is None:
            blind += 1
            if blind > BLIND_MAX:
                return "the camera does not see it"
            continue
        blind = 0
        target.see(robot.eye.camera, T_base_cam, circle.features)
        if float(np.linalg.norm(target.p_base - np.array(place))) > FAR_OFF_M + FAR_OFF_SIGMAS * fruit.sigma_m:
            return "what the camera sees hangs too far from where the inventory has the fruit"
        gap = T_base_cam[:3, :3].T @ (target.p_base - T_base_cam[:3, 3]) - GOAL_IN_CAMERA_M
        if np.hypot(gap[0], gap[1]) < NEAR_SIDE_M and abs(gap[2]) < NEAR_DEPTH_M:
            return ""
        await _step(robot, pitch_rad, target, T_base_cam)
    return "the hand did not settle before it"


GOAL_IN_CAMERA_M: Array = np.array(
    [
        -gardener.CAMERA_IN_HAND_M[1],
        gardener.CAMERA_IN_HAND_M[2],
        gardener.HAND_M + READY_M - gardener.CAMERA_IN_HAND_M[0],
    ]
)
"""Where the fruit is, in the camera's frame, when the tool is `READY_M` short of it."""


async def _step(robot: Robot, pitch_rad: float, target: Target, T_base_cam: Array) -> None:
    """One step of the control law."""
    camera = robot.eye.camera
    u, v, r = target.features(camera, T_base_cam)
    at_goal = replace(target, p_base=T_base_cam[:3, :3] @ GOAL_IN_CAMERA_M + T_base_cam[:3, 3])
    goal = at_goal.features(camera, T_base_cam)
    L = interaction_matrix(camera, u, v, r, target.radius_m)
    step = T_base_cam[:3, :3] @ servo_step(L, np.array([u, v, r]) - goal)
    at = T_base_cam[:3, 3] + step
    q = inverse((float(at[0]), float(at[1]), float(at[2])), pitch_rad, gardener.CAMERA_IN_HAND_M)
    now = joints_now(robot)
    await move_arm(robot, [Leg(q=q, duration_s=leg_s(now, q, FAST_SHARE))])


def best_match(
    robot: Robot, circles: Sequence[Detection], target: Target, T_base_cam: Array, colour: str
) -> Detection | None:
    """The detection that is most likely the target, within its gate; never of the opposite colour."""
    fitting = [(index, c) for index, c in enumerate(circles) if c.colour != OPPOSITE.get(colour)]
    scored = [(_distance2(robot, target, c, T_base_cam), index) for index, c in fitting]
    within = [pair for pair in scored if pair[0] < GATE_CHI2]
    return circles[min(within)[1]] if within else None


async def _take(task: Task, fruit: Fruit, way: Approach, target: Target, near: list[Neighbour]) -> Pick:
    """The irreversible part: under a permit, and nothing of it is begun after the permit's validity."""
    robot = task.robot
    before = await robot.eye.look()
    if feels(robot):
        raise SkillFailed(f"the force sensor feels {robot.state().force_n:.1f} N between open fingers: it is stuck")
    permit, asked_s = await task.take_permit(fruit.fruit_id)
    await task.keep_picture(permit, "before", before)
    why = ""
    for deeper_m in DEEPER_M:
        if robot.clock.now() - asked_s > permit.valid_for_s:
            why = why or "the permit ran out"
            break
        try:
            held = await _grasp(robot, way, target, deeper_m)
        except Refused as error:
            why = reason_unless_halted(error)
            break
        if held:
            return await _carry(task, fruit, way, target, permit)
        why = "nothing was held: the force sensor felt no fruit"
        await _go_along(robot, _reversed_way(target, way), PULL_SHARE, Grip(way.opening_m, way.roll_rad))
        try:
            lost = await servo(robot, way.pitch_rad, target, fruit, _place(task, fruit), near)
        except Refused as error:
            lost = reason_unless_halted(error)
        if lost:
            why = f"{why}; then {lost}"
            break
    await task.keep_picture(permit, "after", await robot.eye.look())
    return Pick(fruit_id=fruit.fruit_id, outcome="failed", reason=why[:500], permit_id=permit.permit_id)


def _point(p: Array) -> Point3:
    return float(p[0]), float(p[1]), float(p[2])


def _reversed_way(target: Target, way: Approach) -> list[Joints]:
    return list(way_in(_point(target.p_base), way.pitch_rad, 0.0, READY_M))


async def _grasp(robot: Robot, way: Approach, target: Target, deeper_m: float) -> bool:
    """Advance straight onto the fruit and close; whether the force sensor feels it."""
    grip = Grip(way.opening_m, way.roll_rad)
    await _go_along(robot, way_in(_point(target.p_base), way.pitch_rad, READY_M, -deeper_m), ADVANCE_SHARE, grip)
    await close_gripper(robot)
    force_n = robot.state().force_n
    if force_n is None:
        raise SkillFailed("the force sensor is silent: whether anything is held cannot be told")
    return force_n > HELD_N


async def close_gripper(robot: Robot) -> None:
    """Close until the force sensor feels something firmly, or the fingers meet."""
    await _fingers(robot, 0.0, CLOSE_S + SETTLE_S)


async def open_gripper(robot: Robot, opening_m: float = gardener.GRIPPER_OPEN_M) -> None:
    await _fingers(robot, opening_m, RELEASE_S)


async def _fingers(robot: Robot, opening_m: float, seconds: float) -> None:
    """Move the fingers while the arm holds still."""
    q, until_s = joints_now(robot), robot.clock.now() + seconds
    while robot.clock.now() < until_s:
        robot.body.want(arm=q, arm_s=0.1, gripper_m=opening_m)
        await robot.tick()


async def _carry(task: Task, fruit: Fruit, way: Approach, target: Target, permit: Permit) -> Pick:
    """Pull it off, see that it came, lay it into the basket."""
    robot = task.robot
    feared = await _pull(robot, way, target)
    after = await robot.eye.look()
    await task.keep_picture(permit, "after", after)
    held = feels(robot)
    T_base_cam = camera_pose(joints_now(robot))
    still = best_match(robot, after.sure, _sharp(target), T_base_cam, fruit.colour)
    if not held:
        where = "it still hangs there" if still is not None else "it fell"
        await open_gripper(robot, way.opening_m)
        return _lost(fruit, permit, f"slipped out of the fingers{feared}: {where}", gone=still is None)
    if not await to_basket(robot):
        return _lost(fruit, permit, "slipped out of the fingers on the way to the basket: it fell", gone=still is None)
    remark = "held by force; another fruit shows where it hung" if still is not None else ""
    return Pick(fruit_id=fruit.fruit_id, outcome="picked", reason=remark, permit_id=permit.permit_id)


def _lost(fruit: Fruit, permit: Permit, reason: str, gone: bool) -> Pick:
    return Pick(fruit_id=fruit.fruit_id, outcome="failed", reason=reason, permit_id=permit.permit_id, gone=gone)


def _sharp(target: Target) -> Target:
    """Only a circle just where the fruit was counts as the fruit still there."""
    return replace(target, P=np.eye(3) * 0.006**2)


async def _pull(robot: Robot, way: Approach, target: Target) -> str:
    """Straight back, slowly, the hand tipping up; a remark when the squeeze went beyond its limit."""
    fruit, start = _point(target.p_base), joints_now(robot)
    path = [start]
    for share in (0.15, 0.3, 0.45, 0.6, 0.8, 1.0):
        tilt = TWIST_RAD * min(1.0, share / 0.6)
        try:
            path.append(_tilted(fruit, way.pitch_rad, share * RETREAT_M, tilt))
        except Refused:
            path.append(_tilted(fruit, way.pitch_rad, share * RETREAT_M, 0.0))
    await _go_along(robot, path, PULL_SHARE, Grip(0.0, way.roll_rad))
    force_n = robot.state().force_n
    return f" (squeezed with {force_n:.1f} N)" if force_n is not None and force_n > GRIP_N_MAX else ""


def _tilted(fruit: Point3, pitch_rad: float, back_m: float, tilt_rad: float) -> Joints:
    return inverse(along(fruit, pitch_rad, back_m), pitch_rad + tilt_rad)


async def _go_along(robot: Robot, path: Sequence[Joints], share: float, grip: Grip) -> None:
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
    settled_s = robot.clock.now() + SETTLE_S
    while robot.clock.now() < settled_s:
        robot.body.want(arm=now, arm_s=0.1, gripper_m=grip.opening_m, roll_rad=_roll(robot, grip))
        await robot.tick()


async def _swing_before(robot: Robot, way: Approach) -> None:
    """Before the fruit: out of the plant first, aside where nothing hangs, and straight in."""
    grip = Grip(way.opening_m, way.roll_rad)
    await withdraw(robot)
    await _swing(robot, way.back, grip)
    await _go_along(robot, (way.look,), FAST_SHARE, grip)


async def _swing(robot: Robot, goal: Joints, grip: Grip) -> None:
    """To a pose by clear legs, the gripper opening on the way."""
    for leg in swing(joints_now(robot), goal):
        await _go_along(robot, (leg.q,), FAST_SHARE, grip)


async def to_basket(robot: Robot) -> bool:
    """Over the basket without letting go, and open; whether something was held until there."""
    for leg in swing(joints_now(robot), gardener.ARM_BASKET_RAD):
        await _go_along(robot, (leg.q,), FAST_SHARE, Grip(0.0, 0.0))
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
