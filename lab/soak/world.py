"""The truth of a soaked garden: where robots stand, what the soil holds, which fruit hang. Nothing here has a loop.

Everything is a function of time between two commands, brought up to date whenever somebody looks or acts, so that a
quiet day costs nothing. Judges read it; services meet it only through the devices of `lab.soak.devices`.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from core.estimation.odometry import arc
from core.geometry.planar import Pose, between, distance_m
from core.robots import gardener
from core.robots.garden_map import GardenMap
from core.scenario import Plant, Scenario
from core.wire.fruit import Colour

SEEK_MPS = 0.12
SEEK_M, SEEK_SIDE_M = 1.3, 0.6
CONTACT_M, CONTACT_SIDE_M, CONTACT_RAD = 0.02, 0.04, 0.15
SOAKING_S = 12.0
"""Two thirds of a dose have reached the probe after so long."""
TAP_MLPS = 50.0
RED_SHARE, TURNING_SHARE = 0.8, 0.65
"""Of a fruit's life on the plant until it is red, and until it turns; from there on it hangs red."""


@dataclass(slots=True)
class Dose:
    """One run of one pump into one pot's soil, or onto the floor."""

    number: int
    robot_id: str
    plant_id: str
    permit_id: str
    began_s: float
    ended_s: float | None = None
    ml: float = 0.0


@dataclass(slots=True)
class TrueFruit:
    """One fruit: born at `born_s`, red from `red_s` on; it hangs until somebody takes it."""

    name: str
    plant_id: str
    at: tuple[float, float, float]
    born_s: float
    red_s: float
    taken_by: list[str] = field(default_factory=list)
    """Permits under which a hand closed on it or on where it hung: more than one is a broken invariant."""
    taken_s: float = math.inf

    def colour(self, now_s: float) -> Colour:
        share = (now_s - self.born_s) / (self.red_s - self.born_s)
        return "red" if share >= 1.0 else "turning" if share >= TURNING_SHARE / RED_SHARE else "green"

    def hangs(self, now_s: float) -> bool:
        return self.born_s <= now_s and not self.taken_by


@dataclass(slots=True)
class Soil:
    """One pot's water: what the probe feels, and what is still on its way down."""

    litres: float
    ratio: float
    dry_per_s: float
    pending_ml: float = 0.0
    at_s: float = 0.0

    def look(self, now_s: float) -> float:
        """Water content now."""
        dt_s = now_s - self.at_s
        if dt_s > 0.0:
            left_ml = self.pending_ml * math.exp(-dt_s / SOAKING_S)
            wet = (self.pending_ml - left_ml) / (self.litres * 1000.0)
            self.ratio = max(0.02, self.ratio + wet - self.dry_per_s * dt_s)
            self.pending_ml, self.at_s = left_ml, now_s
        return self.ratio

    def pour(self, ml: float, now_s: float) -> None:
        self.look(now_s)
        self.pending_ml += ml


@dataclass(slots=True)
class Pot:
    plant: Plant
    soil: Soil
    fruits: list[TrueFruit] = field(default_factory=list)
    samples_s: list[float] = field(default_factory=list)
    """When the pot measured its soil, lately."""
    probe_silent: bool = False


Mode = Literal["stop", "drive", "seek"]


@dataclass(slots=True)
class Body:
    """One robot, as it is."""

    name: str
    pose: Pose
    battery_ratio: float
    tank_ml: float
    at_s: float = 0.0
    mode: Mode = "stop"
    v_mps: float = 0.0
    omega_radps: float = 0.0
    left_m: float = 0.0
    right_m: float = 0.0
    dock: str = ""
    """Whose contacts it stands on."""
    pumping: Dose | None = None
    pump_broken: bool = False
    filling_s: float = 0.0
    """The tap pours into it until then."""
    seek_from: Pose = (0.0, 0.0, 0.0)
    seek_dock: str = ""
    seek_since_s: float = 0.0

    @property
    def moving(self) -> bool:
        return self.mode == "seek" or self.v_mps != 0.0 or self.omega_radps != 0.0


