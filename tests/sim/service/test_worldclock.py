from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import httpx
import pytest

from core.clock import WorldClock
from core.mesh.worldclock import SILENCE_S, follow
from core.virtual import run_virtual


class Feed(httpx.AsyncByteStream):
    """Says the given lines half a second apart, then ends."""

    def __init__(self, lines: list[str]) -> None:
        self.lines = lines

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for line in self.lines:
            yield (line + "\n").encode()
            await asyncio.sleep(0.5)


def following(answers: list[httpx.Response]) -> tuple[WorldClock, httpx.AsyncClient, list[str]]:
    asked: list[str] = []

    async def answer(request: httpx.Request) -> httpx.Response:
        asked.append(str(request.url))
        if not answers:
            raise httpx.ConnectError("refused")
        return answers.pop(0)

    return WorldClock(), httpx.AsyncClient(transport=httpx.MockTransport(answer)), asked


def feed(*lines: str) -> httpx.Response:
    return httpx.Response(200, stream=Feed(list(lines)))


def test_the_clock_follows_the_feed_and_stops_when_the_world_is_gone() -> None:
    async def main() -> None:
        clock, http, asked = following([feed('{"garden_s": 100.0, "rate": 2.0}', '{"garden_s": 101.0, "rate": 4.0}')])
        task = asyncio.create_task(follow(clock, "http://sim/", http))
        await asyncio.sleep(0.25)
        assert clock.now() == pytest.approx(100.5)
        await asyncio.sleep(0.5)
        assert clock.now() == pytest.approx(102.0)
        await asyncio.sleep(SILENCE_S + 2.0)
        stopped_s = clock.now()
        await asyncio.sleep(5.0)
        assert clock.now() == stopped_s
        assert clock.rate == 0.0
        assert set(asked) == {"http://sim/clock/feed"}
        task.cancel()

    run_virtual(main())


def test_a_world_that_comes_back_moves_the_clock_again_and_never_backwards() -> None:
    async def main() -> None:
        late = httpx.Response(503)
        clock, http, _ = following([feed('{"garden_s": 50.0, "rate": 1.0}'), late, feed('{"garden_s": 49.0, "rate": 1.0}')])
        task = asyncio.create_task(follow(clock, "http://sim", http))
        seen = []
        for _ in range(40):
            await asyncio.sleep(0.1)
            seen.append(clock.now())
        assert seen == sorted(seen)
        assert seen[-1] > 50.5
        task.cancel()

    run_virtual(main())


@pytest.mark.parametrize("line", ["nonsense", '{"garden_s": -1, "rate": 1}', '{"garden_s": NaN, "rate": 1}', "[]"])
def test_nonsense_in_the_feed_does_not_move_the_clock_nor_end_the_following(line: str) -> None:
    async def main() -> None:
        clock, http, asked = following([feed(line), feed('{"garden_s": 7.0, "rate": 1.0}')])
        task = asyncio.create_task(follow(clock, "http://sim", http))
        await asyncio.sleep(1.3)
        assert len(asked) == 2
        assert clock.now() == pytest.approx(7.8, abs=0.01)
        task.cancel()

    run_virtual(main())
