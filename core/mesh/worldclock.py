"""Following a simulated world's clock over HTTP."""

from __future__ import annotations

import asyncio
import json
import ssl
from collections.abc import Mapping
from typing import Annotated

import httpx
from pydantic import Field, ValidationError

from core.clock import WorldClock
from core.wire.documents import Document

SILENCE_S = 3.0
"""Wall seconds without a message after which the world is taken to be gone."""
RETRY_S = 0.5


class ClockBeat(Document):
    """One line of `GET /clock/feed`: the world's time and how fast it runs."""

    garden_s: Annotated[float, Field(ge=0)]
    rate: Annotated[float, Field(ge=0, le=1000)]


async def follow(
    clock: WorldClock,
    url: str,
    http: httpx.AsyncClient | None = None,
    tls: ssl.SSLContext | None = None,
    headers: Mapping[str, str] | None = None,
) -> None:
    """Steer `clock` by the feed at `url`, reconnecting for ever; a lost world stops it after SILENCE_S.

    `url` is the world's address (`http://127.0.0.1:8090`); `tls` is for one of https, `headers` go with every
    question. Waits in wall seconds: garden time stands still meanwhile.
    """
    feed_url = url.rstrip("/") + "/clock/feed"
    if http is not None:
        await _follow(clock, feed_url, http)
    async with httpx.AsyncClient(verify=tls or True, headers=headers) as own:
        await _follow(clock, feed_url, own)


async def _follow(clock: WorldClock, feed_url: str, http: httpx.AsyncClient) -> None:
    loop = asyncio.get_running_loop()
    heard_s = loop.time()
    while True:
        try:
            async with http.stream("GET", feed_url, timeout=httpx.Timeout(SILENCE_S)) as response:
                response.raise_for_status()
                async for line in response.aiter_lines():
                    beat = ClockBeat.model_validate_json(line)
                    clock.steer(beat.garden_s, beat.rate)
                    heard_s = loop.time()
        except (httpx.HTTPError, ValidationError, json.JSONDecodeError):
            pass
        if loop.time() - heard_s >= SILENCE_S:
            clock.steer(clock.now(), 0.0)
        await asyncio.sleep(RETRY_S)
