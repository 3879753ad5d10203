"""The gate, rule by rule. Random sequences against an oracle: `test_gate_sequences.py`."""

from __future__ import annotations

import ast
import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from msgspec import structs

from core.manipulation.arm import Joints, reach_m
from core.robots import gardener
from core.robots.fence import KEEP_M, Fence, fence_of
from core.scenario import SCENARIOS_DIR, find
from core.wire.body import Setpoint
from core.wire.geometry import Pose2
from robot_service.body import gate
from robot_service.body.gate import (
    ARM_OUT_M,
    BASE_FRESH_S,
    LIFE_S,
    SERVO_FRESH_S,
    SLOW_MPS,
    STOP,
    Command,
    Dose,
    GateState,
    Verdict,
    check,
)

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
    gripper_m=0.03,
    force_n=0.1,
    force_s=NOW_S - 0.1,
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
    assert replace(verdict.command, gripper_holds=False) == STOP
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


FENCE = Fence(x_m_min=-2.0, x_m_max=2.0, y_m_min=-1.5, y_m_max=1.5, markers={400: Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0)})
EDGE_M = 2.0 - KEEP_M
FENCED = replace(GOOD, fence=FENCE, place=(0.0, 0.0, 0.0), place_s=NOW_S - 0.5)


@pytest.mark.parametrize(
    ("place", "v_mps", "allowed"),
    [
        ((0.0, 0.0, 0.0), 0.3, True),
        ((EDGE_M - 0.091, 0.0, 0.0), 0.3, True),
        ((EDGE_M - 0.089, 0.0, 0.0), 0.3, False),
        ((EDGE_M - 0.089, 0.0, 0.0), 0.28, True),
        ((EDGE_M - 0.01, 0.0, 0.0), -0.3, True),
        ((EDGE_M - 0.01, 0.0, math.pi), 0.3, True),
        ((EDGE_M - 0.01, 0.0, math.pi), -0.3, False),
        ((EDGE_M - 0.01, 0.0, math.pi / 2), 0.3, True),
        ((EDGE_M + 0.2, 0.0, 0.0), 0.01, False),
        ((EDGE_M + 0.2, 0.0, math.pi / 2), 0.3, False),
        ((EDGE_M + 0.2, 0.0, 0.0), -0.3, True),
        ((-EDGE_M + 0.05, 0.0, math.pi), 0.3, False),
        ((0.0, 1.5 - KEEP_M - 0.05, math.pi / 2), 0.3, False),
        ((0.0, -1.5 + KEEP_M + 0.05, -math.pi / 2), 0.3, False),
        ((0.0, -1.5 + KEEP_M + 0.05, math.pi / 2), 0.3, True),
    ],
)
def test_nobody_drives_out_of_the_fence_and_from_outside_only_back_in(
    place: tuple[float, float, float], v_mps: float, allowed: bool
) -> None:
    state = replace(FENCED, place=place, v_mps=v_mps)
    assert passes(Setpoint(seq=1, base="drive", v_mps=v_mps), state) == allowed
    for elsewhere in ({"place": None}, {"place_s": NOW_S - 2.001}, {"place_s": NOW_S + 0.001}, {"fence": None}):
        assert passes(Setpoint(seq=1, base="drive", v_mps=v_mps), replace(state, **elsewhere))  # type: ignore[arg-type]


def test_at_the_fence_the_base_turns_freely_and_a_curve_counts_by_where_it_leads() -> None:
    at_edge = replace(FENCED, place=(EDGE_M - 0.05, 0.0, 0.0), v_mps=0.0)
    assert passes(Setpoint(seq=1, base="drive", omega_radps=1.0), replace(at_edge, omega_radps=1.0))
    assert passes(Setpoint(seq=1, base="drive", omega_radps=1.0), replace(at_edge, place=(EDGE_M + 0.1, 0.0, 0.0)))
    slanting = replace(FENCED, place=(EDGE_M - 0.045, 0.0, 1.0), v_mps=0.3)
    assert "fence" in refused(Setpoint(seq=1, base="drive", v_mps=0.3), slanting)
    assert passes(Setpoint(seq=1, base="drive", v_mps=0.3, omega_radps=2.0), replace(slanting, omega_radps=2.0))


