from __future__ import annotations

import asyncio

import pytest

from core.clock import VirtualClock
from core.errors import LinkDown
from core.virtual import run_virtual
from hw.links import memory_pair


def test_bytes_written_in_one_instant_arrive_in_order_and_before_the_end() -> None:
    async def story() -> None:
        here, there = memory_pair(VirtualClock())
        for number in range(100):
            here.write(bytes((number,)))
        await here.close()
        await asyncio.sleep(0.01)
        assert await there.read() == bytes(range(100))
        with pytest.raises(LinkDown):
            await there.read()

    run_virtual(story())
