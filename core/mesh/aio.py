"""The mesh's real transport: one aiohttp session for all peers, one kept connection or more for each."""

from __future__ import annotations

from collections.abc import Mapping

import aiohttp
from yarl import URL

from core.mesh.client import Answer

KEPT_S = 25.0
"""Shorter than the server keeps an idle connection, so that no request meets one that is closing."""


class AiohttpTransport:
    """A PeerTransport that scales to hundreds of hosts. The caller holds the time-out. Nobody there is an OSError."""

    def __init__(self) -> None:
        self._session: aiohttp.ClientSession | None = None
        self._urls: dict[str, URL] = {}

    async def send(self, method: str, url: str, headers: Mapping[str, str], body: bytes) -> Answer:
        session = self._open()
        for again in (method == "GET", False):
            try:
                return await self._exchange(session, method, url, headers, body)
            except aiohttp.ServerDisconnectedError as error:
                # A kept connection that the peer had closed meanwhile: a GET may simply be asked again.
                if not again:
                    raise ConnectionResetError("it closed the connection") from error
            except aiohttp.ClientError as error:
                raise ConnectionError(str(error)) from error
        raise AssertionError("unreachable")

    async def _exchange(
        self, session: aiohttp.ClientSession, method: str, url: str, headers: Mapping[str, str], body: bytes
    ) -> Answer:
        data = body or None
        async with session.request(method, self._url(url), headers=headers, data=data, allow_redirects=False) as response:
            content = await response.read()
            return Answer(response.status, content, {name.lower(): value for name, value in response.headers.items()})

    def _url(self, text: str) -> URL:
        """Parsing costs more than the lookup: the same few addresses come again and again."""
        url = self._urls.get(text)
        if url is None:
            if len(self._urls) > 2000:
                self._urls.clear()
            url = self._urls[text] = URL(text, encoded=True)
        return url

    def _open(self) -> aiohttp.ClientSession:
        if self._session is None:
            connector = aiohttp.TCPConnector(limit=0, keepalive_timeout=KEPT_S, use_dns_cache=True)
            nothing = aiohttp.ClientTimeout(total=None)
            self._session = aiohttp.ClientSession(connector=connector, timeout=nothing, cookie_jar=aiohttp.DummyCookieJar())
        return self._session

    async def aclose(self) -> None:
        if self._session is not None:
            await self._session.close()
