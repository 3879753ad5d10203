"""From device readings to what the gate judges by and what the brain is told."""

from __future__ import annotations

import math
from dataclasses import dataclass

from core.manipulation.arm import Joints
from core.robots import gardener
from core.robots.fence import Fence
from core.wire.body import BodyState, Marker
from hw.ports import Base, BaseReading, LinkStatus, Localizer, MarkerFix, ServoBoard, ServoReading
from robot_service.body.actuators import arm_angles, gripper_opening_m
from robot_service.body.gate import Dose, GateState
from robot_service.body.whereabouts import Whereabouts

_NO_BASE = BaseReading(stamp_s=-1e9, left_m=0.0, right_m=0.0)
_NO_SERVOS = ServoReading(stamp_s=-1e9)
ANALOG_FRESH_S = 3.0
TRAVEL_FRESH_S = 0.1
"""A state carries the stamp of its travel while that is so young, and the time of sending otherwise."""


@dataclass(slots=True)
class Sight:
    """Counts marker fixes, so that the brain can tell a new one from the last."""

    count: int = 0
    seen: MarkerFix | None = None
    last: MarkerFix | None = None

    def look(self, fix: MarkerFix | None) -> None:
        if fix is None or fix is self.seen:
            return
        self.seen = fix
        if fix.marker_id is not None:
            self.last = fix
            self.count += 1

    def marker(self, stamp_s: float) -> Marker | None:
        """The last fix, its age counted from `stamp_s`."""
        fix = self.last
        if fix is None or fix.marker_id is None:
            return None
        return Marker(
            marker_id=fix.marker_id,
            x_m=fix.x_m,
            y_m=fix.y_m,
            yaw_rad=fix.yaw_rad,
            age_s=round(max(0.0, stamp_s - fix.stamp_s), 4),
            count=self.count,
        )


