"""Who may do what: a garden key signs one token a node, and every node can check it without asking anybody.

Tokens are JSON Web Tokens signed with Ed25519 (RFC 8037). Their `exp` is held against the garden's clock, which is Unix
time in a real garden and starts at zero in a simulated one; `docs/security-setup.md` says what follows from that.
"""

from __future__ import annotations

import base64
import hashlib
import secrets
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import jwt
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from core.errors import ConfigError, Unauthorised
from core.mesh import keyfiles

V = TypeVar("V")
ROLES = ("plant", "robot", "operator", "viewer")
TOKEN_LIFE_S = 365 * 86400.0
_CACHE_MAX = 1024
_TOKEN_CHARS_MAX = 4096
_HINT = "send `Authorization: Bearer TOKEN`; `garden token` prints one"


@dataclass(frozen=True, slots=True)
class Caller:
    """Who a verified token speaks for."""

    subject: str
    role: str


ANYBODY = Caller("anybody", "operator")
"""The caller of a node that runs without authentication (tests only)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What a node sends with every request, and what it proves itself with to those who do not know it yet."""

    subject: str
    role: str
    token: str
    card: str = ""
    """The garden's word that `key` is this node's. No token: whoever reads it can do nothing with it."""
    key: Ed25519PrivateKey | None = field(default=None, compare=False, repr=False)

    def expires_s(self) -> float:
        """When its token ends [garden s], as the token itself says."""
        return float(jwt.decode(self.token, options={"verify_signature": False, "verify_exp": False})["exp"])

    @classmethod
    def load(cls, folder: Path) -> Identity:
        """Read `folder/token`, and `card` and `node.key` where they are; raises ConfigError when there is no token."""
        token, card, key = _text(folder / "token"), "", None
        if (folder / "card").exists() and (folder / "node.key").exists():
            card, key = _text(folder / "card"), GardenKey.load(folder / "node.key").key
        try:
            claims = jwt.decode(token, options={"verify_signature": False})
            return cls(str(claims["sub"]), str(claims["role"]), token, card, key)
        except (jwt.InvalidTokenError, KeyError) as error:
            raise ConfigError(f"{folder / 'token'} holds no token", hint="run `garden init`") from error


@dataclass(frozen=True, slots=True)
class Card:
    """Whose key a verified card names."""

    subject: str
    role: str
    key: Ed25519PublicKey


@dataclass(frozen=True, slots=True)
class GardenKey:
    """The one key that enrols: it stays with whoever ran `garden init`."""

    key: Ed25519PrivateKey

    @classmethod
    def generate(cls) -> GardenKey:
        return cls(Ed25519PrivateKey.generate())

    @classmethod
    def from_seed(cls, seed: int) -> GardenKey:
        """A key that is a function of a number: for simulated gardens in one process only."""
        return cls(Ed25519PrivateKey.from_private_bytes(hashlib.sha256(b"garden %d" % seed).digest()))

    @classmethod
    def load(cls, path: Path) -> GardenKey:
        try:
            key = serialization.load_pem_private_key(keyfiles.read(path), password=None)
        except (ValueError, TypeError, UnsupportedAlgorithm) as error:
            raise ConfigError(f"{path} holds no key", hint="run `garden init`") from error
        if not isinstance(key, Ed25519PrivateKey):
            raise ConfigError(f"{path} is not an Ed25519 key", hint="run `garden init`")
        return cls(key)

    def public(self) -> Ed25519PublicKey:
        return self.key.public_key()

    def issue(self, subject: str, role: str, now_s: float, life_s: float = TOKEN_LIFE_S, **more: Any) -> Identity:
        """Sign a token for `subject`, valid until `now_s + life_s` on the garden's clock."""
        if role not in ROLES:
            raise ConfigError(f"no role {role!r}", hint=f"one of: {', '.join(ROLES)}")
        claims = {"sub": subject, "role": role, "aud": audience(self.public()), "iat": int(now_s)}
        claims |= {"exp": int(now_s + life_s)} | more
        return Identity(subject, role, jwt.encode(claims, self.key, algorithm="EdDSA"))

    def card(self, subject: str, role: str, key: Ed25519PublicKey, now_s: float, life_s: float = TOKEN_LIFE_S) -> str:
        """Sign that `key` is the own key of the node `subject`. Of another audience than tokens, it opens nothing."""
        claims = {"sub": subject, "role": role, "aud": _card_audience(self.public()), "iat": int(now_s)}
        claims |= {"exp": int(now_s + life_s), "cnf": _confirmation(key)}
        return jwt.encode(claims, self.key, algorithm="EdDSA")

    def verifier(self) -> Verifier:
        return Verifier(self.public())


