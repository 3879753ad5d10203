"""Peers by the kernel's routing table: under a mesh routing daemon a host route's metric is its hop count.

babeld (`reflect-kernel-metric true`, `default type wired rxcost 1`, `redistribute local ip ... allow`) writes such routes
under a protocol number of its own, olsrd (`FIBMetric "correct"`) under the one that `RtProto` gives it. A metric of any
other protocol says nothing about hops and is not trusted. A withdrawn route may linger as unreachable.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from socket import AF_INET
from typing import Any

from core.clock import Clock
from core.errors import ConfigError
from core.mesh.discovery import Hint

EVERY_S = 1.0
BABELD = 42
"""Its kernel route protocol (rtnetlink's `rtm_protocol`)."""
_UNICAST, _HOST_BITS, _UNREACHABLE = 1, 32, 4294967295


@dataclass(slots=True)
class KernelRoutes:
    """Every host that a routing daemon reaches may be a peer, at the garden's one port."""

    clock: Clock
    port: int
    scheme: str = "http"
    protocols: Collection[int] = (BABELD,)
    """Kernel route protocols whose metric counts hops."""
    name: str = "kernel routes"

    async def run(self, seen: Callable[[list[Hint]], None]) -> None:
        try:
            from pyroute2 import AsyncIPRoute
        except ImportError as error:
            raise ConfigError("discovery by routes needs pyroute2", hint="pip install 'robot-garden[discovery]'") from error
        last: list[Hint] | None = None
        async with AsyncIPRoute() as kernel:
            while True:
                routes = [route async for route in await kernel.get_routes(family=AF_INET)]
                if (hints := hosts(routes, self.port, self.scheme, self.protocols)) != last:
                    seen(hints)
                    last = hints
                await self.clock.sleep(EVERY_S)


def hosts(routes: Iterable[Any], port: int, scheme: str = "http", protocols: Collection[int] = (BABELD,)) -> list[Hint]:
    """The peers that kernel routes hint at, nearest first."""
    found: dict[str, int] = {}
    for route in routes:
        told = dict(route["attrs"])
        hops = told.get("RTA_PRIORITY", _UNREACHABLE)
        known = route["proto"] in protocols and route["type"] == _UNICAST and route["dst_len"] == _HOST_BITS
        if known and 0 < hops < 256 and "RTA_DST" in told:
            found[told["RTA_DST"]] = min(hops, found.get(told["RTA_DST"], 255))
    nearest_first = sorted(found.items(), key=lambda item: (item[1], item[0]))
    return [Hint(f"{scheme}://{host}:{port}", hops) for host, hops in nearest_first]
