"""Peers on the same link by multicast DNS (RFC 6762, 6763): services of the type `_robotgarden._tcp`."""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from core.errors import ConfigError
from core.mesh.discovery import Hint

if TYPE_CHECKING:
    from zeroconf.asyncio import AsyncZeroconf

TYPE = "_robotgarden._tcp.local."
RESOLVE_MS = 3000


@dataclass(slots=True)
class MulticastDns:
    """Announces this node at `url` (scheme, address, port) and hears of others."""

    id: str
    kind: str
    url: str
    name: str = "mDNS"
    _seen: dict[str, Hint] = field(default_factory=dict)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)

    async def run(self, seen: Callable[[list[Hint]], None]) -> None:
        try:
            from zeroconf import ServiceStateChange
            from zeroconf.asyncio import AsyncServiceBrowser, AsyncServiceInfo, AsyncZeroconf
        except ImportError as error:
            raise ConfigError("discovery by mDNS needs zeroconf", hint="pip install 'robot-garden[discovery]'") from error
        host, port = urlsplit(self.url).hostname or "", urlsplit(self.url).port or 80
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            raise ConfigError(f"{self.url} cannot be announced", hint="name this node's own address in its URL") from None
        mine = AsyncServiceInfo(
            TYPE, f"{self.id.replace('.', '-')}.{TYPE}", addresses=[address.packed], port=port, properties={"id": self.id}
        )
        resolving: set[asyncio.Task[None]] = set()

        def changed(zeroconf: Any, service_type: str, name: str, state_change: Any) -> None:
            if state_change is ServiceStateChange.Removed:
                self._seen.pop(name, None)
                self._changed.set()
                return
            task = asyncio.ensure_future(self._resolve(AsyncServiceInfo(service_type, name), zeroconf, name))
            resolving.add(task)
            task.add_done_callback(resolving.discard)

        link: AsyncZeroconf = AsyncZeroconf(interfaces=[host])
        try:
            browser = AsyncServiceBrowser(link.zeroconf, TYPE, handlers=[changed])
            await (await link.async_register_service(mine, allow_name_change=False))
            while True:
                await self._changed.wait()
                self._changed.clear()
                seen([hint for hint in self._seen.values() if hint.url != self.url])
        finally:
            for task in resolving:
                task.cancel()
            await asyncio.shield(_leave(link, browser))

    async def _resolve(self, info: Any, zeroconf: Any, name: str) -> None:
        if await info.async_request(zeroconf, RESOLVE_MS) and (addresses := info.parsed_addresses()):
            self._seen[name] = Hint(f"{urlsplit(self.url).scheme}://{addresses[0]}:{info.port}")
            self._changed.set()


async def _leave(link: AsyncZeroconf, browser: Any) -> None:
    """Say goodbye, so that others need not wait for the record to expire."""
    await browser.async_cancel()
    await link.async_unregister_all_services()
    await link.async_close()
