"""Writing a scenario back as TOML: the standard library only reads it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from core.scenario import Scenario


def dump(scenario: Scenario) -> str:
    """A file that `core.scenario.load` reads back as the same scenario."""
    return "\n".join(_table(scenario.model_dump(), "")) + "\n"


def _table(table: Mapping[str, Any], path: str) -> Iterator[str]:
    nested = {name: value for name, value in table.items() if isinstance(value, dict) or _tables(value)}
    yield from (f"{name} = {json.dumps(value)}" for name, value in table.items() if name not in nested)
    for name, value in nested.items():
        full = f"{path}{name}"
        for inner in [value] if isinstance(value, dict) else value:
            yield f"\n[{full}]" if isinstance(value, dict) else f"\n[[{full}]]"
            yield from _table(inner, full + ".")


def _tables(value: Any) -> bool:
    return isinstance(value, list | tuple) and bool(value) and isinstance(value[0], dict)


def shifted(scenario: Scenario, by: int) -> Scenario:
    """The same scenario with every port moved up; raises pydantic's ValidationError when one leaves the range."""
    document = scenario.model_dump()
    document["ports"] = {name: port + by for name, port in document["ports"].items()}
    return Scenario.model_validate(document)
