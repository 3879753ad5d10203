"""What moves, pours or opens in a garden, as told at both ends of the wires and as the world has it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

from doors import Doors

from hw.drivers.create import CreateDriver
from hw.drivers.firmata import FirmataBoard, FirmataValve
from hw.drivers.ssc32 import Ssc32Driver
from sim.body import RobotBody
from sim.pot import Pot, TapBoard

ACTS: dict[type, tuple[str, ...]] = {
    CreateDriver: ("drive", "seek_dock", "stop"),
    Ssc32Driver: ("move", "output", "stop"),
    FirmataValve: ("open_for", "shut"),
    FirmataBoard: ("set_tap",),
    RobotBody: ("set_wheels", "set_pulse", "set_output"),
    TapBoard: ("set_digital",),
    Pot: ("set_digital",),
}
"""The calls by which a service tells a driver to act, and by which a device's firmware then does.

A garden at rest makes none of them: its loops read sensors only.
"""
FELT = ("battery_ratio",)
"""Of a robot, what time alone changes."""


@contextmanager
def acts_told() -> Iterator[Counter[str]]:
    """Count every act in this process from now on."""
    told: Counter[str] = Counter()
    with ExitStack() as stack:
        for owner, names in ACTS.items():
            for name in names:
                counted = _counting(getattr(owner, name), f"{owner.__name__}.{name}", told)
                stack.enter_context(mock.patch.object(owner, name, counted))
        yield told


def _counting(act: Callable[..., Any], name: str, told: Counter[str]) -> Callable[..., Any]:
    def counted(self: Any, *args: Any, **more: Any) -> Any:
        told[name] += 1
        return act(self, *args, **more)

    return counted


def world_of(doors: Doors) -> dict[str, Any]:
    """Where everything stands that an act would move, fill or empty: the truth of the world, to the last bit."""
    truth = doors.runner.run(_truth(doors))
    robots = [{name: value for name, value in robot.items() if name not in FELT} for robot in truth["robots"]]
    poured = {plant["id"]: plant["poured_ml"] for plant in truth["plants"]}
    return {"robots": robots, "poured_ml": poured} | {name: truth[name] for name in ("spilt_ml", "tap_ml", "tap_open")}


async def _truth(doors: Doors) -> dict[str, Any]:
    return doors.garden.truth().model_dump()
