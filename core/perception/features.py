"""The paper's feature detector: patches that vote for the centre of a fruit (paper 000, section 4.1, figures 6 and 7).

After Torralba, Murphy and Freeman, Sharing features (2004): a feature is a small patch of a training fruit and where it lay
relative to the fruit's centre. Its normalised cross-correlation with the image, blurred by a centroid mask and moved by
that offset, is high where a fruit's centre may be. Gentle boosting over regression stumps chose the forty strongest of many
random patches; their sum is the vote map, looked at in fifteen scales. Patches are of brightness and its derivatives, not of
colour: red and green fruit are treated alike, and only the answer's `colour` is looked up afterwards.

The paper took 16 s a frame. Here the strongest features are computed everywhere, the rest only where those have not given
up (a cascade), one pyramid of planes serves all. `garden train features` writes `features.npz`.
"""

from __future__ import annotations

import functools
import importlib.resources
import io
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from core.perception import feature_kernels as kernels
from core.perception import filter_kernels
from core.perception.detection import COLOURS, Detection, Detector, Image

Floats: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int32]

WEIGHTS = "features.npz"
VERSION = 2
LONG_SIDE_PX = 400
"""Of the finest level of the pyramid."""
RADIUS_PX = 6.0
"""Of the fruit that a level looks for, in its own pixels."""
SCALES = 15
SCALE_STEP = 1.19
"""Each level is so many times smaller than the one before: fruit of 1.5 to 17 % of the image's longer side in radius."""
BORDER_PX = 22
"""Levels are continued by so much, that fruit at the image's edge are seen: at least offset + half a patch + mask."""
PLANES = ("grey", "right", "down", "vivid", "edge")
"""The same whichever way the image's channels are exchanged: they see how coloured a fruit is, never which colour."""
SIZES = (5, 9, 13)
"""Sides of patches [px of a level]."""
ALL_WINDOWS = frozenset((plane, which) for plane in range(len(PLANES)) for which in range(len(SIZES)))
PATCH_SHAPE = (max(SIZES), kernels.WIDE)
NOISE = 0.012
"""Contrast below which a window counts as flat: added to its deviation before normalising."""
MASK_REACH = 1
MASK_SPREAD_PX = 0.8
"""The centroid mask is a Gaussian of this deviation, cut off at MASK_REACH."""
KERNEL_FROM = 11
"""From this size on OpenCV would correlate by Fourier transforms, which takes longer than our own kernel."""
BINS = 64
"""A feature's values -1..1 fall into so many; the stumps on it add up to a table over them."""
DENSE = 8
"""The strongest features, computed at every pixel."""
CANDIDATES_MAX = 60
"""A level."""
VOTES_SOFT = 1.5
"""Margins of pictured vote maps, in these steps, go through a logistic function."""
APART = 0.8
"""Of the larger radius: nearer centres are one fruit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """What `garden train features` learns. The strongest feature comes first."""

    features: Ints
    """(k, 5): plane, size index, size, and where the patch lies right and down of the centre [px of a level]."""
    patches: Floats
    """(k, *PATCH_SHAPE): zero mean, unit norm, in the first size x size."""
    tables: Floats
    """(k, BINS): what a feature adds to the margin: the sum of its stumps."""
    floors: Floats
    """(k,): after a feature, a margin below this gives the place up."""
    margin_min: Floats
    """(1,): a fruit from here on."""
    slope: Floats
    """(2,): the log odds of a fruit are slope[0] + slope[1] margin."""
    colour: Floats
    """(3, 6): odds of green, turning, red over `tint_terms`."""

    @property
    def windows(self) -> frozenset[tuple[int, int]]:
        """Planes and size indices of its patches."""
        return frozenset((int(plane), int(which)) for plane, which in self.features[:, :2])

    def to_bytes(self) -> bytes:
        """As an npz file."""
        out = io.BytesIO()
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        np.savez_compressed(out, version=np.array([VERSION]), **arrays)
        return out.getvalue()

    @classmethod
    def of(cls, npz: bytes) -> Model:
        """From an npz file; raises ValueError when it is of another version."""
        with np.load(io.BytesIO(npz)) as read:
            if int(read["version"][0]) != VERSION:
                raise ValueError(f"features of version {int(read['version'][0])}, not {VERSION}: garden train features")
            return cls(**{field.name: read[field.name] for field in fields(cls)})


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """One scale of the pyramid."""

    zoom: float
    """Image pixels in one of the level's."""
    shape: tuple[int, int]
    """Without the border."""
    planes: Floats
    """(PLANES, h, w) with the border."""
    weights: Floats
    """(PLANES, SIZES, h, w): 1 over the norm of the window around each pixel."""

    def circles(self, points: Ints) -> Floats:
        """Points (n, 2: x, y) with the border -> circles (n, 3: u, v, radius) [px of the image]."""
        centres = (points - BORDER_PX + 0.5) * self.zoom
        return np.column_stack([centres, np.full(len(points), RADIUS_PX * self.zoom)]).astype(np.float32)


