"""Who else is in the garden."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import Field

from core.errors import NotFound
from core.wire.documents import Document, Identifier

PeerKind = Literal["plant", "robot", "station", "sim", "console"]


class Peer(Document):
    id: Identifier
    kind: PeerKind
    url: Annotated[str, Field(pattern=r"^https?://[^\s/]+$")]
    """Scheme, host and port, no path: `http://127.0.0.1:8101`."""


class Peers:
    """The enrolled peers. Static today; discovery (mDNS, routing tables) will call `replace` with what it sees.

    A node asks only hosts listed here: a URL found in somebody's document is never fetched.
    """

    def __init__(self, peers: Iterable[Peer] = ()) -> None:
        self._peers: dict[str, Peer] = {}
        self.replace(peers)

    def replace(self, peers: Iterable[Peer]) -> None:
        self._peers = {peer.id: peer for peer in peers}

    def all(self) -> list[Peer]:
        return list(self._peers.values())

    def of_kind(self, kind: PeerKind) -> list[Peer]:
        return [peer for peer in self._peers.values() if peer.kind == kind]

    def get(self, id: str) -> Peer:
        """Raises NotFound for somebody we were never told of."""
        try:
            return self._peers[id]
        except KeyError:
            raise NotFound(f"no peer {id!r}", hint=f"known: {', '.join(self._peers) or 'nobody'}") from None

    def find(self, id: str) -> Peer | None:
        return self._peers.get(id)

    def one_hop(self) -> list[Peer]:
        """Neighbours in direct reach: everybody, on a static list."""
        return self.all()
