"""A pot's or a station's settings, from `PLANT_...` variables; places and lists are JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from core.robots import gardener
from core.wire.documents import Identifier, Ratio
from core.wire.geometry import Point3, Pose2
from core.wire.market import PlantCard
from core.wire.plant import Settings

_NOZZLE = Point3(x_m=gardener.NOZZLE_POINT_M[0], y_m=gardener.NOZZLE_POINT_M[1], z_m=gardener.NOZZLE_POINT_M[2])


class DockSettings(BaseModel):
    """One dock of a station. `pose` is the base pose of a docked robot, world frame."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: Identifier
    pose: Pose2
    tap: bool = False


class PlantSettings(BaseSettings):
    """`PLANT_KIND` pot: needs stem, dock and probe_url. `PLANT_KIND` station: needs docks, and tap_url if one has a tap."""

    model_config = SettingsConfigDict(env_prefix="PLANT_", frozen=True, extra="forbid")

    id: Identifier
    kind: Literal["pot", "station"] = "pot"
    url: str = ""
    """Where others reach this service; it travels on the plant's card."""
    data: Path | None = None
    """Folder of this node's documents and history."""
    stem: Point3 | None = None
    """Centre of the soil's surface, world frame."""
    dock: Pose2 | None = None
    """Base pose of a docked robot, world frame."""
    nozzle: Point3 = _NOZZLE
    """Where water should leave, plant frame."""
    probe_url: str = ""
    """`socket://HOST:PORT?pin=0`, `/dev/ttyACM0?pin=0` or `iio:///sys/bus/iio/devices?name=...&channel=0`."""
    probe_gain: float = 1.0
    probe_offset_ratio: float = 0.0
    threshold_ratio: Ratio = 0.20
    target_ratio: Ratio = 0.24
    dose_ml: Annotated[float, Field(gt=0, le=500)] = 150.0
    day_cap_ml: Annotated[float, Field(gt=0, le=10000)] = 1500.0
    probe_every_s: Annotated[float, Field(ge=1, le=3600)] = 10.0
    soak_s: Annotated[float, Field(ge=0, le=3600)] = 60.0
    inventory_every_s: Annotated[float, Field(ge=60, le=1e7)] = 43200.0
    uncertainty_max: Annotated[float, Field(gt=0, le=1)] = 0.4
    inventory: bool = True
    """Ask for scans; without it only when an operator does, or a pick is in doubt."""
    harvest: bool = True
    """Ask for fruit that was seen ripe to be picked; without it only when somebody orders."""
    place: Point3 = Point3(x_m=0.0, y_m=0.0, z_m=0.0)
    """Where a station stands."""
    docks: tuple[DockSettings, ...] = ()
    tap_url: str = ""
    """`socket://HOST:PORT?valve=8`."""
    tap_flow_mlps: Annotated[float, Field(gt=0, le=1000)] = 50.0

    @model_validator(mode="after")
    def _whole(self) -> PlantSettings:
        if self.data is None:
            raise ValueError("PLANT_DATA is missing: the folder for this node's documents")
        if self.kind == "pot" and (self.stem is None or self.dock is None or not self.probe_url):
            raise ValueError("a pot needs PLANT_STEM, PLANT_DOCK and PLANT_PROBE_URL")
        if self.kind == "station" and not self.docks:
            raise ValueError("a station needs PLANT_DOCKS")
        if any(dock.tap for dock in self.docks) and not self.tap_url:
            raise ValueError("a dock with a tap needs PLANT_TAP_URL")
        return self

    @property
    def folder(self) -> Path:
        assert self.data is not None
        return self.data

    def care(self) -> Settings:
        """The watering settings an operator has not changed yet."""
        names = Settings.model_fields
        return Settings.model_validate({name: getattr(self, name) for name in names})

    def card(self) -> PlantCard:
        """What a robot needs to serve this pot."""
        assert self.stem is not None
        assert self.dock is not None
        return PlantCard(plant_id=self.id, url=self.url, stem=self.stem, dock=self.dock, nozzle=self.nozzle)
