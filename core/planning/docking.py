"""Driving onto a dock: our own controller on its infrared beams, and the watchdog that any docking runs under.

Dock frame: origin and heading of a docked base, so x points at the dock, y to the approaching robot's left.
The dock sends a red and a green beam that overlap on the centre line; which ones the receiver sees bounds the bearing at
which it stands. Those bounds correct what odometry, or the pose estimate, says of the robot's place.
Source: paper 000, sections 3 and 8.2; the controller is ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

from core.estimation.odometry import advance
from core.geometry.planar import Pose, between, wrap
from core.robots import gardener

BEAM_RAD = math.radians(25.0)
OVERLAP_RAD = math.radians(6.0)
EMITTER_X_M = gardener.BODY_RADIUS_M
"""The beams leave the dock's face, which a docked body touches."""
BEAM_SIGMA_RAD = math.radians(1.0)
BEAM_NEAREST_M = 0.08
"""Nearer than this to the emitter a bearing means nothing."""
FAR_MPS, NEAR_MPS, CREEP_MPS, BACK_MPS = 0.18, 0.08, 0.04, -0.12
OMEGA_RADPS_MAX = 0.9
LOOKAHEAD_M = 0.16
SETTLE_S = 1.2
"""Charge current shows this long after the contacts touch, at worst."""
OVERRUN_M, OVERRUN_M_MAX = 0.05, 0.09
"""So far beyond the dock by its own reckoning it believes, at its first and at later tries, that it misjudged the way."""
RETREAT_M = 0.40
TRIES = 5
TIME_S = 60.0


class DockSense(Protocol):
    """What the controller reads; `core.wire.body.BodyState` has it all."""

    @property
    def left_m(self) -> float: ...
    @property
    def right_m(self) -> float: ...
    @property
    def bump_left(self) -> bool: ...
    @property
    def bump_right(self) -> bool: ...
    @property
    def ir_red(self) -> bool: ...
    @property
    def ir_green(self) -> bool: ...
    @property
    def contacts(self) -> bool: ...
    @property
    def docked(self) -> bool: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchdogRectangle:
    """1 m across and 1.5 m deep before a dock. While docking the robot stays inside, or goes back to the launch point."""

    dock: Pose
    length_m: float = gardener.WATCHDOG_LENGTH_M
    width_m: float = gardener.WATCHDOG_WIDTH_M
    beyond_m: float = 0.10

    def inside(self, pose: Pose) -> bool:
        """True while the base (world frame) is in the rectangle."""
        x, y, _ = between(self.dock, pose)
        return self.beyond_m - self.length_m <= x <= self.beyond_m and abs(y) <= self.width_m / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class DockCommand:
    v_mps: float = 0.0
    omega_radps: float = 0.0
    status: Literal["running", "docked", "outside", "failed"] = "running"
    why: str = ""