def features_detector() -> Detector:
    """The detector with its packaged weights; raises FileNotFoundError without them."""
    return with_model(packaged())


@functools.cache
def packaged() -> Model:
    """The weights beside this file."""
    return Model.of(importlib.resources.files("core.perception").joinpath(WEIGHTS).read_bytes())


def with_model(model: Model) -> Detector:
    """A detector by its weights. It keeps no state between images."""
    return lambda image: detect(image, model)


def detect(image: Image, model: Model) -> list[Detection]:
    """Fruit in an image (H, W, 3) BGR uint8 of any size, the surest first."""
    circles, margins = found(image, model)
    balanced = image_gains(image)
    return [
        Detection(
            u_px=float(u),
            v_px=float(v),
            radius_px=float(radius),
            colour=COLOURS[int(np.argmax(model.colour @ tint_terms(tint(image, balanced, u, v, radius))))],
            confidence=float(1 / (1 + np.exp(-(model.slope[0] + model.slope[1] * margin)))),
        )
        for (u, v, radius), margin in zip(circles.tolist(), margins.tolist(), strict=True)
    ]


def found(image: Image, model: Model) -> tuple[Floats, Floats]:
    """Circles (n, 3: u, v, radius) [px] and their margins (n,), the surest first, one a fruit."""
    circles, margins = [np.zeros((0, 3), np.float32)], [np.zeros(0, np.float32)]
    for level in levels(image, model.windows):
        points, each = candidates(level, model)
        circles.append(level.circles(points))
        margins.append(each)
    together, margin = np.concatenate(circles), np.concatenate(margins)
    order = np.argsort(-margin, kind="stable")
    together, margin = together[order], margin[order]
    kept = filter_kernels.distinct(together, APART)
    return together[kept], margin[kept]


def stages(image: Image) -> dict[str, Image | Floats]:
    """What `garden see --stages` shows: the planes and the vote map of every third level (0..1, softened)."""
    model = packaged()
    pictures: dict[str, Image | Floats] = {}
    for k, level in enumerate(levels(image, model.windows)):
        inner = (slice(BORDER_PX, -BORDER_PX),) * 2
        if k == 0:
            pictures |= {name: _stretched(plane[inner]) for name, plane in zip(PLANES, level.planes, strict=True)}
        if k % 3 == 0:
            votes = vote_map(level, model, len(model.features))[inner]
            soft = np.asarray(1 / (1 + np.exp(-votes / VOTES_SOFT)), np.float32)
            size = (round(level.shape[1] * level.zoom), round(level.shape[0] * level.zoom))
            name = f"votes_radius_{RADIUS_PX * level.zoom:.0f}px"
            pictures[name] = np.asarray(cv2.resize(soft, size, interpolation=cv2.INTER_NEAREST), np.float32)
    return pictures


def _stretched(plane: Floats) -> Floats:
    low, high = np.percentile(plane, (1, 99))
    return np.asarray(np.clip((plane - low) / max(high - low, 1e-6), 0, 1), np.float32)


def warm() -> None:
    """Compile the kernels into numba's cache, so that nobody's first picture waits for them."""
    found(np.full((48, 64, 3), 90, np.uint8), replace(packaged(), floors=np.full(len(packaged().floors), -1e6, np.float32)))


def levels(image: Image, windows: frozenset[tuple[int, int]] = ALL_WINDOWS) -> Iterator[Level]:
    """The pyramid, the finest level (the smallest fruit) first. `windows`: plane and size index of the norms needed."""
    height, width = image.shape[:2]
    base: Floats | None = None
    for k in range(SCALES):
        scale = LONG_SIDE_PX / max(height, width) / SCALE_STEP**k
        size = (max(round(width * scale), 1), max(round(height * scale), 1))
        source = image if base is None else base
        how = cv2.INTER_AREA if size[0] < source.shape[1] else cv2.INTER_LINEAR
        small = np.asarray(cv2.resize(source, size, interpolation=how), np.float32)
        if base is None:
            small /= 255
            base = small
        planes = planes_of(small)
        yield Level(zoom=1 / scale, shape=(size[1], size[0]), planes=planes, weights=norms_of(planes, windows))


def planes_of(bgr: Floats) -> Floats:
    """An image (h, w, 3) 0..1 -> PLANES (5, h + border, w + border).

    The channels' mean, smoothed a little; its slopes right and down; the most less the least channel; the length of the
    steepest channel's slope.
    """
    smooth = cv2.GaussianBlur(cv2.copyMakeBorder(bgr, *(BORDER_PX,) * 4, cv2.BORDER_REPLICATE), (3, 3), 0.7)
    out = np.empty((len(PLANES), *smooth.shape[:2]), np.float32)
    blue, green, red = (np.asarray(channel, np.float32) for channel in cv2.split(smooth))
    kernels.slopes(blue, green, red, out)
    return out


