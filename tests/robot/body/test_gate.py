"""The gate, rule by rule, and random sequences against an oracle written from the rules alone."""

from __future__ import annotations

import ast
import math
import random
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs

from core.manipulation.arm import Joints
from core.robots import gardener
from core.wire.body import Setpoint
from robot_service.body.gate import LIFE_S, SLOW_MPS, STOP, Command, Dose, GateState, check

ROOT = Path(__file__).parents[3]
NOW_S = 100.0
OUT: Joints = (0.0, 0.85, -1.17, -0.47)
GOOD = GateState(
    heard_s=NOW_S - 0.02,
    stopped=False,
    base_up=True,
    base_s=NOW_S - 0.01,
    servo_up=True,
    servo_s=NOW_S - 0.1,
    arm_rad=gardener.ARM_HOME_RAD,
    tank_ml=900.0,
    v_mps=0.3,
)
DOCKED = replace(GOOD, docked=True, v_mps=0.0)
IN_HAND = replace(DOCKED, dose=Dose(debited_ml=50.0))
DRIVE = Setpoint(seq=1, base="drive", v_mps=0.3)
BACK = Setpoint(seq=1, base="drive", v_mps=-0.05)
SEEK = Setpoint(seq=1, base="seek_dock")
PUMP = Setpoint(seq=1, pump=True, permit_id="p", dose_ml=50.0)


def refused(setpoint: Setpoint, state: GateState) -> str:
    """The reason; and nothing of it may have got through."""
    verdict = check(setpoint, state, NOW_S)
    assert verdict.command == STOP
    assert verdict.debit_ml == 0.0
    assert verdict.refusal
    return verdict.refusal


def test_a_good_setpoint_passes_unchanged() -> None:
    assert check(DRIVE, GOOD, NOW_S).command == Command(base="drive", v_mps=0.3)
    assert check(SEEK, GOOD, NOW_S).command == Command(base="seek_dock")
    assert check(PUMP, IN_HAND, NOW_S).command == Command(pump=True)
    arm = check(Setpoint(seq=1, arm=OUT, arm_s=3.0, gripper_m=0.02), DOCKED, NOW_S).command
    assert arm == Command(arm=OUT, arm_s=3.0, gripper_m=0.02)


def test_it_boots_with_everything_off() -> None:
    for setpoint in (None, DRIVE, SEEK, PUMP):
        assert check(setpoint, GateState(), NOW_S).command == STOP


@pytest.mark.parametrize("age_s", [LIFE_S + 0.001, 5.0, -0.01, math.inf, math.nan])
def test_a_setpoint_past_its_life_or_from_the_future_moves_nothing(age_s: float) -> None:
    assert check(DRIVE, replace(GOOD, heard_s=NOW_S - age_s), NOW_S).command == STOP


@pytest.mark.parametrize("setpoint", [DRIVE, SEEK, PUMP, Setpoint(seq=1, arm=OUT), Setpoint(seq=1, gripper_m=0.01)])
@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"stopped": True, "stopped_by": "anna"}, "stopped by anna"),
        ({"base_up": False}, "base's link"),
        ({"servo_up": False}, "servo board's link"),
        ({"base_s": NOW_S - 1.0}, "no fresh reading from the base"),
        ({"servo_s": NOW_S - 3.0}, "no fresh reading from the servo"),
        ({"base_s": math.nan}, "no fresh reading"),
        ({"wheel_drop": True}, "wheel"),
    ],
)
def test_nothing_moves_at_all(setpoint: Setpoint, change: dict[str, object], why: str) -> None:
    assert why in refused(setpoint, replace(IN_HAND, **change))  # type: ignore[arg-type]


