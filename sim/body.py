"""One simulated robot: what its devices move and feel. Fills `CreateBody`, `ServoRig` and `MarkerCamera`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from core.robots import gardener as g
from core.robots.markers import ceiling_markers
from core.scenario import Robot, Scenario
from core.wire.geometry import Pose2
from sim.devices.plants import CreateSense, MarkerSight
from sim.physics import beams, edges, markers
from sim.physics.arm import Arm
from sim.physics.pack import Pack
from sim.physics.pose import Planar, yaw_of
from sim.physics.touch import Press
from sim.physics.water import PumpFault, Tank
from sim.physics.wheels import Drive
from sim.scene.hang import GRIP_FRICTION
from sim.scene.traits import Traits, generator

TANK_NOISE_V = 0.004
FORCE_NOISE_V = 0.006
FALLEN_M = 0.08


@dataclass(slots=True, kw_only=True)
class RobotFaults:
    """Set these as you like; they act at once."""

    wheel_slip: float = 1.0
    """Factor on the tyres' creep: 3 makes turns come out very short."""
    pump: PumpFault = PumpFault.OK
    marker_blind: bool = False
    dead_battery: bool = False
    camera: frozenset[str] = frozenset()
    """The faults of `sim.faults` that befall the camera in the hand."""
    overexposure: float = 1.0
    force_stuck: bool = False
    """The gripper's force sensor repeats its last reading."""
    pad_friction: float | None = None
    """Of wet or dusty finger pads; None: as they should be."""


