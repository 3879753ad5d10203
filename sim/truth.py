"""What is so in the simulated world: for judges and pictures, never for algorithms."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from core.wire.geometry import Point3, Pose2


class _Fact(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Collisions(_Fact):
    """Touches so far; one that lasts, or comes back within half a second, counts once."""

    robot_robot: int
    robot_pot: int
    robot_dock: int
    """Against a dock while not mated with it."""
    arm: int


class RobotTruth(_Fact):
    id: str
    pose: Pose2
    z_m: float
    fallen: bool
    """Off the field, or tipped over."""
    v_mps: float
    omega_radps: float
    wheels_mps: tuple[float, float]
    """Setpoints, left and right."""
    travel_m: tuple[float, float]
    """What the encoders have counted, left and right."""
    arm_rad: tuple[float, ...]
    """Pan, shoulder, elbow, wrist."""
    gripper_m: float
    nozzle: Point3
    battery_ratio: float
    charging: bool
    tank_ml: float
    pumping: bool
    pumped_ml: float
    docked_at: str | None
    collisions: Collisions


class FruitTruth(_Fact):
    id: str
    position_plant: Point3
    position_world: Point3
    radius_m: float
    colour: Literal["green", "turning", "red"]
    ripeness: float


class PlantTruth(_Fact):
    id: str
    moisture_ratio: float
    stored_ml: float
    poured_ml: float
    given_off_ml: float
    drained_ml: float
    fruit: tuple[FruitTruth, ...]


class Truth(_Fact):
    time_s: float
    hour: float
    """Of the garden's day."""
    robots: tuple[RobotTruth, ...]
    plants: tuple[PlantTruth, ...]
    spilt_ml: float
    tap_ml: float
    """Drawn from the tap so far."""
    tap_open: bool
    at_rest: bool

    def robot(self, robot_id: str) -> RobotTruth:
        return next(robot for robot in self.robots if robot.id == robot_id)

    def plant(self, plant_id: str) -> PlantTruth:
        return next(plant for plant in self.plants if plant.id == plant_id)
