"""A Create on a plane, without physics: for tests of emulator and driver, and for `garden emulate`.

Dock frame: the origin is the axle centre of a robot that stands docked, x points into the dock, y left. The beams start
`APEX_M` ahead of it. The dock's face stops the body, and the contacts touch when the axle is close enough to the origin.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass

from hw.protocols.create import Model
from sim.devices.create import CreateEmulator
from sim.devices.create_dock import Side
from sim.devices.plants import CreateSense

APEX_M = 0.19
RECEIVER_M = 0.13
BEAM_RANGE_M = 2.0
FIELD_RANGE_M = 0.5
BEAM_OUTER_RAD = math.radians(22.0)
BEAM_OVERLAP_RAD = math.radians(3.0)
"""Each beam reaches this far over the centre line."""
MATE_X_M, MATE_Y_M, MATE_YAW_RAD = 0.015, 0.020, math.radians(6.0)
FACE_M = 0.004
"""The axle gets no further than this beyond the docked pose."""
FACE_HALF_M = 0.25
WHEEL_LAG_S = 0.08
STEP_S_MAX = 0.005
IDLE_A, MOVING_A, CHARGE_A = -0.6, -1.2, 2.5


@dataclass(slots=True)
class Pose:
    x_m: float = -1.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


class BenchCreate:
    """Fills `sim.devices.plants.CreateBody`; `advance` moves it. The first call only sets its time."""

    def __init__(
        self,
        rng: random.Random,
        *,
        wheelbase_m: float = 0.235,
        pose: Pose | None = None,
        red_side: Side = "left",
        wheel_noise: float = 0.0,
        dock: bool = True,
        apex_m: float = APEX_M,
        receiver_m: float = RECEIVER_M,
    ) -> None:
        self._rng, self._wheelbase_m, self._wheel_noise = rng, wheelbase_m, wheel_noise
        self.pose = pose or Pose()
        self._red_left = red_side == "left"
        self._dock, self._apex_m, self._receiver_m = dock, apex_m, receiver_m
        self._wanted = (0.0, 0.0)
        self._speed = [0.0, 0.0]
        self._travel = [0.0, 0.0]
        self._blocked = False
        self._now_s: float | None = None
        self.charge_ah = 5.0
        self.capacity_ah = 6.77
        self.extra: dict[str, bool] = {}
        """Senses forced from outside, by field name of CreateSense: cliffs, drops, bumps."""
        self.may_charge: Callable[[], bool] = lambda: True

    @property
    def wheels(self) -> tuple[float, float]:
        """The setpoint, left and right [m/s]."""
        return self._wanted

    def set_wheels(self, left_mps: float, right_mps: float) -> None:
        self._wanted = (left_mps, right_mps)

    @property
    def contacts(self) -> bool:
        pose = self.pose
        near = abs(pose.x_m) <= MATE_X_M and abs(pose.y_m) <= MATE_Y_M
        return self._dock and near and abs(_wrap(pose.yaw_rad)) <= MATE_YAW_RAD

    def advance(self, now_s: float) -> None:
        """Move on to `now_s`."""
        at_s = now_s if self._now_s is None else self._now_s
        while (left_s := now_s - at_s) > 1e-9:
            dt_s = min(left_s, STEP_S_MAX)
            self._step(dt_s)
            at_s += dt_s
        self._now_s = at_s

    def sense(self) -> CreateSense:
        red, green, field = self._beams()
        contacts = self.contacts
        charging = contacts and self.may_charge()
        moving = self._wanted != (0.0, 0.0)
        bumped = self._blocked and not contacts
        forced = {"bump_left": bumped, "bump_right": bumped} | self.extra
        return CreateSense(
            ir_red=red,
            ir_green=green,
            ir_field=field,
            contacts=contacts,
            charging=charging,
            current_a=CHARGE_A if charging else MOVING_A if moving else IDLE_A,
            charge_ah=self.charge_ah,
            capacity_ah=self.capacity_ah,
            left_m=self._travel[0],
            right_m=self._travel[1],
            **forced,
        )

    def _step(self, dt_s: float) -> None:
        share = dt_s / (WHEEL_LAG_S + dt_s)
        for side in (0, 1):
            self._speed[side] += share * (self._wanted[side] - self._speed[side])
            self._travel[side] += self._speed[side] * dt_s
        if self._speed == [0.0, 0.0]:
            self._charge(dt_s)
            return
        left, right = (speed * (1 + self._rng.gauss(0.0, self._wheel_noise)) for speed in self._speed)
        self._roll(0.5 * (left + right) * dt_s, (right - left) / self._wheelbase_m * dt_s)
        self._charge(dt_s)

    def _roll(self, way_m: float, turn_rad: float) -> None:
        pose = self.pose
        mean = pose.yaw_rad + 0.5 * turn_rad
        x_m = pose.x_m + way_m * math.cos(mean)
        pose.y_m += way_m * math.sin(mean)
        pose.yaw_rad = _wrap(pose.yaw_rad + turn_rad)
        self._blocked = self._dock and abs(pose.y_m) < FACE_HALF_M and x_m > FACE_M
        pose.x_m = FACE_M if self._blocked else x_m

    def _charge(self, dt_s: float) -> None:
        current_a = CHARGE_A if self.contacts and self.may_charge() else IDLE_A
        self.charge_ah = max(0.0, min(self.capacity_ah, self.charge_ah + current_a * dt_s / 3600))

    def _beams(self) -> tuple[bool, bool, bool]:
        """Red, green and field at the receiver."""
        if not self._dock:
            return False, False, False
        pose = self.pose
        back_m = self._apex_m - pose.x_m - self._receiver_m * math.cos(pose.yaw_rad)
        left_m = pose.y_m + self._receiver_m * math.sin(pose.yaw_rad)
        range_m, bearing = math.hypot(back_m, left_m), math.atan2(left_m, back_m)
        near = range_m < BEAM_RANGE_M
        on_left = near and -BEAM_OVERLAP_RAD < bearing < BEAM_OUTER_RAD
        on_right = near and -BEAM_OUTER_RAD < bearing < BEAM_OVERLAP_RAD
        field = range_m < FIELD_RANGE_M
        return (on_left, on_right, field) if self._red_left else (on_right, on_left, field)


def _wrap(angle_rad: float) -> float:
    return math.remainder(angle_rad, math.tau)


class BenchedCreate(CreateEmulator):
    """A Create that brings its own plane: whoever steps the firmware moves the body too."""

    def __init__(self, model: Model, body: BenchCreate, rng: random.Random, *, red_side: Side = "left") -> None:
        super().__init__(model, body, rng, red_side=red_side)
        self.bench = body
        body.may_charge = lambda: self.may_charge

    def step(self, now_s: float) -> None:
        self.bench.advance(now_s)
        super().step(now_s)


def create1(seed: int) -> BenchedCreate:
    """A Create 1, a metre before its dock."""
    rng = random.Random(seed)
    return BenchedCreate(Model.CREATE1, BenchCreate(rng, wheelbase_m=0.258), rng)


def create2(seed: int) -> BenchedCreate:
    """A Create 2, a metre before its dock."""
    rng = random.Random(seed)
    return BenchedCreate(Model.CREATE2, BenchCreate(rng, wheelbase_m=0.235), rng)
