"""Fruit as they cross the wire: seen by a robot, known by a plant, picked, forecast (paper 000, section 5).

Positions are in the plant frame: origin at the centre of the soil's surface, x towards the dock, z up.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from core.wire.documents import Document, Identifier, Ratio, Seconds, Sentence
from core.wire.geometry import Pose2

Colour = Literal["green", "turning", "red"]
Outcome = Literal["picked", "failed", "unreachable"]
PlantMetres = Annotated[float, Field(ge=-5, le=5)]
Radius = Annotated[float, Field(gt=0, le=0.2)]
Sigma = Annotated[float, Field(gt=0, le=1)]
Angle = Annotated[float, Field(gt=0, le=3.1)]
Pixels = Annotated[float, Field(ge=-1e5, le=1e5)]
Count = Annotated[int, Field(ge=0, le=2**53)]
GardenSeconds = Annotated[float, Field(ge=0, le=1e12)]
"""A time on the garden's clock."""
FRUITS_MAX = 200
VIEWS_MAX = 32


class NewFruit(Document):
    """`POST /inventory/fruits`: the paper's five and the position in the plant frame."""

    colour: Colour
    confidence: Ratio = 0.75
    """Probability that there is such a fruit."""
    x_m: PlantMetres
    y_m: PlantMetres
    z_m: PlantMetres
    radius_m: Radius
    robot_pose: Pose2 | None = None
    """Base pose relative to the plant when it was seen."""
    image_x_px: Pixels | None = None
    image_y_px: Pixels | None = None
    sigma_m: Sigma = 0.02
    """Standard deviation of the position, along each axis."""
    ripeness: Ratio | None = None
    """From its hue: 0 wholly green, 1 wholly red; None when only the colour's name is known."""


class Fruit(NewFruit):
    """One fruit of the inventory, with its identity and when it was first and last seen."""

    fruit_id: Identifier
    first_seen_s: GardenSeconds = 0.0
    last_seen_s: GardenSeconds = 0.0
    seen_count: Count = 0
    """Scans that saw it."""
    missed_count: Count = 0
    """Scans in a row that should have seen it and did not."""
    unreachable: Sentence = ""
    """Why no robot need try it until something has changed; empty: it may be picked."""
    failed: Sentence = ""
    """Why the last pick failed; the next scan that sees the fruit takes it away."""
    in_doubt: bool = False
    """A pick was permitted and nobody told how it ended: a scan decides."""


class Sighting(NewFruit):
    """One fruit as one scan saw it, lifted to the plant frame; the plant finds out which fruit it is."""

    views: Annotated[list[Annotated[int, Field(ge=0, lt=VIEWS_MAX)]], Field(max_length=VIEWS_MAX)] = []
    """Indices of the scan's views in which it was detected."""


class Direction(Document):
    """A unit vector."""

    x: Annotated[float, Field(ge=-1, le=1)]
    y: Annotated[float, Field(ge=-1, le=1)]
    z: Annotated[float, Field(ge=-1, le=1)]


class View(Document):
    """Where the camera was, plant frame, and what it could see: a pyramid of the two opening angles."""

    x_m: PlantMetres
    y_m: PlantMetres
    z_m: PlantMetres
    look: Direction
    """Optical axis."""
    up: Direction
    """Upwards in the image."""
    fov_x_rad: Angle
    """Whole opening angle across the image."""
    fov_y_rad: Angle
    range_m_min: Annotated[float, Field(ge=0, le=10)] = 0.05
    range_m_max: Annotated[float, Field(gt=0, le=10)] = 1.5
    """How far away a fruit is still detected."""


class Accuracy(Document):
    """How good the detector is, per view: its recall of visible fruit, its precision."""

    recall: Annotated[float, Field(gt=0, lt=1)] = 0.75
    precision: Annotated[float, Field(gt=0, lt=1)] = 0.90


