"""Detectors by name.

Each entry names a factory `MODULE:FUNCTION` without arguments, loaded when it is asked for: a detector brings its own
weights, and some of them a library.
"""

from __future__ import annotations

import importlib
from typing import Any

from core.errors import ConfigError
from core.perception.detection import Detector

DETECTORS = {
    "filter": "core.perception.filters:filter_detector",
    "features": "core.perception.features:features_detector",
    "best": "core.perception.best:best_detector",
}


KEEN = {"best": "core.perception.best:keen_detectors"}
"""Those that can tell of faint circles too."""


def keen_detectors(name: str) -> tuple[Detector, Detector, float]:
    """For those who see a fruit several times: detectors that tell of faint circles too, where there are such.

    Returns a quick one, one with finer sight (the same where there is none), and the confidence from which on a circle
    stands for itself: 0 when all do. Raises as `detector`.
    """
    if name in KEEN:
        found: tuple[Detector, Detector, float] = _made(name, KEEN[name])
        return found
    only = detector(name)
    return only, only, 0.0


def detector(name: str) -> Detector:
    """A detector by its name, or the user's own function as `MODULE:FUNCTION`.

    Raises ConfigError when there is no such thing, or when it lacks its weights.
    """
    if ":" in name:
        return _own(name)
    if name not in DETECTORS:
        raise ConfigError(f"no detector {name!r}", hint=f"one of: {', '.join(DETECTORS)}; or package.module:function")
    made: Detector = _made(name, DETECTORS[name])
    return made


def _made(name: str, factory: str) -> Any:
    try:
        return _load(factory)()
    except FileNotFoundError as error:
        raise ConfigError(f"detector {name!r} lacks its weights: {error}", hint=f"garden train {name}") from error


def _own(spec: str) -> Detector:
    found: Detector = _load(spec)
    return found


def _load(spec: str) -> Any:
    module_name, _, function = spec.partition(":")
    try:
        return getattr(importlib.import_module(module_name), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"cannot load detector {spec!r}: {error}", hint="write it as package.module:function") from error
