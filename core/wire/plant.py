"""A pot's and a station's own documents."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from core.wire.documents import Document, Identifier, Millilitres, Ratio, Seconds, Sentence
from core.wire.fruit import FruitCounts
from core.wire.geometry import Point3, Pose2
from core.wire.market import PlantCard


class SoilReading(Document):
    """The newest judged reading. `ratio` is None unless `state` is good."""

    state: Literal["good", "stale", "stuck", "out_of_range", "open", "short", "down", "unknown"]
    ratio: Ratio | None = None
    volts: float | None = None
    age_s: Seconds | None = None
    why: Sentence = ""


class Settings(Document):
    """`PATCH /settings` takes any part of it."""

    threshold_ratio: Annotated[float, Field(ge=0, le=0.6)] = 0.20
    target_ratio: Annotated[float, Field(ge=0, le=0.6)] = 0.24
    dose_ml: Annotated[float, Field(gt=0, le=500)] = 150.0
    day_cap_ml: Annotated[float, Field(gt=0, le=10000)] = 1500.0
    probe_every_s: Annotated[float, Field(ge=1, le=3600)] = 10.0
    soak_s: Annotated[float, Field(ge=0, le=3600)] = 60.0
    """After a dose the water needs this long to reach the probe."""
    inventory_every_s: Annotated[float, Field(ge=60, le=1e7)] = 43200.0
    """A scan is asked for at the latest after this long, and sooner when what is known has grown too uncertain."""
    uncertainty_max: Annotated[float, Field(gt=0, le=1)] = 0.4
    """Of the inventory: above it the pot asks for a scan."""
    inventory: bool = True
    """Ask for scans; without it only when an operator does, or a pick is in doubt."""
    harvest: bool = True
    """Ask for fruit that was seen ripe to be picked; without it only when somebody orders."""


class SettingsPatch(Document):
    """`PATCH /settings`: whatever is given changes, the rest stays."""

    threshold_ratio: Annotated[float, Field(ge=0, le=0.6)] | None = None
    target_ratio: Annotated[float, Field(ge=0, le=0.6)] | None = None
    dose_ml: Annotated[float, Field(gt=0, le=500)] | None = None
    day_cap_ml: Annotated[float, Field(gt=0, le=10000)] | None = None
    probe_every_s: Annotated[float, Field(ge=1, le=3600)] | None = None
    soak_s: Annotated[float, Field(ge=0, le=3600)] | None = None
    inventory_every_s: Annotated[float, Field(ge=60, le=1e7)] | None = None
    uncertainty_max: Annotated[float, Field(gt=0, le=1)] | None = None
    inventory: bool | None = None
    harvest: bool | None = None


class PlantState(Document):
    """`GET /state` of a pot."""

    plant_id: Identifier
    now_s: float
    soil: SoilReading
    thirsty: bool
    """Asking for water now, with hysteresis."""
    settings: Settings
    open_tasks: list[str] = []
    watered_today_ml: Millilitres = 0.0
    dock_holder: str = ""
    fruit: FruitCounts = FruitCounts()
    """Of the inventory."""
    fruit_uncertainty: Ratio = 1.0
    """Of the inventory: 0 just scanned, 1 nothing known."""
    waiting: Sentence = ""
    """Why nothing happens although the pot is thirsty; empty when nothing is amiss."""
    card: PlantCard


class DockState(Document):
    dock_id: str
    pose: Pose2
    tap: bool = False
    holder: str = ""
    yielding: bool = False
    wanted_by: str = ""


class StationState(Document):
    """`GET /state` of a station."""

    station_id: Identifier
    now_s: float
    docks: list[DockState]
    tap_open: bool
    dispensed_ml: Millilitres = 0.0


class TapRequest(Document):
    """`POST /tap` by the robot that holds the tap's dock: open for at most this long."""

    robot_id: Identifier
    open_s: Annotated[float, Field(gt=0, le=60)]


class TapGrant(Document):
    open_s: Seconds
    flow_mlps: Annotated[float, Field(gt=0)]


class StationCard(Document):
    station_id: Identifier
    url: str
    place: Point3
    docks: list[DockState]
    extra: dict[str, Any] = {}
