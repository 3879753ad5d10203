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

from core.errors import Unauthorised
from core.mesh.auth import Verifier
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
        claims = {"sub": self.id, "kind": self.kind, "url": self.url, "nonce": nonce, "card": self.card}
        return Introduction(proof=jwt.encode(claims, self.key, algorithm="EdDSA"))


def met(proof: str, nonce: str, url: str, verifier: Verifier, now_s: float) -> Peer:
    """Who proved itself at `url` for the question `nonce`; raises Unauthorised when nobody of this garden did."""
    card = verifier.card(_claims(proof).get("card"), now_s)
    claims = _claims(proof, card.key)
    if claims.get("nonce") != nonce:
        raise Unauthorised("the proof answers another question")
    if claims.get("url") != url:
        raise Unauthorised(f"the node there says that it answers at {claims.get('url')!r}, not at {url!r}")
    kind = claims.get("kind")
    if claims.get("sub") != card.subject or kind not in ROLE_OF or ROLE_OF[kind] != card.role:
        raise Unauthorised(f"{card.subject} is enrolled as a {card.role}, not as the {kind!r} it says it is")
    return Peer(id=card.subject, kind=cast(PeerKind, kind), url=url)


def _claims(token: str, key: Any = None) -> dict[str, Any]:
    options: Any = {"verify_signature": key is not None, "verify_aud": False, "verify_exp": False, "verify_iat": False}
    try:
        return jwt.decode(token, key, algorithms=["EdDSA"], options=options)
    except (jwt.InvalidTokenError, ValueError) as error:
        raise Unauthorised(f"this proves nothing: {error}") from error
