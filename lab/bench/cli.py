"""`garden bench NAME...`: our cost beside a peer's, interleaved in one run; ratios, not absolute times."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from core.errors import ConfigError
from lab.quiet import hush
from lab.reproduce import load_object

BENCHES = {
    "world": "lab.bench.world:bench_world",
    "wavefront": "lab.bench.wavefront:bench_wavefront",
    "camera": "lab.bench.camera:bench_camera",
    "pot": "lab.bench.pot:bench_pot",
    "market": "lab.bench.market:bench_market",
    "broadcast": "lab.bench.broadcast:bench_broadcast",
    "detector": "lab.bench.detector:bench_detector",
    "vision": "lab.bench.vision:bench_vision",
}
"""Each is a function (n) -> rows {name, ours, peer, ratio, unit, n}; a row may carry target and ok."""

Row = dict[str, Any]


def run_bench(name: str, n: int) -> list[Row]:
    """One bench's rows; raises ConfigError for an unknown one."""
    if name not in BENCHES:
        raise ConfigError(f"no bench {name!r}", hint=f"one of: {', '.join(BENCHES)}")
    hush()
    bench: Callable[[int], list[Row]] = load_object(BENCHES[name])
    return bench(n)


def show(rows: list[Row], console: Console) -> None:
    table = Table()
    columns = ("name", "ours", "peer", "ratio", "unit", "n", "target", "ok")
    for heading in columns:
        table.add_column(heading)
    for row in rows:
        table.add_row(*(_cell(row.get(column)) for column in columns))
    console.print(table)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def bench_command(
    names: Annotated[list[str] | None, typer.Argument(help="Which: " + ", ".join(BENCHES))] = None,
    n: Annotated[int, typer.Option(min=1, help="Repetitions of each pair")] = 5,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON list of rows")] = False,
) -> None:
    """Measure ours and the peer side by side. A missing peer is said, not skipped in silence."""
    tell = Console(stderr=True)
    rows: list[Row] = []
    try:
        for name in names or list(BENCHES):
            tell.print(f"bench {name} ...", highlight=False)
            rows += run_bench(name, n)
    except ConfigError as error:
        tell.print(f"{error} ({error.hint})")
        raise typer.Exit(2) from error
    if as_json:
        json.dump(rows, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        show(rows, Console())
