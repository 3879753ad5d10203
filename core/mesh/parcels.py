"""Requests that neighbours pass on, and the answers: sealed by whoever wrote them. Pure.

A radio without routing reaches neighbours only. There a request travels as a parcel: flooded with a limited hop count (the
MIT paper, section 9), or along a way that a flood found, named hop by hop (source routing, RFC 4728). Whoever passes it on
shows a token of its own; the request inside carries none, but a signature under its author's own key, which a card of the
garden names. So nobody on the way can alter, forge or repeat it; read, delay and drop it they can.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import unquote

from pydantic import Field

from core.errors import BadRequest, Unauthorised, Unprocessable
from core.mesh.auth import Caller, Verifier
from core.mesh.client import FLOOD_BYTES_MAX, Answer
from core.mesh.introduction import Introducer, signed, signer
from core.mesh.peers import Peer
from core.wire.documents import Document, Identifier

PATH = "/parcels"
LIFE_S = 30.0
"""A seal is good so long before and after the time it names: nodes' clocks may differ by as much."""
HOPS_MAX = 16
BODY_BYTES_MAX = FLOOD_BYTES_MAX
"""With its seal, in base64, that is a request as long as any node takes."""
ANSWERS_MAX = 64
"""A node hands back no more to a flood."""
WITHIN_S_MAX = 30.0
EVERYBODY = "*"
"""The address of a flood, as `client.ROBOTS` is: no node's id begins with an asterisk."""
REQUEST_HEADERS = ("content-type", "idempotency-key", "if-match", "if-none-match")
ANSWER_HEADERS = ("content-type", "etag", "location")
_METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE")
_PATH = re.compile(r"/[!-~]{0,511}")
_PARCEL, _ANSWER = "parcel", "answer"
_Base64 = Annotated[str, Field(max_length=4 * BODY_BYTES_MAX // 3 + 4)]
_Seal = Annotated[str, Field(max_length=8192, pattern=r"^[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+$")]
_Way = Annotated[list[Identifier], Field(max_length=HOPS_MAX)]


class Parcel(Document):
    """`POST /parcels`: from neighbour to neighbour."""

    seal: _Seal
    """A JWT under the author's own key: what is asked, of whom."""
    body: _Base64 = ""
    via: Annotated[list[Identifier], Field(min_length=1, max_length=HOPS_MAX)]
    """Who had it so far, its author first, who hands it over last."""
    way: _Way | None = None
    """Who is to get it next, and so on until its addressee; null: everybody in reach."""
    hops_left: Annotated[int, Field(ge=0, le=HOPS_MAX)] = 0
    """How often a flood may still be passed on."""
    within_s: Annotated[float, Field(gt=0, le=WITHIN_S_MAX)]
    """Whoever hands it over waits so long for answers [s of the machine]."""


class ParcelAnswer(Document):
    """What one node answered."""

    seal: _Seal
    """A JWT under its own key."""
    body: _Base64 = ""
    way: _Way
    """Who passed the question on, itself the last."""


class ParcelAnswers(Document):
    """What came back from a parcel: nothing when nobody was reached, or it had been here before."""

    answers: Annotated[list[ParcelAnswer], Field(max_length=ANSWERS_MAX)] = []


@dataclass(frozen=True, slots=True)
class Question:
    """What its author sealed."""

    sender: Peer
    role: str
    number: str
    """Never twice from one author."""
    to: str
    method: str
    path: str
    headers: Mapping[str, str]
    body: bytes
    at_s: float

    @property
    def key(self) -> tuple[str, str]:
        """The same for every copy of it."""
        return self.sender.id, self.number

    @property
    def caller(self) -> Caller:
        return Caller(self.sender.id, self.role)

    def is_for(self, me: str, role: str) -> bool:
        return self.to in (me, EVERYBODY, f"*{role}")


def sealed(
    author: Introducer, number: str, to: str, method: str, path: str, headers: Mapping[str, str], body: bytes, now_s: float
) -> str:
    """The seal of a request; of its headers only those that mean something to an app are kept."""
    return author.sign(
        {
            "aud": _PARCEL, "jti": number, "iat": now_s, "to": to, "method": method, "path": path,
            "headers": _kept(headers, REQUEST_HEADERS), "sha256": _digest(body),
        }
    )  # fmt: skip


def opened(parcel: Parcel, verifier: Verifier, now_s: float, born_s: float) -> Question:
    """The request inside; raises Unauthorised unless it is whole, of this garden, and written now and since `born_s`."""
    card, claims = signed(parcel.seal, verifier, now_s)
    sender, body = signer(card, claims), unpacked(parcel.body)
    _check(claims, _PARCEL, body)
    at_s = claims.get("iat")
    if isinstance(at_s, bool) or not isinstance(at_s, int | float) or abs(now_s - at_s) > LIFE_S:
        raise Unauthorised("this parcel was not written now", hint="nodes' clocks may differ by half a minute")
    if at_s < born_s:
        raise Unauthorised("this parcel was written before this node began", hint="send it anew")
    if parcel.via[0] != sender.id:
        raise Unauthorised(f"this is a parcel of {sender.id}, and came from {parcel.via[0]}")
    number, to, method, path = (claims.get(name) for name in ("jti", "to", "method", "path"))
    texts = isinstance(number, str) and isinstance(to, str) and isinstance(path, str)
    inner = unquote(str(path).partition("?")[0])
    if not texts or len(str(number)) > 80 or method not in _METHODS or not _PATH.fullmatch(str(path)) or inner == PATH:
        raise Unprocessable("this parcel holds no request")
    headers = _headers(claims, REQUEST_HEADERS)
    return Question(sender, card.role, str(number), str(to), str(method), str(path), headers, body, float(at_s))


def sealed_answer(author: Introducer, question: Question, answer: Answer) -> str:
    """The seal of an answer, good for this question alone."""
    return author.sign(
        {
            "aud": _ANSWER, "re": list(question.key), "status": answer.status,
            "headers": _kept(answer.headers, ANSWER_HEADERS), "sha256": _digest(answer.body),
        }
    )  # fmt: skip


def opened_answer(told: ParcelAnswer, key: tuple[str, str], verifier: Verifier, now_s: float) -> tuple[Peer, Answer]:
    """Who answered the question of this key, and what; raises Unauthorised."""
    card, claims = signed(told.seal, verifier, now_s)
    peer, body = signer(card, claims), unpacked(told.body)
    _check(claims, _ANSWER, body)
    if claims.get("re") != list(key):
        raise Unauthorised("this answers another question")
    if not told.way or told.way[-1] != peer.id:
        raise Unauthorised(f"this is an answer of {peer.id}, and says that it came from {told.way[-1:]}")
    status = claims.get("status")
    if isinstance(status, bool) or not isinstance(status, int) or not 100 <= status < 600:
        raise Unauthorised("this answer has no status")
    return peer, Answer(status, body, _headers(claims, ANSWER_HEADERS))


def packed(body: bytes) -> str:
    return base64.b64encode(body).decode()


def unpacked(text: str) -> bytes:
    """Raises BadRequest."""
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise BadRequest("the parcel's body is not base64") from error


def _check(claims: Mapping[str, Any], audience: str, body: bytes) -> None:
    if claims.get("aud") != audience:
        raise Unauthorised(f"this seals no {audience}")
    if claims.get("sha256") != _digest(body):
        raise Unauthorised("the body is not the one that was sealed")


def _digest(body: bytes) -> str:
    return hashlib.sha256(body).hexdigest()


def _kept(headers: Mapping[str, str], names: tuple[str, ...]) -> dict[str, str]:
    return {name: headers[name] for name in names if name in headers}


def _headers(claims: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, str]:
    told = claims.get("headers")
    whole = isinstance(told, dict) and all(
        name in names and isinstance(value, str) and len(value) <= 512 and value.isascii() and value.isprintable()
        for name, value in told.items()
    )
    if not isinstance(told, dict) or not whole:
        raise Unprocessable("this parcel's headers are not those of a request")
    return dict(told)
