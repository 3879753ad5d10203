"""The paper's filter detector: each filter a map of its own, combined with weights (paper 000, section 4.2, figure 8).

White balance first, so that a purple lamp does not paint the plant. Then Algorithm 1's filters: smoothness (Sobel), red and
green colour planes, blobs between a least and a largest area, Hough circles, spectral highlights. Where the circles and the
colour agree a fruit may be; the weighted sum of what every filter says there decides. The gains of the paper were tuned by
hand; these are fitted by `garden train filter` from labelled images (`filters.json`).
"""

from __future__ import annotations

import functools
import importlib.resources
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from core.perception import filter_kernels as kernels
from core.perception.detection import Colour, Detection, Detector, Image

Floats: TypeAlias = NDArray[np.float32]

WEIGHTS = "filters.json"
LONG_SIDE_PX = 400
"""Images are brought to this size first."""
BINS = 32
"""Of each channel in the colour table."""
BRIGHTNESS = 0.42
"""What the balanced image's generalised mean is brought to, 1 being white."""
BALANCED_EVERY_PX = 6
GAIN_RANGE = (0.4, 4.0)
BGR_LUMA = (0.114, 0.587, 0.299)
SOBEL_SOFT = 0.35
"""Brightness step over a Sobel window at which smoothness has fallen to 1/e."""
BLOB_FROM = 0.35
"""Colour times smoothness above which a pixel belongs to a blob."""
AREA_MIN, AREA_MAX = 2e-4, 0.25
"""Of a blob, as shares of the image."""
HIGHLIGHT_STEP = 0.10
"""A highlight is this much brighter than its surroundings."""
STEEP = 0.10
"""Least slope of a vote's pixel."""
RADII_PX = (4, 8)
"""Of the circles voted for at each pyramid level; a level has half the size of the one before."""
LEVELS = 5
SPOKES = np.array([(math.cos(math.tau * k / 16), math.sin(math.tau * k / 16)) for k in range(16)], np.float32)
"""Directions in which an outline is looked for."""
AREA_SCALE = 0.55
"""Pictures that shrink further are averaged over areas, others are interpolated."""
VOTE_MIN = 0.30
"""Circle votes plus colour at a centre below which it is not looked at."""
MIDDLE = 0.6
"""Of a fruit's radius: so far from its centre it is asked for its tint."""
CANDIDATES_MAX = 50
"""A pyramid level and colour."""

FAMILIES: tuple[Colour, Colour] = ("red", "green")
MAPS = ("red", "green", "brightness", "whiteness", "smooth", "highlight", "area_red", "area_green")
FEATURES = (
    "colour_rim",
    "colour_middle",
    "colour_around",
    "colour_further",
    "other_colour",
    "smooth",
    "smooth_around",
    "area",
    "circle",
    "edge_seen",
    "edge_step",
    "highlight",
    "brightness",
    "brighter_than_around",
    "whiteness",
    "log_radius",
)
"""What the filters say of a candidate, in the order of the weights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """What `garden train filter` fits."""

    balance_norm: float
    """Of the generalised mean that is made grey: 1 is the mean, large ones look at the brightest."""
    colour: NDArray[np.float64]
    """(2, len(colour_terms)): log odds of red and of green fruit against everything else."""
    candidate: NDArray[np.float64]
    """(2, 1 + terms): a family's bias and gains over `terms` of the normalised features."""
    centre: NDArray[np.float64]
    """(2, FEATURES): features' means."""
    spread: NDArray[np.float64]
    """(2, FEATURES): features' deviations."""
    ripe: NDArray[np.float64]
    """(3,): log odds of red against turning: bias, and gains of log red/green and log blue/green in the fruit's middle."""
    sure: NDArray[np.float64]
    """(2,): the confidence from which a candidate of the family is a fruit."""
    apart: float
    """Of the larger radius: nearer centres are one fruit."""

    def document(self) -> dict[str, Any]:
        """As JSON, rounded."""
        return {name: np.round(getattr(self, name), 5).tolist() for name in Weights.__slots__}

    @classmethod
    def of(cls, document: dict[str, Any]) -> Weights:
        """From JSON; raises KeyError when a part is missing."""
        arrays = {name: np.array(document[name], float) for name in cls.__slots__ if name not in ("balance_norm", "apart")}
        return cls(balance_norm=float(document["balance_norm"]), apart=float(document["apart"]), **arrays)


