"""Hobby servos: each turns towards its pulse as fast as it can and then holds."""

from __future__ import annotations

import math
from typing import Any

from core.robots import gardener as g

SETTLED_RAD = 1e-6


class Arm:
    """One robot's arm and gripper. Until the first pulse every servo keeps the folded pose it was left in."""

    def __init__(self, model: Any, data: Any, robot_id: str, rolls: bool = False) -> None:
        self._data = data
        self._sensordata = data.sensordata
        self._servos = g.SERVOS | {"roll": g.ROLL_SERVO} if rolls else g.SERVOS
        self._motors = {name: int(model.actuator(f"{robot_id}/{name}").id) for name in self._servos}
        self._angles = {name: int(model.joint(f"{robot_id}/{name}").qposadr[0]) for name in g.ARM_JOINTS}
        fingers = [int(model.joint(f"{robot_id}/finger-{side}").qposadr[0]) for side in ("left", "right")]
        self._touch = [int(model.sensor(f"{robot_id}/touch-{side}").adr[0]) for side in ("left", "right")]
        self._by_channel = {servo.channel: name for name, servo in self._servos.items()}
        self._nozzle = int(model.site(f"{robot_id}/nozzle").id)
        self.target_rad = dict(zip(g.ARM_JOINTS, g.ARM_HOME_RAD, strict=True)) | {"gripper": 0.0}
        if rolls:
            self.target_rad["roll"] = 0.0
        self.now_rad = dict(self.target_rad)
        for name, angle in zip(g.ARM_JOINTS, g.ARM_HOME_RAD, strict=True):
            data.qpos[self._angles[name]] = angle
        for finger in fingers:
            data.qpos[finger] = 0.0
        self._command()

    @property
    def idle(self) -> bool:
        if self.target_rad == self.now_rad:
            return True
        return all(abs(self.target_rad[n] - now) < SETTLED_RAD for n, now in self.now_rad.items())

    def pulse(self, channel: int, pulse_us: float) -> None:
        name = self._by_channel.get(channel)
        if name is not None and math.isfinite(pulse_us) and pulse_us > 0.0:
            servo = self._servos[name]
            self.target_rad[name] = min(servo.max_rad, max(servo.min_rad, servo.angle_rad(pulse_us)))

    def apply(self, dt_s: float, powered: bool) -> None:
        if not powered or self.idle:
            return
        for name, servo in self._servos.items():
            step = servo.speed_radps_max * dt_s
            left = self.target_rad[name] - self.now_rad[name]
            self.now_rad[name] += min(step, max(-step, left))
        self._command()

    def freeze(self) -> None:
        """Power is gone: the gears hold where they are."""
        self.target_rad = dict(self.now_rad)

    def _command(self) -> None:
        for name, motor in self._motors.items():
            angle = self.now_rad[name]
            self._data.ctrl[motor] = g.gripper_opening_m(angle) / 2 if name == "gripper" else angle

    def angles_rad(self) -> tuple[float, ...]:
        """Pan, shoulder, elbow, wrist as they are."""
        return tuple(float(self._data.qpos[self._angles[name]]) for name in g.ARM_JOINTS)

    def nozzle(self) -> tuple[float, float, float]:
        """Nozzle in the world [m]."""
        at = self._data.site_xpos[self._nozzle]
        return float(at[0]), float(at[1]), float(at[2])

    def grip_n(self) -> float:
        """Mean squeeze on the finger pads [N]."""
        left, right = self._touch
        return float((self._sensordata[left] + self._sensordata[right]) / 2)
