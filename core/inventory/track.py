"""What a plant keeps of one fruit: the document everybody reads, and behind it the evidence that it rests on."""

from __future__ import annotations

import math

from core.growth.belief import Belief, Observation, Pace, believe
from core.wire.documents import Document
from core.wire.fruit import Count, Fruit, GardenSeconds, NewFruit, PlantMetres, Sighting, View

LOGIT_MAX = 5.0
"""No evidence makes a fruit more certain than 0.993: it may fall any time."""


class Place(Document):
    """A point in the plant frame."""

    x_m: PlantMetres
    y_m: PlantMetres
    z_m: PlantMetres

    @property
    def p(self) -> tuple[float, float, float]:
        return self.x_m, self.y_m, self.z_m


class Eye(Document):
    """From where it was looked for while it certainly hung there, and how often it was seen from there."""

    place: Place
    looks: Count = 0
    seen: Count = 0


class Evidence(Document):
    """What the plant's document says of a fruit rests on this; durable with it."""

    seen: list[Observation]
    """What scans said of its colour and size, oldest first."""
    eyes: list[Eye] = []
    marked_at: Place | None = None
    """Where it hung when a robot could not reach it."""
    marked_s: GardenSeconds = 0.0
    failures: Count = 0
    """Picks of it that failed, and when the last did."""
    failed_s: GardenSeconds = 0.0
    ripe_since_s: GardenSeconds | None = None
    """When it was first seen red, if it has been since."""
    blind_scans: Count = 0
    """Scans since its pick came into doubt that could not have seen it."""


class Track(Evidence):
    """One fruit with its evidence."""

    fruit: Fruit

    @classmethod
    def of(cls, fruit: Fruit, evidence: Evidence | None = None) -> Track:
        """Without `evidence`: a fruit that somebody only told of."""
        if evidence is not None:
            return cls.model_construct(fruit=fruit, **{name: getattr(evidence, name) for name in Evidence.model_fields})
        first = Observation(t_s=fruit.last_seen_s, colour=fruit.colour, radius_m=fruit.radius_m, ripeness=fruit.ripeness)
        since_s = fruit.last_seen_s if fruit.colour == "red" else None
        return cls(fruit=fruit, seen=[first], ripe_since_s=since_s)

    @property
    def p(self) -> tuple[float, float, float]:
        return self.fruit.x_m, self.fruit.y_m, self.fruit.z_m

    @property
    def evidence(self) -> Evidence:
        return Evidence.model_construct(**{name: getattr(self, name) for name in Evidence.model_fields})

    def belief(self, pace: Pace) -> Belief:
        return believe(self.seen, pace)

    def with_fruit(self, **changes: object) -> Track:
        return self.model_copy(update={"fruit": self.fruit.model_copy(update=changes)})


def point(seen: NewFruit | Sighting | View | Place) -> tuple[float, float, float]:
    """Its place in the plant frame [m]."""
    return seen.x_m, seen.y_m, seen.z_m


def logit(p: float) -> float:
    bound = 1.0 / (1.0 + math.exp(LOGIT_MAX))
    p = min(1.0 - bound, max(bound, p))
    return math.log(p / (1.0 - p))


def probability(log_odds: float) -> float:
    log_odds = min(LOGIT_MAX, max(-LOGIT_MAX, log_odds))
    return 1.0 / (1.0 + math.exp(-log_odds))
