"""`garden see IMAGE`: what a detector makes of one image, and every stage on the way."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from rich.console import Console

from core.errors import ConfigError
from core.perception.detection import Detection, Image
from core.perception.registry import DETECTORS, detector
from lab.reproduce import load_object

STAGES = {"filter": "core.perception.filters:stages", "features": "core.perception.features:stages"}
"""Detectors that can be looked into: a function (image) -> pictures by name, (h, w, 3) uint8 or maps (h, w) of 0..1."""
INK = {"red": (40, 40, 255), "turning": (0, 190, 255), "green": (60, 255, 60)}


def drawn(image: Image, detections: Sequence[Detection]) -> Image:
    """A copy with each fruit's circle in its colour and its confidence beside it."""
    out = image.copy()
    for found in detections:
        centre = (round(found.u_px), round(found.v_px))
        cv2.circle(out, centre, max(round(found.radius_px), 2), (0, 0, 0), 4, cv2.LINE_AA)
        cv2.circle(out, centre, max(round(found.radius_px), 2), INK[found.colour], 2, cv2.LINE_AA)
        text = f"{found.confidence:.2f}"
        cv2.putText(out, text, (centre[0] - 12, centre[1] + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(
            out, text, (centre[0] - 12, centre[1] + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1, cv2.LINE_AA
        )
    return out


def write_stages(folder: Path, image: Image, found: Sequence[Detection], spec: str | None) -> None:
    """A numbered picture of each stage, brightest where a map is largest, and the detections last."""
    folder.mkdir(parents=True, exist_ok=True)
    maps: dict[str, Any] = load_object(spec)(image) if spec else {}
    for index, (name, stage) in enumerate(maps.items()):
        save(folder / f"{index:02d}-{name}.png", stage if stage.dtype == np.uint8 else _heat(stage))
    save(folder / f"{len(maps):02d}-detections.png", drawn(image, found))


def _heat(stage: Any) -> Image:
    shade = np.clip(np.asarray(stage) * 255, 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(shade, cv2.COLORMAP_INFERNO), np.uint8)


def read_image(path: Path) -> Image:
    """The pixels of a file; raises ConfigError when it holds none."""
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ConfigError(f"cannot read an image from {path}")
    return np.asarray(pixels, np.uint8)


def save(path: Path, image: Image) -> None:
    """Write a picture; raises ConfigError when it cannot be written."""
    if not cv2.imwrite(str(path), image):
        raise ConfigError(f"cannot write {path}")


def see_command(
    image: Annotated[Path, typer.Argument(help="A picture")],
    stages: Annotated[Path | None, typer.Option(help="Folder for a picture of each stage")] = None,
    which: Annotated[str, typer.Option(help="One of ours: " + ", ".join(DETECTORS))] = "filter",
    own: Annotated[str | None, typer.Option("--with", help="MODULE:FUNCTION of your own detector")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the detections as JSON")] = False,
) -> None:
    """Detect the fruit of one image; with --stages, write what each filter saw."""
    tell = Console(stderr=True)
    try:
        pixels = read_image(image)
        found = detector(own or which)(pixels)
        if stages is not None:
            write_stages(stages, pixels, found, None if own else STAGES.get(which))
    except ConfigError as error:
        tell.print(f"{error} ({error.hint})", markup=False)
        raise typer.Exit(2) from error
    if as_json:
        rows = [{k: getattr(d, k) for k in ("u_px", "v_px", "radius_px", "colour", "confidence")} for d in found]
        json.dump(rows, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        Console().print(f"{len(found)} fruit: " + ", ".join(f"{d.colour} at {d.u_px:.0f}, {d.v_px:.0f}" for d in found))
