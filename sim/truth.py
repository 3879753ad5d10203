"""What is so in the simulated world: for judges and pictures, never for algorithms."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from core.wire.geometry import Point3, Pose2

Colour = Literal["green", "turning", "red"]


class _Fact(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Collisions(_Fact):
    """Touches so far; one that lasts, or comes back within half a second, counts once."""

    robot_robot: int
    robot_pot: int
    robot_dock: int
    """Against a dock while not mated with it."""
    arm: int


class ByColour(_Fact):
    green: int
    turning: int
    red: int


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
    grip_n: float
    """Mean squeeze on the pads, as the force sensor should have it."""
    torn_gripped: ByColour
    """Fruit that came off between its pads."""
    torn_touched: ByColour
    """Fruit that came off otherwise while its arm was by: brushed, dragged, struck."""


class FruitTruth(_Fact):
    """One fruit that is in the garden, wherever it is."""

    id: str
    position_plant: Point3
    """Centre, in the frame of the plant that bore it."""
    position_world: Point3
    radius_m: float
    colour: Colour
    ripeness: float
    where: Literal["plant", "hand", "basket", "ground"]
    robot_id: str | None
    """Whose hand or basket."""
    torn_by: str | None
    """Which robot tore it off; None while it hangs, or when it dropped by itself."""
    torn_how: Literal["grip", "touch"] | None
    pull_n: float
    """What its stalk bears now."""
    strength_n: float
    """Pull along its stalk that would break it; half of it when bent by 90 degrees or twisted by 180."""


class GoneTruth(_Fact):
    """A fruit that has left the garden: taken out of a robot's basket, or rotten on the ground."""

    id: str
    how: Literal["taken", "rotten"]
    robot_id: str | None
    colour: Colour
    at_s: float


class PlantTruth(_Fact):
    id: str
    moisture_ratio: float
    stored_ml: float
    poured_ml: float
    given_off_ml: float
    drained_ml: float
    fruit: tuple[FruitTruth, ...]
    dropped: ByColour
    """Fruit that fell with no robot near: overripe."""
    gone: tuple[GoneTruth, ...]
    """The last two hundred of the garden's."""


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
