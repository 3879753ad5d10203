"""What a node tells of itself to strangers, and of its peers to everybody."""

from __future__ import annotations

from fastapi import FastAPI, Query

from core.clock import Clock
from core.errors import NotFound
from core.mesh.auth import Identity
from core.mesh.introduction import NONCE_CHARS, Introducer, Introduction
from core.mesh.peers import Contact, PeerKind, Peers
from core.wire.documents import Document, Identifier


class SeenPeer(Document):
    """One line of `GET /peers`."""

    id: Identifier
    kind: PeerKind
    url: str
    source: str
    hops: int
    present: bool
    """False: it was here, and does not answer any more."""
    seen_ago_s: float | None
    """Since it last proved who it is; null for the static list."""
    way: list[Identifier] = []
    """Who passes requests on to it, itself the last; empty: it is asked directly."""


def add_presence(app: FastAPI, peers: Peers, clock: Clock, introducer: Introducer | None) -> None:
    """`GET /peers` and `GET /introduction`; `/readyz` tells where peers come from."""
    app.state.peers = peers

    @app.get("/peers", summary="Who else is known here, and how far away", tags=["node"])
    async def known() -> list[SeenPeer]:
        return [_told(contact, clock.now()) for contact in peers.contacts()]

    @app.get("/introduction", summary="Prove to a stranger who answers here", tags=["node"])
    async def introduction(nonce: str = Query(min_length=NONCE_CHARS[0], max_length=NONCE_CHARS[1])) -> Introduction:
        if introducer is None:
            raise NotFound("this node has no card", hint="run `garden init` again and give the node its own URL")
        return introducer.introduce(nonce)


def introducer(identity: Identity | None, kind: str, url: str) -> Introducer | None:
    """None when this node cannot prove itself: no key, no card, no URL."""
    if identity is None or identity.key is None or not identity.card or not url:
        return None
    return Introducer(identity.subject, kind, url, identity.card, identity.key)


def _told(contact: Contact, now_s: float) -> SeenPeer:
    peer, seen_s = contact.peer, contact.seen_s
    return SeenPeer(
        id=peer.id, kind=peer.kind, url=peer.url, source=contact.source, hops=contact.hops, present=contact.present,
        seen_ago_s=None if seen_s is None else max(0.0, now_s - seen_s), way=list(contact.way),
    )  # fmt: skip
