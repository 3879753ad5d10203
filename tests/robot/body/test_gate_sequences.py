"""Long random lives of a robot through the gate, judged by an oracle written from docs/body.md, not from the gate.

What the gate lets through moves the robot, and where that leaves it is what the gate judges by next. Time goes on, brains
fall silent and talk nonsense, sensors and links come and go, somebody presses the e-stop and releases it.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import pytest
from msgspec import structs

from core.manipulation.arm import Joints
from core.robots import gardener as g
from core.robots.fence import Fence
from core.wire.body import Setpoint
from core.wire.geometry import Pose2
from robot_service.body import gate
from robot_service.body.gate import Command, Dose, GateState, Verdict, check

WILD = (math.nan, math.inf, -math.inf, 1e9, -1e9)
OUT: Joints = (0.0, 0.85, -1.17, -0.47)
LOW: Joints = (0.0, math.radians(-10.0), math.radians(-60.0), math.radians(-30.0))
HALF_M = 1.0
FENCE = Fence(
    x_m_min=-HALF_M, x_m_max=HALF_M, y_m_min=-HALF_M, y_m_max=HALF_M, markers={400: Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0)}
)
EPISODES = {
    "stopped": (0.001, 0.02),
    "base_down": (0.0005, 0.05),
    "servo_down": (0.0005, 0.05),
    "base_silent": (0.001, 0.03),
    "servo_silent": (0.0005, 0.01),
    "force_silent": (0.002, 0.02),
    "markers_silent": (0.002, 0.01),
    "wheel_drop": (0.0005, 0.1),
    "cliff": (0.002, 0.1),
    "bump": (0.002, 0.1),
    "docked": (0.003, 0.003),
    "brain_silent": (0.002, 0.05),
    "dry": (0.0005, 0.01),
    "squeezed": (0.005, 0.05),
    "capped": (0.001, 0.02),
}
"""What comes over the robot: the chance a turn that it begins, and that it ends."""


def drawn_wish(rng: random.Random) -> Setpoint:
    def number(low: float, high: float) -> float:
        return rng.choice(WILD) if rng.random() < 0.004 else rng.uniform(low, high)

    ranges = [(g.SERVOS[name].min_rad, g.SERVOS[name].max_rad) for name in g.ARM_JOINTS]
    p, s, e, w = (number(low - 0.05, high + 0.05) for low, high in ranges)
    pump = rng.random() < 0.4
    return Setpoint(
        seq=0,
        base="stop" if pump and rng.random() < 0.8 else rng.choice(("stop", "drive", "drive", "seek_dock")),
        v_mps=number(-0.8, 0.8) if rng.random() < 0.6 else number(-0.1, 0.1),
        omega_radps=number(-3.0, 3.0) if rng.random() < 0.5 else 0.0,
        arm=rng.choice((None, None, g.ARM_HOME_RAD, g.ARM_HOME_RAD, OUT, LOW, (p, s, e, w), (p, s, e, w))),
        arm_s=abs(number(0.0, 4.0)) if rng.random() < 0.97 else number(-1.0, 40.0),
        gripper_m=rng.choice((None, 0.0, 0.0, g.GRIPPER_OPEN_M, number(-0.002, 0.046), number(-0.002, 0.046))),
        roll_rad=rng.choice((None, 0.0, number(-1.65, 1.65))),
        pump=pump,
        permit_id=rng.choice(("", *(f"p{rng.randrange(10**6)}",) * 9)),
        dose_ml=number(1.0, 40.0) if rng.random() < 0.95 else number(-5.0, 0.0),
    )


def towards(now: float, goal: float, step: float) -> float:
    return now + max(-step, min(step, goal - now))


@dataclass
class Life:
    """One robot: its truth, what its sensors last said, and what it was told."""

    rng: random.Random
    now_s: float = 1000.0
    wish: Setpoint | None = None
    wish_until_s: float = 0.0
    heard_s: float = -math.inf
    on: dict[str, bool] = field(default_factory=lambda: dict.fromkeys(EPISODES, False))
    base_s: float = -math.inf
    servo_s: float = -math.inf
    said: Command = gate.STOP
    before_s: float = 1000.0
    arm: Joints | None = None
    arm_goal: Joints | None = None
    arm_left_s: float = 0.0
    arm_read: Joints | None = None
    grip_m: float | None = None
    grip_goal_m: float = 0.0
    grip_read_m: float | None = None
    fruit_m: float = 0.0
    force_n: float | None = None
    force_s: float = -math.inf
    tank_ml: float = 1500.0
    spent: dict[str, float] = field(default_factory=dict)
    permit_id: str = ""
    delivered_ml: float = 0.0
    wanted: tuple[str, float, float] | None = None
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seen_s: float = -math.inf
    clear: bool = True
    """The arm began outside of floor and body, and nobody but the gate moved it since."""

    def live(self) -> None:
        """Time passes; what the gate let through goes on meanwhile."""
        rng = self.rng
        dt_s = 0.02 if rng.random() < 0.97 else rng.choice((0.0, 0.05, 0.2, 0.6, 3.0))
        self.before_s, self.now_s = self.now_s, self.now_s + dt_s
        for name, (begins, ends) in EPISODES.items():
            if rng.random() < (ends if self.on[name] else begins):
                self.on[name] = not self.on[name]
        self._move(dt_s)
        self._sense()
        self._listen()
        if self.wanted is not None and self.now_s >= self.wanted[2]:
            self.permit_id, self.delivered_ml = self.wanted[0], 0.0
            self.spent[self.permit_id] = self.wanted[1]
            self.wanted = None
        if rng.random() < 0.002:
            self.permit_id = ""

    def _move(self, dt_s: float) -> None:
        c, rng = self.said, self.rng
        if c.base == "drive":
            x, y, yaw = self.pose
            mid = yaw + c.omega_radps * dt_s / 2
            self.pose = x + c.v_mps * dt_s * math.cos(mid), y + c.v_mps * dt_s * math.sin(mid), yaw + c.omega_radps * dt_s
        if rng.random() < 0.0005:
            self.pose = rng.uniform(-1.1, 1.1), rng.uniform(-1.1, 1.1), rng.uniform(-3.0, 3.0)
            self.seen_s = -math.inf
        if self.arm is not None and self.arm_goal is not None and self.arm_left_s > 0.0:
            share = min(1.0, dt_s / self.arm_left_s)
            a, b, d, e = (x + share * (y - x) for x, y in zip(self.arm, self.arm_goal, strict=True))
            self.arm, self.arm_left_s = (a, b, d, e), max(0.0, self.arm_left_s - dt_s)
        if self.grip_m is not None:
            self.grip_m = towards(self.grip_m, self.grip_goal_m, 0.0573 * dt_s)
        if c.pump:
            self.delivered_ml += g.PUMP_MLPS * dt_s
            self.tank_ml -= g.PUMP_MLPS * dt_s
        if rng.random() < 0.0005:
            self.arm, self.grip_m, self.arm_left_s, self.clear = None, None, 0.0, False
        if rng.random() < 0.0005:
            self.tank_ml = 1500.0
        if rng.random() < 0.005:
            self.fruit_m = rng.choice((0.0, 0.02, 0.03))

    def _sense(self) -> None:
        now_s, on = self.now_s, self.on
        if not on["base_silent"]:
            self.base_s = now_s - 0.01
        if not on["servo_silent"] and now_s - self.servo_s >= 0.1:
            self.servo_s, self.arm_read, self.grip_read_m = now_s, self.arm, self.grip_m
            if not on["force_silent"]:
                pressed = 0.0 if self.grip_m is None else max(0.0, self.fruit_m - self.grip_m)
                self.force_s, self.force_n = now_s, 9.5 if on["squeezed"] else min(10.0, 500.0 * pressed)
        if on["force_silent"] and self.rng.random() < 0.01:
            self.force_n = None
        if not on["markers_silent"] and now_s - self.seen_s >= 0.5:
            self.seen_s = now_s

    def _listen(self) -> None:
        if self.now_s >= self.wish_until_s:
            self.wish_until_s = self.now_s + self.rng.choice((0.1, 0.5, 2.0, 4.0))
            self.wish = drawn_wish(self.rng) if self.rng.random() < 0.97 else None
            if self.wish is not None and self.wish.pump and self.permit_id and self.rng.random() < 0.3:
                self.wish = structs.replace(self.wish, permit_id=self.permit_id)
        if not self.on["brain_silent"]:
            self.heard_s = self.now_s - self.rng.choice((0.0, 0.01))

    def state(self) -> GateState:
        on = self.on
        return GateState(
            heard_s=self.heard_s,
            stopped=on["stopped"],
            base_up=not on["base_down"],
            base_s=self.base_s,
            servo_up=not on["servo_down"],
            servo_s=self.servo_s,
            wheel_drop=on["wheel_drop"],
            cliff=on["cliff"],
            bump=on["bump"],
            docked=on["docked"],
            arm_rad=self.arm_read,
            arm_moving=self.arm_left_s > 0.0,
            gripper_m=self.grip_read_m,
            force_n=self.force_n,
            force_s=self.force_s,
            tank_ml=None if self.rng.random() < 0.01 else 0.0 if on["dry"] else max(0.0, self.tank_ml),
            dose=self._dose(),
            fence=FENCE,
            place=self.pose if math.isfinite(self.seen_s) else None,
            place_s=self.seen_s,
            v_mps=self.said.v_mps,
            omega_radps=self.said.omega_radps,
            dt_s=self.now_s - self.before_s,
        )

    def _dose(self) -> Dose:
        if self.wish is None or not self.wish.pump or not self.wish.permit_id:
            return Dose()
        if self.wish.permit_id == self.permit_id:
            return Dose(debited_ml=self.spent[self.permit_id], delivered_ml=self.delivered_ml)
        waiting = "the dose is being written down" if self.wanted is not None else ""
        return Dose(used=self.wish.permit_id in self.spent, refusal=waiting or ("capped" if self.on["capped"] else ""))

    def obey(self, verdict: Verdict) -> None:
        """The devices do what was let through; the arm and the fingers as the actuators tell them."""
        c, was = verdict.command, self.said
        if c.arm is not None and c.arm != was.arm:
            if self.arm is None:
                self.arm = c.arm
            self.arm_goal, self.arm_left_s = c.arm, c.arm_s
        elif c.arm is None and was.arm is not None:
            self.arm_left_s = 0.0
        if c.gripper_m is not None:
            self.grip_goal_m = c.gripper_m
            self.grip_m = c.gripper_m if self.grip_m is None else self.grip_m
        elif c.gripper_holds and self.grip_m is not None:
            self.grip_goal_m = self.grip_m
        if verdict.debit_ml > 0.0 and self.wish is not None and self.wanted is None:
            self.wanted = self.wish.permit_id, verdict.debit_ml, self.now_s + 0.05
        self.said = c


# The oracle


def chain(q: Joints, per_link: int = 6) -> list[tuple[float, float, float]]:
    """Points (x, y, z) [m] along forearm and hand, one link turned after another."""
    r, z, pitch, points = 0.0, g.SHOULDER_Z_M, 0.0, []
    for number, (angle, length_m) in enumerate(zip(q[1:], (g.UPPER_ARM_M, g.FOREARM_M, g.HAND_M), strict=True)):
        pitch += angle
        for _ in range(per_link):
            r, z = r + length_m / per_link * math.cos(pitch), z + length_m / per_link * math.sin(pitch)
            if number:
                points.append((g.SHOULDER_X_M + r * math.cos(q[0]), r * math.sin(q[0]), z))
    return points


def struck(q: Joints) -> bool:
    """A point of the arm is in the floor, in the round body, or in the mast."""
    for x, y, z in chain(q):
        mast = math.hypot(x - g.SHOULDER_X_M, y) < g.MAST_RADIUS_M and z < g.SHOULDER_Z_M
        if z < 0.0 or mast or (math.hypot(x, y) < g.BODY_RADIUS_M and z < g.BODY_HEIGHT_M):
            return True
    return False


def stretched(q: Joints) -> float:
    """Furthest point from the base's centre, seen from above [m]."""
    return max(math.hypot(x, y) for x, y, _ in [*chain(q), elbow(q)])


