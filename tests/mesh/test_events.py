"""The event log forgets the oldest, never the order."""

from __future__ import annotations

import asyncio

from core.clock import VirtualClock
from core.mesh.events import EventLog
from core.virtual import run_virtual


def test_a_listener_gets_the_past_and_then_the_present_in_order() -> None:
    async def go() -> list[int]:
        log = EventLog(VirtualClock(), size=5, first_id=10)
        for _ in range(7):
            log.add("a", "b")
        heard: list[int] = []

        async def listen() -> None:
            async for entry in log.follow(13):
                heard.append(entry.id)

        listener = asyncio.create_task(listen())
        for _ in range(2):
            await asyncio.sleep(1)
            log.add("a", "b")
        await asyncio.sleep(1)
        listener.cancel()
        return heard

    assert run_virtual(go()) == [14, 15, 16, 17, 18]


def test_only_the_newest_are_kept() -> None:
    async def go() -> list[int]:
        log = EventLog(VirtualClock(), size=3)
        for _ in range(5):
            log.add("a", "b" * 1000)
        return [entry.id for entry in log.since(0)]

    assert run_virtual(go()) == [3, 4, 5]
