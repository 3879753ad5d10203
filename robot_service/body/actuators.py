"""The only place that tells a device to move. It takes what the gate let through and says it once."""

from __future__ import annotations

import math
from dataclasses import replace

from core.manipulation.arm import Joints
from core.robots import gardener
from hw.ports import Base, ServoBoard
from robot_service.body.gate import STOP, Command

REPEAT_S = 0.2
"""What the base shall do is said again this often, should it have missed it."""
SETTLE_S = 0.15
"""A servo that should have arrived may still swing."""


class Actuators:
    """Base, arm, gripper and pump behind one `apply`. Remembers what was said, to say only changes."""

    def __init__(self, base: Base, servos: ServoBoard) -> None:
        self._base, self._servos = base, servos
        self._said = STOP
        self._said_s = -math.inf
        self._arm_until_s = self._gripper_until_s = -math.inf
        self._links = (-math.inf, -math.inf)
        self._pump_since_s: float | None = None
        self._pumped_s = 0.0

    @property
    def said(self) -> Command:
        return self._said

    @property
    def pumping(self) -> bool:
        return self._pump_since_s is not None

    def arm_moving(self, now_s: float) -> bool:
        """A move that we began should not have ended yet."""
        return now_s < self._arm_until_s

    def pump_run_s(self, now_s: float) -> float:
        """How long the pump has run since `start_count` [s]."""
        return self._pumped_s + (now_s - self._pump_since_s if self._pump_since_s is not None else 0.0)

    def start_count(self) -> None:
        self._pumped_s = 0.0

    def apply(self, command: Command, now_s: float) -> None:
        """Make the devices do exactly this."""
        links = (self._base.link.since_s, self._servos.link.since_s)
        fresh = links != self._links
        if fresh:
            # A device that came back knows nothing of what it was told before.
            self._links = links
            self.halt(now_s)
        if command.gripper_holds and now_s < self._gripper_until_s:
            # The board stops all of its channels or none: what else was asked for is said again.
            self._servos.stop()
            self._count(False, now_s)
            self._said, self._gripper_until_s = replace(self._said, arm=None, roll_rad=None), -math.inf
        self._switch_pump(command.pump, now_s)
        self._move_base(command, now_s)
        self._move_arm(command, now_s)
        self._move_gripper(command, now_s)
        self._said = command

    def halt(self, now_s: float) -> None:
        """Stop everything, said again even if it should stand already."""
        self._count(False, now_s)
        self._servos.stop()
        self._base.stop()
        self._said, self._arm_until_s, self._gripper_until_s = STOP, -math.inf, -math.inf

    def pump_off(self, now_s: float) -> None:
        """The independent off-timer's hand on the relay."""
        self._servos.output(gardener.PUMP_CHANNEL, False)
        self._count(False, now_s)

    def _switch_pump(self, on: bool, now_s: float) -> None:
        if on is not (self._pump_since_s is not None):
            self._servos.output(gardener.PUMP_CHANNEL, on)
            self._count(on, now_s)

    def _count(self, on: bool, now_s: float) -> None:
        if self._pump_since_s is not None:
            self._pumped_s += now_s - self._pump_since_s
        self._pump_since_s = now_s if on else None

    def _move_base(self, command: Command, now_s: float) -> None:
        said = self._said
        same = (command.base, command.v_mps, command.omega_radps) == (said.base, said.v_mps, said.omega_radps)
        if command.base == "drive" and (not same or now_s - self._said_s >= REPEAT_S):
            self._base.drive(command.v_mps, command.omega_radps)
            self._said_s = now_s
        elif command.base == "seek_dock" and (not same or now_s - self._said_s >= REPEAT_S):
            self._base.seek_dock()
            self._said_s = now_s
        elif command.base == "stop" and said.base != "stop":
            self._base.stop()

    def _move_arm(self, command: Command, now_s: float) -> None:
        said = self._said
        moved = dict[int, float]()
        if command.arm is not None and command.arm != said.arm:
            moved |= _pulses(command.arm)
        if command.roll_rad is not None and command.roll_rad != said.roll_rad:
            moved[gardener.ROLL_SERVO.channel] = gardener.ROLL_SERVO.pulse_us(command.roll_rad)
        if moved:
            duration_s = command.arm_s if command.arm is not None else _ROLL_S
            self._servos.move(moved, duration_s)
            self._arm_until_s = max(self._arm_until_s, now_s + duration_s + SETTLE_S)
        elif command.arm is None and said.arm is not None and self.arm_moving(now_s):
            self._servos.stop()
            self._arm_until_s = now_s
            if command.pump:
                self._servos.output(gardener.PUMP_CHANNEL, True)

    def _move_gripper(self, command: Command, now_s: float) -> None:
        """A move of its own, no faster than its servo: pulses that ran ahead would squeeze before the force is felt."""
        opening_m, was_m = command.gripper_m, self._said.gripper_m
        if opening_m is None or opening_m == was_m:
            return
        share = 1.0 if was_m is None else abs(opening_m - was_m) / gardener.GRIPPER_OPEN_M
        duration_s = max(_GRIPPER_S_MIN, share * (_GRIPPER.max_rad - _GRIPPER.min_rad) / _GRIPPER.speed_radps_max)
        self._servos.move(_gripper_pulse(opening_m), duration_s)
        self._gripper_until_s = now_s + duration_s + SETTLE_S
        self._arm_until_s = max(self._arm_until_s, self._gripper_until_s)


_GRIPPER = gardener.SERVOS["gripper"]
_GRIPPER_S_MIN = 0.1
_ROLL_S = 0.5


def _pulses(q: Joints) -> dict[int, float]:
    servos = (gardener.SERVOS[name] for name in gardener.ARM_JOINTS)
    return {servo.channel: servo.pulse_us(angle) for servo, angle in zip(servos, q, strict=True)}


def _gripper_pulse(opening_m: float) -> dict[int, float]:
    share = opening_m / gardener.GRIPPER_OPEN_M
    return {_GRIPPER.channel: _GRIPPER.pulse_us(_GRIPPER.min_rad + share * (_GRIPPER.max_rad - _GRIPPER.min_rad))}


def gripper_opening_m(pulses_us: dict[int, float]) -> float | None:
    """The fingers' opening that the board commands now; None until it has driven them."""
    pulse_us = pulses_us.get(_GRIPPER.channel)
    return None if pulse_us is None else gardener.gripper_opening_m(_GRIPPER.angle_rad(pulse_us))


def arm_angles(pulses_us: dict[int, float]) -> Joints | None:
    """Joint angles the board commands now; None until it has driven every joint."""
    servos = [gardener.SERVOS[name] for name in gardener.ARM_JOINTS]
    if any(servo.channel not in pulses_us for servo in servos):
        return None
    p, s, e, w = (servo.angle_rad(pulses_us[servo.channel]) for servo in servos)
    return p, s, e, w
