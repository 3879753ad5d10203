"""What a robot is told about its garden before it has seen anything: the arena, the pots and every dock."""

from __future__ import annotations

from pydantic import Field

from core.robots import gardener
from core.scenario import Arena, Scenario
from core.wire.documents import Document, Identifier
from core.wire.geometry import Pose2

DOCK_RADIUS_M = 0.12
"""A dock's housing as a disc, its edge touching the docked robot's front."""


class KnownPot(Document):
    plant_id: Identifier
    x_m: float
    y_m: float
    radius_m: float = Field(default=gardener.POT_RADIUS_M, gt=0)


class KnownDock(Document):
    """One dock. `name` is a plant's id, or `station/DOCK`."""

    name: Identifier
    pose: Pose2
    """Base pose of a docked robot, world frame."""
    tap: bool = False

    @property
    def owner(self) -> str:
        return self.name.partition("/")[0]

    @property
    def dock_id(self) -> str:
        """The name at its owner; empty at a plant, which has only one."""
        return self.name.partition("/")[2]


class GardenMap(Document):
    """`ROBOT_MAP`: the fixed garden, in the world frame."""

    length_m: float = Field(gt=0)
    width_m: float = Field(gt=0)
    ceiling_m: float = Field(default=2.6, gt=0)
    marker_spacing_m: float = Field(default=1.5, gt=0)
    pots: list[KnownPot] = []
    docks: list[KnownDock] = []

    @property
    def arena(self) -> Arena:
        return Arena(
            length_m=self.length_m,
            width_m=self.width_m,
            ceiling_m=self.ceiling_m,
            marker_spacing_m=self.marker_spacing_m,
        )

    def dock(self, name: str) -> KnownDock | None:
        return next((dock for dock in self.docks if dock.name == name), None)


def map_of(scenario: Scenario) -> GardenMap:
    """The map that a scenario's robots are given."""
    taps = {f"{scenario.station.id}/{dock.id}" for dock in scenario.station.docks if dock.tap}
    arena = scenario.arena
    return GardenMap(
        length_m=arena.length_m,
        width_m=arena.width_m,
        ceiling_m=arena.ceiling_m,
        marker_spacing_m=arena.marker_spacing_m,
        pots=[KnownPot(plant_id=p.id, x_m=p.x_m, y_m=p.y_m) for p in scenario.plants],
        docks=[KnownDock(name=name, pose=pose, tap=name in taps) for name, pose in scenario.docks().items()],
    )
