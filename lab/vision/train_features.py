"""`garden train features`: the feature detector's patches, learnt from labelled images by gentle boosting.

After Torralba, Murphy and Freeman, Sharing features (2004), and paper 000, section 4.1: random patches cut from fruit, each
with its place; stumps on what they say at fruit centres and elsewhere; the forty that boosting takes first. What a first
detector wrongly finds is then learnt from as background. A part of the training groups is kept from boosting and decides the
margin to ask for. Everything random comes from the seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import minimize

import core.perception
from core.errors import ConfigError
from core.perception import feature_kernels, features, filter_kernels
from core.perception.detection import COLOURS, Box, Detection, Image, match
from core.perception.features import Level, Model
from lab.vision import dataset
from lab.vision.evaluate import evaluate

Floats: TypeAlias = NDArray[np.float32]
Bytes: TypeAlias = NDArray[np.uint8]
Ints: TypeAlias = NDArray[np.int32]
Tell = Callable[[str], None]

DICTIONARY = 800
"""Random patches to choose from."""
STRONGEST = 40
STUMPS = 200
"""Altogether: after the forty patches are chosen, boosting goes on with those alone."""
SHRINK = 0.5
"""Of each stump: many small steps overfit less (Friedman 2001)."""
SPREAD = 9
"""Patches lie this near the fruit's centre [px of a level]."""
RANDOM_NEGATIVES = 15
MINED = (25, 25)
"""Background learnt from, of an image: drawn anywhere at first, then what the last detector found wrongly, at most."""
KEPT_SHARE = 0.2
"""Of the training groups, to decide the margin."""
CENTRAL, CENTRAL_MAX = 0.35, 0.75
"""In half sizes from a box's centre: within the first it is the fruit, beyond the second it is background."""
RATIO, RATIO_MAX = 1.25, 1.8
"""Of radii: likewise."""
FLOOR_SHARE = 0.01
"""Of the fruit that would be found at last, how many a step of the cascade may give up."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A labelled image."""

    source: str
    group: str
    boxes: tuple[Box, ...]
    image: Image


@dataclass(frozen=True, slots=True)
class Dictionary:
    """Random patches: as in `Model`."""

    features: Ints
    patches: Floats


@dataclass(frozen=True, slots=True)
class Samples:
    """Places learnt from: what each patch says there (n, k) as a bin, fruit (+1) or not (-1) (n,), the image's source."""

    bins: Bytes
    target: Floats
    source: NDArray[np.str_]

    def __add__(self, other: Samples) -> Samples:
        return Samples(
            np.concatenate([self.bins, other.bins]),
            np.concatenate([self.target, other.target]),
            np.concatenate([self.source, other.source]),
        )


def train(data: Sequence[Path], out: Path | None, seed: int, progress: Tell) -> None:
    """Learn from the train part of the split, write `features.npz`, tell how it does on the validation part.

    Raises ConfigError when there is nothing to learn from.
    """
    parts = dataset.split(dataset.grouped([p for folder in data for p in dataset.read(folder)]), seed)
    if not parts.train:
        raise ConfigError("no images to train from", hint="give --data a folder with labels.json")
    progress(f"{len(parts.train)} images to learn from, {len(parts.validation)} kept for judging, split by seed {seed}")
    model = fitted([scene(p) for p in parts.train], seed, progress)
    target = (out or Path(core.perception.__path__[0])) / features.WEIGHTS
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(model.to_bytes())
    progress(f"wrote {target} ({target.stat().st_size / 1e3:.0f} kB)")
    for source in sorted({p.path.parent for p in parts.validation}):
        judged = evaluate(features.with_model(model), [p for p in parts.validation if p.path.parent == source])
        scores = ", ".join(f"{name} P {c.precision:.3f} R {c.recall:.3f} F1 {c.f1:.3f}" for name, c in judged.counts.items())
        progress(f"{source.parent.name}: {judged.images} images: {scores}; {judged.ms_per_frame:.0f} ms a frame")


def scene(photograph: dataset.Photograph) -> Scene:
    return Scene(str(photograph.path.parent.parent), photograph.group, photograph.boxes, photograph.image())


