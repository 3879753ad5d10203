"""`python -m robot_service.body`: the process that owns the robot's serial ports."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Awaitable, Iterator

import structlog
from pydantic import ValidationError

from core.clock import Clock, WorldClock
from core.errors import GardenError
from core.mesh.runtime import GardenSettings, make_clock, setup_logging
from hw.links import open_link
from robot_service.body.body import build_body
from robot_service.body.settings import BodySettings
from robot_service.body.watchdog import Watchdog, Wires, last_words

_log = structlog.get_logger("robot.body")


async def _serve(garden: GardenSettings, settings: BodySettings) -> None:
    """Run the body until SIGTERM or SIGINT; what dies first ends all."""
    clock, clock_loops = make_clock(garden)
    async with asyncio.TaskGroup() as group:
        clocks = [group.create_task(_run(loop())) for loop in clock_loops]
        await _first_time(clock)
        wires = Wires(open_link)
        node = build_body(settings, clock, wires.open)
        clocks.append(group.create_task(Watchdog(node, wires, last_words(settings)).run()))
        body = group.create_task(node.run())
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, body.cancel)
        await asyncio.wait([body])
        for task in clocks:
            task.cancel()


async def _run(loop: Awaitable[None]) -> None:
    await loop


async def _first_time(clock: Clock) -> None:
    """Wait for the world's first word: doses are judged by garden time."""
    while isinstance(clock, WorldClock) and clock.rate == 0 and clock.now() == 0:  # noqa: ASYNC110 (no event for it)
        await asyncio.sleep(0.02)


def _causes(error: BaseException) -> Iterator[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        for inner in error.exceptions:
            yield from _causes(inner)
    else:
        yield error


def main() -> None:
    """End with 0 on SIGTERM and 1 on any failure, saying why."""
    try:
        garden, settings = GardenSettings(), BodySettings()
    except ValidationError as error:
        sys.exit(f"a GARDEN_ or BODY_ setting is wrong: {error}")
    setup_logging(garden.log)
    try:
        asyncio.run(_serve(garden, settings))
    except Exception as error:
        for cause in _causes(error):
            hint = cause.hint if isinstance(cause, GardenError) else ""
            _log.error("cannot go on", why=f"{type(cause).__name__}: {cause}", hint=hint)
        sys.exit(1)


if __name__ == "__main__":
    main()
