"""The Create's own docking (opcode 143) as a state machine on beams, bumps and contacts; it knows no map.

The dock's red and green beams each cover one half of the space before it and overlap on the centre line; the force field
is a short-range circle. The receiver has no direction, but it sits ahead of the axle: turning on the spot sweeps it
sideways, so steering towards the other colour whenever only one is seen makes the receiver slide along the centre line,
and the axle follows it with the receiver's lead as length constant.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from enum import Enum
from typing import Literal

from sim.devices.plants import CreateSense

Side = Literal["left", "right"]
"""On which side of the centre line only red is seen, for a robot that faces the dock."""

FAR_MPS = 0.20
NEAR_MPS = 0.08
"""In the force field."""
ARC_MPS = 0.10
ARC_RADPS = 0.8
PIVOT_MPS = 0.015
PIVOT_RADPS = 0.7
SPIN_RADPS = 1.2
BACK_MPS = 0.12
BACK_M = 0.22
FLEE_M = 0.15
ROAM_MPS = 0.18
ROAM_M = 0.45
TIGHT_RAD = math.radians(130.0)
"""Having turned so far without finding the other colour, the robot widens its arc to a spiral."""
RUN_IN_M = 0.25
"""Coming from a search, drive into the beam before turning in it."""
BLIND_S = 0.6
"""Without any beam for so long, the line is lost."""


class Phase(Enum):
    SPIN = "spin until a beam is seen"
    ROAM = "drive elsewhere to look again"
    FOLLOW = "follow the line between red and green"
    BACK = "back off after a bump or a cliff"
    TURN = "turn away"
    DONE = "contacts touch"


@dataclass(slots=True)
class DockSeeker:
    """Give it the senses every 15 ms; it gives rim speeds. Heading and way come from its own wheel odometry."""

    rng: random.Random
    red_side: Side
    wheelbase_m: float
    phase: Phase = Phase.FOLLOW
    _begun: bool = False
    _now_s: float = 0.0
    _seen_s: float = 0.0
    _way_m: float = 0.0
    _yaw_rad: float = 0.0
    _mark_way_m: float = 0.0
    _mark_yaw_rad: float = 0.0
    _turn: float = 1.0
    _goal: float = 0.0
    _run_in_m: float = 0.0
    _after_back: Phase = Phase.FOLLOW

    @property
    def done(self) -> bool:
        return self.phase is Phase.DONE

    def update(self, now_s: float, sense: CreateSense) -> tuple[float, float]:
        """Left and right rim speeds [m/s] for the next tick."""
        self._odometry(now_s, sense)
        if sense.contacts:
            self.phase = Phase.DONE
        elif self.phase not in (Phase.BACK, Phase.TURN) and _blocked(sense):
            self._retreat(sense)
        v_mps, omega_radps = self._act(sense)
        half_mps = 0.5 * omega_radps * self.wheelbase_m
        return v_mps - half_mps, v_mps + half_mps

    def _act(self, sense: CreateSense) -> tuple[float, float]:
        match self.phase:
            case Phase.FOLLOW:
                return self._follow(sense)
            case Phase.SPIN:
                return self._spin(sense)
            case Phase.ROAM:
                return self._roam(sense)
            case Phase.BACK:
                return self._back()
            case Phase.TURN:
                return self._turn_away()
            case Phase.DONE:
                return 0.0, 0.0

    def _odometry(self, now_s: float, sense: CreateSense) -> None:
        self._way_m = 0.5 * (sense.left_m + sense.right_m)
        self._yaw_rad = (sense.right_m - sense.left_m) / self.wheelbase_m
        self._now_s = now_s
        if not self._begun:
            self._begun, self._seen_s = True, now_s
            self._mark()

    def _mark(self) -> None:
        self._mark_way_m, self._mark_yaw_rad = self._way_m, self._yaw_rad

    def _enter(self, phase: Phase) -> None:
        self.phase, self._seen_s = phase, self._now_s
        self._mark()

    @property
    def _driven_m(self) -> float:
        return self._way_m - self._mark_way_m

    @property
    def _turned_rad(self) -> float:
        return self._yaw_rad - self._mark_yaw_rad

    def _retreat(self, sense: CreateSense) -> None:
        """Back off: at the dock to try the line again, elsewhere to turn away from what is in the way."""
        at_dock = sense.ir_field and self.phase is Phase.FOLLOW and (sense.bump_left or sense.bump_right)
        if not at_dock:
            right = sense.bump_right or sense.cliff_right or sense.cliff_front_right
            self._turn = 1.0 if right else -1.0
        self._after_back = Phase.FOLLOW if at_dock else Phase.TURN
        self._goal = BACK_M if at_dock else FLEE_M
        self._enter(Phase.BACK)

    # The phases: each gives (v [m/s], omega [rad/s])

    def _follow(self, sense: CreateSense) -> tuple[float, float]:
        if not (sense.ir_red or sense.ir_green):
            return self._blind()
        self._seen_s = self._now_s
        if sense.ir_red and sense.ir_green:
            self._mark()
            self._run_in_m = 0.0
            return (NEAR_MPS if sense.ir_field else FAR_MPS), 0.0
        on_left = sense.ir_red is (self.red_side == "left")
        self._turn = -1.0 if on_left else 1.0
        if self._driven_m < self._run_in_m:
            return ARC_MPS, 0.0
        turned = abs(self._turned_rad) / TIGHT_RAD
        if turned > 1.0:
            return FAR_MPS, self._turn * ARC_RADPS / turned**2
        if sense.ir_field:
            return PIVOT_MPS, self._turn * PIVOT_RADPS
        return ARC_MPS, self._turn * ARC_RADPS

    def _blind(self) -> tuple[float, float]:
        """Neither colour: keep turning to where the line was, then look round."""
        if self._now_s - self._seen_s > BLIND_S:
            self._enter(Phase.SPIN)
        return 0.0, self._turn * PIVOT_RADPS

    def _found(self) -> None:
        self._enter(Phase.FOLLOW)
        self._run_in_m = RUN_IN_M

    def _spin(self, sense: CreateSense) -> tuple[float, float]:
        if sense.ir_red or sense.ir_green:
            self._found()
        elif abs(self._turned_rad) > 2.0 * math.pi:
            self._goal = self.rng.uniform(0.3, 1.2) * math.pi
            self._enter(Phase.TURN)
        return 0.0, self._turn * SPIN_RADPS

    def _roam(self, sense: CreateSense) -> tuple[float, float]:
        if sense.ir_red or sense.ir_green:
            self._found()
        elif self._driven_m > ROAM_M:
            self._enter(Phase.SPIN)
        return ROAM_MPS, 0.0

    def _back(self) -> tuple[float, float]:
        if -self._driven_m < self._goal:
            return -BACK_MPS, 0.0
        self._goal = self.rng.uniform(0.5, 0.9) * math.pi
        self._enter(self._after_back)
        return 0.0, 0.0

    def _turn_away(self) -> tuple[float, float]:
        if abs(self._turned_rad) >= self._goal:
            self._enter(Phase.ROAM)
        return 0.0, self._turn * SPIN_RADPS


def _blocked(sense: CreateSense) -> bool:
    cliff = sense.cliff_left or sense.cliff_front_left or sense.cliff_front_right or sense.cliff_right
    return cliff or sense.bump_left or sense.bump_right
