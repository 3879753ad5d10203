"""`garden train NAME`: fit a detector again from labelled photographs and rendered frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from core.errors import ConfigError
from lab.quiet import hush
from lab.reproduce import load_object
from lab.vision.dataset import SPLIT_SEED

TRAINERS = {
    "filter": "lab.vision.fit_filters:fit",
    "features": "lab.vision.train_features:train",
    "best": "lab.vision.train_best:train",
}
"""Each is a function (data, out, seed, progress) -> None: folders of labelled photographs, the folder that gets the weights
(None: in place, beside the detector), the split's seed, and somebody to tell."""


def train_command(
    name: Annotated[str, typer.Argument(help="Which: " + ", ".join(TRAINERS))],
    data: Annotated[list[Path], typer.Option(help="Folder with labels.json, or a folder of such; may be repeated")],
    out: Annotated[Path | None, typer.Option(help="Folder for the weights; in place if left out")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the split into train and validation")] = SPLIT_SEED,
) -> None:
    """Fit or train a detector, and report how it does on what it has not seen."""
    tell = Console(stderr=True)
    hush()
    try:
        if name not in TRAINERS:
            raise ConfigError(f"cannot train {name!r}", hint=f"one of: {', '.join(TRAINERS)}")
        trainer: Callable[..., None] = load_object(TRAINERS[name])
        trainer(data=data, out=out, seed=seed, progress=lambda line: tell.print(line, highlight=False, markup=False))
    except ConfigError as error:
        tell.print(f"{error} ({error.hint})", markup=False)
        raise typer.Exit(2) from error
