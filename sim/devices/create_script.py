"""Create 1 scripts: up to 100 stored bytes of commands, and the waits during which the robot listens to nobody."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Protocol

from hw.protocols.create import Command, Mode, Op
from sim.devices.plants import CreateSense


class Odometer(Protocol):
    def travel_mm(self, sense: CreateSense) -> float:
        """Cumulative mean travel of both wheels."""
        ...

    def yaw_deg(self, sense: CreateSense) -> float:
        """Cumulative turn, counter-clockwise positive."""
        ...

    @property
    def buttons(self) -> int: ...


class Scripts:
    """Opcodes 152 to 158."""

    def __init__(self) -> None:
        self.stored = b""
        self._wait: Command | None = None
        self._begun_s = 0.0
        self._begun: CreateSense = CreateSense()

    def store(self, commands: bytes) -> None:
        self.stored = commands[:100]

    @property
    def waiting(self) -> bool:
        return self._wait is not None

    def begin(self, wait: Command, now_s: float, sense: CreateSense) -> None:
        self._wait, self._begun_s, self._begun = wait, now_s, sense

    def over(self, now_s: float, sense: CreateSense, odometer: Odometer, mode: Mode) -> bool:
        """Whether the wait has ended; forgets it then."""
        if self._wait is not None and self._ended(self._wait, now_s, sense, odometer, mode):
            self._wait = None
        return self._wait is None

    def _ended(self, wait: Command, now_s: float, sense: CreateSense, odometer: Odometer, mode: Mode) -> bool:
        if wait.op == Op.WAIT_TIME:
            return now_s - self._begun_s + 1e-9 >= 0.1 * wait.data[0]
        if wait.op == Op.WAIT_EVENT:
            event: int = struct.unpack(">b", wait.data)[0]
            happened = abs(event) in _EVENTS and _EVENTS[abs(event)](sense, odometer.buttons, mode)
            return happened == (event > 0)
        gauge = odometer.travel_mm if wait.op == Op.WAIT_DISTANCE else odometer.yaw_deg
        (goal,) = wait.int16s()
        gone = gauge(sense) - gauge(self._begun)
        return math.copysign(1.0, goal) * gone >= abs(goal) if goal else True


_EVENTS: dict[int, Callable[[CreateSense, int, Mode], bool]] = {
    1: lambda s, b, m: s.drop_left or s.drop_right or s.drop_caster,
    2: lambda s, b, m: s.drop_caster,
    3: lambda s, b, m: s.drop_left,
    4: lambda s, b, m: s.drop_right,
    5: lambda s, b, m: s.bump_left or s.bump_right,
    6: lambda s, b, m: s.bump_left,
    7: lambda s, b, m: s.bump_right,
    8: lambda s, b, m: s.ir_field,
    9: lambda s, b, m: s.wall,
    10: lambda s, b, m: s.cliff_left or s.cliff_front_left or s.cliff_front_right or s.cliff_right,
    11: lambda s, b, m: s.cliff_left,
    12: lambda s, b, m: s.cliff_front_left,
    13: lambda s, b, m: s.cliff_front_right,
    14: lambda s, b, m: s.cliff_right,
    15: lambda s, b, m: s.contacts,
    16: lambda s, b, m: bool(b & 4),
    17: lambda s, b, m: bool(b & 1),
    18: lambda s, b, m: False,
    19: lambda s, b, m: False,
    20: lambda s, b, m: False,
    21: lambda s, b, m: False,
    22: lambda s, b, m: m is Mode.PASSIVE,
}
