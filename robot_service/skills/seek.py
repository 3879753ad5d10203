"""Looking for one fruit among others: which circle is which, the servo that brings the hand before it, looks from aside.

What was seen of the fruit and of all about it is gathered in a `Sight`, in the frame of a base that stands still.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from core.errors import Refused, Unprocessable
from core.inventory.matching import assign
from core.inventory.sightings import lift_fixed_radius
from core.manipulation.approach import READY_M, Approach, Obstacle
from core.manipulation.arm import Point3, inverse
from core.manipulation.eye import beside, camera_pose
from core.manipulation.kinematics import Array
from core.manipulation.servo import FRUIT_RADIUS_M, GATE_CHI2, Target, interaction_matrix, servo_step
from core.manipulation.swing import Leg, leg_s
from core.perception.detection import Detection
from core.robots import gardener
from core.wire.fruit import Fruit
from robot_service.eye import Look
from robot_service.robot import Robot, SkillFailed
from robot_service.skills.arm import joints_now, move_arm, withdraw
from robot_service.skills.hand import FAST_SHARE, Grip, swing_to

LOOKS_MAX = 10
"""Of one servo run."""
BLIND_MAX = 1
"""Pictures in a row without the fruit, besides the first."""
NEAR_SIDE_M, NEAR_DEPTH_M = 0.004, 0.008
"""The servo is content when the fruit is this near to the middle between the fingers, and to its distance."""
FAR_OFF_M, FAR_OFF_SIGMAS = 0.016, 1.5
"""A fruit further than this from where the inventory has it, or than so many of its standard deviations beyond, is another
one: neighbours hang two to four centimetres apart."""
OPPOSITE = {"red": "green", "green": "red"}
"""No detector takes one of these for the other; turning goes for both."""
STRANGE_RATIO = 0.6
"""A circle whose centre is further from all others than this part of both radii is a fruit of its own."""
STRANGER_SIGMA_M, STRANGER_KNOWN_M = 0.015, 0.010
UNSEEN = "the camera does not see it"


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A fruit that is not wanted now: what is known of it, better with every picture."""

    target: Target
    colour: str
    stranger: bool = False
    """Not in the inventory."""

    @property
    def counts(self) -> bool:
        """A circle of which one picture alone tells may be a leaf, or hang much further off."""
        return not self.stranger or (self.target.sightings > 0 and self.target.sigma_m <= STRANGER_KNOWN_M)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """The fruit that is wanted, where the inventory has it (base frame [m]), and what was seen of it and its neighbours."""

    fruit: Fruit
    place: Point3
    target: Target
    near: list[Neighbour]

    @property
    def at(self) -> Point3:
        """Where the fruit is, as far as is known now."""
        return point(self.target.p_base)

    @property
    def obstacles(self) -> list[Obstacle]:
        near = [other.target for other in self.near if other.counts]
        return [Obstacle(centre=point(other.p_base), radius_m=other.radius_m) for other in near]


def point(p: Array) -> Point3:
    return float(p[0]), float(p[1]), float(p[2])


async def servo(robot: Robot, way: Approach, sight: Sight, short_m: float = READY_M) -> str:
    """Bring the hand to `short_m` before the fruit by what the camera sees; why it did not, or empty.

    Image-based: the features' error through the inverse interaction matrix gives the camera's next step; the distance in
    it comes from all pictures so far, not from the radius alone. A fruit whose place is `known` from other sides may be
    hidden from this one. Raises Refused when a step leaves the arm's reach.
    """
    goal = _goal_in_camera(short_m)
    blind = 0
    for _ in range(LOOKS_MAX):
        look = await robot.eye.look()
        T_base_cam = camera_pose(joints_now(robot))
        seen = take_in(robot, sight, look, T_base_cam)
        if not seen and not sight.target.known:
            blind += 1
            if blind > BLIND_MAX:
                return UNSEEN
            continue
        blind = 0
        if why := _another(sight):
            return why
        gap = T_base_cam[:3, :3].T @ (sight.target.p_base - T_base_cam[:3, 3]) - goal
        if np.hypot(gap[0], gap[1]) < NEAR_SIDE_M and abs(gap[2]) < NEAR_DEPTH_M:
            return ""
        await _step(robot, way.pitch_rad, sight.target, T_base_cam, goal)
    return "the hand did not settle before it"