class Truth:
    """The whole garden as it is."""

    def __init__(
        self, scenario: Scenario, garden: GardenMap, rng: random.Random, dry_per_day: float, fruit_days: float
    ) -> None:
        self._rng, self._map, self._fruit_s = rng, garden, fruit_days * 86400.0
        self._docks = {dock.name: (dock.pose.x_m, dock.pose.y_m, dock.pose.yaw_rad) for dock in garden.docks}
        self.pots = {p.id: self._pot(p, dry_per_day) for p in scenario.plants}
        self.robots = {
            r.id: Body(r.id, (r.home.x_m, r.home.y_m, r.home.yaw_rad), r.battery_ratio, r.tank_ml) for r in scenario.robots
        }
        self.homes = {r.id: (r.home.x_m, r.home.y_m, r.home.yaw_rad) for r in scenario.robots}
        self.doses: list[Dose] = []
        self.picks = 0
        self.began: Callable[[Dose], None] = lambda dose: None
        """A pump has started."""
        self.water_out = False
        self._fruit_number = 0

    @staticmethod
    def now() -> float:
        return asyncio.get_running_loop().time()

    def _pot(self, plant: Plant, dry_per_day: float) -> Pot:
        dry_per_s = dry_per_day / 86400.0 * self._rng.uniform(0.8, 1.2)
        return Pot(plant, Soil(plant.soil_litres, self._rng.uniform(0.195, 0.22), dry_per_s))

    # Robots

    def look(self, robot_id: str) -> Body:
        """The robot, brought up to now."""
        body, now_s = self.robots[robot_id], self.now()
        if (dt_s := now_s - body.at_s) > 0.0:
            body.at_s = now_s
            self._move(body, dt_s, now_s)
            self._flow(body, dt_s, now_s)
            self._power(body, dt_s)
        return body

    def command(self, robot_id: str, mode: Mode, v_mps: float = 0.0, omega_radps: float = 0.0) -> None:
        body = self.look(robot_id)
        if body.battery_ratio <= 0.0:
            mode, v_mps, omega_radps = "stop", 0.0, 0.0
        if mode == "seek" and body.mode != "seek":
            body.seek_from, body.seek_since_s, body.seek_dock = body.pose, self.now(), self._in_sight(body)
        body.mode, body.v_mps, body.omega_radps = mode, v_mps, omega_radps

    def _in_sight(self, body: Body) -> str:
        """The dock whose beams it follows; empty when it sees none, or somebody stands there."""
        found = ""
        for name, place in self._docks.items():
            x_m, y_m, yaw_rad = between(place, body.pose)
            seen = -SEEK_M < x_m < 0.1 and abs(y_m) < SEEK_SIDE_M and abs(yaw_rad) < 1.2
            if seen and (not found or distance_m(place, body.pose) < distance_m(self._docks[found], body.pose)):
                found = name
        return "" if any(other.dock == found for other in self.robots.values() if other is not body) else found

    def _move(self, body: Body, dt_s: float, now_s: float) -> None:
        before = body.pose
        if body.mode == "seek":
            self._seek(body, now_s)
        elif body.v_mps or body.omega_radps:
            x, y, yaw = arc(before, body.v_mps * dt_s, body.omega_radps * dt_s)
            body.pose = (x, y, yaw)
            half_m = body.omega_radps * gardener.WHEELBASE_M["create2"] / 2
            body.left_m += (body.v_mps - half_m) * dt_s
            body.right_m += (body.v_mps + half_m) * dt_s
        if body.pose != before:
            body.dock = self._contact(body.pose)

    def _seek(self, body: Body, now_s: float) -> None:
        """Straight from where it began onto the contacts."""
        if not body.seek_dock:
            return
        goal, start = self._docks[body.seek_dock], body.seek_from
        way_m = distance_m(start, goal)
        share = 1.0 if way_m < 1e-6 else min(1.0, (now_s - body.seek_since_s) * SEEK_MPS / way_m)
        turn = math.remainder(goal[2] - start[2], 2 * math.pi)
        pose = (start[0] + share * (goal[0] - start[0]), start[1] + share * (goal[1] - start[1]), start[2] + share * turn)
        gone_m = distance_m(body.pose, pose)
        half_m = math.remainder(pose[2] - body.pose[2], 2 * math.pi) * gardener.WHEELBASE_M["create2"] / 2
        body.left_m, body.right_m = body.left_m + gone_m - half_m, body.right_m + gone_m + half_m
        body.pose = pose
        if share == 1.0:
            body.mode = "stop"

    def _contact(self, pose: Pose) -> str:
        for name, place in self._docks.items():
            x, y, yaw = between(place, pose)
            if abs(x) < CONTACT_M and abs(y) < CONTACT_SIDE_M and abs(yaw) < CONTACT_RAD:
                return name
        return ""

    def _power(self, body: Body, dt_s: float) -> None:
        watts = -gardener.CHARGE_W if body.dock else gardener.IDLE_W + (gardener.DRIVE_W if body.moving else 0.0)
        body.battery_ratio = min(1.0, max(0.0, body.battery_ratio - watts * dt_s / 3600.0 / gardener.PACK_WH))
        if body.battery_ratio <= 0.0 and not body.dock:
            body.mode, body.v_mps, body.omega_radps = "stop", 0.0, 0.0

    # Water

    def _flow(self, body: Body, dt_s: float, now_s: float) -> None:
        if (dose := body.pumping) is not None and not body.pump_broken:
            ml = min(gardener.PUMP_MLPS * dt_s, body.tank_ml)
            body.tank_ml -= ml
            dose.ml += ml
            if (pot := self.pots.get(body.dock)) is not None:
                pot.soil.pour(ml, now_s)
        filled_s = min(now_s, body.filling_s) - (now_s - dt_s)
        if filled_s > 0.0 and not self.water_out and body.dock.startswith("station/"):
            body.tank_ml = min(gardener.TANK_ML, body.tank_ml + TAP_MLPS * filled_s)

    def pump(self, robot_id: str, on: bool, permit_id: str = "") -> Dose | None:
        """Switch the relay; returns the dose that ended with it, if one did."""
        body, now_s = self.look(robot_id), self.now()
        if on is (body.pumping is not None):
            return None
        if on:
            body.pumping = Dose(len(self.doses), robot_id, body.dock, permit_id, now_s)
            self.doses.append(body.pumping)
            self.began(body.pumping)
            return None
        ended, body.pumping = body.pumping, None
        assert ended is not None
        ended.ended_s = now_s
        return ended

    def tap(self, open_s: float) -> None:
        """The tap pours into whoever stands at it."""
        for dock in self._map.docks:
            for body in self.robots.values():
                if dock.tap and self.look(body.name).dock == dock.name:
                    body.filling_s = self.now() + open_s

    # Fruit

    def grow(self, plant_id: str) -> list[TrueFruit]:
        """The pot's fruit that hang now; where one was taken another sets after a while."""
        pot, now_s = self.pots[plant_id], self.now()
        hanging = [fruit for fruit in pot.fruits if not fruit.taken_by]
        for _ in range(pot.plant.fruit - len(hanging)):
            self._fruit_number += 1
            first = not pot.fruits or len(pot.fruits) < pot.plant.fruit
            born_s = now_s - self._rng.uniform(0.0, self._fruit_s) if first else now_s
            red_s = born_s + self._fruit_s * self._rng.uniform(0.9, 1.1)
            fruit = TrueFruit(f"{plant_id}/{self._fruit_number}", plant_id, self._free_place(pot), born_s, red_s)
            pot.fruits.append(fruit)
        return [fruit for fruit in pot.fruits if fruit.hangs(now_s)]

    def _free_place(self, pot: Pot) -> tuple[float, float, float]:
        """A place some centimetres from every fruit that hangs, and from where the last ones hung."""
        others = [fruit.at for fruit in pot.fruits[-3 * pot.plant.fruit :]]
        for _ in range(200):
            place = (self._rng.uniform(-0.05, 0.16), self._rng.uniform(-0.15, 0.15), self._rng.uniform(0.2, 0.7))
            if all(math.dist(place, other) > 0.09 for other in others):
                return place
        return place

    def pick(self, plant_id: str, at: tuple[float, float, float], permit_id: str) -> bool:
        """A hand closes there: whether a fruit came off."""
        self.picks += 1
        near = [fruit for fruit in self.pots[plant_id].fruits if math.dist(fruit.at, at) < 0.03]
        if not near:
            return False
        fruit = min(near, key=lambda f: (bool(f.taken_by), math.dist(f.at, at)))
        came = fruit.hangs(self.now())
        fruit.taken_by.append(permit_id)
        if came:
            fruit.taken_s = self.now()
        return came