def test_it_is_the_speed_it_is_told_that_counts_at_the_fence_not_the_one_it_wants() -> None:
    standing = replace(FENCED, place=(EDGE_M - 0.02, 0.0, 0.0), v_mps=0.0)
    assert check(DRIVE, standing, NOW_S).command.v_mps == pytest.approx(0.02)


def test_the_bases_own_docking_is_free_inside_the_fence_and_not_begun_outside() -> None:
    assert passes(SEEK, replace(FENCED, place=(EDGE_M - 0.01, 0.0, 0.0)))
    assert "outside the fence" in refused(SEEK, replace(FENCED, place=(EDGE_M + 0.01, 0.0, 0.0)))


def test_a_fence_judges_where_a_place_is_as_old_as_two_seconds_and_no_older() -> None:
    out = replace(FENCED, place=(EDGE_M + 0.1, 0.0, 0.0))
    for age_s, judged in ((0.0, True), (gate.PLACE_FRESH_S, True), (gate.PLACE_FRESH_S + 1e-6, False)):
        assert passes(DRIVE, replace(out, place_s=NOW_S - age_s)) != judged


def test_every_dock_and_every_home_of_the_built_in_gardens_is_well_inside_its_fence() -> None:
    """So that a robot at a dock by the edge is not hindered, the marker sensor's error and all."""
    scenarios = [find(path.parent.name) for path in SCENARIOS_DIR.glob("*/scenario.toml")]
    assert scenarios
    for scenario in scenarios:
        fence = fence_of(scenario.arena)
        places = [*scenario.docks().values(), *(robot.home for robot in scenario.robots)]
        for p in places:
            for v_mps in (-0.15, 0.15):
                for dx, dy in ((0.04, 0.0), (-0.04, 0.0), (0.0, 0.04), (0.0, -0.04)):
                    assert not fence.leaves((p.x_m + dx, p.y_m + dy, p.yaw_rad), v_mps, 0.0), (scenario.name, p)


def test_an_arm_of_unknown_place_goes_home_first() -> None:
    lost = replace(DOCKED, arm_rad=None)
    assert "folded" in refused(Setpoint(seq=1, arm=OUT), lost)
    assert check(Setpoint(seq=1, arm=gardener.ARM_HOME_RAD), lost, NOW_S).command.arm == gardener.ARM_HOME_RAD


LOW: Joints = (0.0, math.radians(-10.0), math.radians(-60.0), math.radians(-30.0))
"""Every joint within its range, the fingers below the floor."""


def test_the_arm_is_kept_out_of_the_floor_and_its_own_body_and_may_always_leave_them() -> None:
    assert "floor" in refused(Setpoint(seq=1, arm=LOW, arm_s=3.0), DOCKED)
    one, other = (-0.8, 0.3, -2.2, 1.5), (0.1, 0.6, -2.1, -1.1)
    assert passes(Setpoint(seq=1, arm=other, arm_s=3.0), replace(DOCKED, arm_rad=other))
    assert "on its way" in refused(Setpoint(seq=1, arm=other, arm_s=3.0), replace(DOCKED, arm_rad=one))
    for goal in (gardener.ARM_HOME_RAD, OUT):
        assert passes(Setpoint(seq=1, arm=goal, arm_s=3.0), replace(DOCKED, arm_rad=LOW))


def test_the_arm_is_never_faster_than_its_servos() -> None:
    assert check(Setpoint(seq=1, arm=OUT, arm_s=0.0), DOCKED, NOW_S).command.arm_s >= 0.8
    assert "outside" in refused(Setpoint(seq=1, arm=OUT, arm_s=1e6), DOCKED)


@pytest.mark.parametrize("opening_m", [-0.01, 0.05])
def test_a_gripper_opening_out_of_range_is_refused(opening_m: float) -> None:
    assert "gripper" in refused(Setpoint(seq=1, gripper_m=opening_m), GOOD)