def _card_audience(garden: Ed25519PublicKey) -> str:
    return f"{audience(garden)}/card"


def _confirmation(key: Ed25519PublicKey) -> dict[str, Any]:
    """RFC 7800: the key whose holder is meant, as a JWK (RFC 8037)."""
    x = base64.urlsafe_b64encode(key.public_bytes_raw()).rstrip(b"=").decode()
    return {"jwk": {"kty": "OKP", "crv": "Ed25519", "x": x}}


def _confirmed(claims: dict[str, Any]) -> Ed25519PublicKey:
    """Raises Unauthorised when no key is named."""
    try:
        x = str(claims["cnf"]["jwk"]["x"])
        return Ed25519PublicKey.from_public_bytes(base64.urlsafe_b64decode(x + "=" * (-len(x) % 4)))
    except (KeyError, TypeError, ValueError) as error:
        raise Unauthorised("the card names no key") from error


def audience(garden: Ed25519PublicKey) -> str:
    """The garden's name on a token: the fingerprint of its public key."""
    return "garden-" + hashlib.sha256(garden.public_bytes_raw()).hexdigest()[:16]


class Verifier:
    """Checks tokens against the garden's public key; a token once verified is remembered until it expires."""

    def __init__(self, garden: Ed25519PublicKey) -> None:
        self._garden = garden
        self._audience = audience(garden)
        self._known: dict[str, tuple[Caller, float]] = {}
        self._cards: dict[str, tuple[Card, float]] = {}

    @classmethod
    def load(cls, path: Path) -> Verifier:
        """From a `garden.pub` file, or a folder that holds one."""
        path = path / "garden.pub" if path.is_dir() else path
        try:
            key = serialization.load_pem_public_key(keyfiles.read(path))
        except (ValueError, UnsupportedAlgorithm) as error:
            raise ConfigError(f"{path} holds no public key", hint="run `garden init`") from error
        if not isinstance(key, Ed25519PublicKey):
            raise ConfigError(f"{path} is not an Ed25519 key", hint="run `garden init`")
        return cls(key)

    def verify(self, token: str, now_s: float) -> Caller:
        """The caller a token speaks for; raises Unauthorised for any token that is not whole, ours and alive."""
        known = self._known.get(token)
        if known is None:
            known = self._check(token)
        caller, expires_s = known
        if now_s >= expires_s:
            self._known.pop(token, None)
            raise Unauthorised("the token has expired", hint=_HINT)
        if token not in self._known:
            _remember(self._known, token, known)
        return caller

    def card(self, card: object, now_s: float) -> Card:
        """Whose key a card names; raises Unauthorised for any card that is not whole, ours and alive."""
        if not isinstance(card, str):
            raise Unauthorised("there is no card")
        if (known := self._cards.get(card)) is None:
            claims = self._claims(card, _card_audience(self._garden))
            caller, expires_s = _caller(claims)
            known = Card(caller.subject, caller.role, _confirmed(claims)), expires_s
            _remember(self._cards, card, known)
        if now_s >= known[1]:
            raise Unauthorised("the card has expired")
        return known[0]

    def _check(self, token: str) -> tuple[Caller, float]:
        return _caller(self._claims(token, self._audience))

    def _claims(self, token: str, audience: str) -> dict[str, Any]:
        if len(token) > _TOKEN_CHARS_MAX:
            raise Unauthorised("the token is too long", hint=_HINT)
        # PyJWT would hold the times against the operating system's clock; the garden's clock decides.
        options: Any = {"require": ["sub", "aud", "exp", "iat"], "verify_exp": False, "verify_iat": False}
        options["verify_nbf"] = False
        try:
            return jwt.decode(token, self._garden, algorithms=["EdDSA"], audience=audience, options=options)
        except (jwt.InvalidTokenError, ValueError) as error:
            raise Unauthorised(f"the token is not one of this garden: {error}", hint=_HINT) from error


