"""The safety gate: what of a setpoint may reach the devices now, and why the rest may not.

Pure: no I/O, no clock of its own. Everything that moves passes `check`, some 50 times a second, and whatever it does not
let through stops. It starts with everything off and lets nothing through without fresh readings and a fresh setpoint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from core.manipulation.arm import Joints, limit_broken, reach_m, strikes
from core.robots import gardener
from core.robots.fence import Fence
from core.wire.body import COMMAND_LIFE_S, Setpoint

LIFE_S = COMMAND_LIFE_S - 0.06
"""Three control periods early, so that the wheels stand within the contract's life."""
BASE_FRESH_S = 0.5
SERVO_FRESH_S = 2.0
PLACE_FRESH_S = 2.0
"""A marker seen within this time, and the wheels since then, tell the place: the sensor speaks twice a second."""
ACCEL_MPS2 = 1.0
OMEGA_ACCEL_RADPS2 = 8.0
SLOW_MPS, SLOW_RADPS = 0.10, 0.6
"""With the arm out, or where nobody knows where it is, no faster than this."""
ARM_OUT_M = gardener.BODY_RADIUS_M + 0.05
ARM_NEAR_RAD = 0.05
ARM_S_MAX = 30.0
FORCE_FRESH_S = 0.8
"""The board is asked ten times a second while something moves, and twice while all stands."""
GRIP_SLACK_M = 0.0005
"""The board tells its pulses to 10 us, which is 0.45 mm of the fingers' opening."""
TANK_EMPTY_ML = 5.0
DOSE_END_ML = 0.05
"""This near to the dose the dose is done: a millisecond of pumping is no reason to switch a relay."""
Base = Literal["stop", "drive", "seek_dock"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """What the devices are told. The default is: nothing."""

    base: Base = "stop"
    v_mps: float = 0.0
    omega_radps: float = 0.0
    arm: Joints | None = None
    """None stops the arm where it is."""
    arm_s: float = 0.0
    gripper_m: float | None = None
    gripper_holds: bool = False
    """The fingers stop where they are."""
    roll_rad: float | None = None
    pump: bool = False


STOP = Command()


@dataclass(frozen=True, slots=True, kw_only=True)
class Dose:
    """The standing of the permit a setpoint names."""

    used: bool = False
    """Spent: it was debited before this brain came, or its dose is delivered."""
    debited_ml: float = 0.0
    """Durably written off for this permit; 0 until then."""
    delivered_ml: float = 0.0
    refusal: str = ""
    """Why the caps would not allow to debit it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GateState:
    """All that the gate judges by. Stamps and ages are garden seconds."""

    heard_s: float = -math.inf
    """When the setpoint came."""
    stopped: bool = True
    """The e-stop is latched."""
    stopped_by: str = ""
    base_up: bool = False
    base_s: float = -math.inf
    servo_up: bool = False
    servo_s: float = -math.inf
    wheel_drop: bool = False
    cliff: bool = False
    bump: bool = False
    docked: bool = False
    arm_rad: Joints | None = None
    arm_moving: bool = False
    gripper_m: float | None = None
    """The opening that the board commands now; None while nobody knows it."""
    force_n: float | None = None
    """What the fingers squeeze with; None while the sensor is silent."""
    force_s: float = -math.inf
    """When that was read."""
    tank_ml: float | None = None
    dose: Dose = Dose()
    fence: Fence | None = None
    place: tuple[float, float, float] | None = None
    """The base in the fence's frame [m, m, rad], by ceiling markers and wheels."""
    place_s: float = -math.inf
    """When a marker was seen last."""
    v_mps: float = 0.0
    omega_radps: float = 0.0
    """What the wheels were told last."""
    dt_s: float = 0.02
    """Since then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """`command` may go to the devices. Before a pump starts, `debit_ml` must be written off durably."""

    command: Command = STOP
    refusals: tuple[str, ...] = ()
    debit_ml: float = 0.0

    @property
    def refusal(self) -> str:
        return "; ".join(self.refusals)


def check(setpoint: Setpoint | None, state: GateState, now_s: float) -> Verdict:
    """Judge the newest setpoint; each part (base, arm, gripper, pump) is allowed or refused by itself."""
    if setpoint is None or not 0.0 <= now_s - state.heard_s <= LIFE_S:
        return Verdict()
    if why := _nothing_moves(setpoint, state, now_s):
        return Verdict(refusals=(why,) if wants_anything(setpoint) else ())
    refusals: list[str] = []
    base, v, omega = _base(setpoint, state, now_s, refusals)
    arm, arm_s = _arm(setpoint, state, refusals)
    gripper_m, roll_rad = _gripper(setpoint, state, now_s, refusals), _roll(setpoint, refusals)
    pump, debit_ml = _pump(setpoint, state, refusals)
    command = Command(
        base=base,
        v_mps=v,
        omega_radps=omega,
        arm=arm,
        arm_s=arm_s,
        gripper_m=gripper_m,
        gripper_holds=gripper_m is None and setpoint.gripper_m is not None,
        roll_rad=roll_rad,
        pump=pump,
    )
    return Verdict(command=command, refusals=tuple(refusals), debit_ml=debit_ml)


def wants_anything(setpoint: Setpoint) -> bool:
    """Whether anything shall move."""
    moves = (setpoint.arm, setpoint.gripper_m, setpoint.roll_rad)
    return setpoint.base != "stop" or setpoint.pump or any(goal is not None for goal in moves)


def _nothing_moves(setpoint: Setpoint, state: GateState, now_s: float) -> str:
    """The reason for which no part of the setpoint may move anything; empty when there is none."""
    if state.stopped:
        return f"stopped by {state.stopped_by}" if state.stopped_by else "stopped"
    if not _finite(setpoint):
        return "a number in the setpoint is not finite"
    if not state.base_up:
        return "the base's link is down"
    if not state.servo_up:
        return "the servo board's link is down"
    if not 0.0 <= now_s - state.base_s <= BASE_FRESH_S:
        return "no fresh reading from the base"
    if not 0.0 <= now_s - state.servo_s <= SERVO_FRESH_S:
        return "no fresh reading from the servo board"
    return "a wheel hangs in the air" if state.wheel_drop else ""


def _finite(setpoint: Setpoint) -> bool:
    numbers = [setpoint.v_mps, setpoint.omega_radps, setpoint.arm_s, setpoint.dose_ml, *(setpoint.arm or ())]
    numbers += [goal for goal in (setpoint.gripper_m, setpoint.roll_rad) if goal is not None]
    return all(map(math.isfinite, numbers))


def _base(setpoint: Setpoint, state: GateState, now_s: float, refusals: list[str]) -> tuple[Base, float, float]:
    if setpoint.base == "stop":
        return "stop", 0.0, 0.0
    v, omega = (0.0, 0.0) if setpoint.base == "seek_dock" else _limited(setpoint.v_mps, setpoint.omega_radps)
    if why := _base_refusal(setpoint, state, v, omega):
        refusals.append(why)
        return "stop", 0.0, 0.0
    dt_s = min(max(state.dt_s, 0.0), 0.1)
    v = _slew(state.v_mps, v, ACCEL_MPS2 * dt_s)
    omega = _slew(state.omega_radps, omega, OMEGA_ACCEL_RADPS2 * dt_s)
    if why := _fence_refusal(setpoint, state, now_s, v, omega):
        refusals.append(why)
        return "stop", 0.0, 0.0
    return ("drive", v, omega) if setpoint.base == "drive" else ("seek_dock", 0.0, 0.0)


def _fence_refusal(setpoint: Setpoint, state: GateState, now_s: float, v: float, omega: float) -> str:
    """Nobody leaves the fence; who stands outside of it may only come back. Without a fresh place it judges nothing."""
    if state.fence is None or state.place is None or not 0.0 <= now_s - state.place_s <= PLACE_FRESH_S:
        return ""
    if setpoint.base == "seek_dock":
        return "outside the fence: drive back in first" if state.fence.outside_m(*state.place[:2]) > 0.0 else ""
    return "the fence: only back in" if state.fence.leaves(state.place, v, omega) else ""


def _base_refusal(setpoint: Setpoint, state: GateState, v: float, omega: float) -> str:
    seeking = setpoint.base == "seek_dock"
    if state.cliff and (seeking or v > 0.0):
        return "a cliff ahead: only back"
    if state.bump and v > 0.0:
        return "touching something: only back"
    if seeking or abs(v) > SLOW_MPS or abs(omega) > SLOW_RADPS:
        if state.arm_rad is None:
            return "the arm's place is unknown: fold it before driving"
        if reach_m(state.arm_rad) > ARM_OUT_M or (setpoint.arm is not None and reach_m(setpoint.arm) > ARM_OUT_M):
            return "the arm is out: only slowly"
    return ""


def _limited(v: float, omega: float) -> tuple[float, float]:
    """Within the limits of speed and yaw rate, curvature kept."""
    share = max(1.0, abs(v) / gardener.V_MPS_MAX, abs(omega) / gardener.OMEGA_RADPS_MAX)
    return v / share, omega / share


def _slew(now: float, wanted: float, step: float) -> float:
    """Gaining speed takes time; losing it does not, and turning round passes through zero."""
    if wanted * now < 0.0:
        now = 0.0
    return math.copysign(min(abs(wanted), abs(now) + step), wanted)


def _arm(setpoint: Setpoint, state: GateState, refusals: list[str]) -> tuple[Joints | None, float]:
    goal = setpoint.arm
    if goal is None:
        return None, 0.0
    why = limit_broken(goal)
    if not why and not 0.0 <= setpoint.arm_s <= ARM_S_MAX:
        why = f"an arm move of {setpoint.arm_s:g} s is outside 0 .. {ARM_S_MAX:g} s"
    if not why and _furthest(goal, gardener.ARM_HOME_RAD) > ARM_NEAR_RAD:
        # The folded pose is always allowed: it is the way out of anything.
        unknown = "the arm's place is unknown: the first move must go to the folded pose"
        why = unknown if state.arm_rad is None else strikes(state.arm_rad, goal)
    if why:
        refusals.append(why)
        return None, 0.0
    start = state.arm_rad or goal
    servos = (gardener.SERVOS[name] for name in gardener.ARM_JOINTS)
    fastest_s = max(abs(b - a) / s.speed_radps_max for s, a, b in zip(servos, start, goal, strict=True))
    return goal, max(setpoint.arm_s, fastest_s)


def _furthest(a: Joints, b: Joints) -> float:
    return max(abs(x - y) for x, y in zip(a, b, strict=True))


def _gripper(setpoint: Setpoint, state: GateState, now_s: float, refusals: list[str]) -> float | None:
    if setpoint.gripper_m is None:
        return None
    if why := _gripper_refusal(setpoint.gripper_m, state, now_s):
        refusals.append(why)
        return None
    return setpoint.gripper_m


def _gripper_refusal(opening_m: float, state: GateState, now_s: float) -> str:
    """To open is always allowed, and so is to hold what is held."""
    if not 0.0 <= opening_m <= gardener.GRIPPER_OPEN_M:
        return f"a gripper opening of {opening_m:g} m is outside 0 .. {gardener.GRIPPER_OPEN_M:g} m"
    if opening_m >= (gardener.GRIPPER_OPEN_M if state.gripper_m is None else state.gripper_m) - GRIP_SLACK_M:
        return ""
    if state.force_n is None or not 0.0 <= now_s - state.force_s <= FORCE_FRESH_S:
        return "the force sensor is silent: the fingers may only open"
    if not state.force_n < gardener.GRIP_N_MAX:
        return f"the fingers squeeze with {state.force_n:.1f} N: they may only open"
    return ""


def _roll(setpoint: Setpoint, refusals: list[str]) -> float | None:
    roll_rad, servo = setpoint.roll_rad, gardener.ROLL_SERVO
    if roll_rad is None or servo.min_rad <= roll_rad <= servo.max_rad:
        return roll_rad
    refusals.append(f"a roll of {roll_rad:g} rad is outside {servo.min_rad:.2f} .. {servo.max_rad:.2f} rad")
    return None


def _pump(setpoint: Setpoint, state: GateState, refusals: list[str]) -> tuple[bool, float]:
    if not setpoint.pump:
        return False, 0.0
    if why := _pump_refusal(setpoint, state):
        refusals.append(why)
        return False, 0.0
    if state.dose.debited_ml <= 0.0:
        return False, setpoint.dose_ml
    return True, 0.0


def _pump_refusal(setpoint: Setpoint, state: GateState) -> str:
    dose = state.dose
    if not setpoint.permit_id:
        return "the pump runs only under a permit"
    if not state.docked:
        return "the pump runs only while docked"
    if setpoint.base != "stop" or state.v_mps != 0.0 or state.omega_radps != 0.0:
        return "the pump runs only while the base stands"
    if state.arm_rad is None:
        return "the pump runs only while the arm's place is known"
    if state.arm_moving:
        return "the pump runs only while the arm stands"
    if state.tank_ml is not None and state.tank_ml <= TANK_EMPTY_ML:
        return "the tank is empty"
    if setpoint.dose_ml <= 0.0:
        return "a dose must be more than nothing"
    if dose.used:
        return f"the permit {setpoint.permit_id} is spent"
    if dose.debited_ml <= 0.0:
        return dose.refusal
    if dose.delivered_ml >= min(dose.debited_ml, setpoint.dose_ml) - DOSE_END_ML:
        return "the dose is delivered"
    return ""
