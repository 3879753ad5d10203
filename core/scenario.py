"""A garden on paper: arena, pots, robots, station, ports. Read from TOML, checked whole, every mistake named.

World frame: origin at the arena's centre on the floor, x along its length, y along its width, z up, yaw counter-clockwise.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from core.errors import ConfigError
from core.robots import gardener
from core.wire.geometry import Pose2

_HERE = Path(__file__).resolve().parent
SCENARIOS_DIR = _HERE / "scenarios" if (_HERE / "scenarios").is_dir() else _HERE.parent / "scenarios"
"""Beside this file in an installed wheel, at the top of a checkout."""

Identifier = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,30}$")]
Ratio = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Arena(_Section):
    """An elevated rectangle; beyond its edge there is nothing to drive on."""

    length_m: Annotated[float, Field(ge=1.5, le=20)] = 4.0
    width_m: Annotated[float, Field(ge=1.5, le=20)] = 3.0
    ceiling_m: Annotated[float, Field(ge=2, le=6)] = 2.6
    marker_spacing_m: Annotated[float, Field(ge=0.5, le=3)] = 1.5
    lamps: Literal["white", "warm", "daylight", "purple"] = "white"
    """The light that plants grow in and cameras see by."""


class Climate(_Section):
    start_hour: Annotated[float, Field(ge=0, lt=24)] = 10.0
    litres_per_day: Annotated[float, Field(ge=0, le=5)] = 0.5
    """What a grown plant and its soil give off on a day."""
    growth: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """How much faster than in life fruit grow and ripen."""


class Plant(_Section):
    id: Identifier
    x_m: Finite
    y_m: Finite
    dock_yaw_deg: Finite
    """Direction from the stem to the dock."""
    moisture_ratio: Ratio = 0.30
    threshold_ratio: Ratio = 0.20
    target_ratio: Ratio = 0.24
    dose_ml: Annotated[float, Field(gt=0, le=500)] = 150.0
    soil_litres: Annotated[float, Field(gt=0.5, le=50)] = 3.0
    height_m: Annotated[float, Field(ge=0.3, le=1.5)] = 0.9
    fruit: Annotated[int, Field(ge=0, le=60)] = 12
    inventory: bool = True
    """Whether the pot asks for scans of its fruit by itself."""
    harvest: bool = True
    """Whether it asks for ripe fruit to be picked by itself."""
    external: bool = False
    """Its service is started by somebody else; it has its port, its keys and its probe all the same."""

    @property
    def dock(self) -> Pose2:
        """Base pose of a docked robot, in the world."""
        return _before(self.x_m, self.y_m, self.dock_yaw_deg, gardener.DOCK_TO_STEM_M)


class StationDock(_Section):
    id: Identifier
    x_m: Finite
    y_m: Finite
    dock_yaw_deg: Finite
    """Direction from the dock's wall to the robot that stands at it."""
    tap: bool = False

    @property
    def dock(self) -> Pose2:
        """Base pose of a docked robot, in the world; x_m, y_m is where the dock's face stands."""
        return _before(self.x_m, self.y_m, self.dock_yaw_deg, gardener.BODY_RADIUS_M)


class Station(_Section):
    id: Identifier = "station"
    docks: tuple[StationDock, ...] = Field(default=(), min_length=1)


class Robot(_Section):
    id: Identifier
    kind: Literal["gardener"] = "gardener"
    create: Literal["create1", "create2"] = "create2"
    docking: Literal["seek-dock", "beam"] = "seek-dock"
    wrist: Literal["plain", "roll"] = "plain"
    """Whether the gripper turns about the hand."""
    spread_after_s: Annotated[float, Field(ge=0, le=1e6)] = 120.0
    """Idle for so long it looks for a better place to wait at; 0: never."""
    x_m: Finite
    y_m: Finite
    yaw_deg: Finite = 0.0
    battery_ratio: Ratio = 0.9
    tank_ml: Annotated[float, Field(ge=0, le=gardener.TANK_ML)] = 1200.0

    @property
    def home(self) -> Pose2:
        return Pose2(x_m=self.x_m, y_m=self.y_m, yaw_rad=math.radians(self.yaw_deg))


class Ports(_Section):
    """First TCP port of each family; every one can be moved away from a port in use."""

    console: int = Field(default=8080, ge=1024, le=65000)
    sim: int = Field(default=8090, ge=1024, le=65000)
    plants: int = Field(default=8101, ge=1024, le=65000)
    station: int = Field(default=8121, ge=1024, le=65000)
    robots: int = Field(default=8201, ge=1024, le=65000)
    devices: int = Field(default=9101, ge=1024, le=65000)


class Scenario(_Section):
    """One garden. `load` reads it; `plants`, `robots` and `station` become services."""

    name: Identifier = "garden"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 7
    speed: Annotated[float, Field(gt=0, le=100)] = 3.0
    tls: bool = False
    """Services speak HTTPS, with certificates of the garden's own authority."""
    arena: Arena = Arena()
    climate: Climate = Climate()
    plants: tuple[Plant, ...] = Field(min_length=1, max_length=12)
    robots: tuple[Robot, ...] = Field(min_length=1, max_length=4)
    station: Station
    ports: Ports = Ports()

    @model_validator(mode="after")
    def _hold_together(self) -> Scenario:
        if problems := list(_problems(self)):
            raise ValueError("; ".join(problems))
        return self

    def docks(self) -> dict[str, Pose2]:
        """Every dock by its full name: a plant's id, or `station/DOCK`."""
        named = {plant.id: plant.dock for plant in self.plants}
        return named | {f"{self.station.id}/{dock.id}": dock.dock for dock in self.station.docks}