def elbow(q: Joints) -> tuple[float, float, float]:
    r = g.UPPER_ARM_M * math.cos(q[1])
    return g.SHOULDER_X_M + r * math.cos(q[0]), r * math.sin(q[0]), 0.0


def beyond(x: float, y: float) -> float:
    """How far the middle is beyond the fence less 12 cm [m]."""
    return math.dist((x, y), (max(-0.88, min(0.88, x)), max(-0.88, min(0.88, y))))


def everything_off(sp: Setpoint | None, s: GateState, now_s: float) -> str:
    """Why nothing at all may move."""
    if sp is None or not now_s - 0.3 <= s.heard_s <= now_s:
        return "no command lives"
    if s.stopped or s.wheel_drop or not s.base_up or not s.servo_up:
        return "stopped, lifted or cut off"
    if not now_s - 0.5 <= s.base_s <= now_s or not now_s - 2.0 <= s.servo_s <= now_s:
        return "devices are silent"
    numbers = [sp.v_mps, sp.omega_radps, sp.arm_s, sp.dose_ml, sp.gripper_m or 0.0, sp.roll_rad or 0.0, *(sp.arm or ())]
    return "" if all(map(math.isfinite, numbers)) else "a number is not finite"


def fault(sp: Setpoint | None, s: GateState, now_s: float, verdict: Verdict) -> str:
    """What is wrong with this verdict; empty when nothing is."""
    c, debit_ml = verdict.command, verdict.debit_ml
    if why := everything_off(sp, s, now_s):
        return f"moved although {why}" if c != gate.STOP or debit_ml > 0 else ""
    assert sp is not None
    return _wheels(sp, s, now_s, c) or _joints(sp, s, c) or _fingers(sp, s, now_s, c) or _water(sp, s, c, debit_ml)