async def look_aside(robot: Robot, sight: Sight) -> str:
    """Look from both sides, from above and below until the fruit's place is known; why it is not, or empty."""
    await withdraw(robot)
    why = UNSEEN
    for q in beside(sight.at):
        try:
            await swing_to(robot, q, Grip(0.0))
        except SkillFailed:
            raise
        except Refused:
            continue
        look = await robot.eye.look()
        if take_in(robot, sight, look, camera_pose(joints_now(robot))):
            why = _another(sight)
            if why or sight.target.known:
                return why
            why = "the camera sees it from one side only"
    return why


def _another(sight: Sight) -> str:
    """Why what is seen is not the fruit that is wanted; empty when it is."""
    if float(np.linalg.norm(sight.target.p_base - np.array(sight.place))) > FAR_OFF_M + FAR_OFF_SIGMAS * sight.fruit.sigma_m:
        return "what the camera sees hangs too far from where the inventory has the fruit"
    return ""


def take_in(robot: Robot, sight: Sight, look: Look, T_base_cam: Array) -> bool:
    """Take one picture into account; whether it shows the fruit."""
    mine = _told_apart(robot, look.detections, sight, T_base_cam)
    _learn(robot, look.sure, mine, sight.near, T_base_cam)
    if (circle := mine.get(0)) is None:
        return False
    sight.target.see(robot.eye.camera, T_base_cam, circle.features)
    return True


def _told_apart(robot: Robot, circles: Sequence[Detection], sight: Sight, T_base_cam: Array) -> dict[int, Detection]:
    """Which circle is the target's (0) and which its neighbours' (1, 2, ...): the likeliest for all of them together."""
    hanging = [(sight.target, sight.fruit.colour), *((other.target, other.colour) for other in sight.near)]
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
            near.append(Neighbour(Target.expected(p, STRANGER_SIGMA_M, FRUIT_RADIUS_M), circle.colour, stranger=True))


def _distance2(robot: Robot, target: Target, circle: Detection, T: Array) -> float:
    try:
        return target.distance2(robot.eye.camera, T, circle.features)
    except Unprocessable:
        return math.inf


def shows(robot: Robot, look: Look, sight: Sight) -> bool:
    """Whether a circle is just where the fruit was, as sure as circles are; never of the opposite colour."""
    there, T = Target.expected(sight.target.p_base, 0.006, sight.target.radius_m), camera_pose(joints_now(robot))
    fitting = (circle for circle in look.sure if circle.colour != OPPOSITE.get(sight.fruit.colour))
    return any(_distance2(robot, there, circle, T) < GATE_CHI2 for circle in fitting)


def _goal_in_camera(short_m: float) -> Array:
    """Where the fruit is, in the camera's frame, when the tool is so far short of it (3,) [m]."""
    x, y, z = gardener.CAMERA_IN_HAND_M
    return np.array([-y, z, gardener.HAND_M + short_m - x])


async def _step(robot: Robot, pitch_rad: float, target: Target, T_base_cam: Array, goal_m: Array) -> None:
    """One step of the control law."""
    camera = robot.eye.camera
    u, v, r = target.features(camera, T_base_cam)
    at_goal = replace(target, p_base=T_base_cam[:3, :3] @ goal_m + T_base_cam[:3, 3])
    goal = at_goal.features(camera, T_base_cam)
    L = interaction_matrix(camera, u, v, r, target.radius_m)
    step = T_base_cam[:3, :3] @ servo_step(L, np.array([u, v, r]) - goal)
    at = T_base_cam[:3, 3] + step
    q = inverse((float(at[0]), float(at[1]), float(at[2])), pitch_rad, gardener.CAMERA_IN_HAND_M)
    now = joints_now(robot)
    await move_arm(robot, [Leg(q=q, duration_s=leg_s(now, q, FAST_SHARE))])