def _before(x_m: float, y_m: float, yaw_deg: float, distance_m: float) -> Pose2:
    """The pose `distance_m` out along `yaw_deg` from (x, y), looking back at it."""
    yaw_rad = math.radians(yaw_deg)
    back_rad = math.remainder(yaw_rad + math.pi, math.tau)
    return Pose2(x_m=x_m + distance_m * math.cos(yaw_rad), y_m=y_m + distance_m * math.sin(yaw_rad), yaw_rad=back_rad)


def launch_pose(dock: Pose2) -> Pose2:
    """Where docking begins: straight behind the docked pose, facing it."""
    return Pose2(
        x_m=dock.x_m - gardener.LAUNCH_M * math.cos(dock.yaw_rad),
        y_m=dock.y_m - gardener.LAUNCH_M * math.sin(dock.yaw_rad),
        yaw_rad=dock.yaw_rad,
    )


def device_ports(scenario: Scenario) -> dict[str, int]:
    """TCP port of every simulated device by its name, `robot-1.create`; the same names serve `memory://` links.

    Ten ports a robot from `ports.devices` on; the station's board 99 above it, pot boards from 100 above it.
    """
    first = scenario.ports.devices
    ports = {
        f"{robot.id}.{device}": first + 10 * row + column
        for row, robot in enumerate(scenario.robots)
        for column, device in enumerate(("create", "ssc32", "stargazer"))
    }
    ports[f"{scenario.station.id}.board"] = first + 99
    return ports | {f"{plant.id}.soil": first + 100 + row for row, plant in enumerate(scenario.plants)}


def _problems(scenario: Scenario) -> Iterator[str]:
    yield from _doubled(scenario)
    half_x, half_y = scenario.arena.length_m / 2, scenario.arena.width_m / 2
    edge_m = gardener.BODY_RADIUS_M + 0.05

    def outside(x_m: float, y_m: float, margin_m: float) -> bool:
        return abs(x_m) > half_x - margin_m + 1e-9 or abs(y_m) > half_y - margin_m + 1e-9

    for plant in scenario.plants:
        if outside(plant.x_m, plant.y_m, gardener.POT_RADIUS_M):
            yield f"pot {plant.id} at ({plant.x_m}, {plant.y_m}) stands outside the arena"
        if plant.target_ratio <= plant.threshold_ratio:
            yield f"pot {plant.id}: target_ratio must lie above threshold_ratio"
    for name, dock in scenario.docks().items():
        launch = launch_pose(dock)
        if outside(launch.x_m, launch.y_m, edge_m) or outside(dock.x_m, dock.y_m, edge_m):
            yield f"a robot cannot reach dock {name}: its approach leaves the arena (turn dock_yaw_deg or move it inwards)"
    for robot in scenario.robots:
        if outside(robot.x_m, robot.y_m, edge_m):
            yield f"robot {robot.id} at ({robot.x_m}, {robot.y_m}) starts outside the arena"
    if not any(dock.tap for dock in scenario.station.docks):
        yield f"station {scenario.station.id} has no dock with tap = true: robots could never refill"
    yield from _crowded(scenario)


def _doubled(scenario: Scenario) -> Iterator[str]:
    names = [p.id for p in scenario.plants] + [r.id for r in scenario.robots] + [scenario.station.id, "sim", "console"]
    for name in sorted({n for n in names if names.count(n) > 1}):
        yield f"the id {name} is used twice (sim and console are taken)"
    docks = [d.id for d in scenario.station.docks]
    for name in sorted({n for n in docks if docks.count(n) > 1}):
        yield f"station dock id {name} is used twice"


def _crowded(scenario: Scenario) -> Iterator[str]:
    """Pots and docked or parked robots are discs that must not overlap."""
    discs = [(f"pot {p.id}", p.x_m, p.y_m, gardener.POT_RADIUS_M) for p in scenario.plants]
    stands = [(f"a robot at dock {n}", d.x_m, d.y_m, gardener.BODY_RADIUS_M) for n, d in scenario.docks().items()]
    homes = [(f"robot {r.id}", r.x_m, r.y_m, gardener.BODY_RADIUS_M) for r in scenario.robots]
    for (a, ax, ay, ar), (b, bx, by, br) in combinations([*discs, *stands, *homes], 2):
        if math.hypot(ax - bx, ay - by) < ar + br + 0.02:
            yield f"{a} and {b} would overlap"


def load(path: Path) -> Scenario:
    """Read a scenario file, or a folder holding `scenario.toml`; raises ConfigError naming every mistake."""
    path = path / "scenario.toml" if path.is_dir() else path
    try:
        document = tomllib.loads(path.read_text())
    except OSError as error:
        known = ", ".join(sorted(p.parent.name for p in SCENARIOS_DIR.glob("*/scenario.toml")))
        raise ConfigError(
            f"cannot read scenario {path}: {error.strerror}", hint=f"name a file, or one of: {known}"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not TOML: {error}") from error
    try:
        return Scenario.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"{path}: " + "; ".join(_told(error)), hint="see docs/scenarios.md") from error


def _told(error: ValidationError) -> Iterator[str]:
    for item in error.errors():
        where = ".".join(str(part) for part in item["loc"])
        yield f"{where}: {item['msg']}" if where else str(item["msg"]).removeprefix("Value error, ")


def find(name: str, tls: bool = False) -> Scenario:
    """A built-in scenario by name, or any path to one; `tls` has it speak HTTPS even where the file does not say so."""
    inside = SCENARIOS_DIR / name
    scenario = load(inside if inside.is_dir() else Path(name))
    return scenario.model_copy(update={"tls": True}) if tls else scenario
