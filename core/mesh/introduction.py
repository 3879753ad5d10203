"""How strangers prove that they belong to the garden, before anybody sends them a token.

Discovery only hints that somebody may answer at a URL. Whoever is there is asked, without any token, to sign a number
just drawn: with its own key, which a card signed by the garden's key names (RFC 7800). It signs the URL it answers at as
well, so that nobody can pass the question on to a true node and its answer off as its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import jwt
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from pydantic import ValidationError

from core.errors import Unauthorised
from core.mesh.auth import Card, Verifier
from core.mesh.peers import Peer, PeerKind
from core.wire.documents import Document

ROLE_OF: dict[str, str] = {"plant": "plant", "station": "plant", "robot": "robot"}
"""Which role a card must give to a node of this kind."""
NONCE_CHARS = (16, 64)


class Introduction(Document):
    """`GET /introduction?nonce=...`"""

    proof: str
    """A JWT (EdDSA) under the node's own key: `sub`, `kind`, `url`, `nonce`, and `card`, which names that key."""


@dataclass(frozen=True, slots=True)
class Introducer:
    """Proves who this node is."""

    id: str
    kind: str
    url: str
    card: str
    key: Ed25519PrivateKey

    def introduce(self, nonce: str) -> Introduction:
        return Introduction(proof=self.sign({"nonce": nonce}))

    def sign(self, claims: dict[str, Any]) -> str:
        """A JWT under this node's own key that says who it is, and `claims`."""
        me = {"sub": self.id, "kind": self.kind, "url": self.url, "card": self.card}
        return jwt.encode(claims | me, self.key, algorithm="EdDSA")


def met(proof: str, nonce: str, url: str, verifier: Verifier, now_s: float) -> Peer:
    """Who proved itself at `url` for the question `nonce`; raises Unauthorised when nobody of this garden did."""
    card, claims = signed(proof, verifier, now_s)
    if claims.get("nonce") != nonce:
        raise Unauthorised("the proof answers another question")
    if claims.get("url") != url:
        raise Unauthorised(f"the node there says that it answers at {claims.get('url')!r}, not at {url!r}")
    return signer(card, claims)


def signed(proof: str, verifier: Verifier, now_s: float) -> tuple[Card, dict[str, Any]]:
    """The card that a JWT under a node's own key carries, and all it says; raises Unauthorised."""
    card = verifier.card(_claims(proof).get("card"), now_s)
    return card, _claims(proof, card.key)


def signer(card: Card, claims: dict[str, Any]) -> Peer:
    """The node that signed; raises Unauthorised when it is not the one that the card names."""
    kind = claims.get("kind")
    if claims.get("sub") != card.subject or kind not in ROLE_OF or ROLE_OF[kind] != card.role:
        raise Unauthorised(f"{card.subject} is enrolled as a {card.role}, not as the {kind!r} it says it is")
    try:
        return Peer(id=card.subject, kind=cast(PeerKind, kind), url=claims.get("url", ""))
    except ValidationError as error:
        raise Unauthorised(f"{card.subject} says that it answers at {claims.get('url')!r}") from error


def _claims(token: str, key: Any = None) -> dict[str, Any]:
    options: Any = {"verify_signature": key is not None, "verify_aud": False, "verify_exp": False, "verify_iat": False}
    try:
        return jwt.decode(token, key, algorithms=["EdDSA"], options=options)
    except (jwt.InvalidTokenError, ValueError) as error:
        raise Unauthorised(f"this proves nothing: {error}") from error
