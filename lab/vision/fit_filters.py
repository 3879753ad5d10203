"""`garden train filter`: the filter detector's weights from labelled images.

In turn: the colour planes from pixels inside and outside the labelled boxes; the gains of the weighted sum from candidates
that are fruit and that are not; the confidence to ask for, from candidates judged by weights that had not seen them (folds
of whole groups); red against turning. Every source of images weighs the same. What the split keeps for validation is only
looked at in the end.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

import core.perception
from core.perception import filter_kernels, filters
from core.perception.detection import Box, Counts, Detection, Image, match, total
from core.perception.filters import FAMILIES, Candidates, Seen, Weights
from lab.vision import dataset
from lab.vision.evaluate import evaluate

Array: TypeAlias = NDArray[np.float64]
Tell = Callable[[str], None]

BALANCE_NORMS = (1.0, 3.0)
PIXELS_A_CLASS = 120
"""Of each image, at most."""
INSIDE = 0.75
"""Of a box's half size: within it, its ellipse is fruit."""
CENTRAL = 0.65
"""A candidate this near a box's centre (in half sizes) is the fruit; further out it is neither."""
SIZE_RATIO_MAX = 1.7
NEGATIVES_MAX = 60
"""Candidates beside the fruit, of an image and colour, that are learnt from; drawn among the others."""
FOLDS = 3
NEWTON_STEPS = 12
COLOUR_DECAY, CANDIDATE_DECAY = 1e-3, 3e-3
APART_CHOICES = (0.75, 0.9, 1.05, 1.2, 1.35)
SURE_CHOICES = np.arange(0.10, 0.97, 0.02)


@dataclass(frozen=True, slots=True)
class Sample:
    """An example, where it comes from, its pixels."""

    source: str
    group: str
    boxes: tuple[Box, ...]
    image: Image


@dataclass(frozen=True, slots=True)
class Judged:
    """One image's candidates of one colour and whether they are fruit (n,): 1, 0, or -1 for neither."""

    sample: Sample
    candidates: Candidates
    fruit: NDArray[np.int64]
    learnt: NDArray[np.int64]
    """Indices of those that are learnt from: all fruit, some of the others."""


def fit(data: Sequence[Path], out: Path | None, seed: int, progress: Tell) -> None:
    """Fit on the training part of `data`, write `filters.json` to `out` (in place if None), report on the rest."""
    photographs = dataset.grouped([p for folder in data for p in dataset.read(folder)])
    halves = dataset.split(photographs, seed)
    progress(f"{len(halves.train)} images to fit on, {len(halves.validation)} kept, split by seed {seed}")
    weights = fitted([_sample(p) for p in halves.train], seed, progress)
    target = (out or Path(core.perception.__path__[0])) / filters.WEIGHTS
    target.write_text(json.dumps(weights.document(), separators=(",", ":")) + "\n")
    for name, part in (("fitted on", halves.train), ("kept", halves.validation)):
        for source in sorted({p.path.parent for p in part}):
            mine = [p for p in part if p.path.parent == source]
            progress(f"{name}, {source.parent.name}: {json.dumps(evaluate(filters.with_weights(weights), mine).document())}")


def _sample(photograph: dataset.Photograph) -> Sample:
    image = photograph.image()
    scale = min(1.0, 800 / max(image.shape[:2]))
    small = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    boxes = tuple(
        replace(b, x_px=b.x_px * scale, y_px=b.y_px * scale, width_px=b.width_px * scale, height_px=b.height_px * scale)
        for b in photograph.boxes
    )
    return Sample(str(photograph.path.parent), photograph.group, boxes, small)


def fitted(samples: Sequence[Sample], seed: int, progress: Tell) -> Weights:
    """All weights, from samples alone."""
    rng = np.random.default_rng(seed)
    tries = [(*_colours(samples, norm, rng), norm) for norm in BALANCE_NORMS]
    for loss, _, norm in tries:
        progress(f"colour planes, balanced by norm {norm:g}: loss {loss:.4f}")
    _, colour, norm = min(tries, key=lambda each: each[0])
    table = filters.colour_table(colour)
    seen = [Seen(sample.image, norm, table) for sample in samples]
    judged = [j for sample, one in zip(samples, seen, strict=True) for j in _candidates(sample, one, rng)]
    progress(f"{sum(len(j.fruit) for j in judged)} candidates, {sum(int((j.fruit == 1).sum()) for j in judged)} on fruit")
    progress(f"share of the fruit with a candidate: {_reach(samples, judged)}")
    ripe = _ripe(samples, seen)
    weights = _gains(judged, norm, colour, ripe)
    return _asked(judged, weights, progress)