CLOSE = Setpoint(seq=1, gripper_m=0.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"force_n": gardener.GRIP_N_MAX}, "squeeze with 9.0 N"),
        ({"force_n": 10.0}, "squeeze"),
        ({"force_n": math.nan}, "squeeze"),
        ({"force_n": None}, "silent"),
        ({"force_s": NOW_S - gate.FORCE_FRESH_S - 0.001}, "silent"),
        ({"force_s": NOW_S + 0.001}, "silent"),
        ({"force_s": -math.inf}, "silent"),
        ({"force_n": None, "gripper_m": None}, "silent"),
    ],
)
def test_fingers_that_squeeze_hard_or_do_not_feel_may_hold_and_open_but_close_no_further(
    change: dict[str, object], why: str
) -> None:
    state = replace(GOOD, **change)  # type: ignore[arg-type]
    verdict = check(CLOSE, state, NOW_S)
    assert (verdict.command, len(verdict.refusals)) == (Command(gripper_holds=True), 1)
    assert why in verdict.refusal
    if state.gripper_m is not None:
        for opening_m in (state.gripper_m, state.gripper_m + 0.01, gardener.GRIPPER_OPEN_M):
            assert passes(Setpoint(seq=1, gripper_m=opening_m), state)
        assert passes(Setpoint(seq=1, gripper_m=state.gripper_m - 0.0004), state)
        assert not passes(Setpoint(seq=1, gripper_m=state.gripper_m - 0.0006), state)
    assert passes(Setpoint(seq=1, gripper_m=gardener.GRIPPER_OPEN_M), state)


def test_fingers_that_feel_close() -> None:
    for change in ({}, {"force_n": 8.9}, {"force_s": NOW_S - gate.FORCE_FRESH_S}, {"force_s": NOW_S}, {"gripper_m": None}):
        verdict = check(CLOSE, replace(GOOD, **change), NOW_S)  # type: ignore[arg-type]
        assert verdict == Verdict(command=Command(gripper_m=0.0))


def test_where_fingers_stand_and_how_old_a_force_may_be_counts_to_the_last() -> None:
    blind = replace(at(0.0, 0.0), gripper_m=gate.GRIP_SLACK_M, force_n=None)
    assert passes(CLOSE, blind, 0.0)
    assert not passes(CLOSE, replace(blind, gripper_m=gate.GRIP_SLACK_M + 1e-9), 0.0)
    for age_s, fresh in ((0.0, True), (gate.FORCE_FRESH_S, True), (gate.FORCE_FRESH_S + 1e-9, False), (-1e-9, False)):
        assert passes(CLOSE, replace(at(0.0, 0.0), force_s=-age_s), 0.0) == fresh


def test_a_grip_that_is_held_stays_held_however_hard_it_squeezes() -> None:
    state = replace(GOOD, gripper_m=0.0, force_n=10.0)
    assert check(CLOSE, state, NOW_S).command == Command(gripper_m=0.0)


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


# Where each limit lies


def at(now_s: float, age_s: float, state: GateState = GOOD) -> GateState:
    """All heard of `age_s` before `now_s`."""
    return replace(state, heard_s=now_s - age_s, base_s=now_s - age_s, servo_s=now_s - age_s)


def passes(setpoint: Setpoint, state: GateState, now_s: float = NOW_S) -> bool:
    """Whether all of it gets through."""
    verdict = check(setpoint, state, now_s)
    assert bool(verdict.refusal) == bool(verdict.refusals)
    return verdict.command != STOP and not verdict.command.gripper_holds and not verdict.refusals


def test_the_defaults_of_everything_are_off() -> None:
    off = {"base": "stop", "v_mps": 0.0, "omega_radps": 0.0, "arm": None, "arm_s": 0.0, "gripper_m": None, "roll_rad": None}
    assert asdict(Command()) == off | {"gripper_holds": False, "pump": False}
    assert (Verdict().command, Verdict().refusals, Verdict().debit_ml, Verdict().refusal) == (STOP, (), 0.0, "")
    assert asdict(Dose()) == {"used": False, "debited_ml": 0.0, "delivered_ml": 0.0, "refusal": ""}
    state = GateState()
    assert (state.stopped, state.stopped_by, state.base_up, state.servo_up, state.docked) == (True, "", False, False, False)
    assert (state.heard_s, state.base_s, state.servo_s) == (-math.inf, -math.inf, -math.inf)
    assert (state.v_mps, state.omega_radps, state.dt_s) == (0.0, 0.0, 0.02)
    assert (state.gripper_m, state.force_n, state.force_s) == (None, None, -math.inf)
    assert (state.fence, state.place, state.place_s) == (None, None, -math.inf)


