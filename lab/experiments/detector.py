"""The detectors (paper 000, sections 4 and 8.3): how many fruit each finds, how many finds are fruit, how long it takes.

Rendered frames come from gardens of fresh seeds; photographs are those that the split keeps for validation (`TOMATOES`
names their folder). A detector that is not there, or photographs that are not, miss their bars with a reason.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from core.errors import ConfigError
from core.perception.detection import Box, Detector, Image
from core.perception.registry import detector
from lab.results import Result, held
from lab.vision import dataset, rendered
from lab.vision.evaluate import Evaluation, evaluate

TRIALS = 96
"""Rendered frames."""
TIMED = 8
"""Of them at 640x480, for the slow detector's time."""
FRESH_SEEDS = 700_000
"""Added to the seed: no frame is one that anything was fitted on."""
TOMATOES = "TOMATOES"
PROMISES = (
    ("filter_red_precision", ">=", 0.85),
    ("filter_red_recall", ">=", 0.85),
    ("best_red_precision", ">=", 0.95),
    ("best_red_recall", ">=", 0.95),
    ("best_green_precision", ">=", 0.85),
    ("best_green_recall", ">=", 0.85),
    ("filter_ms", "<=", 10.0),
    ("features_ms", "<=", 500.0),
    ("photograph_red_f1", ">=", 0.80),
    ("photograph_red_green_f1", ">=", 0.70),
)
PAPER = {"filter_red_recall": 0.75, "filter_ms": 333, "features_recall": 0.34, "features_ms": 16000}

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rendered:
    """A rendered frame as an example; fruit less than 40 % visible are not counted."""

    picture: Image
    boxes: tuple[Box, ...]
    group: str

    def image(self) -> Image:
        return self.picture


def fresh_frames(count: int, seed: int) -> list[Rendered]:
    """`count` frames of gardens nobody has seen."""
    out = []
    for frame in rendered.frames(count, FRESH_SEEDS + seed):
        entry = dataset.LabelledImage.model_validate({**frame.labels, "file": ""})
        boxes = tuple(box.box() for box in entry.boxes)
        out.append(Rendered(picture=np.asarray(frame.picture, np.uint8), boxes=boxes, group=str(entry.group)))
    return out


def at_640(frames: Sequence[Rendered]) -> list[Rendered]:
    """The frames at the size whose time is promised; their boxes are not looked at."""
    sized = [np.asarray(cv2.resize(f.picture, (640, 480), interpolation=cv2.INTER_LINEAR), np.uint8) for f in frames]
    return [Rendered(picture=image, boxes=(), group=f.group) for image, f in zip(sized, frames, strict=True)]


def kept_photographs() -> Sequence[dataset.Photograph]:
    """The validation part of the photographs; raises ConfigError when there are none."""
    folder = os.environ.get(TOMATOES)
    if not folder:
        raise ConfigError("no photographs", hint=f"{TOMATOES}=DIR with labels.json and images/, or a folder of such")
    return dataset.split(dataset.grouped(dataset.read(Path(folder)))).validation


def detector_experiment(trials: int | None, seed: int, swap: Detector | None, progress: Tell) -> Result:
    """Every detector on `trials` rendered frames and on the photographs. `swap` replaces the best."""
    trials = trials or TRIALS
    notes: list[str] = []
    progress(f"rendering {trials} frames")
    frames = fresh_frames(trials, seed)
    ours: dict[str, Any] = {}
    found = {name: _found(name, swap if name == "best" else None, notes) for name in ("filter", "features", "best")}
    for name, detect in found.items():
        progress(f"{name}: {'missing' if detect is None else 'rendered frames'}")
        ours |= _rendered(name, detect, frames)
    try:
        photographs = kept_photographs()
    except ConfigError as error:
        notes.append(f"{error}: {error.hint}")
        photographs = ()
    for name, detect in found.items():
        progress(f"{name}: {len(photographs)} photographs")
        prefix = "photograph" if name == "best" else f"{name}_photograph"
        seen = evaluate(detect, photographs) if detect and photographs else None
        ours |= {f"{prefix}_red_f1": _f1(seen, "red"), f"{prefix}_red_green_f1": _f1(seen, "red_green")}
    ours = {metric: None if isinstance(value, float) and math.isnan(value) else value for metric, value in ours.items()}
    return Result(
        name="detector",
        seed=seed,
        trials=trials,
        paper=PAPER,
        ours=ours,
        bars=held(ours, *PROMISES),
        notes=tuple(notes),
    )


def _found(name: str, swap: Detector | None, notes: list[str]) -> Detector | None:
    try:
        return swap or detector(name)
    except ConfigError as error:
        notes.append(f"{name}: {error}")
        return None


def _rendered(name: str, detect: Detector | None, frames: Sequence[Rendered]) -> dict[str, float]:
    """A detector's precision and recall on rendered frames, and its time at 640x480."""
    seen = evaluate(detect, frames) if detect else None
    timed = evaluate(detect, at_640(frames[: TIMED if name == "features" else None])) if detect else None
    ours: dict[str, float] = {}
    for asked in ("red", "green"):
        counts = seen.counts[asked] if seen else None
        ours[f"{name}_{asked}_precision"] = counts.precision if counts else math.nan
        ours[f"{name}_{asked}_recall"] = counts.recall if counts else math.nan
    return ours | {f"{name}_ms": timed.ms_per_frame if timed else math.nan}


def _f1(seen: Evaluation | None, asked: str) -> float:
    return seen.counts[asked].f1 if seen else math.nan