def fitted(scenes: Sequence[Scene], seed: int, progress: Tell) -> Model:
    """The model, from scenes alone."""
    rng = np.random.default_rng(seed)
    learnt, kept = _parted(scenes, rng)
    dictionary = drawn(learnt, DICTIONARY, rng)
    samples = _together([_first(each, dictionary, rng) for one in learnt for each in (one, mirrored(one))])
    model = boosted(samples, dictionary, progress)
    for most in MINED:
        samples += _together([_mined(one, model, dictionary, most) for one in learnt])
        model = boosted(samples, dictionary, progress)
    return replace(_decided(model, kept, progress), colour=_colour(scenes))


def mirrored(one: Scene) -> Scene:
    """The scene, left and right exchanged."""
    width = one.image.shape[1]
    boxes = tuple(replace(box, x_px=width - box.x_px - box.width_px) for box in one.boxes)
    return replace(one, boxes=boxes, image=np.ascontiguousarray(one.image[:, ::-1]))


def _parted(scenes: Sequence[Scene], rng: np.random.Generator) -> tuple[list[Scene], list[Scene]]:
    """To boost with, and to decide by: whole groups of every source."""
    kept: set[str] = set()
    for source in sorted({s.source for s in scenes}):
        groups = sorted({s.group for s in scenes if s.source == source})
        kept |= {groups[k] for k in rng.permutation(len(groups))[: max(1, round(KEPT_SHARE * len(groups)))]}
    return [s for s in scenes if s.group not in kept], [s for s in scenes if s.group in kept]


# Places.


def verdict(circle: Sequence[float], boxes: Sequence[Box]) -> int:
    """1 for a fruit in its place and size, -1 for none, 0 for neither."""
    u, v, radius = circle
    held = [box for box in boxes if box.holds(u, v)]
    fits = [(box.off_centre(u, v), _ratio(radius, box)) for box in held]
    if any(off <= CENTRAL and ratio <= RATIO for off, ratio in fits):
        return 0 if any(box.difficult for box in held) else 1
    if any(box.difficult for box in held) or any(off < CENTRAL_MAX and ratio < RATIO_MAX for off, ratio in fits):
        return 0
    return -1


def _ratio(radius: float, box: Box) -> float:
    ratio = radius / ((box.width_px + box.height_px) / 4)
    return max(ratio, 1 / ratio)


def _fruit(one: Scene, level: Level) -> Ints:
    """Points (n, 2) of the fruit that this level is there for."""
    points = []
    for box in one.boxes:
        if not box.difficult and _ratio(features.RADIUS_PX * level.zoom, box) <= features.SCALE_STEP**0.7:
            u, v = box.x_px + box.width_px / 2, box.y_px + box.height_px / 2
            points.append((u / level.zoom - 0.5, v / level.zoom - 0.5))
    return np.round(np.array(points, float).reshape(-1, 2)).astype(np.int32) + features.BORDER_PX