@pytest.mark.parametrize("field", ["heard_s", "stopped", "base_up", "base_s", "servo_up", "servo_s"])
def test_what_was_never_heard_of_stops_everything_by_itself(field: str) -> None:
    silent = replace(GOOD, **{field: getattr(GateState(), field)})
    assert passes(DRIVE, GOOD)
    assert check(DRIVE, silent, NOW_S).command == STOP


def test_without_a_setpoint_nothing_moves_and_nothing_is_refused() -> None:
    assert check(None, GOOD, NOW_S) == Verdict()
    assert check(DRIVE, replace(GOOD, heard_s=-math.inf), NOW_S) == Verdict()


@pytest.mark.parametrize(
    ("field", "life_s"),
    [("heard_s", LIFE_S), ("base_s", BASE_FRESH_S), ("servo_s", SERVO_FRESH_S)],
    ids=lambda value: str(value),
)
def test_news_counts_from_the_moment_it_came_to_the_end_of_its_life(field: str, life_s: float) -> None:
    for age_s, heard in ((0.0, True), (life_s, True), (life_s + 1e-6, False), (-1e-6, False)):
        assert passes(DRIVE, replace(at(0.0, 0.0), **{field: -age_s}), 0.0) == heard, age_s


def test_the_limits_are_those_of_the_safety_rules() -> None:
    assert pytest.approx(0.24) == LIFE_S
    assert (BASE_FRESH_S, SERVO_FRESH_S, gate.FORCE_FRESH_S, gate.PLACE_FRESH_S) == (0.5, 2.0, 0.8, 2.0)
    assert (SLOW_MPS, pytest.approx(0.224)) == (0.1, ARM_OUT_M)


@pytest.mark.parametrize(("by", "said"), [("anna", "stopped by anna"), ("", "stopped")])
def test_who_stopped_it_is_said_when_it_is_known(by: str, said: str) -> None:
    assert refused(DRIVE, replace(GOOD, stopped=True, stopped_by=by)) == said


@pytest.mark.parametrize(
    "setpoint",
    [DRIVE, SEEK, PUMP, Setpoint(seq=1, arm=OUT), Setpoint(seq=1, gripper_m=0.01), Setpoint(seq=1, roll_rad=0.1)],
)
def test_each_wish_by_itself_is_refused_aloud_and_the_wish_for_nothing_in_silence(setpoint: Setpoint) -> None:
    stopped = replace(IN_HAND, stopped=True)
    assert check(setpoint, stopped, NOW_S).refusals == ("stopped",)
    assert check(Setpoint(seq=1), stopped, NOW_S) == Verdict()


def test_every_part_that_is_refused_says_so() -> None:
    setpoint = Setpoint(seq=1, base="drive", v_mps=0.3, gripper_m=1.0, pump=True)
    assert check(setpoint, replace(GOOD, bump=True), NOW_S).refusal.count("; ") == 2


@pytest.mark.parametrize("hazard", ["cliff", "bump"])
def test_at_a_cliff_or_a_bump_turning_on_the_spot_is_free(hazard: str) -> None:
    turning = Setpoint(seq=1, base="drive", omega_radps=0.5)
    assert passes(turning, replace(GOOD, v_mps=0.0, **{hazard: True}))  # type: ignore[arg-type]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_with_the_arm_out_the_slow_speeds_are_the_limit_both_ways(sign: float) -> None:
    out = replace(GOOD, arm_rad=OUT, v_mps=sign * SLOW_MPS, omega_radps=sign * 0.6)
    assert passes(Setpoint(seq=1, base="drive", v_mps=sign * 0.1, omega_radps=sign * 0.6), out)
    assert "arm" in refused(Setpoint(seq=1, base="drive", v_mps=sign * 0.1001), out)
    assert "arm" in refused(Setpoint(seq=1, base="drive", omega_radps=sign * 0.6001), out)