@dataclass(frozen=True, slots=True)
class Candidates:
    """Places where a fruit may be: circles (n, 3) [px of the full image], what the filters say (n, FEATURES)."""

    family: int
    circles: Floats
    features: Floats


def filter_detector() -> Detector:
    """The detector with its packaged weights; raises FileNotFoundError without them."""
    return with_weights(packaged())


@functools.cache
def packaged() -> Weights:
    """The weights beside this file."""
    return Weights.of(json.loads(importlib.resources.files("core.perception").joinpath(WEIGHTS).read_text()))


def with_weights(weights: Weights) -> Detector:
    """A detector by its weights."""
    table = colour_table(weights.colour)
    return lambda image: detect(image, weights, table)


def detect(image: Image, weights: Weights, table: Floats) -> list[Detection]:
    """Fruit in an image (H, W, 3) BGR uint8 of any size, the surest first. `table` is `colour_table(weights.colour)`."""
    seen = Seen(image, weights.balance_norm, table)
    circles, families, confidence = _judged(list(seen.candidates()), weights)
    order = np.argsort(-confidence)
    kept = order[kernels.distinct(circles[order], weights.apart)]
    return _detections(seen, circles[kept], families[kept], confidence[kept], weights)


def stages(image: Image) -> dict[str, Image | Floats]:
    """Everything on the way to `filter_detector`'s answer, at the working size: the balanced image (h, w, 3) uint8, then
    each filter's map (h, w), 0..1, each colour's circle votes, and the weighted sum, drawn where it was asked."""
    weights = packaged()
    seen = Seen(image, weights.balance_norm, colour_table(weights.colour))
    pictures: dict[str, Image | Floats] = {"balanced": np.clip(seen.image * seen.gains, 0, 255).astype(np.uint8)}
    looked_at = ("smooth", "red", "green", "highlight", "area_red", "area_green")
    pictures |= {name: seen.maps[MAPS.index(name)] for name in looked_at}
    _, votes = circle_votes(seen.maps)
    for k, name in enumerate(FAMILIES):
        pictures[f"circles_{name}"] = np.minimum(votes[k], 1)
        pictures[f"combined_{name}"] = np.zeros(seen.image.shape[:2], np.float32)
    for each in seen.candidates():
        drawn_on = f"combined_{FAMILIES[each.family]}"
        confidence = confidence_of(each, weights)
        for k in np.argsort(confidence):
            u, v, radius = (round(float(value)) for value in each.circles[k] * seen.scale)
            drawn = cv2.circle(np.zeros_like(pictures[drawn_on]), (u, v), max(radius, 1), float(confidence[k]), -1)
            pictures[drawn_on] = np.maximum(pictures[drawn_on], np.asarray(drawn, np.float32))
    return pictures


def warm() -> None:
    """Compile the kernels into numba's cache, so that nobody's first picture waits for them."""
    seen = Seen(np.full((240, 320, 3), 90, np.uint8), 1.0, np.zeros((BINS**3, 2), np.float32))
    found = list(seen.candidates())
    kernels.distinct(np.concatenate([each.circles for each in found]), 1.0)


def _judged(candidates: list[Candidates], weights: Weights) -> tuple[Floats, NDArray[np.int64], NDArray[np.float64]]:
    """Circles, families and confidences of the candidates that are sure enough."""
    circles, families, confidences = [np.zeros((0, 3), np.float32)], [np.zeros(0, np.int64)], [np.zeros(0)]
    for family in range(len(FAMILIES)):
        each = together(candidates, family)
        confidence = confidence_of(each, weights)
        sure = confidence >= weights.sure[each.family]
        circles.append(each.circles[sure])
        families.append(np.full(int(sure.sum()), each.family))
        confidences.append(confidence[sure])
    return np.concatenate(circles), np.concatenate(families), np.concatenate(confidences)


def together(candidates: list[Candidates], family: int) -> Candidates:
    """A family's candidates of all sizes."""
    mine = [each for each in candidates if each.family == family]
    circles, features = np.concatenate([each.circles for each in mine]), np.concatenate([each.features for each in mine])
    return Candidates(family, circles, features)