class Scan(Document):
    """`POST /inventory/scans`: what one scan saw and from where. The same `scan_id` again changes nothing.

    `sightings` are associated by the plant. `fruits` are already known by their ids and are put in as told.
    """

    scan_id: Identifier
    task_id: Annotated[str, Field(max_length=80)] = ""
    """The inventory task it was taken for."""
    robot_id: Annotated[str, Field(max_length=80)] = ""
    views: Annotated[list[View], Field(max_length=VIEWS_MAX)] = []
    sightings: Annotated[list[Sighting], Field(max_length=FRUITS_MAX)] = []
    detector: Accuracy = Accuracy()
    fruits: Annotated[list[Fruit], Field(max_length=FRUITS_MAX)] = []

    @model_validator(mode="after")
    def _views_exist(self) -> Scan:
        if any(index >= len(self.views) for sighting in self.sightings for index in sighting.views):
            raise ValueError(f"a sighting names a view that is not among the {len(self.views)} given")
        return self


class Inventory(Document):
    """`GET /inventory`; its generation is the ETag."""

    plant_id: Identifier
    generation: int = 0
    scans: Count = 0
    """Scans merged so far."""
    scanned_s: GardenSeconds | None = None
    """When the newest was merged; None: never scanned."""
    fruits: list[Fruit] = []


class FruitCounts(Document):
    green: Count = 0
    turning: Count = 0
    red: Count = 0


class Pick(Document):
    """How one permitted pick, or the refusal to try, ended; part of a harvest's report."""

    fruit_id: Identifier
    outcome: Outcome
    reason: Sentence = ""
    permit_id: Annotated[str, Field(max_length=80)] = ""
    """Empty when no permit was taken: nothing was touched."""
    gone: bool = False
    """Of one that failed: the fruit came off and fell; it hangs there no longer."""
    took_s: Seconds = 0.0


class FruitForecast(Document):
    """One fruit as the plant expects it at the forecast's end."""

    fruit_id: Identifier
    colour: Colour
    ripeness: Ratio
    radius_m: Radius
    ripe_probability: Ratio
    """That it hangs there, red."""
    ripe_in_s: Seconds | None = None
    """Until it is expected to be red; 0: now. None: later than a month."""


class Forecast(Document):
    """`GET /forecast?ahead_s=`: ripe fruit some time from now, a day if not said."""

    plant_id: Identifier
    now_s: float
    ahead_s: Seconds
    scanned_s: GardenSeconds | None = None
    now: FruitCounts = FruitCounts()
    """Expected to hang there now."""
    then: FruitCounts = FruitCounts()
    """Expected then, if nobody picks."""
    ripe: Annotated[float, Field(ge=0)] = 0.0
    """Expected number of red fruit then."""
    ripe_min: Count = 0
    ripe_max: Count = 0
    """The number lies between them, both included, with this probability."""
    level: Ratio = 0.9
    uncertainty: Ratio = 1.0
    """Of the inventory: 0 just scanned, 1 nothing known."""
    turning_days: Annotated[float, Field(ge=0, le=100)] = 5.0
    """From the first tinge to red, as this plant has learnt it from its own fruit."""
    fruits: list[FruitForecast] = []


class PickBid(Document):
    """Who offered to pick it, at which cost; None: could not."""

    robot_id: Identifier
    cost_s: Seconds | None
    reason: Sentence = ""


class LedgerLine(Document):
    """`GET /ledger`: one pick that was permitted or refused, and everybody who had a part in it."""

    line_id: Identifier
    """The permit's id; of a fruit that nobody touched the task's id and the fruit's."""
    plant_id: Identifier
    fruit_id: Identifier
    colour: Colour
    radius_m: Radius
    x_m: PlantMetres
    y_m: PlantMetres
    z_m: PlantMetres
    task_id: Identifier
    order_id: Annotated[str, Field(max_length=80)] = ""
    asked_by: Annotated[str, Field(max_length=80)] = ""
    bids: list[PickBid] = []
    """Of the round that chose the robot."""
    robot_id: Identifier
    epoch: Count = 0
    permitted_s: GardenSeconds | None = None
    ended_s: GardenSeconds | None = None
    outcome: Literal["permitted", "picked", "failed", "unreachable", "in_doubt", "gone", "hanging"]
    """`permitted`: under way. `in_doubt`: nobody told; a scan then found it `gone` or still `hanging`."""
    reason: Sentence = ""
    before: Annotated[str, Field(max_length=200)] = ""
    """Path of the picture before the pick at this plant; empty: none."""
    after: Annotated[str, Field(max_length=200)] = ""