class BeamDocking:
    """One docking manoeuvre. Call `step` 20 to 50 times a second until its status is not `running`."""

    def __init__(self, dock: Pose, wheelbase_m: float, *, red_left: bool = True) -> None:
        """`dock` is the docked base pose in the world; `red_left`: the red beam lies to the approaching robot's left."""
        self._dock, self._wheelbase_m, self._red_left = dock, wheelbase_m, red_left
        self._rectangle = WatchdogRectangle(dock=(0.0, 0.0, 0.0))
        self._base: Pose = (-gardener.LAUNCH_M, 0.0, 0.0)
        self._dy_m, self._dyaw_rad = 0.0, 0.0
        self._var_y, self._var_yaw, self._cov = 0.08**2, 0.10**2, 0.0
        self._travel: tuple[float, float] | None = None
        self._phase: Literal["turn", "run", "settle", "back"] = "turn"
        self._since_s = 0.0
        self._begun_s: float | None = None
        self.tries = 1

    @property
    def pose_in_dock(self) -> Pose:
        """Where it thinks the base is, in the dock frame."""
        x, y, yaw = self._base
        return x, y + self._dy_m, wrap(yaw + self._dyaw_rad)

    @property
    def _overrun_m(self) -> float:
        return OVERRUN_M if self.tries == 1 else OVERRUN_M_MAX

    def step(self, sense: DockSense, pose_estimate: Pose | None, now_s: float) -> DockCommand:
        """One setpoint. `pose_estimate` is the base in the world, or None when only odometry and beams are to be had."""
        if self._begun_s is None:
            self._begun_s = self._since_s = now_s
        self._estimate(sense, pose_estimate)
        if sense.docked:
            return DockCommand(status="docked")
        if not self._rectangle.inside(self.pose_in_dock):
            return DockCommand(status="outside", why="left the rectangle before the dock")
        if self.tries > TRIES or now_s - self._begun_s > TIME_S:
            return DockCommand(status="failed", why=f"no charge current after {min(self.tries, TRIES)} tries")
        v, omega = self._phased(sense, now_s)
        return DockCommand(v_mps=v, omega_radps=omega)

    def _phased(self, sense: DockSense, now_s: float) -> tuple[float, float]:
        x, y, yaw = self.pose_in_dock
        if self._phase == "settle":
            if now_s - self._since_s > SETTLE_S:
                self._enter("back", now_s)
                self.tries += 1
            return 0.0, 0.0
        if self._phase == "back":
            if x <= -RETREAT_M or now_s - self._since_s > 6.0:
                self._enter("turn", now_s)
            return BACK_MPS, 0.0
        if sense.contacts or sense.bump_left or sense.bump_right or x > self._overrun_m:
            # A Create lets no charge current in while its wheels are told to turn: stand still and see.
            near = sense.contacts or x > -0.10
            self._enter("settle" if near else "back", now_s)
            self.tries += 0 if near else 1
            return 0.0, 0.0
        alpha = wrap(math.atan2(-y, LOOKAHEAD_M) - yaw)
        if self._phase == "turn":
            if abs(alpha) < 0.06:
                self._enter("run", now_s)
            return 0.0, math.copysign(min(OMEGA_RADPS_MAX, max(0.12, 2.0 * abs(alpha))), alpha)
        if abs(y) > 0.03 + 0.5 * max(0.0, -x - 0.05):
            self._enter("back", now_s)
            self.tries += 1
            return 0.0, 0.0
        return self._run(x, y, alpha)

    def _run(self, x: float, y: float, alpha: float) -> tuple[float, float]:
        """Pursue a point on the centre line, slower as the dock comes near."""
        v = FAR_MPS if x < -0.30 else NEAR_MPS if x < -0.08 else CREEP_MPS
        omega = 2 * v * math.sin(alpha) / math.hypot(LOOKAHEAD_M, y)
        return v, max(-OMEGA_RADPS_MAX, min(OMEGA_RADPS_MAX, omega))

    def _enter(self, phase: Literal["turn", "run", "settle", "back"], now_s: float) -> None:
        self._phase, self._since_s = phase, now_s

    def _estimate(self, sense: DockSense, pose_estimate: Pose | None) -> None:
        before = self._travel or (sense.left_m, sense.right_m)
        self._travel = (sense.left_m, sense.right_m)
        d_left, d_right = sense.left_m - before[0], sense.right_m - before[1]
        self._base = advance(self._base, d_left, d_right, self._wheelbase_m)
        run_m, spun_rad = abs(d_left + d_right) / 2, abs(d_right - d_left) / self._wheelbase_m
        if pose_estimate is not None:
            self._base = between(self._dock, pose_estimate)
            self._var_y, self._var_yaw = min(self._var_y, 0.02**2), min(self._var_yaw, 0.02**2)
            self._cov = max(-0.5 * 0.02**2, min(0.5 * 0.02**2, self._cov))
            run_m, spun_rad = 0.3 * run_m, 0.0
        self._spread(d_left + d_right, run_m, spun_rad)
        if (bounds := self._bearing_bounds(sense.ir_red, sense.ir_green)) is not None:
            self._heed(*bounds)

    def _spread(self, twice_run_m: float, run_m: float, spun_rad: float) -> None:
        """A heading error turns into a lateral one as the robot runs; both grow with travel."""
        ds = twice_run_m / 2
        self._dy_m += ds * math.sin(self._dyaw_rad)
        self._var_y += 2 * ds * self._cov + ds * ds * self._var_yaw + 0.01**2 * run_m
        self._cov += ds * self._var_yaw
        self._var_yaw += 0.05**2 * run_m + 0.05**2 * spun_rad

    def _bearing_bounds(self, red: bool, green: bool) -> tuple[float, float] | None:
        """Between which bearings from the dock the receiver must stand [rad, + to the robot's left]; None: anywhere."""
        inner, outer = OVERLAP_RAD / 2, BEAM_RAD - OVERLAP_RAD / 2
        if red and green:
            return -inner, inner
        if red or green:
            return (inner, outer) if red == self._red_left else (-outer, -inner)
        return None

    def _heed(self, low_rad: float, high_rad: float) -> None:
        """When the estimate stands outside the bounds, pull it to the nearer one (a Kalman update of y and yaw)."""
        x, y, yaw = self.pose_in_dock
        ahead_m = EMITTER_X_M - x - gardener.IR_RECEIVER_X_M * math.cos(yaw)
        if ahead_m < BEAM_NEAREST_M:
            return
        bearing = math.atan2(y + gardener.IR_RECEIVER_X_M * math.sin(yaw), ahead_m)
        nu = low_rad - bearing if bearing < low_rad else high_rad - bearing if bearing > high_rad else 0.0
        if nu == 0.0:
            return
        hy, hyaw = 1.0 / ahead_m, gardener.IR_RECEIVER_X_M / ahead_m
        py, pyaw = self._var_y * hy + self._cov * hyaw, self._cov * hy + self._var_yaw * hyaw
        S = hy * py + hyaw * pyaw + BEAM_SIGMA_RAD**2
        self._dy_m += py / S * nu
        self._dyaw_rad += pyaw / S * nu
        self._var_y -= py * py / S
        self._cov -= py * pyaw / S
        self._var_yaw -= pyaw * pyaw / S
