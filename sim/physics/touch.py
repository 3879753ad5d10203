"""Contacts of robots' shells and arms with things: bumpers pressed, collisions counted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from sim.physics.pose import Planar

BUMP_N = 2.0
"""Force that presses the bumper's spring switch."""
KNOCK_N = 0.5
"""Lightest touch that counts as a collision."""
APART_S = 0.5
"""Touching again sooner than this is the same collision."""
FRONT_RAD = math.radians(95.0)
MIDDLE_RAD = math.radians(18.0)
"""Within this angle of straight ahead both switches close."""

ARM_PARTS = frozenset(
    (
        *("pan-hub", "upper-arm", "forearm", "palm", "hose"),
        *("rail-left", "rail-right", "shell-left", "shell-right", "pad-left", "pad-right"),
    )
)

Key = tuple[str, str]


@dataclass(slots=True)
class Press:
    left: bool = False
    right: bool = False


@dataclass(slots=True)
class Tally:
    """Collisions so far, by kind."""

    robot_robot: int = 0
    robot_pot: int = 0
    robot_dock: int = 0
    arm: int = 0


@dataclass(slots=True)
class Touch:
    """Looks through the contact list after a control tick."""

    model: Any
    data: Any
    robots: tuple[str, ...]
    pressed: dict[str, Press] = field(default_factory=dict)
    tally: dict[str, Tally] = field(default_factory=dict)
    _last: dict[Key, float] = field(default_factory=dict)
    _owner: list[tuple[str, str]] = field(default_factory=list)
    """For every geom: (kind, id)."""
    _watched: tuple[bool, ...] = ()
    _force: Any = None

    def __post_init__(self) -> None:
        self.pressed = {robot: Press() for robot in self.robots}
        self.tally = {robot: Tally() for robot in self.robots}
        self._owner = [_owner(self.model.geom(index).name, set(self.robots)) for index in range(self.model.ngeom)]
        self._watched = tuple(kind in ("shell", "arm") for kind, _ in self._owner)
        self._force = np.zeros(6)

    def forget(self) -> None:
        """Time has jumped: what touches now touches for the first time."""
        self._last.clear()

    def look(self, now_s: float, poses: dict[str, Planar], mated: dict[str, str | None]) -> None:
        """Updates `pressed` and `tally`. A mated robot does not feel its own dock: the plates carry it."""
        for press in self.pressed.values():
            press.left = press.right = False
        if not self.data.ncon:
            return
        watched = self._watched
        for index, (a, b) in enumerate(self.data.contact.geom.tolist()):
            if watched[a] or watched[b]:
                self._contact(index, a, b, now_s, poses, mated)

    def _contact(
        self, index: int, a: int, b: int, now_s: float, poses: dict[str, Planar], mated: dict[str, str | None]
    ) -> None:
        mujoco.mj_contactForce(self.model, self.data, index, self._force)
        force_n = float(self._force[0])
        if force_n < KNOCK_N:
            return
        place = self.data.contact.pos[index]
        for (kind, robot), (other, other_id) in ((self._owner[a], self._owner[b]), (self._owner[b], self._owner[a])):
            if kind not in ("shell", "arm") or other not in ("shell", "pot", "dock"):
                continue
            if other == "dock" and mated.get(robot) == other_id:
                continue
            self._count(robot, kind, other, other_id, now_s)
            if kind == "shell" and force_n >= BUMP_N:
                self._press(robot, poses[robot].local(float(place[0]), float(place[1])))

    def _press(self, robot: str, place: tuple[float, float]) -> None:
        angle = math.atan2(place[1], place[0])
        if abs(angle) <= FRONT_RAD:
            self.pressed[robot].left |= angle > -MIDDLE_RAD
            self.pressed[robot].right |= angle < MIDDLE_RAD

    def _count(self, robot: str, kind: str, other: str, other_id: str, now_s: float) -> None:
        key = (f"{robot}/{kind}", other_id)
        if now_s - self._last.get(key, -math.inf) > APART_S:
            tally = self.tally[robot]
            name = "arm" if kind == "arm" else {"shell": "robot_robot", "pot": "robot_pot", "dock": "robot_dock"}[other]
            setattr(tally, name, getattr(tally, name) + 1)
        self._last[key] = now_s


def _owner(name: str, robots: set[str]) -> tuple[str, str]:
    head, _, tail = name.rpartition("/")
    if tail in ("pot", "dock"):
        return tail, head
    robot, _, part = name.partition("/")
    if robot in robots and part == "shell":
        return "shell", robot
    return ("arm", robot) if robot in robots and part in ARM_PARTS else ("ground", name)
