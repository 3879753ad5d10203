"""Finding peers without a list: sources hint at URLs, whoever answers there proves itself, and is lost when it is silent.

Nothing a source says is believed (`core.mesh.introduction`), and only addresses of private networks are asked.
"""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from random import Random
from typing import Protocol
from urllib.parse import quote, urlsplit

import structlog

from core.clock import Clock
from core.errors import GardenError, PeerDown, Unauthorised
from core.mesh.auth import Verifier
from core.mesh.client import Mesh, PeerTransport, read
from core.mesh.introduction import Introduction, met
from core.mesh.peers import Peer, Peers

ROUND_S = 1.0
AGAIN_S = 20.0
"""Who is known is asked again so often."""
STRANGER_AGAIN_S = 10.0
"""Who did not prove itself is asked again so often."""
MISSES_MAX = 3
"""Somebody that stays silent so many times in a row is lost."""
MISSED_AGAIN_S = 2.0
_log = structlog.get_logger("garden.discovery")


@dataclass(frozen=True, slots=True)
class Hint:
    """Somebody may answer at `url`, so many hops away."""

    url: str
    hops: int = 1


class Source(Protocol):
    """Where hints come from. `run` hands over all that hold now, whenever they change."""

    name: str

    async def run(self, seen: Callable[[list[Hint]], None]) -> None: ...


@dataclass(slots=True)
class _Lead:
    """One hint that is being followed."""

    hops: int
    source: str
    next_s: float = 0.0
    misses: int = 0
    peer: Peer | None = None
    """Who proved itself there."""


@dataclass(slots=True)
class Discovery:
    """Follows the hints of all sources and keeps `peers` true. `transport` carries questions without any token."""

    me: str
    peers: Peers
    transport: PeerTransport
    verifier: Verifier
    clock: Clock
    rng: Random
    sources: list[Source]
    loopback: bool = False
    """This node itself answers on the loopback interface, so others may."""
    _leads: dict[str, _Lead] = field(default_factory=dict)
    _asking: Mesh = field(init=False)

    def __post_init__(self) -> None:
        self._asking = Mesh(self.transport, None, self.clock)
        self.peers.sources = (*self.peers.sources, *(source.name for source in self.sources))

    def loops(self) -> list[Callable[[], Awaitable[None]]]:
        return [self.run, *(self._listening(source) for source in self.sources)]

    def _listening(self, source: Source) -> Callable[[], Awaitable[None]]:
        async def listen() -> None:
            await source.run(lambda hints: self.hinted(source.name, hints))

        return listen

    def hinted(self, source: str, hints: list[Hint]) -> None:
        """All that this source sees now. What it sees no longer is not followed any more, and lost."""
        seen = {hint.url: hint for hint in hints if self._may_ask(hint.url)}
        for url in [url for url, lead in self._leads.items() if lead.source == source and url not in seen]:
            self._drop(self._leads.pop(url))
        for url, hint in seen.items():
            lead = self._leads.setdefault(url, _Lead(hint.hops, source))
            if lead.hops != hint.hops:
                lead.hops, lead.next_s = hint.hops, 0.0

    def _may_ask(self, url: str) -> bool:
        """Only an address of a private network: nobody may send us elsewhere."""
        try:
            parts = urlsplit(url)
            address, port = ipaddress.ip_address(parts.hostname or ""), parts.port
        except ValueError:
            return False
        near = address.is_loopback if self.loopback else address.is_private and not address.is_loopback
        return parts.scheme in ("http", "https") and not parts.path and port is not None and near

    def _drop(self, lead: _Lead) -> None:
        if lead.peer is not None and self.peers.lost(lead.peer.id):
            _log.info("lost a peer", peer=lead.peer.id, source=lead.source)

    async def run(self) -> None:
        while True:
            await self.look()
            await self.clock.sleep(ROUND_S)

    async def look(self) -> None:
        """Ask whoever is due."""
        async with asyncio.TaskGroup() as group:
            for url, lead in self._leads.items():
                if self.clock.now() >= lead.next_s:
                    group.create_task(self._ask(url, lead))

    async def _ask(self, url: str, lead: _Lead) -> None:
        try:
            peer = await self._meet(url)
        except Unauthorised as error:
            _log.warning("refused a stranger", url=url, why=str(error))
            lead.next_s = self.clock.now() + STRANGER_AGAIN_S
            return self._drop(lead)
        except GardenError:
            lead.misses += 1
            lead.next_s = self.clock.now() + (MISSED_AGAIN_S if lead.misses < MISSES_MAX else STRANGER_AGAIN_S)
            return self._drop(lead) if lead.misses >= MISSES_MAX else None
        lead.misses, lead.next_s = 0, self.clock.now() + AGAIN_S * (0.8 + 0.4 * self.rng.random())
        if peer.id == self.me:
            return
        if lead.peer is not None and lead.peer.id != peer.id:
            self._drop(lead)
        lead.peer = peer
        if self.peers.found(peer, lead.source, lead.hops, self.clock.now()):
            _log.info("found a peer", peer=peer.id, url=url, source=lead.source, hops=lead.hops)

    async def _meet(self, url: str) -> Peer:
        """Raises Unauthorised for somebody who is not of the garden, PeerDown when nobody answers."""
        nonce = f"{self.rng.getrandbits(128):032x}"
        stranger = Peer(id="stranger", kind="robot", url=url)
        answer = await self._asking.exchange(stranger, "GET", f"/introduction?nonce={quote(nonce)}")
        if answer.status != 200:
            raise PeerDown(f"{url} introduces nobody ({answer.status})")
        said = read(stranger, answer, Introduction)
        return met(said.proof, nonce, url, self.verifier, self.clock.now())
