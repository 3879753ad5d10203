"""Devices without bytes: `hw.ports` filled from the truth. They have no loop of their own: a reading is made when wanted."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable

from core.estimation.markers import marker_view
from core.geometry.planar import Pose, distance_m
from core.robots import gardener
from hw.ports import BaseReading, ChargingState, LinkStatus, MarkerFix, ServoReading
from hw.protocols.vh400 import volts_of
from lab.soak.life import NodeClock
from lab.soak.world import Dose, Truth

FIX_EVERY_S = 2.0


class _Device:
    """What all share: a wire that is up, and nothing to do."""

    def __init__(self, clock: NodeClock) -> None:
        self._clock = clock
        self._up = LinkStatus(up=True, why="", since_s=clock.now())

    @property
    def link(self) -> LinkStatus:
        return self._up

    def rest(self, resting: bool) -> None:
        """Costs nothing either way."""

    async def run(self) -> None:
        await asyncio.get_running_loop().create_future()


class KinematicBase(_Device):
    """Wheels that do exactly what they are told, and find a dock when they stand before it."""

    def __init__(self, robot_id: str, truth: Truth, clock: NodeClock, moved: Callable[[str], None]) -> None:
        super().__init__(clock)
        self._id, self._truth, self._moved = robot_id, truth, moved

    @property
    def reading(self) -> BaseReading:
        body = self._truth.look(self._id)
        docked = bool(body.dock) and not body.moving
        return BaseReading(
            stamp_s=self._clock.now(),
            left_m=body.left_m,
            right_m=body.right_m,
            charging=ChargingState.FULL_CHARGING if docked else ChargingState.NOT_CHARGING,
            home_base=bool(body.dock),
            voltage_v=gardener.PACK_V,
            current_a=2.0 if docked else -1.0,
            charge_ah=body.battery_ratio,
            capacity_ah=1.0,
        )

    def drive(self, v_mps: float, omega_radps: float) -> None:
        self._truth.command(self._id, "drive", v_mps, omega_radps)
        if v_mps or omega_radps:
            self._moved(self._id)

    def seek_dock(self) -> None:
        self._truth.command(self._id, "seek")
        self._moved(self._id)

    def stop(self) -> None:
        self._truth.command(self._id, "stop")


class KinematicServos(_Device):
    """An arm that moves along straight lines of its joints, the pump's relay, the tank's level."""

    def __init__(
        self, robot_id: str, truth: Truth, clock: NodeClock, permit: Callable[[], str], poured: Callable[[Dose], None]
    ) -> None:
        super().__init__(clock)
        self._id, self._truth, self._permit, self._poured = robot_id, truth, permit, poured
        self._from: dict[int, float] = {}
        self._to: dict[int, float] = {}
        self._began_s = self._ends_s = 0.0

    @property
    def reading(self) -> ServoReading:
        now_s, body = self._clock.now(), self._truth.look(self._id)
        tank_v = body.tank_ml / gardener.TANK_ML * gardener.TANK_SENSOR_V_FULL
        pulses, moving = self._pulses(now_s), now_s < self._ends_s
        return ServoReading(stamp_s=now_s, pulses_us=pulses, moving=moving, analog_v=(0.0, tank_v))

    def _pulses(self, now_s: float) -> dict[int, float]:
        if now_s >= self._ends_s:
            return self._to
        share = (now_s - self._began_s) / (self._ends_s - self._began_s)
        return {ch: self._from.get(ch, to) + share * (to - self._from.get(ch, to)) for ch, to in self._to.items()}

    def move(self, pulses_us: dict[int, float], duration_s: float) -> None:
        now_s = self._clock.now()
        self._from = dict(self._pulses(now_s))
        self._to = self._from | pulses_us
        self._began_s, self._ends_s = now_s, now_s + max(0.01, duration_s)

    def output(self, channel: int, high: bool) -> None:
        if channel == gardener.PUMP_CHANNEL:
            ended = self._truth.pump(self._id, high, self._permit())
            if ended is not None:
                self._poured(ended)

    def stop(self) -> None:
        now_s = self._clock.now()
        self._from = self._to = dict(self._pulses(now_s))
        self._ends_s = now_s
        self.output(gardener.PUMP_CHANNEL, False)


class KinematicMarkers(_Device):
    """Ceiling markers seen exactly, every other second."""

    def __init__(self, robot_id: str, truth: Truth, clock: NodeClock, markers: dict[int, Pose]) -> None:
        super().__init__(clock)
        self._id, self._truth, self._markers = robot_id, truth, markers
        self._fix: MarkerFix | None = None

    @property
    def fix(self) -> MarkerFix | None:
        now_s = self._clock.now()
        if self._fix is None or now_s - self._fix.stamp_s >= FIX_EVERY_S:
            pose = self._truth.look(self._id).pose
            number, place = min(self._markers.items(), key=lambda item: distance_m(item[1], pose))
            x_m, y_m, yaw_rad = marker_view(pose, place)
            self._fix = MarkerFix(stamp_s=now_s, marker_id=number, x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, height_m=2.2)
        return self._fix


class SoakProbe(_Device):
    """A soil probe in the true soil."""

    def __init__(self, plant_id: str, truth: Truth, clock: NodeClock, rng: random.Random) -> None:
        super().__init__(clock)
        self._pot, self._truth, self._rng = truth.pots[plant_id], truth, rng

    async def sample(self, count: int) -> tuple[float, ...]:
        now_s = self._truth.now()
        if self._pot.probe_silent:
            return ()
        volts = volts_of(self._pot.soil.look(now_s))
        self._pot.samples_s = [*self._pot.samples_s[-30:], now_s]
        return tuple(volts + self._rng.gauss(0.0, 0.0008) for _ in range(count))


class SoakValve(_Device):
    """The station's tap."""

    def __init__(self, truth: Truth, clock: NodeClock) -> None:
        super().__init__(clock)
        self._truth = truth

    async def open_for(self, for_s: float) -> None:
        self._truth.tap(for_s)

    async def shut(self) -> None:
        self._truth.tap(-math.inf)
