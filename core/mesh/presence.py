"""What a node tells of itself to strangers, and of its peers to everybody."""

from __future__ import annotations

from collections.abc import Iterator

from fastapi import FastAPI, Query

from core.clock import Clock
from core.errors import NotFound
from core.mesh.auth import Identity
from core.mesh.introduction import NONCE_CHARS, Introducer, Introduction
from core.mesh.metrics import Reading, measure
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


def add_presence(app: FastAPI, peers: Peers, clock: Clock, identity: Identity | None, kind: str, url: str) -> None:
    """`GET /peers` and `GET /introduction`; `/readyz` tells where peers come from, `/metrics` how many there are."""
    app.state.peers = peers
    me = introducer(identity, kind, url)
    measure(app.state.registry, lambda: _readings(peers, identity, clock))

    @app.get("/peers", summary="Who else is known here, and how far away", tags=["node"])
    async def known() -> list[SeenPeer]:
        return [_told(contact, clock.now()) for contact in peers.contacts()]

    @app.get("/introduction", summary="Prove to a stranger who answers here", tags=["node"])
    async def introduction(nonce: str = Query(min_length=NONCE_CHARS[0], max_length=NONCE_CHARS[1])) -> Introduction:
        if me is None:
            raise NotFound("this node has no card", hint="run `garden init` again and give the node its own URL")
        return me.introduce(nonce)


def introducer(identity: Identity | None, kind: str, url: str) -> Introducer | None:
    """None when this node cannot prove itself: no key, no card, no URL."""
    if identity is None or identity.key is None or not identity.card or not url:
        return None
    return Introducer(identity.subject, kind, url, identity.card, identity.key)


def _readings(peers: Peers, identity: Identity | None, clock: Clock) -> Iterator[Reading]:
    contacts = peers.contacts()
    for present in (True, False):
        count = sum(contact.present is present for contact in contacts)
        labels = {"present": str(present).lower()}
        yield Reading("garden_peers", "Peers ever met, by whether they are there now", count, labels)
    if identity is not None:
        left_s = identity.expires_s() - clock.now()
        yield Reading("garden_token_left_seconds", "Until this node's own token ends", left_s)


def _told(contact: Contact, now_s: float) -> SeenPeer:
    peer, seen_s = contact.peer, contact.seen_s
    return SeenPeer(
        id=peer.id, kind=peer.kind, url=peer.url, source=contact.source, hops=contact.hops, present=contact.present,
        seen_ago_s=None if seen_s is None else max(0.0, now_s - seen_s), way=list(contact.way),
    )  # fmt: skip