@pytest.mark.parametrize("field", ["v_mps", "omega_radps", "arm_s", "dose_ml", "gripper_m"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_moves_nothing(field: str, value: float) -> None:
    assert "not finite" in refused(structs.replace(DRIVE, **{field: value}), GOOD)  # type: ignore[arg-type]
    assert "not finite" in refused(Setpoint(seq=1, arm=(0.0, value, 0.0, 0.0)), GOOD)


@pytest.mark.parametrize("hazard", ["cliff", "bump"])
def test_at_a_cliff_or_a_bump_only_back(hazard: str) -> None:
    state = replace(GOOD, **{hazard: True})  # type: ignore[arg-type]
    assert "only back" in refused(DRIVE, state)
    assert check(BACK, replace(state, v_mps=-0.05), NOW_S).command.v_mps == -0.05


def test_the_bases_own_docking_may_touch_but_not_fall() -> None:
    assert check(SEEK, replace(GOOD, bump=True), NOW_S).command.base == "seek_dock"
    assert "cliff" in refused(SEEK, replace(GOOD, cliff=True))


@pytest.mark.parametrize("state", [replace(GOOD, arm_rad=OUT), replace(GOOD, arm_rad=None)], ids=["out", "unknown"])
def test_with_the_arm_out_or_unknown_only_slowly(state: GateState) -> None:
    for setpoint in (DRIVE, SEEK, Setpoint(seq=1, base="drive", omega_radps=1.5)):
        assert "arm" in refused(setpoint, state)
    slow = Setpoint(seq=1, base="drive", v_mps=SLOW_MPS, omega_radps=0.1)
    assert check(slow, state, NOW_S).command.v_mps == SLOW_MPS


def test_the_arm_may_not_swing_out_at_speed_but_then_the_base_stops_and_the_arm_moves() -> None:
    verdict = check(structs.replace(DRIVE, arm=OUT, arm_s=3.0), GOOD, NOW_S)
    assert (verdict.command.base, verdict.command.arm) == ("stop", OUT)
    assert "arm is out" in verdict.refusal


def test_speeds_beyond_the_limits_are_scaled_down_and_curvature_is_kept() -> None:
    command = check(
        Setpoint(seq=1, base="drive", v_mps=2.0, omega_radps=1.0), replace(GOOD, v_mps=0.5, omega_radps=2.0), NOW_S
    )
    assert command.command.v_mps == gardener.V_MPS_MAX
    assert command.command.omega_radps == pytest.approx(0.25)


def test_speed_is_gained_gently_and_lost_at_once() -> None:
    still = replace(GOOD, v_mps=0.0)
    assert check(DRIVE, still, NOW_S).command.v_mps == pytest.approx(0.02)
    assert check(structs.replace(DRIVE, v_mps=0.0), GOOD, NOW_S).command.v_mps == 0.0
    assert check(BACK, GOOD, NOW_S).command.v_mps == pytest.approx(-0.02)
    assert check(DRIVE, replace(still, dt_s=100.0), NOW_S).command.v_mps <= 0.1


@pytest.mark.parametrize("arm", [(2.0, 0.5, -1.0, 0.0), (0.0, 3.0, -1.0, 0.0), (0.0, 0.5, 0.5, 0.0), (0.0, 0.5, -1.0, 1.6)])
def test_a_joint_out_of_range_is_refused_by_name(arm: Joints) -> None:
    assert "outside" in refused(Setpoint(seq=1, arm=arm), GOOD)


def test_a_refused_arm_does_not_hold_up_the_base() -> None:
    verdict = check(structs.replace(DRIVE, arm=(9.0, 0.0, 0.0, 0.0)), replace(GOOD, arm_rad=gardener.ARM_HOME_RAD), NOW_S)
    assert verdict.command.arm is None
    slow = check(structs.replace(BACK, arm=(9.0, 0.0, 0.0, 0.0)), replace(GOOD, v_mps=-0.05), NOW_S)
    assert (slow.command.base, slow.command.arm) == ("drive", None)


def test_an_arm_of_unknown_place_goes_home_first() -> None:
    lost = replace(DOCKED, arm_rad=None)
    assert "folded" in refused(Setpoint(seq=1, arm=OUT), lost)
    assert check(Setpoint(seq=1, arm=gardener.ARM_HOME_RAD), lost, NOW_S).command.arm == gardener.ARM_HOME_RAD


def test_the_arm_is_never_faster_than_its_servos() -> None:
    assert check(Setpoint(seq=1, arm=OUT, arm_s=0.0), DOCKED, NOW_S).command.arm_s >= 0.8
    assert "outside" in refused(Setpoint(seq=1, arm=OUT, arm_s=1e6), DOCKED)


@pytest.mark.parametrize("opening_m", [-0.01, 0.05])
def test_a_gripper_opening_out_of_range_is_refused(opening_m: float) -> None:
    assert "gripper" in refused(Setpoint(seq=1, gripper_m=opening_m), GOOD)


@pytest.mark.parametrize(
    ("setpoint", "change", "why"),
    [
        (structs.replace(PUMP, permit_id=""), {}, "permit"),
        (PUMP, {"docked": False}, "docked"),
        (PUMP, {"v_mps": 0.1}, "base stands"),
        (PUMP, {"arm_moving": True}, "arm stands"),
        (PUMP, {"arm_rad": None}, "place is known"),
        (PUMP, {"tank_ml": 2.0}, "tank is empty"),
        (structs.replace(PUMP, dose_ml=0.0), {}, "more than nothing"),
        (structs.replace(PUMP, dose_ml=-5.0), {}, "more than nothing"),
        (PUMP, {"dose": Dose(used=True)}, "spent"),
        (PUMP, {"dose": Dose(refusal="the cap is reached")}, "cap"),
        (PUMP, {"dose": Dose(debited_ml=50.0, delivered_ml=50.0)}, "delivered"),
        (structs.replace(PUMP, dose_ml=80.0), {"dose": Dose(debited_ml=50.0, delivered_ml=50.0)}, "delivered"),
        (structs.replace(PUMP, dose_ml=20.0), {"dose": Dose(debited_ml=50.0, delivered_ml=20.0)}, "delivered"),
    ],
)
def test_the_pump_is_refused(setpoint: Setpoint, change: dict[str, object], why: str) -> None:
    assert why in refused(setpoint, replace(IN_HAND, **change))  # type: ignore[arg-type]


def test_driving_and_pumping_at_once_drives_only() -> None:
    verdict = check(structs.replace(PUMP, base="drive", v_mps=-0.05), replace(IN_HAND, v_mps=-0.05), NOW_S)
    assert (verdict.command.base, verdict.command.pump) == ("drive", False)


def test_a_dose_is_debited_before_the_pump_starts() -> None:
    verdict = check(PUMP, DOCKED, NOW_S)
    assert (verdict.command.pump, verdict.debit_ml) == (False, 50.0)


# Random sequences


def draw_setpoint(rng: random.Random) -> Setpoint:
    wild = (math.nan, math.inf, -math.inf, 1e9, -1e9)

    def number(spread: float) -> float:
        return rng.choice(wild) if rng.random() < 0.01 else rng.uniform(-spread, spread)

    arm = rng.choice((None, gardener.ARM_HOME_RAD, OUT, (number(2.0), number(3.0), number(3.0), number(2.0))))
    return Setpoint(
        seq=0,
        base=rng.choice(("stop", "stop", "drive", "drive", "seek_dock")),
        v_mps=number(0.8),
        omega_radps=number(3.0),
        arm=arm,
        arm_s=abs(number(5.0)),
        gripper_m=rng.choice((None, number(0.06))),
        pump=rng.random() < 0.5,
        permit_id=rng.choice(("", "p", "p")),
        dose_ml=number(200.0) if rng.random() < 0.3 else 50.0,
    )


def draw_state(rng: random.Random, now_s: float) -> GateState:
    def rarely() -> bool:
        return rng.random() < 0.04

    dose = Dose(
        used=rarely(),
        debited_ml=rng.choice((0.0, 50.0)),
        delivered_ml=rng.uniform(0.0, 60.0),
        refusal=rng.choice(("", "", "capped")),
    )
    return GateState(
        heard_s=now_s - rng.choice((0.0, 0.02, 0.1, rng.uniform(-0.1, 0.6))),
        stopped=rarely(),
        base_up=not rarely(),
        base_s=now_s - rng.choice((0.01, 0.01, rng.uniform(0.0, 1.0))),
        servo_up=not rarely(),
        servo_s=now_s - rng.choice((0.1, rng.uniform(0.0, 4.0))),
        wheel_drop=rarely(),
        cliff=rarely(),
        bump=rarely(),
        docked=rng.random() < 0.6,
        arm_rad=rng.choice((None, gardener.ARM_HOME_RAD, gardener.ARM_HOME_RAD, OUT)),
        arm_moving=rarely(),
        tank_ml=rng.choice((None, 0.0, 700.0)),
        dose=dose,
        dt_s=rng.choice((0.02, 0.02, 0.5, 0.0)),
    )


def stretched(q: Joints) -> float:
    """The oracle's own forward kinematics: furthest joint from the base's centre, seen from above."""
    far, r, pitch = gardener.SHOULDER_X_M, 0.0, 0.0
    for angle, length_m in zip(q[1:], (gardener.UPPER_ARM_M, gardener.FOREARM_M, gardener.HAND_M), strict=True):
        pitch += angle
        r += length_m * math.cos(pitch)
        far = max(far, abs(complex(gardener.SHOULDER_X_M + r * math.cos(q[0]), r * math.sin(q[0]))))
    return far


def fault(sp: Setpoint, s: GateState, now_s: float, c: Command, debit_ml: float) -> str:
    """What is wrong with letting `c` through; empty when nothing is. Written from docs/body.md, not from the gate."""
    moving = c != STOP or debit_ml > 0
    numbers = (sp.v_mps, sp.omega_radps, sp.arm_s, sp.dose_ml, *(sp.arm or ()), sp.gripper_m or 0.0)
    if moving and (s.stopped or s.wheel_drop or not s.base_up or not s.servo_up or any(map(math.isnan, numbers))):
        return "moved although nothing may move"
    if moving and (now_s - s.heard_s > 0.3 or now_s - s.base_s > 0.5 or now_s - s.servo_s > 2.0):
        return "moved on old news"
    if c.base != sp.base and c.base != "stop":
        return "did what was not asked"
    if abs(c.v_mps) > gardener.V_MPS_MAX + 1e-9 or abs(c.omega_radps) > gardener.OMEGA_RADPS_MAX + 1e-9:
        return "too fast"
    if abs(c.v_mps) > abs(s.v_mps) + 0.1 + 1e-9 or c.v_mps * sp.v_mps < 0:
        return "jumped"
    if (c.v_mps > 0 and (s.cliff or s.bump)) or (c.base == "seek_dock" and s.cliff):
        return "went on at a cliff or a bump"
    out = s.arm_rad is None or stretched(s.arm_rad) > 0.23 or (c.arm is not None and stretched(c.arm) > 0.23)
    if out and (c.base == "seek_dock" or abs(c.v_mps) > 0.1 + 1e-9):
        return "drove fast with the arm out"
    for name, angle in zip(gardener.ARM_JOINTS, c.arm or (), strict=False):
        if not gardener.SERVOS[name].min_rad - 1e-6 <= angle <= gardener.SERVOS[name].max_rad + 1e-6:
            return "bent a joint too far"
    if c.arm is not None and s.arm_rad is None and c.arm != gardener.ARM_HOME_RAD:
        return "moved an arm of unknown place"
    water = c.pump or debit_ml > 0
    arm_stands = s.arm_rad is not None and not s.arm_moving
    if water and (not sp.permit_id or not s.docked or s.dose.used or not arm_stands or s.v_mps or c.base != "stop"):
        return "water where none may flow"
    if c.pump and (s.dose.debited_ml <= 0 or s.dose.delivered_ml >= min(s.dose.debited_ml, sp.dose_ml)):
        return "water beyond the dose"
    return "debit against the caps" if debit_ml > 0 and (s.dose.refusal or debit_ml != sp.dose_ml) else ""


@pytest.mark.parametrize("steps", [100_000, pytest.param(1_000_000, marks=pytest.mark.soak)])
def test_random_steps_stay_within_the_rules(steps: int) -> None:
    seed = 20261122
    print("seed", seed)
    rng = random.Random(seed)
    setpoints = [draw_setpoint(rng) for _ in range(3000)]
    states = [draw_state(rng, NOW_S) for _ in range(3000)]
    before, alive, wet = STOP, 0, 0
    for step in range(steps):
        setpoint = setpoints[int(rng.random() * 3000)]
        state = replace(states[int(rng.random() * 3000)], v_mps=before.v_mps, omega_radps=before.omega_radps)
        verdict = check(setpoint, state, NOW_S)
        wrong = fault(setpoint, state, NOW_S, verdict.command, verdict.debit_ml)
        assert not wrong, (step, wrong, setpoint, state, verdict)
        before = verdict.command
        alive += verdict.command.base == "drive"
        wet += verdict.command.pump
    assert alive > steps / 20
    assert wet > 0.003 * steps


# Who may touch a device

MOVING = {"drive", "seek_dock", "move", "output", "halt"}


def calls(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    return {n.func.attr for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)}


def imported(path: Path) -> set[str]:
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = {alias.name for n in nodes if isinstance(n, ast.Import) for alias in n.names}
    return names | {n.module or "" for n in nodes if isinstance(n, ast.ImportFrom)}


@pytest.mark.parametrize("path", sorted((ROOT / "robot_service").rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_only_the_actuators_tell_a_device_to_move(path: Path) -> None:
    inside = path.is_relative_to(ROOT / "robot_service" / "body")
    if path.name == "body.py" and inside:
        assert calls(path) & MOVING <= {"halt"}
        return
    # A camera moves nothing: the brain may look by itself.
    assert not any(name.startswith("hw.drivers") for name in imported(path) - {"hw.drivers.camera"})
    if inside and path.name != "actuators.py":
        assert not calls(path) & MOVING


def test_the_gate_is_small_and_pure() -> None:
    path = ROOT / "robot_service" / "body" / "gate.py"
    assert len(path.read_text().splitlines()) <= 400
    assert imported(path) <= {"__future__", "math", "dataclasses", "typing"} | {
        "core.manipulation.arm",
        "core.robots",
        "core.wire.body",
    }