def test_an_arm_just_at_its_limit_is_not_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "ARM_OUT_M", reach_m(OUT))
    assert passes(DRIVE, replace(GOOD, arm_rad=OUT))
    assert passes(structs.replace(DRIVE, arm=OUT, arm_s=3.0), GOOD)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_too_fast_either_way_is_scaled_to_the_limit(sign: float) -> None:
    fast = replace(GOOD, v_mps=sign * 0.5, omega_radps=sign * 2.0)
    ahead = check(Setpoint(seq=1, base="drive", v_mps=sign * 1.0), fast, NOW_S).command
    round_ = check(Setpoint(seq=1, base="drive", omega_radps=sign * 8.0, v_mps=sign * 0.4), fast, NOW_S).command
    assert (ahead.v_mps, ahead.omega_radps) == (sign * 0.5, 0.0)
    assert (round_.v_mps, round_.omega_radps) == (pytest.approx(sign * 0.1), sign * 2.0)


def test_the_bases_own_docking_is_told_no_speed() -> None:
    for setpoint in (SEEK, structs.replace(SEEK, v_mps=0.3, omega_radps=1.0)):
        for state in (GOOD, replace(GOOD, bump=True)):
            assert check(setpoint, state, NOW_S).command == Command(base="seek_dock")


@pytest.mark.parametrize(
    ("was", "wanted", "dt_s", "told"),
    [
        (0.0, 0.3, 0.02, 0.02),
        (0.1, 0.3, 0.02, 0.12),
        (0.29, 0.3, 0.02, 0.3),
        (0.3, 0.1, 0.02, 0.1),
        (0.3, -0.3, 0.02, -0.02),
        (-0.3, 0.3, 0.02, 0.02),
        (-0.1, -0.3, 0.02, -0.12),
        (0.0, 0.3, 0.1, 0.1),
        (0.0, 0.3, 5.0, 0.1),
        (0.1, 0.3, 0.0, 0.1),
        (0.1, 0.3, -1.0, 0.1),
    ],
)
def test_speed_is_gained_by_one_metre_a_second_squared(was: float, wanted: float, dt_s: float, told: float) -> None:
    command = check(Setpoint(seq=1, base="drive", v_mps=wanted), replace(GOOD, v_mps=was, dt_s=dt_s), NOW_S).command
    assert command.v_mps == pytest.approx(told, abs=1e-12)


def test_turning_is_gained_by_eight_radians_a_second_squared() -> None:
    command = check(Setpoint(seq=1, base="drive", omega_radps=1.5), replace(GOOD, omega_radps=0.5), NOW_S).command
    assert command.omega_radps == pytest.approx(0.66)


@pytest.mark.parametrize(("arm_s", "allowed"), [(0.0, True), (30.0, True), (30.01, False), (-0.01, False)])
def test_an_arm_move_takes_between_nothing_and_half_a_minute(arm_s: float, allowed: bool) -> None:
    assert passes(Setpoint(seq=1, arm=OUT, arm_s=arm_s), DOCKED) == allowed


def test_an_arm_move_is_stretched_to_what_its_slowest_joint_needs() -> None:
    needed_s = (math.radians(150.0) - 0.85) / 2.0
    for arm_s, told_s in ((0.0, needed_s), (0.5, needed_s), (3.0, 3.0)):
        command = check(Setpoint(seq=1, arm=OUT, arm_s=arm_s), DOCKED, NOW_S).command
        assert command.arm_s == pytest.approx(told_s)
    wrist = (0.0, math.radians(150.0), math.radians(-150.0), math.radians(-50.0))
    assert check(Setpoint(seq=1, arm=wrist), DOCKED, NOW_S).command.arm_s == pytest.approx(math.radians(110.0) / 2.0)
    assert check(Setpoint(seq=1, arm=gardener.ARM_HOME_RAD), replace(DOCKED, arm_rad=None), NOW_S).command.arm_s == 0.0


@pytest.mark.parametrize(("off_rad", "allowed"), [(0.05, True), (-0.05, True), (0.0501, False), (-0.0501, False)])
def test_an_arm_of_unknown_place_goes_within_a_twentieth_of_a_radian_of_home(off_rad: float, allowed: bool) -> None:
    goal = (off_rad, *gardener.ARM_HOME_RAD[1:])
    assert passes(Setpoint(seq=1, arm=goal), replace(DOCKED, arm_rad=None)) == allowed