def _wheels(sp: Setpoint, s: GateState, now_s: float, c: Command) -> str:
    if c.base not in (sp.base, "stop") or (c.base != "drive" and (c.v_mps or c.omega_radps)):
        return "did what was not asked"
    if (
        abs(c.v_mps) > 0.5 + 1e-9
        or abs(c.omega_radps) > 2.0 + 1e-9
        or c.v_mps * sp.v_mps < 0
        or c.omega_radps * sp.omega_radps < 0
    ):
        return "too fast, or the other way"
    dt_s = min(0.1, s.dt_s)
    if abs(c.v_mps) > abs(s.v_mps) + 1.0 * dt_s + 1e-9 or abs(c.omega_radps) > abs(s.omega_radps) + 8.0 * dt_s + 1e-9:
        return "gained speed too soon"
    if (c.v_mps > 0 and (s.cliff or s.bump)) or (c.base == "seek_dock" and s.cliff):
        return "went on at a cliff or a bump"
    out = s.arm_rad is None or stretched(s.arm_rad) > 0.225 or (sp.arm is not None and stretched(sp.arm) > 0.225)
    if out and (c.base == "seek_dock" or abs(c.v_mps) > 0.1 + 1e-9 or abs(c.omega_radps) > 0.6 + 1e-9):
        return "drove fast with the arm out"
    if s.place is None or not now_s - 2.0 <= s.place_s <= now_s:
        return ""
    x, y, yaw = s.place
    was_m = beyond(x, y)
    for _ in range(10):
        yaw += c.omega_radps * 0.03
        x, y = x + c.v_mps * 0.03 * math.cos(yaw), y + c.v_mps * 0.03 * math.sin(yaw)
    if beyond(x, y) > max(0.02, was_m + 0.01) or (c.base == "seek_dock" and was_m > 0.0):
        return "left the fence"
    return ""


