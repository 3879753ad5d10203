"""JSON as RFC 8259 means it: every key once, every number finite, no bottomless nesting.

pydantic's parser lets all of that pass. What others send, requests (`core.mesh.strict`) and answers (`core.mesh.client`)
alike, is looked at here before a model reads it.
"""

from __future__ import annotations

import json
import math
import re
import sys
from typing import Any

from pydantic_core import from_json, to_json

DEPTH_MAX = 32
NUMBER_MAX = sys.float_info.max
DIGITS_MAX = 300
"""More may be more than a float holds, and are looked at closer; of an integer, they are not even read."""
_LONG_NUMBER = re.compile(rb"[0-9]{%d}" % DIGITS_MAX)


class NotFinite(ValueError):
    """NaN, an infinity, or a number that is too large for a float."""


def check(raw: bytes) -> None:
    """Raises ValueError for what is not JSON as meant here, and NotFinite for its numbers."""
    if not surely_plain(raw):
        _look_closer(raw)


def surely_plain(raw: bytes) -> bool:
    """A fraction of the whole check's time, and true for what our own services write; false says nothing yet.

    What comes out again as it went in was written from dictionaries, where no key is twice.
    """
    if raw.count(b"{") + raw.count(b"[") > DEPTH_MAX or (len(raw) > DIGITS_MAX and _LONG_NUMBER.search(raw)):
        return False
    try:
        return to_json(from_json(raw, allow_inf_nan=False)) == raw
    except ValueError:
        return False


def _look_closer(raw: bytes) -> None:
    try:
        value = _DECODER.decode(raw.decode("utf-8"))
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except UnicodeDecodeError:
        raise ValueError("not UTF-8") from None
    if raw.count(b"{") + raw.count(b"[") > DEPTH_MAX and _deeper(value, DEPTH_MAX):
        raise ValueError(f"nested more than {DEPTH_MAX} deep")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice[:40]!r} comes twice")
    return document


def _no_constant(name: str) -> float:
    raise NotFinite(f"{name} is not a number")


def _float(text: str) -> float:
    return _bounded(float(text), text)


def _int(text: str) -> float:
    return _bounded(int(text) if len(text) <= DIGITS_MAX else math.inf, text)


def _bounded(value: float, text: str) -> float:
    if not -NUMBER_MAX <= value <= NUMBER_MAX:
        raise NotFinite(f"{text[:40]} is too large")
    return value


_DECODER = json.JSONDecoder(object_pairs_hook=_once, parse_constant=_no_constant, parse_float=_float, parse_int=_int)


def _deeper(value: Any, depth: int) -> bool:
    """Whether containers in `value` nest more than `depth` deep."""
    level = [value]
    for _ in range(depth):
        level = [inner for item in level for inner in _inside(item)]
        if not level:
            return False
    return any(isinstance(item, dict | list) for item in level)


def _inside(item: Any) -> list[Any]:
    if isinstance(item, dict):
        return list(item.values())
    return item if isinstance(item, list) else []
