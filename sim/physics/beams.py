"""What a robot's infrared receiver, wall sensor and charging plates meet: plane geometry of docks, pots and robots."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from core.robots import gardener as g
from core.wire.geometry import Pose2
from sim.physics.pose import Planar, wrap

BEAM_RANGE_M = 1.6
BEAM_INNER_RAD = math.radians(3.0)
"""Each beam reaches this far across the centre line, so that both are seen within it."""
BEAM_OUTER_RAD = math.radians(22.0)
EMITTER_SETBACK_M = 0.10
"""The lamps sit behind a slit, this far behind the dock's face."""
FIELD_RADIUS_M = 0.5
RED_ON_LEFT = g.DOCK_RED_SIDE == "left"

MATED_ALONG_M = 0.015
MATED_ACROSS_M = 0.020
MATED_RAD = math.radians(6.0)
HELD_SLACK = 1.2
MATED_NEAR_M = 0.05
"""Further than this along the world's x or y no plates touch."""

WALL_EYE_M = (0.10, -0.142)
"""In the base frame, at the body's edge."""
WALL_RANGE_M = 0.10

Disc = tuple[float, float, float]
"""x, y, radius [m]."""


@dataclass(frozen=True, slots=True)
class Infrared:
    red: bool = False
    green: bool = False
    field: bool = False


DARK = Infrared()


class Dock:
    """One dock's geometry, from the pose of the robot that stands at it."""

    def __init__(self, name: str, docked: Pose2) -> None:
        self.name = name
        self.docked = Planar(docked.x_m, docked.y_m, docked.yaw_rad)
        self.emitter = self.docked.point(g.BODY_RADIUS_M + EMITTER_SETBACK_M, 0.0)
        self._out_rad = docked.yaw_rad + math.pi

    def mated(self, pose: Planar, held: bool = False) -> bool:
        """Do the robot's plates touch the dock's? Sprung plates that already do (`held`) part a little later."""
        if abs(pose.x_m - self.docked.x_m) > MATED_NEAR_M or abs(pose.y_m - self.docked.y_m) > MATED_NEAR_M:
            return False
        along, across = self.docked.local(pose.x_m, pose.y_m)
        slack = HELD_SLACK if held else 1.0
        near = abs(along) <= slack * MATED_ALONG_M and abs(across) <= slack * MATED_ACROSS_M and abs(pose.z_m) < 0.02
        return near and abs(wrap(pose.yaw_rad - self.docked.yaw_rad)) <= slack * MATED_RAD

    def shines_on(self, x_m: float, y_m: float, discs: Iterable[Disc]) -> Infrared:
        """What of this dock a receiver at (x, y) sees past the discs that stand about."""
        ex, ey = self.emitter
        dx, dy = x_m - ex, y_m - ey
        distance = math.hypot(dx, dy)
        if distance > BEAM_RANGE_M:
            return DARK
        # Positive: counter-clockwise from the dock's outward axis, which is to the right of an arriving robot.
        off = wrap(math.atan2(dy, dx) - self._out_rad)
        on_right = -BEAM_INNER_RAD <= off <= BEAM_OUTER_RAD
        on_left = -BEAM_OUTER_RAD <= off <= BEAM_INNER_RAD
        near = distance <= FIELD_RADIUS_M
        if not (on_right or on_left or near):
            return DARK
        for disc in discs:
            if _cuts(ex, ey, dx, dy, disc):
                return DARK
        red, green = (on_left, on_right) if RED_ON_LEFT else (on_right, on_left)
        return Infrared(red, green, near)


def infrared(docks: Iterable[Dock], pose: Planar, discs: list[Disc]) -> Infrared:
    """Everything the omni-directional receiver sees at once."""
    x_m, y_m = pose.point(g.IR_RECEIVER_X_M, 0.0)
    red = green = near = False
    for dock in docks:
        if abs(x_m - dock.emitter[0]) > BEAM_RANGE_M or abs(y_m - dock.emitter[1]) > BEAM_RANGE_M:
            continue
        seen = dock.shines_on(x_m, y_m, discs)
        if seen is DARK:
            continue
        red, green, near = red or seen.red, green or seen.green, near or seen.field
    return Infrared(red, green, near)


def wall(pose: Planar, discs: list[Disc]) -> bool:
    """The wall sensor looks to the right from the front right of the body."""
    x_m, y_m = pose.point(*WALL_EYE_M)
    near = [d for d in discs if max(abs(d[0] - x_m), abs(d[1] - y_m)) < d[2] + WALL_RANGE_M]
    if not near:
        return False
    ahead = pose.yaw_rad - math.pi / 2
    dx, dy = WALL_RANGE_M * math.cos(ahead), WALL_RANGE_M * math.sin(ahead)
    return any(_cuts(x_m, y_m, dx, dy, disc) for disc in near)


def _cuts(x: float, y: float, dx: float, dy: float, disc: Disc) -> bool:
    """Does the segment from (x, y) along (dx, dy) pass through the disc?"""
    cx, cy, radius = disc[0] - x, disc[1] - y, disc[2]
    length2 = dx * dx + dy * dy
    at = 0.0 if length2 == 0.0 else min(1.0, max(0.0, (cx * dx + cy * dy) / length2))
    return (cx - at * dx) ** 2 + (cy - at * dy) ** 2 < radius * radius
