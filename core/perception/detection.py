"""What every detector gives, and how it is judged.

A detector is a pure function of an image. Its fruit are matched with labelled boxes by one rule: a detection whose
centre lies inside a box has found it, and each box is found once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Image: TypeAlias = NDArray[np.uint8]
"""(H, W, 3), blue green red."""
Colour = Literal["green", "turning", "red"]
COLOURS: tuple[Colour, ...] = ("green", "turning", "red")


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """A fruit in an image: its circle [px, origin at the outer corner of the top left pixel], how ripe, how sure in 0..1."""

    u_px: float
    v_px: float
    radius_px: float
    colour: Colour
    confidence: float

    @property
    def features(self) -> NDArray[np.float64]:
        """The circle as (u, v, r) [px]."""
        return np.array([self.u_px, self.v_px, self.radius_px])


Detector = Callable[[Image], list[Detection]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A labelled fruit [px]. A `difficult` one may be found or not: it is not counted. `ambiguous`: its colour is unsure."""

    x_px: float
    y_px: float
    width_px: float
    height_px: float
    label: Colour
    difficult: bool = False
    ambiguous: bool = False

    def holds(self, u_px: float, v_px: float) -> bool:
        """Whether the point lies inside."""
        return 0 <= u_px - self.x_px <= self.width_px and 0 <= v_px - self.y_px <= self.height_px

    def off_centre(self, u_px: float, v_px: float) -> float:
        """Distance from the centre in half sizes: 1 at the middle of a side."""
        across = (u_px - self.x_px - self.width_px / 2) / max(self.width_px / 2, 1e-9)
        down = (v_px - self.y_px - self.height_px / 2) / max(self.height_px / 2, 1e-9)
        return math.hypot(across, down)


@dataclass(frozen=True, slots=True)
class Counts:
    """Boxes found, detections with no fruit under them, boxes not found."""

    found: int = 0
    false: int = 0
    missed: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.found + other.found, self.false + other.false, self.missed + other.missed)

    @property
    def precision(self) -> float:
        """Share of the detections that are fruit; NaN when there were none."""
        return _share(self.found, self.found + self.false)

    @property
    def recall(self) -> float:
        """Share of the fruit that were found; NaN when there were none."""
        return _share(self.found, self.found + self.missed)

    @property
    def f1(self) -> float:
        """Harmonic mean of both; NaN when there was neither fruit nor detection."""
        return _share(2 * self.found, 2 * self.found + self.false + self.missed)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


@dataclass(frozen=True, slots=True)
class Match:
    """The outcome of one detection: the index of the box it found, or of a box that is not counted, or neither."""

    box: int | None
    ignored: bool = False


def match(detections: Sequence[Detection], boxes: Sequence[Box], ignored: Sequence[bool]) -> list[Match]:
    """Each detection's outcome, in the given order.

    The surest detection chooses first, among the counted boxes around its centre that are still free, the one it is most
    central in. One that finds none is false, unless a box that is not counted (`ignored`, one flag a box) holds it.
    """
    free = {index for index, skip in enumerate(ignored) if not skip}
    outcome = [Match(None)] * len(detections)
    for index in sorted(range(len(detections)), key=lambda i: -detections[i].confidence):
        u_px, v_px = detections[index].u_px, detections[index].v_px
        held = [k for k, box in enumerate(boxes) if box.holds(u_px, v_px)]
        if mine := [k for k in held if k in free]:
            best = min(mine, key=lambda k: boxes[k].off_centre(u_px, v_px))
            free.remove(best)
            outcome[index] = Match(best)
        elif skipped := [k for k in held if ignored[k]]:
            outcome[index] = Match(skipped[0], ignored=True)
    return outcome


def score(detections: Sequence[Detection], boxes: Sequence[Box], colour: Colour | None) -> Counts:
    """Counts for one image.

    For a colour: its detections against its boxes; for red and for green, `turning` boxes are not counted either way.
    For None ("red+green"): every detection against every box, whatever the colours. `difficult` boxes are never counted.
    """
    if colour is None:
        mine, ignored = list(detections), [box.difficult for box in boxes]
        ours = list(boxes)
    else:
        mine = [d for d in detections if d.colour == colour]
        ours = [box for box in boxes if box.difficult or box.label in (colour, "turning")]
        ignored = [box.difficult or box.label != colour for box in ours]
    outcomes = match(mine, ours, ignored)
    found = sum(o.box is not None and not o.ignored for o in outcomes)
    return Counts(found, sum(o.box is None for o in outcomes), ignored.count(False) - found)


def total(counts: Iterable[Counts]) -> Counts:
    """All images together."""
    return sum(counts, Counts())
