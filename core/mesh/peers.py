"""Who else is in the garden: told once by a static list, or found and lost by discovery (`core.mesh.discovery`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from core.errors import NotFound
from core.wire.documents import Document, Identifier

PeerKind = Literal["plant", "robot", "station", "sim", "console"]
STATIC = "static list"
FLOOD = "flood"


class Peer(Document):
    id: Identifier
    kind: PeerKind
    url: Annotated[str, Field(pattern=r"^https?://[^\s/]+$")]
    """Scheme, host and port, no path: `http://127.0.0.1:8101`."""


@dataclass(slots=True)
class Contact:
    """One peer, and what is known of the way to it."""

    peer: Peer
    source: str = STATIC
    hops: int = 1
    seen_s: float | None = None
    """When it last proved who it is [garden s]; None for the static list, which is never asked to."""
    present: bool = True
    way: tuple[str, ...] = ()
    """Who passes requests on to it, itself the last (`core.mesh.relay`); empty: it is asked directly."""

    @property
    def in_reach(self) -> bool:
        """Somebody listed, or met at its own address: it may be sent our token."""
        return self.source != FLOOD


class Peers:
    """The enrolled peers. A node asks only hosts listed here: a URL found in somebody's document is never fetched.

    Whoever discovery has lost is asked for nothing new (`all`, `of_kind`, `one_hop` leave it out), but `get` and `find`
    still know it: a robot that vanished may hold a task that has to be called off.
    """

    def __init__(self, peers: Iterable[Peer] = (), hops_max: int = 255) -> None:
        """`hops_max`: whoever is farther away is not asked (the paper's flood with a hop limit)."""
        self._contacts: dict[str, Contact] = {}
        self._hops_max = hops_max
        self.sources: tuple[str, ...] = (STATIC,)
        """Where peers come from, for people."""
        self.replace(peers)

    def replace(self, peers: Iterable[Peer]) -> None:
        """Know just these, for ever."""
        self._contacts = {peer.id: Contact(peer) for peer in peers}

    def found(self, peer: Peer, source: str, hops: int, now_s: float) -> bool:
        """Somebody has proved who it is; whether that is news. The static list's own word stands."""
        known = self._contacts.get(peer.id)
        if known is not None and known.seen_s is None:
            known.hops, known.way = hops, ()
            return False
        news = known is None or not known.present or known.peer != peer
        self._contacts[peer.id] = Contact(peer, source, hops, now_s)
        return news

    def heard(self, peer: Peer, way: tuple[str, ...], now_s: float) -> bool:
        """Somebody's sealed word came along a way of neighbours; whether that is news. Where it answers, others know."""
        known = self._contacts.get(peer.id)
        if known is not None and known.in_reach and known.present:
            known.hops, known.way = len(way), way if len(way) > 1 else ()
            return False
        news = known is None or not known.present
        self._contacts[peer.id] = Contact(peer, FLOOD, len(way), now_s, way=way)
        return news

    def lost(self, id: str) -> bool:
        """Somebody does not answer any more; whether that is news."""
        known = self._contacts.get(id)
        if known is None or known.seen_s is None or not known.present:
            return False
        known.present, known.way = False, ()
        return True

    def contacts(self) -> list[Contact]:
        """Everybody ever met, present or not."""
        return list(self._contacts.values())

    def _near(self, hops: int) -> list[Peer]:
        return [c.peer for c in self._contacts.values() if c.present and c.hops <= hops]

    def all(self) -> list[Peer]:
        return self._near(self._hops_max)

    def of_kind(self, kind: PeerKind) -> list[Peer]:
        return [peer for peer in self.all() if peer.kind == kind]

    def get(self, id: str) -> Peer:
        """Raises NotFound for somebody we were never told of."""
        if (known := self._contacts.get(id)) is None:
            raise NotFound(f"no peer {id!r}", hint=f"known: {', '.join(self._contacts) or 'nobody'}")
        return known.peer

    def find(self, id: str) -> Peer | None:
        known = self._contacts.get(id)
        return None if known is None else known.peer

    def at(self, url: str) -> str | None:
        """Who is known to answer at an address."""
        return next((c.peer.id for c in self._contacts.values() if c.in_reach and c.peer.url == url), None)

    def contact(self, id: str) -> Contact | None:
        return self._contacts.get(id)

    def one_hop(self) -> list[Peer]:
        """Neighbours in direct reach: everybody, on a static list."""
        return self._near(1)