class RobotBody:
    """A gardener in the world. `World` steps it."""

    def __init__(self, scenario: Scenario, robot: Robot, seed: int, model: Any, data: Any, traits: Traits) -> None:
        self.id = robot.id
        self.faults = RobotFaults()
        self.drive = Drive(model, data, robot)
        self.arm = Arm(model, data, robot.id, rolls=robot.wrist == "roll")
        self.pack = Pack.at(robot.battery_ratio)
        self.tank = Tank(level_ml=robot.tank_ml, flow=traits.pump)
        self.pumped_ml = 0.0
        self.may_charge: Callable[[], bool] = lambda: True
        """Asked at every step: does the base's firmware let charge flow?"""
        self.docked_at: str | None = None
        self.press = Press()
        self.discs: list[beams.Disc] = []
        """Pots and other robots, for rays."""
        self.docks: list[beams.Dock] = []
        self._scenario = scenario
        self._markers: dict[int, Pose2] = ceiling_markers(scenario.arena)
        self._model, self._data = model, data
        self._pads = [int(model.geom(f"{robot.id}/pad-{side}").id) for side in ("left", "right")]
        self._pad_friction: float | None = None
        self.stuck_v: float | None = None
        joint = model.joint(f"{robot.id}/free")
        self.qpos, self.dof = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._free = data.qpos[self.qpos : self.qpos + 7]
        self.marker_rng = generator(seed, f"markers/{robot.id}")
        self.analog_rng = generator(seed, f"analog/{robot.id}")
        self.pose = self._pose()

    # Stepping, by the world

    def before(self, dt_s: float) -> None:
        """Setpoints go to the motors."""
        self.tank.fault = self.faults.pump
        self.drive.slip_factor = self.faults.wheel_slip
        self.drive.apply(dt_s, self.powered)
        self.arm.apply(dt_s, self.powered)
        if self.faults.pad_friction != self._pad_friction:
            self._pad_friction = self.faults.pad_friction
            self._model.geom_friction[self._pads, 0] = GRIP_FRICTION[0] if self._pad_friction is None else self._pad_friction

    def after(self, docks: list[beams.Dock]) -> None:
        """Where are we, and does a dock hold us?"""
        self.pose = self._pose()
        held = self.docked_at
        self.docked_at = next((dock.name for dock in docks if dock.mated(self.pose, dock.name == held)), None)

    def live(self, seconds: float) -> None:
        """The battery's side of time."""
        self.pack.advance(seconds, self.load_w(), self.docked_at is not None and self.may_charge())

    def load_w(self) -> float:
        if self.faults.dead_battery:
            return 0.0
        load_w = g.IDLE_W
        load_w += 0.0 if self.drive.idle else g.DRIVE_W
        load_w += 0.0 if self.arm.idle else g.ARM_W
        return load_w + (g.PUMP_W if self.pumping else 0.0)

    @property
    def powered(self) -> bool:
        return not (self.faults.dead_battery or self.pack.empty)

    @property
    def pumping(self) -> bool:
        return self.tank.running(self.powered)

    @property
    def idle(self) -> bool:
        return (self.drive.idle and self.arm.idle and not self.pumping) or not self.powered

    @property
    def fallen(self) -> bool:
        return abs(self.pose.z_m) > FALLEN_M or self._upright() < 0.8

    def _upright(self) -> float:
        _, x, y, _ = self._data.qpos[self.qpos + 3 : self.qpos + 7]
        return float(1.0 - 2.0 * (x * x + y * y))

    def _pose(self) -> Planar:
        x, y, z, *q = self._free.tolist()
        return Planar(x, y, yaw_of(*q), z)

    # CreateBody

    def sense(self) -> CreateSense:
        edge = edges.edges(self.pose, self._scenario.arena)
        drop_left, drop_right = (drop > edges.WHEEL_DROP_M for drop in self.drive.drop_m())
        seen = beams.infrared(self.docks, self.pose, self.discs)
        left_m, right_m = self.drive.travel_m()
        dead = self.faults.dead_battery
        return CreateSense(
            bump_left=self.press.left,
            bump_right=self.press.right,
            drop_left=drop_left,
            drop_right=drop_right,
            drop_caster=edge.caster,
            wall=beams.wall(self.pose, self.discs),
            cliff_left=edge.cliffs[0],
            cliff_front_left=edge.cliffs[1],
            cliff_front_right=edge.cliffs[2],
            cliff_right=edge.cliffs[3],
            ir_red=seen.red,
            ir_green=seen.green,
            ir_field=seen.field,
            contacts=self.docked_at is not None,
            charging=self.pack.charging,
            voltage_v=self.pack.voltage_v,
            current_a=self.pack.current_a,
            charge_ah=0.0 if dead else self.pack.charge_ah,
            capacity_ah=self.pack.capacity_ah,
            temperature_c=25.0 + 0.8 * abs(self.pack.current_a),
            left_m=left_m,
            right_m=right_m,
        )

    def set_wheels(self, left_mps: float, right_mps: float) -> None:
        self.drive.want(left_mps, right_mps)

    # ServoRig

    def set_pulse(self, channel: int, pulse_us: float) -> None:
        self.arm.pulse(channel, pulse_us)

    def set_output(self, channel: int, high: bool) -> None:
        if channel == g.PUMP_CHANNEL:
            self.tank.switched_on = high

    def analog_v(self, index: int) -> float:
        if index == g.TANK_INPUT:
            return self._noisy(g.TANK_SENSOR_V_FULL * self.tank.level_ml / g.TANK_ML, TANK_NOISE_V)
        if index == g.FORCE_INPUT:
            return self._force_v()
        return 0.0

    def _force_v(self) -> float:
        if not self.faults.force_stuck:
            self.stuck_v = None
        elif self.stuck_v is not None:
            return self.stuck_v
        volts = self._noisy(g.FORCE_SENSOR_V_MAX * self.arm.grip_n() / g.FORCE_SENSOR_N_MAX, FORCE_NOISE_V)
        self.stuck_v = volts if self.faults.force_stuck else None
        return volts

    def _noisy(self, volts: float, sigma_v: float) -> float:
        return float(min(5.0, max(0.0, volts + self.analog_rng.normal(0.0, sigma_v))))

    # MarkerCamera

    def sight(self, now_s: float) -> MarkerSight | None:
        if self.faults.marker_blind or not self.powered:
            return None
        return markers.sight_of(self.pose, self._markers, self._scenario.arena.ceiling_m, self.marker_rng)