def confidence_of(candidates: Candidates, weights: Weights) -> NDArray[np.float64]:
    """The collective estimate (n,): a logistic function of the weighted sum of what the filters say (`terms`, summed as a
    quadratic form)."""
    k = candidates.family
    x = _within_reason((candidates.features - weights.centre[k]) / weights.spread[k])
    bias, gains, count = weights.candidate[k, 0], weights.candidate[k, 1:], x.shape[1]
    in_pairs = np.zeros((count, count))
    in_pairs[_pairs(count)] = gains[count:]
    return _logistic(bias + x @ gains[:count] + np.einsum("ij,ij->i", x @ in_pairs, x))


def terms(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalised features (n, f) and their products in pairs (n, f + f (f + 1) / 2), within reason."""
    x = _within_reason(x)
    a, b = _pairs(x.shape[1])
    return np.concatenate([x, x[:, a] * x[:, b]], axis=1)


def _within_reason(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.clip(x, -4, 4)


@functools.cache
def _pairs(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.triu_indices(count)


def _logistic(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -30, 30))), float)


def _detections(
    seen: Seen, circles: Floats, families: NDArray[np.int64], confidences: NDArray[np.float64], weights: Weights
) -> list[Detection]:
    ripe = weights.ripe[0] + seen.tints(circles) @ weights.ripe[1:] >= 0
    reds: tuple[Colour, Colour] = ("turning", "red")
    colours = [
        reds[int(is_ripe)] if family == 0 else FAMILIES[family] for family, is_ripe in zip(families, ripe, strict=True)
    ]
    return [
        Detection(u_px=u, v_px=v, radius_px=radius, colour=colour, confidence=confidence)
        for (u, v, radius), colour, confidence in zip(circles.tolist(), colours, confidences.tolist(), strict=True)
    ]


def colour_terms(bgr: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """What the colour planes look at in colours (n, 3), balanced, 0..1: all products up to the third degree (n, 20)."""
    b, g, r = (np.log(np.asarray(bgr[:, k], float) + 0.06) for k in range(3))
    x = np.stack([(b + g + r) / 3 + 1.2, r - g, b - g], axis=1)
    parts = [np.ones(len(x))]
    for i in range(4):
        for j in range(4 - i):
            parts += [x[:, 0] ** i * x[:, 1] ** j * x[:, 2] ** k for k in range(4 - i - j) if i + j + k]
    return np.stack(parts, axis=1)


def colour_table(colour: NDArray[np.float64]) -> Floats:
    """How likely each colour is red and green fruit (BINS^3, 2); the bins' order is blue, green, red."""
    axis = (np.arange(BINS) + 0.5) / BINS
    bgr = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    odds = np.clip(colour_terms(bgr) @ colour.T, -20, 20)
    total = 1 + np.exp(odds).sum(axis=1, keepdims=True)
    return np.ascontiguousarray((np.exp(odds) / total).astype(np.float32))


def gains_of(image: Image, norm: float) -> NDArray[np.float64]:
    """Factors (3,) that make the image's generalised mean grey (shades of grey: Finlayson and Trezzi 2004)."""
    powers = (np.arange(256) / 255) ** norm
    mean = np.maximum(kernels.means(image, BALANCED_EVERY_PX, powers) ** (1 / norm), 1e-3)
    level = BRIGHTNESS + 0.15 * (1 - 1 / norm)
    return np.asarray(np.clip(level / mean, *GAIN_RANGE), float)


class Seen:
    """One image through the filters."""

    def __init__(self, image: Image, balance_norm: float, table: Floats) -> None:
        self.scale = LONG_SIDE_PX / max(image.shape[:2])
        size = (max(round(image.shape[1] * self.scale), 16), max(round(image.shape[0] * self.scale), 16))
        how = cv2.INTER_AREA if self.scale < AREA_SCALE else cv2.INTER_LINEAR
        self.image = np.asarray(cv2.resize(image, size, interpolation=how), np.uint8)
        self.gains = gains_of(self.image, balance_norm)
        values = np.clip(np.arange(256)[None] / 255 * self.gains[:, None], 0, 1)
        bins = np.minimum(values * BINS, BINS - 1).astype(np.int32)
        luma = (values * np.array(BGR_LUMA)[:, None]).astype(np.float32)
        self.maps: Floats = np.empty((len(MAPS), *self.image.shape[:2]), np.float32)
        """(MAPS, h, w)"""
        red, green, brightness, whiteness, smooth, highlight, area_red, area_green = self.maps
        kernels.planes(self.image, bins, luma, table, _SHARES, self.maps)
        smoothness(brightness, smooth)
        highlights(brightness, whiteness, highlight)
        areas(red, smooth, area_red)
        areas(green, smooth, area_green)

    def candidates(self) -> Iterator[Candidates]:
        """Where circles and colour agree, for each size and colour."""
        maps, zoom = self.maps, 1.0
        for _ in range(LEVELS):
            sources, votes = circle_votes(maps)
            for family in range(len(FAMILIES)):
                yield self._level(maps, sources[family], votes[family], family, zoom)
            if min(maps.shape[1:]) < 4 * RADII_PX[1]:
                break
            maps, zoom = kernels.halve(maps), zoom * 2

    def _level(self, maps: Floats, source: Floats, votes: Floats, family: int, zoom: float) -> Candidates:
        points = kernels.tops(votes, VOTE_MIN, CANDIDATES_MAX)
        found = np.empty((len(points), len(FEATURES)), np.float32)
        kernels.describe(maps, source, votes, points, family, (RADII_PX[0] * 0.8, RADII_PX[1] * 1.3), SPOKES, found)
        radius = found[:, -1] * zoom
        found[:, -1] = np.log(radius)
        circles = np.column_stack([(points + 0.5) * zoom, radius]) / self.scale
        return Candidates(family, circles.astype(np.float32), found)

    def tints(self, circles: Floats) -> NDArray[np.float64]:
        """Log of red over green and of blue over green (n, 2) in the middles of circles (n, 3), balanced."""
        b, g, r = (
            kernels.tints(self.image, self.maps[0], circles * np.float32(self.scale), MIDDLE) / 255 * self.gains + 0.02
        ).T
        return np.asarray(np.log(np.stack([r / g, b / g], axis=1)), float)


def smoothness(brightness: Floats, out: Floats) -> None:
    """1 where brightness does not change, towards 0 at edges and veins (Sobel); both (h, w)."""
    gx = cv2.Sobel(brightness, cv2.CV_32F, 1, 0)
    gy = cv2.Sobel(brightness, cv2.CV_32F, 0, 1)
    cv2.magnitude(gx, gy, magnitude=out)
    out *= np.float32(-1 / SOBEL_SOFT)
    cv2.exp(out, dst=out)


def highlights(brightness: Floats, whiteness: Floats, out: Floats) -> None:
    """1 on small white spots: brighter than all around by a step, and colourless; all (h, w)."""
    height, width = brightness.shape
    small = cv2.resize(brightness, (max(width // 4, 1), max(height // 4, 1)), interpolation=cv2.INTER_AREA)
    around = cv2.resize(cv2.blur(small, (7, 7)), (width, height), interpolation=cv2.INTER_LINEAR)
    step = np.empty_like(brightness)
    kernels.rise(brightness, np.asarray(around, np.float32), whiteness, HIGHLIGHT_STEP, step)
    cv2.dilate(step, _NEAR, dst=out)


_NEAR = np.ones((3, 3), np.uint8)
_SHARES = (np.arange(BINS)[:, None] / np.maximum(np.arange(BINS), 1)).astype(np.float32)


def areas(plane: Floats, smooth: Floats, out: Floats) -> None:
    """1 on blobs of smooth fruit colour whose area lies between the least and the largest; all (h, w)."""
    height, width = plane.shape
    small = np.empty((height // 2, width // 2), np.uint8)
    kernels.blobs(plane, smooth, BLOB_FROM, small)
    count, labels = cv2.connectedComponents(small, connectivity=4)
    wanted = np.empty(small.shape, np.float32)
    kernels.of_area(np.asarray(labels, np.int32), count, AREA_MIN, AREA_MAX, wanted)
    cv2.resize(wanted, (width, height), dst=out, interpolation=cv2.INTER_LINEAR)


def circle_votes(maps: Floats) -> tuple[Floats, Floats]:
    """Of each family the plane whose discs are looked for (colour, brighter in the middle), and the votes for their centres;
    both (2, h, w)."""
    shape = (len(FAMILIES), *maps.shape[1:])
    sources, votes = np.empty(shape, np.float32), np.empty(shape, np.float32)
    cast = np.empty(shape[1:], np.float32)
    for colour, source, vote in zip(maps, sources, votes, strict=False):
        kernels.bright_colour(colour, maps[kernels.BRIGHTNESS], source)
        kernels.vote(source, STEEP, *RADII_PX, cast)
        kernels.agreement(cast, colour, vote)
    return sources, votes