def _remember(known: dict[str, V], text: str, what: V) -> None:
    """The oldest is forgotten for it, when there are many."""
    if len(known) >= _CACHE_MAX:
        known.pop(next(iter(known)))
    known[text] = what


def _caller(claims: dict[str, Any]) -> tuple[Caller, float]:
    """Who is meant, and until when; raises Unauthorised."""
    subject, role, expires_s = claims["sub"], claims.get("role"), claims["exp"]
    if role not in ROLES or isinstance(expires_s, bool) or not isinstance(expires_s, int | float):
        raise Unauthorised("the token names no role or no time", hint=_HINT)
    return Caller(str(subject), role), float(expires_s)


# ------------------------------------------------------------------------------------------------- key folders


@dataclass(frozen=True, slots=True)
class Enrolled:
    """One node to enrol. Its folder may be mounted by it alone."""

    id: str
    role: str
    secret: bool = False
    """Also make `body.secret`: a robot's brain proves itself to its body with it."""


def make_garden(folder: Path, nodes: Iterable[Enrolled], now_s: float, life_s: float = TOKEN_LIFE_S) -> list[str]:
    """`garden init`: make whatever is missing below `folder`, and tell what was made. Never replaces a key.

    Files: `garden.key` (0600) and `garden.pub`; for every node `ID/{node.key,token,card,garden.pub}`, for a robot also
    `ID/body.secret`; `operator/` and `viewer/` with a token each.
    """
    made: list[str] = []
    folder.mkdir(parents=True, exist_ok=True, mode=0o755)
    key_path = folder / "garden.key"
    if not key_path.exists():
        keyfiles.write(key_path, keyfiles.private_pem(GardenKey.generate().key))
        made.append("garden.key")
    garden = GardenKey.load(key_path)
    public_pem = keyfiles.public_pem(garden.public())
    keyfiles.write(folder / "garden.pub", public_pem, mode=0o644)
    for node in (*nodes, Enrolled("operator", "operator"), Enrolled("viewer", "viewer")):
        if _enrol(folder / node.id, node, garden, now_s, life_s):
            made.append(node.id)
        keyfiles.write(folder / node.id / "garden.pub", public_pem, mode=0o644)
    return made


def _enrol(folder: Path, node: Enrolled, garden: GardenKey, now_s: float, life_s: float) -> bool:
    """True when the node had no living token of this garden yet."""
    folder.mkdir(exist_ok=True, mode=0o755)
    key_path, token_path = folder / "node.key", folder / "token"
    if not key_path.exists():
        keyfiles.write(key_path, keyfiles.private_pem(Ed25519PrivateKey.generate()))
    if node.secret and not (folder / "body.secret").exists():
        keyfiles.write(folder / "body.secret", secrets.token_hex(32).encode())
    if token_path.exists() and _alive(folder, garden, now_s):
        return False
    public = GardenKey.load(key_path).public()
    # As RFC 7800 has it: a token that says whose it is.
    identity = garden.issue(node.id, node.role, now_s, life_s, cnf=_confirmation(public))
    keyfiles.write(folder / "card", garden.card(node.id, node.role, public, now_s, life_s).encode())
    keyfiles.write(token_path, identity.token.encode())
    return True


def _alive(folder: Path, garden: GardenKey, now_s: float) -> bool:
    """Whether token and card are there and hold."""
    verifier = garden.verifier()
    try:
        verifier.verify(_text(folder / "token"), now_s)
        verifier.card(_text(folder / "card"), now_s)
    except (Unauthorised, ConfigError):
        return False
    return True


def _text(path: Path) -> str:
    return keyfiles.read(path).decode("ascii", "replace").strip()