def _joints(sp: Setpoint, s: GateState, c: Command) -> str:
    if c.roll_rad is not None and (c.roll_rad != sp.roll_rad or abs(c.roll_rad) > math.pi / 2 + 1e-9):
        return "turned the fingers too far"
    if c.arm is None:
        return ""
    for name, angle in zip(g.ARM_JOINTS, c.arm, strict=True):
        if not g.SERVOS[name].min_rad - 1e-6 <= angle <= g.SERVOS[name].max_rad + 1e-6:
            return "bent a joint too far"
    if c.arm != sp.arm or not max(0.0, sp.arm_s) <= c.arm_s <= 30.0:
        return "moved the arm as nobody asked"
    if s.arm_rad is None:
        return "" if c.arm == g.ARM_HOME_RAD else "moved an arm of unknown place"
    if any(abs(b - a) > 2.0 * c.arm_s + 1e-9 for a, b in zip(s.arm_rad, c.arm, strict=True)):
        return "moved the arm faster than its servos"
    return "the arm's goal is in the floor or the robot" if struck(c.arm) else ""


def _fingers(sp: Setpoint, s: GateState, now_s: float, c: Command) -> str:
    if c.gripper_m is None:
        return ""
    if c.gripper_m != sp.gripper_m or not 0.0 <= c.gripper_m <= 0.044:
        return "moved the fingers as nobody asked, or beyond their range"
    closes = c.gripper_m < (0.044 if s.gripper_m is None else s.gripper_m) - 0.001
    feels = s.force_n is not None and now_s - 0.8 - 1e-9 <= s.force_s <= now_s
    if closes and not feels:
        return "closed without feeling"
    return "squeezed further" if closes and s.force_n is not None and s.force_n >= 9.0 else ""