# Colour planes.


def _colours(samples: Sequence[Sample], norm: float, rng: np.random.Generator) -> tuple[float, Array]:
    """The loss on folds not fitted on, and the colour weights (2, terms)."""
    pixels = [_pixels(sample, norm, rng) for sample in samples]
    folds = _folds([s.group for s in samples])
    losses = []
    for fold in range(FOLDS):
        held = [p for p, f in zip(pixels, folds, strict=True) if f == fold]
        rest = [p for p, f in zip(pixels, folds, strict=True) if f != fold]
        losses.append(_softmax_loss(_softmax_fit(*_stacked(rest)), *_stacked(held))[0])
    return float(np.mean(losses)), _softmax_fit(*_stacked(pixels))


def _pixels(sample: Sample, norm: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64], Array]:
    """Balanced colours' terms (n, t), classes (n,): 0 other, 1 red, 2 green; weights (n,)."""
    image = cv2.resize(sample.image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    classes = _mask(sample.boxes, image.shape[:2], 0.5)
    gains = filters.gains_of(np.asarray(image, np.uint8), norm)
    picked = []
    for each in range(3):
        at = np.flatnonzero(classes == each)
        picked.append(rng.permutation(at)[: PIXELS_A_CLASS * (2 if each == 0 else 1)])
    index = np.concatenate(picked)
    bgr = np.clip(image.reshape(-1, 3)[index] / 255 * gains, 0, 1)
    return filters.colour_terms(bgr), classes.ravel()[index].astype(int), np.ones(len(index))


def _mask(boxes: Sequence[Box], shape: tuple[int, ...], scale: float) -> NDArray[np.int8]:
    """Each pixel's class (h, w); -1 where nobody can say: near an outline, or where the label is a guess."""
    classes = np.zeros(shape, np.int8)
    for box in boxes:
        cv2.rectangle(classes, *_corners(box, scale, 1.0), -1, -1)
    for box in sorted(boxes, key=lambda b: -b.width_px * b.height_px):
        kind = -1 if box.difficult or box.ambiguous else 2 if box.label == "green" else 1
        centre = (round((box.x_px + box.width_px / 2) * scale), round((box.y_px + box.height_px / 2) * scale))
        axes = (round(box.width_px / 2 * INSIDE * scale), round(box.height_px / 2 * INSIDE * scale))
        cv2.ellipse(classes, centre, axes, 0, 0, 360, kind, -1)
    return classes


def _corners(box: Box, scale: float, grow: float) -> tuple[tuple[int, int], tuple[int, int]]:
    half_w, half_h = box.width_px / 2 * grow, box.height_px / 2 * grow
    u, v = box.x_px + box.width_px / 2, box.y_px + box.height_px / 2
    return (int((u - half_w) * scale), int((v - half_h) * scale)), (int((u + half_w) * scale), int((v + half_h) * scale))


def _stacked(parts: Sequence[tuple[Array, NDArray[np.int64], Array]]) -> tuple[Array, NDArray[np.int64], Array]:
    return (
        np.concatenate([p[0] for p in parts]),
        np.concatenate([p[1] for p in parts]),
        np.concatenate([p[2] for p in parts]),
    )


def _softmax_fit(x: Array, y: NDArray[np.int64], weight: Array) -> Array:
    def cost(flat: Array) -> tuple[float, Array]:
        loss, slope = _softmax_loss(flat.reshape(2, -1), x, y, weight)
        return loss + COLOUR_DECAY * float(flat @ flat), slope.ravel() + 2 * COLOUR_DECAY * flat

    found = minimize(cost, np.zeros(2 * x.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 120})
    return np.asarray(found.x.reshape(2, -1), float)


def _softmax_loss(w: Array, x: Array, y: NDArray[np.int64], weight: Array) -> tuple[float, Array]:
    """Mean cross entropy and its slope; class 0 has no weights of its own."""
    odds = np.column_stack([np.zeros(len(x)), x @ w.T])
    odds -= odds.max(axis=1, keepdims=True)
    p = np.exp(odds)
    p /= p.sum(axis=1, keepdims=True)
    rows, whole = np.arange(len(x)), weight.sum()
    loss = -float((weight * np.log(np.maximum(p[rows, y], 1e-12))).sum() / whole)
    p[rows, y] -= 1
    return loss, (p[:, 1:] * weight[:, None]).T @ x / whole


# Gains.


def _candidates(sample: Sample, seen: Seen, rng: np.random.Generator) -> list[Judged]:
    out = []
    found = list(seen.candidates())
    for family in range(len(FAMILIES)):
        mine = filters.together(found, family)
        fruit = np.array([_verdict(circle, family, sample.boxes) for circle in mine.circles], int).reshape(-1)
        others = rng.permutation(np.flatnonzero(fruit == 0))[:NEGATIVES_MAX]
        out.append(Judged(sample, mine, fruit, np.concatenate([np.flatnonzero(fruit == 1), others])))
    return out


def _verdict(circle: NDArray[np.float32], family: int, boxes: Sequence[Box]) -> int:
    """1 for a fruit of the family, 0 for none, -1 for neither."""
    u, v, radius = (float(value) for value in circle)
    held = [box for box in boxes if box.holds(u, v)]
    for box in held:
        ratio = radius / ((box.width_px + box.height_px) / 4)
        if box.off_centre(u, v) <= CENTRAL and 1 / SIZE_RATIO_MAX <= ratio <= SIZE_RATIO_MAX:
            if box.difficult or box.ambiguous:
                return -1
            if (box.label == "green") == (FAMILIES[family] == "green"):
                return 1
    if any(box.difficult or box.ambiguous for box in held):
        return -1
    same = [box for box in held if (box.label == "green") == (FAMILIES[family] == "green")]
    return -1 if same else 0


def _reach(samples: Sequence[Sample], judged: Sequence[Judged]) -> str:
    """How many of the fruit any candidate could find, by source."""
    told = []
    for source in sorted({s.source for s in samples}):
        found = missed = 0
        for j in judged:
            if j.sample.source != source:
                continue
            for box in j.sample.boxes:
                if not box.difficult and (box.label == "green") == (j.candidates.family == 1):
                    near = any(box.off_centre(float(c[0]), float(c[1])) < 1 for c in j.candidates.circles)
                    found, missed = found + near, missed + (not near)
        told.append(f"{Path(source).parent.name} {found / max(found + missed, 1):.2f}")
    return ", ".join(told)


def _gains(judged: Sequence[Judged], norm: float, colour: Array, ripe: Array) -> Weights:
    rows, centres, spreads = [], [], []
    for family in range(len(FAMILIES)):
        mine = [j for j in judged if j.candidates.family == family]
        x = np.concatenate([j.candidates.features[j.learnt] for j in mine]).astype(float)
        y = np.concatenate([j.fruit[j.learnt] for j in mine])
        weight = np.concatenate([np.full(len(j.learnt), w) for j, w in zip(mine, _source_weights(mine), strict=True)])
        centres.append(x.mean(axis=0))
        spreads.append(x.std(axis=0) + 1e-6)
        terms = filters.terms((x - centres[-1]) / spreads[-1])
        rows.append(_logistic_fit(np.column_stack([np.ones(len(terms)), terms]), y, weight, CANDIDATE_DECAY))
    nothing = np.zeros(len(FAMILIES))
    parts: dict[str, Any] = {"candidate": np.array(rows), "centre": np.array(centres), "spread": np.array(spreads)}
    return Weights(balance_norm=norm, colour=colour, ripe=ripe, sure=nothing, apart=1.0, **parts)


def _source_weights(mine: Sequence[Judged]) -> list[float]:
    """So that every source of images weighs the same."""
    counts: dict[str, int] = {}
    for j in mine:
        counts[j.sample.source] = counts.get(j.sample.source, 0) + len(j.learnt)
    return [sum(counts.values()) / len(counts) / max(counts[j.sample.source], 1) for j in mine]


def _logistic_fit(x: Array, y: NDArray[np.int64], weight: Array, decay: float) -> Array:
    """Weights (t,) of a logistic regression by Newton's method; the first column is the bias and is not held back."""
    share = weight / weight.sum()
    held = np.full(x.shape[1], 2 * decay)
    held[0] = 1e-9
    w = np.zeros(x.shape[1])
    for _ in range(NEWTON_STEPS):
        p = 1 / (1 + np.exp(-np.clip(x @ w, -30, 30)))
        slope = x.T @ (share * (p - y)) + held * w
        curve = (x * (share * np.maximum(p * (1 - p), 1e-4))[:, None]).T @ x + np.diag(held)
        w -= np.linalg.solve(curve, slope)
    return np.asarray(w, float)


# Thresholds.


def _folds(groups: Sequence[str]) -> list[int]:
    names = sorted(set(groups))
    return [names.index(group) % FOLDS for group in groups]


def _asked(judged: Sequence[Judged], weights: Weights, progress: Tell) -> Weights:
    """The weights with the confidence to ask for and how near two fruit may be.

    Chosen for the best mean F1 over the sources, by gains that had not seen the image; red decides how near.
    """
    folds = _folds([j.sample.group for j in judged])
    blind: list[tuple[Judged, Array]] = []
    for fold in range(FOLDS):
        rest = _gains([j for j, f in zip(judged, folds, strict=True) if f != fold], 1.0, weights.colour, weights.ripe)
        blind += [(j, filters.confidence_of(j.candidates, rest)) for j, f in zip(judged, folds, strict=True) if f == fold]
    tries = []
    for apart in APART_CHOICES:
        best = [_best_sure(blind, family, apart) for family in range(len(FAMILIES))]
        told = ", ".join(f"{FAMILIES[k]} {f1:.3f} at {sure:.2f}" for k, (f1, sure) in enumerate(best))
        progress(f"{apart:g} radii apart, mean F1 over the sources on folds not fitted on: {told}")
        tries.append((best[0][0], apart, np.array([sure for _, sure in best])))
    _, apart, sure = max(tries, key=lambda each: each[0])
    return replace(weights, sure=sure, apart=apart)


def _best_sure(blind: Sequence[tuple[Judged, Array]], family: int, apart: float) -> tuple[float, float]:
    outcomes = [_outcomes(j, confidence, apart) for j, confidence in blind if j.candidates.family == family]
    return max((_mean_f1(outcomes, float(sure)), float(sure)) for sure in SURE_CHOICES)


@dataclass(frozen=True, slots=True)
class Outcomes:
    """One image's detections of one colour, the surest first: how sure, right (1), false (0) or not counted (-1)."""

    source: str
    confidence: Array
    right: NDArray[np.int64]
    fruit: int
    """How many there are to find."""


def _outcomes(j: Judged, confidence: Array, apart: float) -> Outcomes:
    """The surest choose first, so that asking for more confidence only cuts the list's end."""
    order = np.argsort(-confidence)
    order = order[confidence[order] >= SURE_CHOICES[0]]
    order = order[filter_kernels.distinct(j.candidates.circles[order], apart)]
    colour = FAMILIES[j.candidates.family]
    found = [
        Detection(u_px=float(c[0]), v_px=float(c[1]), radius_px=float(c[2]), colour=colour, confidence=float(p))
        for c, p in zip(j.candidates.circles[order], confidence[order], strict=True)
    ]
    boxes = [box for box in j.sample.boxes if box.difficult or box.label in (colour, "turning")]
    ignored = [box.difficult or box.label != colour for box in boxes]
    right = np.array([-1 if m.ignored else int(m.box is not None) for m in match(found, boxes, ignored)], int)
    return Outcomes(j.sample.source, confidence[order], right, ignored.count(False))


def _mean_f1(outcomes: Sequence[Outcomes], sure: float) -> float:
    by_source: dict[str, list[Counts]] = {}
    for each in outcomes:
        right = each.right[each.confidence >= sure]
        found = int((right == 1).sum())
        by_source.setdefault(each.source, []).append(Counts(found, int((right == 0).sum()), each.fruit - found))
    return float(np.mean([total(counts).f1 for counts in by_source.values()]))


# Ripeness.


def _ripe(samples: Sequence[Sample], seen: Sequence[Seen]) -> Array:
    """Log odds (3,) of red against turning by the tint of a fruit's middle."""
    tints, red, sources = [], [], []
    for sample, one in zip(samples, seen, strict=True):
        for box in sample.boxes:
            if box.label == "green" or box.difficult or box.ambiguous:
                continue
            radius = (box.width_px + box.height_px) / 4
            circle = np.array([box.x_px + box.width_px / 2, box.y_px + box.height_px / 2, radius], np.float32)
            tints.append(np.concatenate([[1.0], one.tints(circle[None])[0]]))
            red.append(int(box.label == "red"))
            sources.append(sample.source)
    y = np.array(red)
    weight = np.array([1 / sources.count(source) for source in sources])
    return _logistic_fit(np.array(tints), y, weight, 1e-4)
