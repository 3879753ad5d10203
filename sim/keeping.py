"""The world's checkpoint on disk: written whole or not at all, read back at the next start.

Garden time never goes back over a restart: every checkpoint reserves the time until well after the next one is due, and a
world that ended badly goes on from there. Its soil and batteries live through the time that was skipped.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import structlog

from core.clock import Clock
from core.errors import GardenError, StorageError
from sim.clockwork import Clockwork
from sim.faults import FaultBoard
from sim.world import World

SCHEMA = 1
EVERY_S = 2.0
RESERVE_S = 3 * EVERY_S
DAY_S = 86400.0
_log = structlog.get_logger("garden.sim")


class Keeper:
    """Writes and reads `folder/world.json` for one world."""

    def __init__(self, folder: Path, world: World, faults: FaultBoard, clockwork: Clockwork) -> None:
        self.path = folder / "world.json"
        self._world, self._faults, self._clockwork = world, faults, clockwork

    def restore(self) -> bool:
        """Go on where the last run ended; False when there is nothing that could be used. A bad file is kept aside."""
        try:
            raw = self.path.read_bytes()
        except FileNotFoundError:
            return False
        except OSError as error:
            raise StorageError(f"cannot read {self.path}: {error.strerror}") from error
        try:
            self._put_back(json.loads(raw))
        except (GardenError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            aside = _set_aside(self.path)
            _log.warning("checkpoint ignored", why=f"{type(error).__name__}: {error}", kept_as=str(aside))
            return False
        return True

    def begin_anew(self) -> None:
        """A new world on a later day at the same hour: other services remember times that must not come again."""
        try:
            reserved_s = _finite(json.loads(self.path.read_bytes())["reserved_s"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return
        self._world.time_s = DAY_S * math.ceil(reserved_s / DAY_S)

    def _put_back(self, document: dict[str, Any]) -> None:
        if document["schema"] != SCHEMA:
            raise ValueError(f"schema {document['schema']}, not {SCHEMA}")
        reserved_s, before = _finite(document["reserved_s"]), self._world.snapshot()
        try:
            self._world.restore(document["world"])
            self._faults.restore(document["faults"])
        except Exception:
            self._world.restore(before)
            self._faults.restore([])
            raise
        self._world.stride(max(0.0, reserved_s - self._world.time_s))

    def document(self, reserve_s: float = 0.0) -> dict[str, Any]:
        """What a checkpoint holds."""
        self._clockwork.catch_up()
        world = self._world.snapshot()
        return {
            "schema": SCHEMA,
            "reserved_s": self._world.time_s + reserve_s,
            "faults": self._faults.kept(),
            "world": world,
        }

    async def run(self, clock: Clock) -> None:
        """A checkpoint every few wall seconds, and one at the end."""
        try:
            while True:
                document = self.document(RESERVE_S * self._clockwork.speed)
                await clock.offload(lambda document=document: write_whole(self.path, document))  # type: ignore[misc]
                await clock.sleep(EVERY_S)
        finally:
            write_whole(self.path, self.document())


def write_whole(path: Path, document: dict[str, Any]) -> None:
    """Replace the file in one step: after a crash it is the old one or the new one. Raises StorageError."""
    temporary = path.with_suffix(".tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("w") as file:
            json.dump(document, file, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror}") from error


def _finite(value: object) -> float:
    if not isinstance(value, float | int) or not math.isfinite(value):
        raise ValueError(f"{value!r} is not a time")
    return float(value)


def _set_aside(path: Path) -> Path:
    for number in range(1, 1000):
        aside = path.with_suffix(f".bad-{number}")
        if not aside.exists():
            return path.rename(aside)
    return path
