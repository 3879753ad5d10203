"""`garden reproduce NAME`: a paper's experiment in our garden, ours beside the paper's."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from core.errors import ConfigError
from lab.quiet import hush
from lab.results import Result

EXPERIMENTS = {
    "detector": "lab.experiments.detector:detector_experiment",
    "square-loop": "lab.experiments.square_loop:square_loop",
    "watering": "lab.experiments.watering:watering",
    "allocation": "lab.experiments.allocation:allocation",
    "network": "lab.experiments.network:network",
    "inventory": "lab.experiments.inventory:inventory",
    "grasp": "lab.experiments.grasp:grasp",
}
"""Each is a function (trials, seed, with_, progress) -> Result."""

Progress = Callable[[str], None]


def load_object(spec: str) -> Any:
    """The object named `MODULE:NAME`; raises ConfigError when there is none."""
    module_name, _, name = spec.partition(":")
    try:
        return getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"cannot load {spec!r}: {error}", hint="write it as package.module:function") from error


def run_experiment(name: str, trials: int | None, seed: int, swap: str | None, progress: Progress) -> Result:
    """Run one experiment by name; raises ConfigError for an unknown one."""
    if name not in EXPERIMENTS:
        raise ConfigError(f"no experiment {name!r}", hint=f"one of: {', '.join(EXPERIMENTS)}")
    hush()
    experiment: Callable[..., Result] = load_object(EXPERIMENTS[name])
    return experiment(trials=trials, seed=seed, swap=load_object(swap) if swap else None, progress=progress)


def show(result: Result, console: Console) -> None:
    """Ours beside the paper's, and the bars."""
    table = Table(title=f"{result.name}: {result.trials} trials, seed {result.seed}")
    for heading in ("metric", "paper", "ours", "bar", ""):
        table.add_column(heading)
    bars = {bar.metric: bar for bar in result.bars}
    for metric in result.ours:
        bar = bars.get(metric)
        verdict = "" if bar is None else ("ok" if bar.ok else "MISSED")
        wanted = "" if bar is None else f"{bar.op} {bar.bar:g}"
        table.add_row(metric, cell(result.paper.get(metric)), cell(result.ours[metric]), wanted, verdict)
    console.print(table)
    for note in result.notes:
        console.print(note)


def cell(value: object) -> str:
    """A value for people."""
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def reproduce_command(
    name: Annotated[str, typer.Argument(help="Which experiment: " + ", ".join(EXPERIMENTS))],
    trials: Annotated[int | None, typer.Option(min=1, help="How often; the experiment's own number if left out")] = None,
    seed: Annotated[int, typer.Option(min=0, help="First seed; trial k takes seed + k")] = 1,
    swap: Annotated[str | None, typer.Option("--with", help="MODULE:FUNCTION of your own algorithm")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document")] = False,
) -> None:
    """Repeat a paper's experiment in the simulated garden, judged by the world's truth. Exit 1 when a bar is missed."""
    tell = Console(stderr=True)
    try:
        result = run_experiment(name, trials, seed, swap, lambda line: tell.print(line, highlight=False))
    except ConfigError as error:
        tell.print(f"{error} ({error.hint})")
        raise typer.Exit(2) from error
    if as_json:
        json.dump(result.document(), sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        show(result, Console())
    if not result.ok:
        raise typer.Exit(1)