class Senses:
    """The three devices, read."""

    def __init__(
        self, base: Base, servos: ServoBoard, localizer: Localizer, fence: Fence | None = None, wheelbase_m: float = 0.235
    ) -> None:
        self._base, self._servos, self._localizer = base, servos, localizer
        self._sight = Sight()
        self._fence = fence
        self._whereabouts = None if fence is None else Whereabouts(fence.markers, wheelbase_m)
        self._epoch = 0
        self._base_since_s: float | None = None
        self._lifted = False
        self._arm_of: ServoReading | None = None
        self._arm: Joints | None = None
        self._told_of: Joints | None = None
        self._told: tuple[float, ...] | None = None
        self._stamp_s = 0.0
        self.lull_s = 0.0
        """How much older readings may be, while the devices are asked seldom."""
        self.base, self.servos = _NO_BASE, _NO_SERVOS

    def look(self) -> None:
        """Take the newest readings."""
        self.base = self._base.reading or _NO_BASE
        self.servos = self._servos.reading or _NO_SERVOS
        self._sight.look(self._localizer.fix)
        link = self._base.link
        if link.up and link.since_s != self._base_since_s:
            self._base_since_s = link.since_s
            self._epoch += 1
            self._lifted = True
        if self._whereabouts is not None and self._base.reading is not None:
            if self._lifted or self._wheel_drop():
                self._whereabouts.forget()
            self._lifted = False
            self._whereabouts.look(self.base, self._localizer.fix)

    def _wheel_drop(self) -> bool:
        return self.base.drop_left or self.base.drop_right or self.base.drop_caster

    @property
    def arm_rad(self) -> Joints | None:
        if self.servos is not self._arm_of:
            self._arm_of, self._arm = self.servos, arm_angles(self.servos.pulses_us)
        return self._arm

    def _arm_told(self) -> tuple[float, ...] | None:
        """The arm to a tenth of a milliradian."""
        if (arm := self.arm_rad) is not self._told_of:
            self._told_of, self._told = arm, None if arm is None else tuple(round(q, 4) for q in arm)
        return self._told

    def tank_ml(self, now_s: float) -> float | None:
        volts = self._analog_v(gardener.TANK_INPUT, now_s)
        return None if volts is None else max(0.0, volts / gardener.TANK_SENSOR_V_FULL * gardener.TANK_ML)

    def force_n(self, now_s: float) -> float | None:
        volts = self._analog_v(gardener.FORCE_INPUT, now_s)
        return None if volts is None else volts / gardener.FORCE_SENSOR_V_MAX * gardener.FORCE_SENSOR_N_MAX

    def _analog_v(self, index: int, now_s: float) -> float | None:
        """A silent sensor reads nothing, not its last word."""
        fresh = self._servos.link.up and now_s - self.servos.stamp_s <= ANALOG_FRESH_S + self.lull_s
        return self.servos.analog_v[index] if fresh and index < len(self.servos.analog_v) else None

    def down(self) -> tuple[str, ...]:
        links = (("base", self._base.link), ("servos", self._servos.link), ("markers", self._localizer.link))
        if links[0][1].up and links[1][1].up and links[2][1].up:
            return ()
        return tuple(_told(name, link) for name, link in links if not link.up)

    def gate_state(
        self,
        now_s: float,
        *,
        heard_s: float,
        stopped: bool,
        stopped_by: str,
        arm_moving: bool,
        dose: Dose,
        v_mps: float,
        omega_radps: float,
        dt_s: float,
    ) -> GateState:
        b, where = self.base, self._whereabouts
        return GateState(
            heard_s=heard_s,
            stopped=stopped,
            stopped_by=stopped_by,
            base_up=self._base.link.up,
            base_s=b.stamp_s,
            servo_up=self._servos.link.up,
            servo_s=self.servos.stamp_s,
            wheel_drop=self._wheel_drop(),
            cliff=b.cliff_left or b.cliff_front_left or b.cliff_front_right or b.cliff_right,
            bump=b.bump_left or b.bump_right,
            docked=b.mated,
            arm_rad=self.arm_rad,
            arm_moving=arm_moving or self.servos.moving,
            gripper_m=gripper_opening_m(self.servos.pulses_us),
            force_n=self.force_n(now_s),
            force_s=self.servos.stamp_s,
            tank_ml=self.tank_ml(now_s),
            dose=dose,
            fence=self._fence,
            place=None if where is None else where.place,
            place_s=-math.inf if where is None else where.seen_s,
            v_mps=v_mps,
            omega_radps=omega_radps,
            dt_s=dt_s,
        )

    def body_state(
        self,
        now_s: float,
        *,
        arm_moving: bool,
        pump: bool,
        pumped_ml: float,
        permit_id: str,
        stopped: bool,
        stopped_by: str,
        stop_kept: bool,
        stop_number: int,
        refusal: str,
        next_in_s: float,
    ) -> BodyState:
        b, arm = self.base, self._arm_told()
        last = self._sight.last
        tank_ml, force_n = self.tank_ml(now_s), self.force_n(now_s)
        stamp_s = self._stamp_s = max(self._stamp_s, b.stamp_s if now_s - b.stamp_s < TRAVEL_FRESH_S else now_s)
        return BodyState(
            stamp_s=stamp_s,
            left_m=round(b.left_m, 6),
            right_m=round(b.right_m, 6),
            odometry_epoch=self._epoch,
            bump_left=b.bump_left,
            bump_right=b.bump_right,
            wheel_drop=b.drop_left or b.drop_right or b.drop_caster,
            cliff=(b.cliff_left, b.cliff_front_left, b.cliff_front_right, b.cliff_right),
            wall=b.wall,
            ir_red=b.ir_red,
            ir_green=b.ir_green,
            ir_field=b.ir_field,
            contacts=b.home_base,
            docked=b.mated,
            oi_mode=b.oi_mode,
            battery_ratio=round(b.battery_ratio, 4),
            battery_v=b.voltage_v,
            battery_a=b.current_a,
            tank_ml=None if tank_ml is None else round(tank_ml, 1),
            force_n=None if force_n is None else round(force_n, 2),
            arm_rad=arm,
            arm_moving=arm_moving or self.servos.moving,
            pump=pump,
            pumped_ml=round(pumped_ml, 3),
            permit_id=permit_id,
            marker=self._sight.marker(stamp_s),
            marker_blind_s=round(now_s - last.stamp_s, 3) if last is not None else round(now_s, 3),
            stopped=stopped,
            stopped_by=stopped_by,
            stop_kept=stop_kept,
            stop_number=stop_number,
            refusal=refusal,
            down=self.down(),
            next_in_s=next_in_s,
        )


def _told(name: str, link: LinkStatus) -> str:
    return f"{name}: {link.why}"
