"""What an experiment found, beside what its paper reports, and the bars we hold ourselves to."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, field
from typing import Any

_OPS = {">=": operator.ge, "<=": operator.le, "==": operator.eq}


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One promise: `value op bar`. A value that could not be measured is NaN and never ok."""

    metric: str
    value: float
    op: str
    bar: float

    @property
    def ok(self) -> bool:
        return not math.isnan(self.value) and bool(_OPS[self.op](self.value, self.bar))

    def document(self) -> dict[str, Any]:
        value = None if math.isnan(self.value) else self.value
        return {"metric": self.metric, "value": value, "op": self.op, "bar": self.bar, "ok": self.ok}


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One experiment's outcome. `ours` holds the metrics by their fixed names (DESIGN, section 8)."""

    name: str
    seed: int
    trials: int
    paper: dict[str, Any]
    ours: dict[str, Any]
    bars: tuple[Bar, ...]
    notes: tuple[str, ...] = ()
    series: dict[str, list[float]] = field(default_factory=dict)
    """Curves for the report, by name."""
    axes: tuple[str, str] = ("", "")
    """What the curves' x and y are."""

    @property
    def ok(self) -> bool:
        return all(bar.ok for bar in self.bars)

    def document(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "seed": self.seed,
            "trials": self.trials,
            "paper": self.paper,
            "ours": self.ours,
            "bars": [bar.document() for bar in self.bars],
            "notes": list(self.notes),
            "series": self.series,
        }


def held(ours: dict[str, Any], *promises: tuple[str, str, float]) -> tuple[Bar, ...]:
    """Bars for (metric, op, bar) triples, their values looked up in `ours`."""
    return tuple(Bar(metric=m, value=_number(ours.get(m)), op=op, bar=bar) for m, op, bar in promises)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
