"""`make reproduce`: every experiment, ours beside the paper's, as `docs/reproduction.md` with its plots."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lab.plots import line_chart
from lab.reproduce import EXPERIMENTS, cell, run_experiment
from lab.results import Result

DOCS = Path(__file__).resolve().parent.parent / "docs"
TRIALS = {"watering": 100}
"""Where an experiment's own number is not enough."""
HEAD = """# Reproduction

The papers' experiments in the simulated garden, judged by the world's truth; written by `make reproduce`.
A bar is what we hold ourselves to; `MISSED` is printed when it is not reached.
"""


def section(result: Result) -> str:
    """One experiment as Markdown."""
    bars = [(bar.metric, f"{bar.op} {bar.bar:g}", "ok" if bar.ok else "MISSED") for bar in result.bars]
    rows = []
    for metric, value in result.ours.items():
        held = [(wanted, verdict) for name, wanted, verdict in bars if name == metric]
        wanted, verdict = "; ".join(w for w, _ in held), "; ".join(v for _, v in held)
        rows.append(f"| `{metric}` | {cell(result.paper.get(metric))} | {cell(value)} | {wanted} | {verdict} |")
    command = f"garden reproduce {result.name} --trials {result.trials} --seed {result.seed}"
    table = "\n".join(("| metric | paper | ours | bar | |", "|---|---|---|---|---|", *rows))
    picture = f"\n![{result.name}](reproduction-{result.name}.svg)\n" if result.series else ""
    notes = "".join(f"\n- {note}" for note in result.notes)
    return f"\n## {result.name}\n\n`{command}`\n\n{table}\n{picture}{notes}".rstrip() + "\n"


def write(results: Sequence[Result], folder: Path) -> Path:
    """The report and its plots below `folder`, beside what was run before; returns the report's path."""
    for result in results:
        if result.series:
            chart = line_chart(result.name, result.axes[0], result.axes[1], result.series)
            (folder / f"reproduction-{result.name}.svg").write_text(chart)
    path = folder / "reproduction.md"
    sections = _sections(path.read_text() if path.exists() else "") | {result.name: section(result) for result in results}
    path.write_text(HEAD + "".join(sections.values()))
    return path


def _sections(report: str) -> dict[str, str]:
    """What an earlier report says of each experiment: those that are not run again stay as they are."""
    parts = report.split("\n## ")[1:]
    return {part.split("\n", 1)[0]: f"\n## {part.rstrip()}\n" for part in parts}


def tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Run every experiment and write docs/reproduction.md.")
    parser.add_argument("names", nargs="*", default=list(EXPERIMENTS), help="only these; the report keeps the others")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trials", type=int, help="for each; its own number if left out")
    given = parser.parse_args()
    results = []
    for name in given.names:
        tell(f"{name} ...")
        results.append(run_experiment(name, given.trials or TRIALS.get(name), given.seed, None, tell))
    print(write(results, DOCS))
    if not all(result.ok for result in results):
        sys.exit("a bar was missed: see the report")


if __name__ == "__main__":
    main()
