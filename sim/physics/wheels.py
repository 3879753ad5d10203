"""Driven wheels: setpoints to motors, encoders back, and the creep of soft tyres on astroturf.

A tyre under load slips in proportion to the force it passes on (the linear part of a creep curve: Pacejka, Tire and
Vehicle Dynamics, chapter 1): slip speed = rolling speed * force / stiffness. MuJoCo's friction rows creep by R * force / b,
where R is their regularisation and b their damping, so `b` follows the rolling speed and the law holds at any speed. The
casters' drag then makes every turn come out short, while the encoders count the whole of it, as paper 000 reports (8.2).
"""

from __future__ import annotations

import math
from typing import Any

import mujoco

from core.robots import gardener as g
from core.scenario import Robot

TYRE_STIFFNESS_N = 150.0
"""Force per unit of slip ratio, one tyre. Chosen so that an 85 cm square by odometry ends 5-15 % of its length off."""
REAR_STIFFNESS_N = 14.0
"""Side force of the rear caster per radian of slip angle: it trails and swings round, late."""
ROLLING_MPS_MIN = 0.02
DAMPING_MAX = 350.0
"""Stiffest contact that a 4 ms step integrates calmly [1/s]."""
ACCELERATION_MPS2 = 1.2
"""The base ramps its wheels; it does not jerk."""
DECELERATION_MPS2 = 3.0


class _Creep:
    """The floor contact of one rolling part: sets its friction damping from its speed."""

    def __init__(self, model: Any, pair: str, stiffness_n: float) -> None:
        self._row = model.pair_solreffriction[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_PAIR, pair)]
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_PAIR, pair)
        impedance = float(model.pair_solimp[index][1])
        body = int(model.geom_bodyid[model.pair_geom1[index]])
        other = int(model.geom_bodyid[model.pair_geom2[index]])
        weight = float(model.body_invweight0[body][0] + model.body_invweight0[other][0])
        regularisation = (1.0 - impedance) / impedance * weight / float(model.opt.impratio)
        self._impedance = impedance
        self._per_speed = regularisation * stiffness_n
        self._damping = 0.0
        self.roll(0.0, 1.0)

    def roll(self, speed_mps: float, slip_factor: float) -> None:
        speed_mps = abs(speed_mps)
        if speed_mps < ROLLING_MPS_MIN:
            speed_mps = ROLLING_MPS_MIN
        damping = min(DAMPING_MAX, self._per_speed / speed_mps) / slip_factor
        if damping != self._damping:
            self._damping = damping
            self._row[0] = -1.0
            self._row[1] = -damping * self._impedance


class Drive:
    """One robot's two wheels and rear caster."""

    def __init__(self, model: Any, data: Any, robot: Robot) -> None:
        self._ctrl, self._qpos, self._qvel = data.ctrl, data.qpos, data.qvel
        self._radius_m = g.WHEEL_DIAMETER_M[robot.create] / 2
        self._half_track_m = g.WHEELBASE_M[robot.create] / 2
        sides = ("left", "right")
        self._motors = [int(model.actuator(f"{robot.id}/{s}-motor").id) for s in sides]
        self._angles = [int(model.joint(f"{robot.id}/{s}-wheel").qposadr[0]) for s in sides]
        self._rates = [int(model.joint(f"{robot.id}/{s}-wheel").dofadr[0]) for s in sides]
        self._springs = [int(model.joint(f"{robot.id}/{s}-spring").qposadr[0]) for s in sides]
        self._tyres = [_Creep(model, f"{robot.id}/{s}-tread", TYRE_STIFFNESS_N) for s in sides]
        self._rear = _Creep(model, f"{robot.id}/rear-caster", REAR_STIFFNESS_N)
        self._start = [0.0, 0.0]
        self.wanted_mps = [0.0, 0.0]
        self.ramped_mps = [0.0, 0.0]
        self.slip_factor = 1.0

    @property
    def idle(self) -> bool:
        return not any(self.wanted_mps) and not any(self.ramped_mps)

    def want(self, left_mps: float, right_mps: float) -> None:
        """Rim speed setpoints; nonsense is taken as a stop, too much is cut to the motor's limit."""
        self.wanted_mps = [
            min(g.V_MPS_MAX, max(-g.V_MPS_MAX, v)) if math.isfinite(v) else 0.0 for v in (left_mps, right_mps)
        ]

    def apply(self, dt_s: float, powered: bool) -> None:
        """Before a control tick: ramp the setpoints, tell the motors, let the tyres know how fast they roll."""
        for side in (0, 1):
            wanted = self.wanted_mps[side] if powered else 0.0
            ramped = _ramp(self.ramped_mps[side], wanted, dt_s)
            self.ramped_mps[side] = ramped
            self._ctrl[self._motors[side]] = ramped / self._radius_m
        left, right = (self._qvel.item(rate) * self._radius_m for rate in self._rates)
        self._tyres[0].roll(left, self.slip_factor)
        self._tyres[1].roll(right, self.slip_factor)
        omega = (right - left) / (2 * self._half_track_m)
        self._rear.roll(math.hypot((left + right) / 2, 0.15 * omega), 1.0)

    def travel_m(self) -> tuple[float, float]:
        """Cumulative rim travel (left, right) as encoders and a nominal wheel see it."""
        left, right = self._angles
        return self._qpos.item(left) * self._radius_m, self._qpos.item(right) * self._radius_m

    def drop_m(self) -> tuple[float, float]:
        """How far each wheel hangs below its place (left, right)."""
        left, right = self._springs
        return self._qpos.item(left), self._qpos.item(right)


def _ramp(now: float, wanted: float, dt_s: float) -> float:
    slowing = abs(wanted) < abs(now) or wanted * now < 0.0
    step = (DECELERATION_MPS2 if slowing else ACCELERATION_MPS2) * dt_s
    return wanted if abs(wanted - now) <= step else now + math.copysign(step, wanted - now)