def _water(sp: Setpoint, s: GateState, c: Command, debit_ml: float) -> str:
    if not (c.pump or debit_ml > 0):
        return ""
    stands = s.v_mps == 0.0 and s.omega_radps == 0.0 and c.base == "stop" and s.arm_rad is not None and not s.arm_moving
    if not sp.pump or not sp.permit_id or not s.docked or s.dose.used or not stands:
        return "water where none may flow"
    if s.tank_ml is not None and s.tank_ml < 5.0:
        return "pumped out of an empty tank"
    if c.pump and (s.dose.debited_ml <= 0 or s.dose.delivered_ml >= min(s.dose.debited_ml, sp.dose_ml)):
        return "water beyond the dose"
    return "debit against the caps" if debit_ml > 0 and (s.dose.refusal or debit_ml != sp.dose_ml or c.pump) else ""


class Watch:
    """What must hold over time, whatever each verdict says."""

    def __init__(self) -> None:
        self._asked: Setpoint | None = None
        self._inside: bool | None = None

    def fault(self, life: Life, state: GateState) -> str:
        if life.delivered_ml > life.spent.get(life.permit_id, math.inf) + 0.02 * g.PUMP_MLPS + 3.0 * g.PUMP_MLPS:
            return "more water came than was written off"
        if life.arm is None:
            return ""
        if life.arm == g.ARM_HOME_RAD:
            life.clear = True
        return "the arm is in the floor or the robot" if life.clear and struck(life.arm) else ""


Check = Callable[[Setpoint | None, GateState, float], Verdict]


def lived(seed: int, steps: int, judged_by: Check = check) -> tuple[str, Counter[str]]:
    """The first fault of a life of so many turns with what led to it, and how often what happened."""
    life, watch, did = Life(random.Random(seed)), Watch(), Counter[str]()
    for step in range(steps):
        life.live()
        state = life.state()
        verdict = judged_by(life.wish, state, life.now_s)
        wrong = fault(life.wish, state, life.now_s, verdict)
        life.obey(verdict)
        wrong = wrong or (watch.fault(life, state) if step % 5 == 0 else "")
        if wrong:
            return f"step {step}: {wrong}: {life.wish} {state} {verdict}", did
        c = verdict.command
        did.update(
            name
            for name, happened in (
                (c.base, True),
                ("arm", c.arm is not None and life.arm_left_s > 0.0),
                ("gripper", c.gripper_m is not None),
                ("holds", c.gripper_holds),
                ("roll", c.roll_rad is not None),
                ("pump", c.pump),
                ("debit", verdict.debit_ml > 0),
                *((why.split(":")[0][:24], True) for why in verdict.refusals),
            )
            if happened
        )
    return "", did


