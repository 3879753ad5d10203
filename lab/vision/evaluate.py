"""`garden evaluate detector`: a detector's precision and recall on labelled images."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from core.errors import ConfigError
from core.perception.detection import Colour, Counts, Detector, score, total
from core.perception.registry import DETECTORS, detector
from lab.vision import dataset

EVALUATIONS = ("detector",)
SCORES: dict[str, Colour | None] = {"red": "red", "green": "green", "red_green": None}


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Counts by what was asked for, and the median time of a frame."""

    images: int
    counts: dict[str, Counts]
    ms_per_frame: float

    def document(self) -> dict[str, Any]:
        """`{"images", "red": {"precision", "recall", "f1"}, "green", "red_green", "ms_per_frame"}`; null where undefined."""
        scores = {name: _numbers(counts) for name, counts in self.counts.items()}
        return {"images": self.images, **scores, "ms_per_frame": _number(self.ms_per_frame)}


def _numbers(counts: Counts) -> dict[str, float | None]:
    return {"precision": _number(counts.precision), "recall": _number(counts.recall), "f1": _number(counts.f1)}


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)


def evaluate(detect: Detector, examples: Iterable[dataset.Example]) -> Evaluation:
    """Run a detector over labelled images, on one thread. `red_green` asks for any fruit, whatever its colour."""
    counts: dict[str, list[Counts]] = {name: [] for name in SCORES}
    taken_ms: list[float] = []
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for example in examples:
            image = example.image()
            if not taken_ms:
                detect(image)
            began = time.perf_counter()
            found = detect(image)
            taken_ms.append((time.perf_counter() - began) * 1000)
            for name, colour in SCORES.items():
                counts[name].append(score(found, example.boxes, colour))
    finally:
        cv2.setNumThreads(threads)
    median_ms = float(np.median(taken_ms)) if taken_ms else math.nan
    return Evaluation(
        images=len(taken_ms), counts={name: total(each) for name, each in counts.items()}, ms_per_frame=median_ms
    )


def show(name: str, evaluation: Evaluation, console: Console) -> None:
    table = Table(title=f"{name}: {evaluation.images} images, {evaluation.ms_per_frame:.1f} ms a frame")
    for heading in ("", "precision", "recall", "F1", "found", "false", "missed"):
        table.add_column(heading)
    for asked, counts in evaluation.counts.items():
        ratios = (f"{value:.3f}" for value in (counts.precision, counts.recall, counts.f1))
        table.add_row(asked.replace("_", "+"), *ratios, str(counts.found), str(counts.false), str(counts.missed))
    console.print(table)


def _chosen(images: Path, labels: Path | None, part: str, seed: int) -> Sequence[dataset.Photograph]:
    photographs = dataset.read(images, labels)
    if part == "all":
        return photographs
    halves = dataset.split(dataset.grouped(photographs), seed)
    if part not in ("train", "validation"):
        raise ConfigError(f"no part {part!r}", hint="one of: all, train, validation")
    return halves.validation if part == "validation" else halves.train


def evaluate_command(
    what: Annotated[str, typer.Argument(help="What to judge: " + ", ".join(EVALUATIONS))],
    images: Annotated[Path, typer.Option(help="Folder with labels.json and images/, or a folder of such")],
    which: Annotated[str, typer.Option(help="One of ours: " + ", ".join(DETECTORS))] = "best",
    labels: Annotated[Path | None, typer.Option(help="Labels elsewhere than IMAGES/labels.json")] = None,
    own: Annotated[str | None, typer.Option("--with", help="MODULE:FUNCTION of your own detector")] = None,
    part: Annotated[str, typer.Option(help="all, or the train or validation part of the split by --seed")] = "all",
    seed: Annotated[int, typer.Option(min=0, help="Of the split")] = dataset.SPLIT_SEED,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document")] = False,
) -> None:
    """Judge a detector on labelled images: a detection is right when its centre lies in a box, each box once."""
    tell = Console(stderr=True)
    try:
        if what not in EVALUATIONS:
            raise ConfigError(f"cannot evaluate {what!r}", hint=f"one of: {', '.join(EVALUATIONS)}")
        evaluation = evaluate(detector(own or which), _chosen(images, labels, part, seed))
    except ConfigError as error:
        tell.print(f"{error} ({error.hint})", markup=False)
        raise typer.Exit(2) from error
    if as_json:
        json.dump(evaluation.document(), sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        show(own or which, evaluation, Console())