def drawn(scenes: Sequence[Scene], count: int, rng: np.random.Generator) -> Dictionary:
    """Random patches around fruit centres, every source alike."""
    sources = sorted({s.source for s in scenes})
    rows, patches = [], []
    for source in sources:
        mine = [s for s in scenes if s.source == source]
        wanted, chosen = -(-count // len(sources)), rng.permutation(len(mine))[:60]
        each = -(-wanted // len(chosen))
        for index in chosen:
            spots = [
                (level, point)
                for level in features.levels(mine[index].image, frozenset())
                for point in _fruit(mine[index], level)
            ]
            for _ in range(each if spots else 0):
                level, (x, y) = spots[int(rng.integers(len(spots)))]
                plane, which = int(rng.integers(len(features.PLANES))), int(rng.integers(len(features.SIZES)))
                size, (right, down) = features.SIZES[which], _offset(rng)
                half = size // 2
                cut = level.planes[plane, y + down - half : y + down + half + 1, x + right - half : x + right + half + 1]
                cut = cut - cut.mean()
                if cut.std() < features.NOISE:
                    continue
                patch = np.zeros(features.PATCH_SHAPE, np.float32)
                patch[:size, :size] = cut / np.linalg.norm(cut)
                rows.append((plane, which, size, right, down))
                patches.append(patch)
    return Dictionary(np.array(rows, np.int32).reshape(-1, 5), np.array(patches, np.float32))


def _offset(rng: np.random.Generator) -> tuple[int, int]:
    while True:
        right, down = (int(value) for value in rng.integers(-SPREAD, SPREAD + 1, 2))
        if right * right + down * down <= SPREAD * SPREAD:
            return right, down


def described(level: Level, points: Ints, dictionary: Dictionary) -> Bytes:
    """Every patch's bin at every point (n, k)."""
    out = np.empty((len(points), len(dictionary.features)), np.uint8)
    learnt = (dictionary.features, dictionary.patches, features.mask(), features.BINS)
    feature_kernels.describe(level.planes, level.weights, np.ascontiguousarray(points), *learnt, out)
    return out


def _first(one: Scene, dictionary: Dictionary, rng: np.random.Generator) -> Samples:
    """The fruit, and background drawn anywhere in place and scale."""
    parts = []
    for level in features.levels(one.image):
        fruit = _fruit(one, level)
        height, width = level.shape
        count = int(rng.poisson(RANDOM_NEGATIVES / features.SCALES))
        other = np.column_stack([rng.integers(0, width, count), rng.integers(0, height, count)]) + features.BORDER_PX
        other = other[[verdict(circle, one.boxes) < 0 for circle in level.circles(other.astype(np.int32)).tolist()]]
        points = np.concatenate([fruit, other]).astype(np.int32)
        target = np.concatenate([np.ones(len(fruit)), -np.ones(len(other))])
        parts.append(_samples(one, level, points, target, dictionary))
    return _together(parts)


def _mined(one: Scene, model: Model, dictionary: Dictionary, most: int) -> Samples:
    """What the model wrongly takes for fruit, the surest first, and where it finds the right ones."""
    rows = []
    pyramid = list(features.levels(one.image))
    for k, level in enumerate(pyramid):
        points, margins = features.candidates(level, model)
        rows += [(k, *point, *circle, m) for point, circle, m in zip(points, level.circles(points), margins, strict=True)]
    if not rows:
        return _together([_samples(one, pyramid[0], np.zeros((0, 2), np.int32), np.zeros(0), dictionary)])
    table = np.array(sorted(rows, key=lambda row: -row[-1]), np.float64)
    table = table[filter_kernels.distinct(np.ascontiguousarray(table[:, 3:6].astype(np.float32)), features.APART)]
    verdicts = np.array([verdict(row[3:6], one.boxes) for row in table.tolist()])
    wrong = np.flatnonzero(verdicts < 0)[:most]
    taken = np.concatenate([np.flatnonzero(verdicts > 0), wrong])
    parts = []
    for k, level in enumerate(pyramid):
        here = taken[table[taken, 0] == k]
        parts.append(_samples(one, level, table[here, 1:3].astype(np.int32), verdicts[here], dictionary))
    return _together(parts)


def _samples(one: Scene, level: Level, points: Ints, target: NDArray[Any], dictionary: Dictionary) -> Samples:
    bins = described(level, points, dictionary)
    return Samples(bins, target.astype(np.float32), np.full(len(points), one.source))


def _together(parts: Sequence[Samples]) -> Samples:
    return Samples(
        np.concatenate([p.bins for p in parts]),
        np.concatenate([p.target for p in parts]),
        np.concatenate([p.source for p in parts]),
    )


# Boosting.


def boosted(samples: Samples, dictionary: Dictionary, progress: Tell) -> Model:
    """Gentle boosting (Friedman, Hastie and Tibshirani 2000) over stumps: first STRONGEST patches, then on with those."""
    base = _balance(samples)
    margin = np.zeros(len(base), np.float32)
    chosen: list[int] = []
    tables: dict[int, Floats] = {}
    columns = np.arange(samples.bins.shape[1])
    bins = samples.bins
    for _ in range(STUMPS):
        if len(chosen) == STRONGEST and len(columns) > STRONGEST:
            columns, bins = np.array(chosen), np.ascontiguousarray(samples.bins[:, chosen])
        weight = base * np.exp(-samples.target * margin)
        column, table = stump(bins, (weight / weight.sum()).astype(np.float32), samples.target)
        feature = int(columns[column])
        if feature not in tables:
            chosen.append(feature)
            tables[feature] = np.zeros(features.BINS, np.float32)
        tables[feature] += np.float32(SHRINK) * table
        margin += np.float32(SHRINK) * table[bins[:, column]]
    steps = np.cumsum([tables[f][samples.bins[:, f]] for f in chosen], axis=0).T
    fruit = samples.target > 0
    told = f"{int(fruit.sum())} fruit, {int((~fruit).sum())} background, {len(chosen)} patches"
    progress(f"{told}: {base[(margin > 0) != fruit].sum():.3f} wrong of both alike")
    model = Model(
        features=dictionary.features[chosen],
        patches=dictionary.patches[chosen],
        tables=np.array([tables[f] for f in chosen]),
        floors=np.zeros(len(chosen), np.float32),
        margin_min=np.zeros(1, np.float32),
        slope=np.array([0, 2], np.float32),
        colour=np.zeros((len(COLOURS), 6), np.float32),
    )
    return with_floors(model, steps[fruit], float(np.quantile(margin[fruit], 0.25)))


def with_floors(model: Model, steps: Floats, margin_min: float) -> Model:
    """The model asking for a margin, its cascade set by the fruit's margins (n, k) after each feature."""
    found = steps[steps[:, -1] >= margin_min]
    floors = np.quantile(found, FLOOR_SHARE, axis=0) if len(found) else np.full(len(model.floors), -np.inf)
    floors[-1] = margin_min
    return replace(model, floors=floors.astype(np.float32), margin_min=np.array([margin_min], np.float32))


def _balance(samples: Samples) -> Floats:
    """Weights (n,) by which every source counts the same, and fruit as much as background."""
    weight = np.zeros(len(samples.target))
    for source in np.unique(samples.source):
        for sign in (-1, 1):
            mine = (samples.source == source) & (samples.target == sign)
            weight[mine] = 1 / max(int(mine.sum()), 1)
    return np.asarray(weight / weight.sum(), np.float32)


def stump(bins: Bytes, weight: Floats, target: Floats) -> tuple[int, Floats]:
    """The column (n, k) and the step over its bins (BINS,) that come nearest to the targets, by weighted squares."""
    sums = np.zeros((bins.shape[1], 2, features.BINS), np.float64)
    histograms(bins, weight, target, sums)
    low = np.cumsum(sums, axis=2)[:, :, :-1]
    high = sums.sum(axis=2)[:, :, None] - low
    gain = low[:, 1] ** 2 / (low[:, 0] + 1e-4) + high[:, 1] ** 2 / (high[:, 0] + 1e-4)
    column, cut = (int(k) for k in np.unravel_index(int(gain.argmax()), gain.shape))
    table = np.empty(features.BINS, np.float32)
    table[: cut + 1] = low[column, 1, cut] / (low[column, 0, cut] + 1e-4)
    table[cut + 1 :] = high[column, 1, cut] / (high[column, 0, cut] + 1e-4)
    return column, table


@njit(cache=True)
def histograms(bins: Bytes, weight: Floats, target: Floats, out: NDArray[np.float64]) -> None:
    """Of samples (n, k): the sums (k, 2, BINS) of the weights, and of the weights times the targets, in each bin."""
    for n in range(bins.shape[0]):
        for k in range(bins.shape[1]):
            out[k, 0, bins[n, k]] += weight[n]
            out[k, 1, bins[n, k]] += weight[n] * target[n]


# The margin to ask for, and colours.


def _decided(model: Model, scenes: Sequence[Scene], progress: Tell) -> Model:
    """Ask for the margin with the best mean F1 over the sources; fit the confidence to what was right."""
    judged = {
        source: [_outcomes(s, model) for s in scenes if s.source == source] for source in sorted({s.source for s in scenes})
    }
    choices = np.quantile(np.concatenate([m for each in judged.values() for m, _, _ in each]), np.linspace(0, 0.99, 100))
    scores = [float(np.mean([_f1(each, margin) for each in judged.values()])) for margin in choices]
    best = float(choices[int(np.argmax(scores))])
    progress(f"margin {best:.2f}: F1 {max(scores):.3f}, mean over the sources, on groups kept from boosting")
    margins = np.concatenate([m[r >= 0] for each in judged.values() for m, r, _ in each])
    right = np.concatenate([r[r >= 0] for each in judged.values() for _, r, _ in each])
    slope = _logistic(np.column_stack([np.ones(len(margins)), margins]), right)
    floors = model.floors.copy()
    floors[-1] = best
    return replace(model, floors=floors, margin_min=np.array([best], np.float32), slope=slope.astype(np.float32))


def _outcomes(one: Scene, model: Model) -> tuple[Floats, NDArray[np.int64], int]:
    """Margins (n,), the surest first; whether right (1), false (0) or not counted (-1); how many fruit there are."""
    circles, margins = features.found(one.image, model)
    detections = [
        Detection(u_px=u, v_px=v, radius_px=r, colour="red", confidence=m)
        for (u, v, r), m in zip(circles.tolist(), margins.tolist(), strict=True)
    ]
    matches = match(detections, one.boxes, [box.difficult for box in one.boxes])
    right = np.array([-1 if m.ignored else int(m.box is not None) for m in matches], np.int64)
    return margins, right, sum(not box.difficult for box in one.boxes)


def _f1(outcomes: Sequence[tuple[Floats, NDArray[np.int64], int]], margin_min: float) -> float:
    found = sum(int((r[m >= margin_min] == 1).sum()) for m, r, _ in outcomes)
    false = sum(int((r[m >= margin_min] == 0).sum()) for m, r, _ in outcomes)
    return 2 * found / max(found + false + sum(fruit for _, _, fruit in outcomes), 1)


def _logistic(x: NDArray[np.float64], right: NDArray[np.int64]) -> NDArray[np.float64]:
    def cost(w: NDArray[np.float64]) -> float:
        odds = x @ w
        return float(np.mean(np.logaddexp(0, odds) - right * odds) + 1e-4 * w @ w)

    return np.asarray(minimize(cost, np.zeros(x.shape[1]), method="BFGS").x, float)


def _colour(scenes: Sequence[Scene]) -> Floats:
    """Weights (3, 6) of a softmax over the tints of the labelled fruit; sources count alike, guessed colours do not."""
    rows, labels, weight = [], [], []
    sources = [s.source for s in scenes]
    for one in scenes:
        gains = features.image_gains(one.image)
        for box in one.boxes:
            if not box.difficult and not box.ambiguous:
                circle = (box.x_px + box.width_px / 2, box.y_px + box.height_px / 2, (box.width_px + box.height_px) / 4)
                rows.append(features.tint_terms(features.tint(one.image, gains, *circle)))
                labels.append(COLOURS.index(box.label))
                weight.append(1 / sources.count(one.source))
    x, y, w = np.array(rows), np.array(labels), np.array(weight) / sum(weight)

    def cost(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        odds = x @ flat.reshape(len(COLOURS), -1).T
        odds -= odds.max(axis=1, keepdims=True)
        p = np.exp(odds)
        p /= p.sum(axis=1, keepdims=True)
        loss = -float(w @ np.log(np.maximum(p[np.arange(len(y)), y], 1e-12)))
        p[np.arange(len(y)), y] -= 1
        return loss + 1e-4 * float(flat @ flat), ((p * w[:, None]).T @ x).ravel() + 2e-4 * flat

    best = minimize(cost, np.zeros(len(COLOURS) * x.shape[1]), jac=True, method="L-BFGS-B")
    return np.asarray(best.x.reshape(len(COLOURS), -1), np.float32)