@pytest.mark.parametrize("steps", [100_000, pytest.param(1_000_000, marks=pytest.mark.soak)])
def test_random_lives_stay_within_the_rules(steps: int) -> None:
    seed = 20261122
    print("seed", seed)
    wrong, did = "", Counter[str]()
    for life in range(10):
        wrong, more = lived(seed + life, steps // 10)
        assert not wrong, (seed + life, wrong)
        did += more
    print(did)
    for name, share in (("drive", 0.05), ("seek_dock", 0.02), ("arm", 0.05), ("gripper", 0.1), ("roll", 0.1)):
        assert did[name] > share * steps, did
    assert min(did["pump"], did["holds"]) > 0.002 * steps, did
    for said in (
        "the fence",
        "the fingers squeeze",
        "the force sensor",
        "there the arm",
        "a cliff",
        "touching",
        "the dose is",
    ):
        assert sum(count for why, count in did.items() if why.startswith(said)) > 20, (said, did)


# A test of the test


def nothing(*_: object) -> str:
    return ""


def as_wanted(_: float, wanted: float, __: float) -> float:
    return wanted


FAST = SimpleNamespace(**vars(g) | {"SERVOS": {name: replace(s, speed_radps_max=4.0) for name, s in g.SERVOS.items()}})
MISTAKES: dict[str, tuple[str, object]] = {
    "a setpoint lives longer": ("LIFE_S", 0.4),
    "old news of the base": ("BASE_FRESH_S", 1.0),
    "old news of the servo board": ("SERVO_FRESH_S", 4.0),
    "nothing is looked at before all": ("_nothing_moves", nothing),
    "numbers need not be finite": ("_finite", lambda setpoint: True),
    "speed is not limited": ("_limited", lambda v, omega: (v, omega)),
    "speed is gained at once": ("_slew", as_wanted),
    "the yaw rate is gained faster": ("OMEGA_ACCEL_RADPS2", 12.0),
    "cliffs, bumps and the arm do not count for the base": ("_base_refusal", nothing),
    "fast with the arm out": ("SLOW_MPS", 0.2),
    "turning fast with the arm out": ("SLOW_RADPS", 0.9),
    "the arm counts as in when it is out": ("ARM_OUT_M", 0.5),
    "no fence": ("_fence_refusal", nothing),
    "an old place": ("PLACE_FRESH_S", 0.2),
    "joints have no ranges": ("limit_broken", nothing),
    "the arm may go anywhere": ("strikes", nothing),
    "an arm of unknown place may begin anywhere": ("ARM_NEAR_RAD", 4.0),
    "servos of twice the speed": ("gardener", FAST),
    "the roll has no range": ("_roll", lambda setpoint, refusals: setpoint.roll_rad),
    "fingers have no range and feel nothing": ("_gripper_refusal", nothing),
    "an old force": ("FORCE_FRESH_S", 2.5),
    "fingers close a little more": ("GRIP_SLACK_M", 0.01),
    "the pump needs nothing": ("_pump_refusal", nothing),
    "an empty tank": ("TANK_EMPTY_ML", -1.0),
    "the dose has no end": ("DOSE_END_ML", -100.0),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_oracle_notices_mistakes_put_into_the_gate(mistake: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name, wrong = MISTAKES[mistake]
    monkeypatch.setattr(gate, name, wrong)
    assert any(lived(seed, 10_000)[0] for seed in range(20261122, 20261132)), f"nobody noticed: {mistake}"