@pytest.mark.parametrize(
    ("setpoint", "allowed"),
    [
        (Setpoint(seq=1, gripper_m=0.0), True),
        (Setpoint(seq=1, gripper_m=gardener.GRIPPER_OPEN_M), True),
        (Setpoint(seq=1, gripper_m=-1e-6), False),
        (Setpoint(seq=1, gripper_m=gardener.GRIPPER_OPEN_M + 1e-6), False),
        (Setpoint(seq=1, roll_rad=gardener.ROLL_SERVO.min_rad), True),
        (Setpoint(seq=1, roll_rad=gardener.ROLL_SERVO.max_rad), True),
        (Setpoint(seq=1, roll_rad=gardener.ROLL_SERVO.min_rad - 1e-6), False),
        (Setpoint(seq=1, roll_rad=gardener.ROLL_SERVO.max_rad + 1e-6), False),
    ],
)
def test_fingers_and_wrist_keep_to_their_ranges(setpoint: Setpoint, allowed: bool) -> None:
    assert passes(setpoint, GOOD) == allowed
    if allowed:
        command = check(setpoint, GOOD, NOW_S).command
        assert (command.gripper_m, command.roll_rad) == (setpoint.gripper_m, setpoint.roll_rad)
    else:
        assert ("roll" if setpoint.gripper_m is None else "gripper") in refused(setpoint, GOOD)


def test_of_several_reasons_against_an_arm_move_the_first_is_said() -> None:
    assert refused(Setpoint(seq=1, arm=(9.0, 0.5, -1.0, 0.0), arm_s=1e6), DOCKED).startswith("pan at")
    lost = replace(DOCKED, arm_rad=None)
    assert refused(Setpoint(seq=1, arm=(9.0, 0.5, -1.0, 0.0)), lost).startswith("pan at")


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_roll_that_is_no_number_moves_nothing(value: float) -> None:
    assert "not finite" in refused(Setpoint(seq=1, base="drive", v_mps=0.1, roll_rad=value), GOOD)


@pytest.mark.parametrize(
    ("change", "allowed"),
    [
        ({"tank_ml": 5.0}, False),
        ({"tank_ml": 5.01}, True),
        ({"tank_ml": None}, True),
        ({"omega_radps": 0.1}, False),
        ({"v_mps": -0.1}, False),
        ({"dose": Dose(debited_ml=50.0, delivered_ml=49.95)}, False),
        ({"dose": Dose(debited_ml=50.0, delivered_ml=49.94)}, True),
        ({"dose": Dose(debited_ml=1.0, delivered_ml=0.0)}, True),
        ({"dose": Dose(debited_ml=1.0, delivered_ml=1.0)}, False),
        ({"dose": Dose(debited_ml=50.0, refusal="the cap is reached")}, True),
    ],
)
def test_the_pump_runs_until_its_dose_is_out_and_only_standing(change: dict[str, object], allowed: bool) -> None:
    verdict = check(PUMP, replace(IN_HAND, **change), NOW_S)  # type: ignore[arg-type]
    assert (verdict.command.pump, bool(verdict.refusals), verdict.debit_ml) == (allowed, not allowed, 0.0)


def test_whoever_wants_to_drive_does_not_pump_even_before_it_moves() -> None:
    verdict = check(structs.replace(PUMP, base="drive", v_mps=0.0), IN_HAND, NOW_S)
    assert (verdict.command.pump, verdict.refusal) == (False, "the pump runs only while the base stands")


def test_a_dose_of_a_single_millilitre_is_a_dose() -> None:
    assert check(structs.replace(PUMP, dose_ml=1.0), DOCKED, NOW_S).debit_ml == 1.0


# Who may touch a device

MOVING = {"drive", "seek_dock", "move", "output", "halt"}


def calls(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    return {n.func.attr for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)}


def imported(path: Path) -> set[str]:
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = {alias.name for n in nodes if isinstance(n, ast.Import) for alias in n.names}
    return names | {n.module or "" for n in nodes if isinstance(n, ast.ImportFrom)}


