"""Where a robot's wheels may take it: a rectangle of the world frame, and the ceiling markers that tell its body its place.

World frame as in `core.scenario`; a place is the base's middle and its heading.
"""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.geometry.planar import Pose, wrap
from core.robots.markers import ceiling_markers
from core.scenario import Arena
from core.wire.geometry import Pose2

KEEP_M = 0.12
"""The base's middle keeps so far inside: its wheels stand half a track to either side."""
LOOK_AHEAD_S = 0.3
"""Setpoint to standstill, with a reading's age: nothing may be outside so soon."""

Metres = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]


class Fence(BaseModel):
    """`BODY_FENCE`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    x_m_min: Metres
    x_m_max: Metres
    y_m_min: Metres
    y_m_max: Metres
    markers: Annotated[dict[int, Pose2], Field(min_length=1)]
    """Marker id -> its pose below the ceiling."""

    @model_validator(mode="after")
    def _holds_a_robot(self) -> Self:
        if min(self.x_m_max - self.x_m_min, self.y_m_max - self.y_m_min) <= 2 * KEEP_M:
            raise ValueError(f"a fence must be wider than {2 * KEEP_M:g} m both ways")
        return self

    def outside_m(self, x_m: float, y_m: float) -> float:
        """How far the base's middle stands beyond where it may [m]; 0 within."""
        beyond_x = max(self.x_m_min + KEEP_M - x_m, x_m - self.x_m_max + KEEP_M, 0.0)
        beyond_y = max(self.y_m_min + KEEP_M - y_m, y_m - self.y_m_max + KEEP_M, 0.0)
        return math.hypot(beyond_x, beyond_y)

    def leaves(self, place: Pose, v_mps: float, omega_radps: float) -> bool:
        """Whether these speeds lead out of the fence, or not back in from outside. To turn on the spot is free."""
        x_m, y_m, yaw_rad = place
        ahead_m, course_rad = v_mps * LOOK_AHEAD_S, wrap(yaw_rad + omega_radps * LOOK_AHEAD_S / 2)
        then_m = self.outside_m(x_m + ahead_m * math.cos(course_rad), y_m + ahead_m * math.sin(course_rad))
        return v_mps != 0.0 and then_m > 0.0 and then_m >= self.outside_m(x_m, y_m)


def fence_of(arena: Arena) -> Fence:
    """A scenario's arena, to its edge."""
    x_m, y_m = arena.length_m / 2, arena.width_m / 2
    return Fence(x_m_min=-x_m, x_m_max=x_m, y_m_min=-y_m, y_m_max=y_m, markers=ceiling_markers(arena))