def norms_of(planes: Floats, windows: frozenset[tuple[int, int]] = ALL_WINDOWS) -> Floats:
    """1 over the norm of each window's pixels less their mean (PLANES, SIZES, h, w), noise added; others are not set."""
    out = np.empty((len(planes), len(SIZES), *planes.shape[1:]), np.float32)
    squares = {plane: planes[plane] ** 2 for plane, _ in windows}
    for plane, which in windows:
        size = SIZES[which]
        mean = cv2.boxFilter(planes[plane], cv2.CV_32F, (size, size))
        square = cv2.boxFilter(squares[plane], cv2.CV_32F, (size, size))
        kernels.normalise(mean, square, size, NOISE, out[plane, which])
    return out


def mask() -> Floats:
    """The centroid mask in one direction (2 MASK_REACH + 1,), summing to 1."""
    steps = np.arange(-MASK_REACH, MASK_REACH + 1)
    bell = np.exp(-(steps**2) / (2 * MASK_SPREAD_PX**2))
    return np.asarray(bell / bell.sum(), np.float32)


def votes_of(level: Level, feature: Ints, patch: Floats) -> Floats:
    """One feature's correlation map, blurred by the centroid mask but not yet moved to the centre (h, w) with the border."""
    plane, which, size = (int(value) for value in feature[:3])
    source, weight, cut = level.planes[plane], level.weights[plane, which], np.ascontiguousarray(patch[:size, :size])
    if size < KERNEL_FROM:
        out = np.asarray(cv2.filter2D(source, cv2.CV_32F, cut), np.float32) * weight
    else:
        out = np.empty_like(source)
        kernels.correlated(source, weight, cut, out)
    return np.asarray(cv2.sepFilter2D(out, cv2.CV_32F, mask(), mask(), borderType=cv2.BORDER_CONSTANT), np.float32)


def vote_map(level: Level, model: Model, count: int) -> Floats:
    """The margin (h, w) with the border after the first `count` features, everywhere."""
    total: Floats = np.zeros(level.planes.shape[1:], np.float32)
    for feature, patch, table in zip(model.features[:count], model.patches, model.tables, strict=False):
        kernels.look_up(votes_of(level, feature, patch), int(feature[3]), int(feature[4]), table, total)
    return total


def candidates(level: Level, model: Model) -> tuple[Ints, Floats]:
    """Points (n, 2: x, y) with the border whose margin (n,) is large enough, each the best of its neighbours."""
    votes = vote_map(level, model, DENSE)
    peaks = (votes >= model.floors[DENSE - 1]) & (votes >= cv2.dilate(votes, np.ones((3, 3), np.uint8)))
    inner = peaks[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    ys, xs = np.nonzero(inner)
    points = np.column_stack([xs, ys]).astype(np.int32) + BORDER_PX
    margins = votes[points[:, 1], points[:, 0]]
    strongest = np.argsort(-margins, kind="stable")[:CANDIDATES_MAX]
    points, margins = np.ascontiguousarray(points[strongest]), np.ascontiguousarray(margins[strongest])
    kernels.cascade(
        level.planes,
        level.weights,
        points,
        model.features,
        model.patches,
        mask(),
        model.tables,
        model.floors,
        DENSE,
        margins,
    )
    sure = margins >= model.margin_min[0]
    return points[sure], margins[sure]


# Colour, asked last and of the answer only.


def image_gains(image: Image) -> NDArray[np.float64]:
    """Factors (3,) that make the image's mean grey (Buchsbaum 1980)."""
    mean = np.maximum(image[::4, ::4].reshape(-1, 3).mean(axis=0), 1.0)
    return np.asarray(mean.mean() / mean, float)


def tint(image: Image, gains: NDArray[np.float64], u: float, v: float, radius: float) -> NDArray[np.float64]:
    """Median log of red over green and of blue over green (2,) in the middle of a circle, balanced."""
    half = max(radius * 0.5, 1.0)
    height, width = image.shape[:2]
    rows = slice(int(np.clip(v - half, 0, height - 1)), int(np.clip(v + half + 1, 1, height)))
    columns = slice(int(np.clip(u - half, 0, width - 1)), int(np.clip(u + half + 1, 1, width)))
    b, g, r = (np.log(image[rows, columns, k] * gains[k] + 4.0) for k in range(3))
    return np.array([np.median(r - g), np.median(b - g)])


def tint_terms(seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the colour's odds are linear in (6,)."""
    x, y = np.clip(seen, -2, 2)
    return np.array([1.0, x, y, x * x, x * y, y * y])
