"""The physical garden: MuJoCo for everything that moves, plain balances for water, soil and charge.

World frame as in `core.scenario`. Time is garden seconds from the scenario's `start_hour`.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from core.robots import gardener as g
from core.robots.markers import ceiling_markers
from core.scenario import Scenario
from core.wire.geometry import Point3, Pose2
from sim import checkpoint
from sim.body import RobotBody
from sim.devices.plants import BoardPins, CreateBody, MarkerCamera, ServoRig
from sim.physics import beams
from sim.physics.fruit import Orchard, Spot, Tally
from sim.physics.touch import Touch
from sim.physics.water import TAP_MLPS, lands_in
from sim.pot import Pot, TapBoard
from sim.scene.build import DT_S, build
from sim.scene.traits import generator
from sim.truth import ByColour, Collisions, FruitTruth, GoneTruth, PlantTruth, RobotTruth, Truth

TICK_S = 0.020
STEPS_A_TICK = round(TICK_S / DT_S)
STILL = 3e-3
"""Generalised velocities below this are rest [m/s, rad/s]."""
STRIDE_S_MAX = 60.0
SETTLE_S = 0.6


class World:
    """One garden. `advance` steps the physics; while `at_rest`, `stride` lets time pass almost for nothing."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario, self.seed = scenario, seed
        self.time_s = 0.0
        self.spilt_ml = 0.0
        self.tap_ml = 0.0
        scene = build(scenario, seed)
        self.model: Any = scene.model
        self.data: Any = mujoco.MjData(self.model)
        self.robots = {
            r.id: RobotBody(scenario, r, seed, self.model, self.data, scene.traits[r.id]) for r in scenario.robots
        }
        litres = scenario.climate.litres_per_day
        self.pots = {p.id: Pot(p, litres, generator(seed, f"probe/{p.id}")) for p in scenario.plants}
        mujoco.mj_forward(self.model, self.data)
        self.orchard = Orchard(scenario, seed, self.model, self.data, scene.shrubs)
        self.docks = [beams.Dock(name, pose) for name, pose in scenario.docks().items()]
        station = scenario.station
        self.tap_board = TapBoard(tuple(f"{station.id}/{dock.id}" for dock in station.docks if dock.tap))
        self.touch = Touch(self.model, self.data, tuple(self.robots))
        self._places = {name: pot.place for name, pot in self.pots.items()}
        self._pot_discs: list[beams.Disc] = [(*place, g.POT_RADIUS_M) for place in self._places.values()]
        self._owed_s = 0.0
        self._still: bool | None = None
        """Whether nothing moves; None until asked after a step."""
        for name, robot in self.robots.items():
            robot.docks, robot.press = self.docks, self.touch.pressed[name]
        self._settle()

    def _settle(self) -> None:
        """Springs find their rest before time begins."""
        mujoco.mj_step(self.model, self.data, nstep=round(SETTLE_S / DT_S))
        self.data.time = 0.0
        self._look()

    # Time

    @property
    def hour(self) -> float:
        """Hour of the garden's day."""
        return (self.scenario.climate.start_hour + self.time_s / 3600.0) % 24.0

    @property
    def at_rest(self) -> bool:
        """Nothing is driven, pumped or poured, and nothing moves."""
        if self.tap_board.open or self.orchard.swaying or not all(robot.idle for robot in self.robots.values()):
            return False
        if self._still is None:
            self._still = float(np.abs(self.data.qvel).max()) < STILL
        return self._still

    def advance(self, seconds: float) -> None:
        """Steps the world in control ticks of 20 ms; a remainder is kept for the next call."""
        self._owed_s += seconds
        while self._owed_s >= TICK_S - 1e-9:
            self._owed_s -= TICK_S
            self._tick()

    def stride(self, seconds: float) -> None:
        """Lets `seconds` pass without physics: soil, batteries and plants live on. Only while `at_rest`."""
        while seconds > 1e-9:
            step_s = min(seconds, STRIDE_S_MAX)
            seconds -= step_s
            self.time_s += step_s
            self._live(step_s)

    def _tick(self) -> None:
        for robot in self.robots.values():
            robot.before(TICK_S)
        self._step()
        self.time_s += TICK_S
        self._look()
        self._pour(TICK_S)
        self._live(TICK_S)

    def _step(self) -> None:
        if self.orchard.swaying:
            self.orchard.sway(self.time_s)
        if not self.orchard.near():
            mujoco.mj_step(self.model, self.data, nstep=STEPS_A_TICK)
            return
        for _ in range(STEPS_A_TICK):
            mujoco.mj_step(self.model, self.data)
            self.orchard.watch()

    def _look(self) -> None:
        """What devices may ask for after a tick."""
        self._still = None
        for robot in self.robots.values():
            robot.after(self.docks)
        discs = {name: (r.pose.x_m, r.pose.y_m, g.BODY_RADIUS_M) for name, r in self.robots.items()}
        for name, robot in self.robots.items():
            robot.discs = self._pot_discs + [disc for other, disc in discs.items() if other != name]
        poses = {name: robot.pose for name, robot in self.robots.items()}
        self.touch.look(self.time_s, poses, {name: robot.docked_at for name, robot in self.robots.items()})

    def _pour(self, dt_s: float) -> None:
        for robot in self.robots.values():
            if not robot.pumping:
                continue
            drawn_ml = robot.tank.pump(dt_s)
            robot.pumped_ml += drawn_ml
            below = lands_in(robot.arm.nozzle(), self._places)
            if below is None:
                self.spilt_ml += drawn_ml
            else:
                self.pots[below].soil.pour(drawn_ml)
        for tap in self.tap_board.open:
            self._run_tap(tap, TAP_MLPS * dt_s)

    def _run_tap(self, tap: str, offered_ml: float) -> None:
        self.tap_ml += offered_ml
        for robot in self.robots.values():
            if robot.docked_at == tap:
                offered_ml = robot.tank.fill(offered_ml)
        self.spilt_ml += offered_ml

    def _live(self, seconds: float) -> None:
        hour = self.hour
        for pot in self.pots.values():
            pot.soil.advance(seconds, hour)
        for robot in self.robots.values():
            robot.live(seconds)
        if self.orchard.due(self.time_s):
            self.orchard.grow(self.time_s, {name: pot.thirst for name, pot in self.pots.items()})
            mujoco.mj_forward(self.model, self.data)
            self._still = None

    # What the emulated devices hang on

    def create_body(self, robot_id: str) -> CreateBody:
        return self.robots[robot_id]

    def servo_rig(self, robot_id: str) -> ServoRig:
        return self.robots[robot_id]

    def marker_camera(self, robot_id: str) -> MarkerCamera:
        return self.robots[robot_id]

    def board_pins(self, owner_id: str) -> BoardPins:
        """Of a plant, or of the station."""
        return self.tap_board if owner_id == self.scenario.station.id else self.pots[owner_id]

    def markers(self) -> dict[int, Pose2]:
        return ceiling_markers(self.scenario.arena)

    # For judges, laboratories and checkpoints

    def teleport(self, robot_id: str, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Puts a robot somewhere else at once. For experiments and tests, never for a service."""
        robot = self.robots[robot_id]
        at, dof = robot.qpos, robot.dof
        self.data.qpos[at : at + 3] = (x_m, y_m, 0.0)
        self.data.qpos[at + 3 : at + 7] = (np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2))
        self.data.qvel[dof : dof + 6] = 0.0
        mujoco.mj_forward(self.model, self.data)
        self._look()

    def take(self, robot_id: str) -> list[str]:
        """Somebody empties a robot's basket; the ids of what was in it. Its places on the plants will flower again."""
        taken = self.orchard.take(robot_id)
        mujoco.mj_forward(self.model, self.data)
        self._look()
        return taken

    def snapshot(self) -> dict[str, Any]:
        """Everything that changes, as plain JSON."""
        return checkpoint.taken(self)

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Goes on from a snapshot of a world of the same scenario and seed; raises ConfigError for another's."""
        checkpoint.put_back(self, snapshot)
        self._owed_s = 0.0
        mujoco.mj_forward(self.model, self.data)
        self._look()

    def truth(self) -> Truth:
        return Truth(
            time_s=self.time_s,
            hour=self.hour,
            robots=tuple(self._robot_truth(robot) for robot in self.robots.values()),
            plants=tuple(self._plant_truth(pot) for pot in self.pots.values()),
            spilt_ml=self.spilt_ml,
            tap_ml=self.tap_ml,
            tap_open=bool(self.tap_board.open),
            at_rest=self.at_rest,
        )

    def _robot_truth(self, robot: RobotBody) -> RobotTruth:
        velocity = self.data.qvel[robot.dof : robot.dof + 6]
        forward = np.array([np.cos(robot.pose.yaw_rad), np.sin(robot.pose.yaw_rad)])
        tally = self.touch.tally[robot.id]
        x_m, y_m, z_m = robot.arm.nozzle()
        return RobotTruth(
            id=robot.id,
            pose=Pose2(x_m=robot.pose.x_m, y_m=robot.pose.y_m, yaw_rad=robot.pose.yaw_rad),
            z_m=robot.pose.z_m,
            fallen=robot.fallen,
            v_mps=float(velocity[:2] @ forward),
            omega_radps=float(velocity[5]),
            wheels_mps=(robot.drive.wanted_mps[0], robot.drive.wanted_mps[1]),
            travel_m=robot.drive.travel_m(),
            arm_rad=robot.arm.angles_rad(),
            gripper_m=g.gripper_opening_m(robot.arm.now_rad["gripper"]),
            nozzle=Point3(x_m=x_m, y_m=y_m, z_m=z_m),
            battery_ratio=0.0 if robot.faults.dead_battery else robot.pack.ratio,
            charging=robot.pack.charging,
            tank_ml=robot.tank.level_ml,
            pumping=robot.pumping,
            pumped_ml=robot.pumped_ml,
            docked_at=robot.docked_at,
            collisions=Collisions(
                robot_robot=tally.robot_robot, robot_pot=tally.robot_pot, robot_dock=tally.robot_dock, arm=tally.arm
            ),
            grip_n=robot.arm.grip_n(),
            torn_gripped=_by_colour(self.orchard.torn[robot.id].grip),
            torn_touched=_by_colour(self.orchard.torn[robot.id].touch),
        )

    def _plant_truth(self, pot: Pot) -> PlantTruth:
        soil = pot.soil
        return PlantTruth(
            id=pot.id,
            moisture_ratio=soil.moisture_ratio,
            stored_ml=soil.stored_ml,
            poured_ml=soil.poured_ml,
            given_off_ml=soil.given_off_ml,
            drained_ml=soil.drained_ml,
            fruit=tuple(
                self._fruit_truth(pot, spot) for spot in self.orchard.spots if spot.plant_id == pot.id and spot.there
            ),
            dropped=_by_colour(self.orchard.fallen[pot.id]),
            gone=tuple(
                GoneTruth(id=gone.fruit_id, how=gone.how, robot_id=gone.robot_id, colour=gone.colour, at_s=gone.at_s)
                for gone in self.orchard.gone
                if gone.plant_id == pot.id
            ),
        )

    def _fruit_truth(self, pot: Pot, spot: Spot) -> FruitTruth:
        x_m, y_m, z_m = self.orchard.position_m(spot)
        x_plant_m, y_plant_m = pot.stem.local(x_m, y_m)
        where, robot_id = self.orchard.where(spot)
        return FruitTruth(
            id=spot.growing.fruit_id,
            position_plant=Point3(x_m=x_plant_m, y_m=y_plant_m, z_m=z_m - g.SOIL_HEIGHT_M),
            position_world=Point3(x_m=x_m, y_m=y_m, z_m=z_m),
            radius_m=spot.drawn_m,
            colour=spot.growing.colour,
            ripeness=spot.growing.ripeness,
            where=where,
            robot_id=robot_id,
            torn_by=spot.torn_by,
            torn_how=spot.torn_how,
            pull_n=self.orchard.pull_n(spot),
            strength_n=spot.growing.strength_n,
        )


def _by_colour(tally: Tally) -> ByColour:
    return ByColour(green=tally.green, turning=tally.turning, red=tally.red)