def names_of(path: Path, package: str) -> set[str]:
    """What it imports of a package, `MODULE.NAME`; the module alone where it is imported whole."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    whole = {alias.name for n in nodes if isinstance(n, ast.Import) for alias in n.names}
    parts = {f"{n.module}.{alias.name}" for n in nodes if isinstance(n, ast.ImportFrom) for alias in n.names}
    return {name for name in whole | parts if name.split(".")[0] == package}


def sources(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


BODY = ROOT / "robot_service" / "body"
OF_HW = {
    "__main__.py": {"hw.links.open_link"},
    "bodylink.py": {"hw.links.ByteLink", "hw.links.Opener"},
    "brain.py": {"hw.drivers.camera.open_camera", "hw.links.Opener"},
}
"""All that a brain has of devices: the stream to its body, and the camera, which moves nothing."""
WIRES = {"socket", "serial", "serial_asyncio_fast", "pty", "os.open", "importlib"}
WIRE_CALLS = {"open_connection", "open_unix_connection", "create_connection", "create_unix_connection", "open_link"}


@pytest.mark.parametrize("path", sources("robot_service"), ids=lambda p: str(p.relative_to(ROOT)))
def test_only_the_actuators_tell_a_device_to_move(path: Path) -> None:
    if path == BODY / "body.py":
        assert calls(path) & MOVING <= {"halt"}
    elif path.is_relative_to(BODY) and path.name != "actuators.py":
        assert not calls(path) & MOVING
        assert not any(name.startswith("hw.drivers") for name in imported(path))


@pytest.mark.parametrize(
    "path", [p for p in sources("robot_service") if not p.is_relative_to(BODY)], ids=lambda p: str(p.relative_to(ROOT))
)
def test_a_brain_has_no_drivers_protocols_or_links_but_the_stream_to_its_body_and_the_camera(path: Path) -> None:
    mine = OF_HW.get(path.name, set()) if path.parent == BODY.parent else set()
    assert names_of(path, "hw") <= mine
    assert not any(name == wire or name.startswith(f"{wire}.") for name in imported(path) for wire in WIRES)
    assert not calls(path) & WIRE_CALLS
    assert not any(f"{name}.".startswith("robot_service.body.") for name in imported(path))


def test_the_brain_opens_one_link_and_that_is_its_bodys() -> None:
    brains = [p for p in sources("robot_service") if not p.is_relative_to(BODY)]
    opened = {p.name for p in brains if "_opener" in calls(p) or "opener" in called_names(p)}
    assert opened == {"bodylink.py"}
    assert "self._opener(self._url)" in (BODY.parent / "bodylink.py").read_text()


def called_names(path: Path) -> set[str]:
    """Of plain functions."""
    tree = ast.parse(path.read_text())
    return {n.func.id for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}


def test_the_taps_valve_is_opened_at_one_place_after_its_debit() -> None:
    """`Station.tap`: what may flow is written down before."""
    opening = [
        (path.relative_to(ROOT).as_posix(), function.name)
        for folder in ("plant_service", "robot_service", "core", "console")
        for path in sources(folder)
        for function in ast.walk(ast.parse(path.read_text()))
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        and any(isinstance(n, ast.Attribute) and n.attr == "open_for" for n in ast.walk(function))
    ]
    assert opening == [("plant_service/station.py", "tap")]
    text = (ROOT / "plant_service" / "station.py").read_text()
    assert text.count("open_for") == 1
    assert text.index("meter.debit(") < text.index("open_for(")
    makers = {p.name for p in sources("plant_service") if any(n.endswith("open_valve") for n in names_of(p, "hw"))}
    assert makers == {"node.py"}
    assert not [p for p in sources("plant_service") if any(n.startswith("hw.drivers.firmata") for n in imported(p))]


def test_the_gate_is_small_and_pure() -> None:
    path = ROOT / "robot_service" / "body" / "gate.py"
    assert len(path.read_text().splitlines()) <= 400
    assert imported(path) <= {"__future__", "math", "dataclasses", "typing"} | {
        "core.manipulation.arm",
        "core.robots",
        "core.robots.fence",
        "core.wire.body",
    }
