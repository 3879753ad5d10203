"""Malformed requests without end, as a function of a seed. Each is wrong by the way it was made, whoever judges it.

Random edits may heal or miss what they hit. So either the place is known to matter (a prefix of an object, one byte
beyond ASCII, another signature), or Python's own JSON reader has to refuse the outcome before it is asked with.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any
from urllib.parse import quote, unquote_to_bytes

import httpx
from doors import KINDS, Doors, Operation
from test_bad_addresses import METHODS, STRANGE_IDS, token_for, wrong_queries
from test_bad_bodies import GOOD, caller, leaves, not_documents, one_field_wrong, one_place_wrong, type_name, wrong_values
from test_who_may import MAY, tokens

from core.mesh.auth import ROLES
from core.mesh.describe import routes

LETTERS = "bdghjkpqz"
"""No word of these is a number, a flag, a colour or null."""
BROKEN_QUERIES = ("%", "a=%ff", "%00=1", ";", "surprise[]=1", "after=1&x", "=", "&&a")
SCHEMES = ("Basic {}", "Token {}", "{}", "Bearer", "Bearer\t{}", "Bearer {} {}", "Digest {}", "Bearer,{}")
BASE64 = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_"
LONGEST = 65536
"""Bytes that a body may have."""


@dataclass(frozen=True, slots=True)
class Asked:
    """One request, and what is wrong with it; `statuses` are those that say so (empty: any refusal)."""

    kind: str
    method: str
    path: str
    wrong: str
    headers: dict[str, bytes] = field(default_factory=dict)
    content: bytes = b""
    statuses: tuple[int, ...] = ()

    async def of(self, doors: Doors) -> httpx.Response:
        return await doors.knock(self.kind, self.method, self.path, self.headers, self.content)


# ------------------------------------------------------------------ bodies


def word(rng: Random, least: int = 1, most: int = 8) -> str:
    return "".join(rng.choices(LETTERS, k=rng.randint(least, most)))


def is_json(raw: bytes) -> bool:
    """By RFC 8259, as far as Python's reader goes: no NaN, and UTF-8 only."""

    def no_constant(name: str) -> float:
        raise ValueError(name)

    try:
        json.loads(raw.decode("utf-8"), parse_constant=no_constant)
    except (ValueError, RecursionError):
        return False
    return True


def shuffled(value: Any, rng: Random) -> Any:
    """The same document with its keys in another order at every depth."""
    if isinstance(value, dict):
        return {key: shuffled(inner, rng) for key, inner in rng.sample(list(value.items()), len(value))}
    return [shuffled(inner, rng) for inner in value] if isinstance(value, list) else value


def text_of(good: dict[str, Any], rng: Random) -> bytes:
    return json.dumps(shuffled(good, rng), indent=rng.choice((None, None, 1))).encode()


def wrong_number(rng: Random) -> str:
    return rng.choice((
        f"{rng.choice(('', '-'))}{rng.uniform(1.0, 9.9):.{rng.randint(0, 9)}f}e{rng.randint(30, 400)}",
        f"{rng.choice(('', '-'))}{rng.randint(10**30, 10**60)}",
        f'"{rng.randint(0, 9999)}"',
        f"{rng.randint(0, 9999)}{word(rng, 1, 3)}",
        f"0{rng.randint(0, 999)}",
        f"0x{rng.randint(0, 9999):x}",
    ))  # fmt: skip


def wrong_text(rng: Random) -> str:
    before, after = word(rng, 0, 9), word(rng, 0, 9)
    return rng.choice((
        str(rng.uniform(-1e6, 1e6)),
        word(rng),
        f'"{before}{chr(rng.randrange(0x20))}{after}"',
        f'"{before}\\u{rng.randint(0xD800, 0xDFFF):04x}{after}"',
        f'"{before}\\{rng.choice("acdeghijkmopqvwxyz0123456789")}{after}"',
        f'"{word(rng, 601, 1500)}"',
        f'["{before}"]',
    ))  # fmt: skip


def wrong_value(value: Any, rng: Random) -> str:
    """Text for a place where `value` is right: of another type, beyond all bounds, or no JSON."""
    if rng.random() < 0.3 or value is None:
        return rng.choice(wrong_values(value))
    if isinstance(value, bool):
        return rng.choice((str(rng.randint(0, 99)), f'"{word(rng)}"', word(rng), f"[{rng.randint(0, 9)}]"))
    if isinstance(value, int | float):
        return wrong_number(rng)
    if isinstance(value, str):
        return wrong_text(rng)
    return rng.choice((str(rng.randint(-99, 99)), f'"{word(rng)}"', word(rng), f"[[{rng.randint(0, 9)}]]"))


def places_wrong(good: dict[str, Any], rng: Random, count: int, readable: bool = False) -> bytes:
    """Up to `count` values wrong at once, none inside another, the keys in any order; `readable`: JSON all the same."""
    document = shuffled(good, rng)
    ways: list[tuple[Any, ...]] = []
    raws: list[str] = []
    for way, value in rng.sample(found := list(leaves(document)), len(found)):
        if len(ways) < count and not any(way[: len(w)] == w or w[: len(way)] == way for w in ways):
            raw = wrong_value(value, rng)
            while readable and not is_json(raw.encode("utf-8", "surrogatepass")):
                raw = wrong_value(value, rng)
            ways.append(way)
            raws.append(raw)
    marks = [f"\u0001{number}\u0002" for number in range(len(ways))]
    for way, mark in zip(ways, marks, strict=True):
        inner = document
        for key in way[:-1]:
            inner = inner[key]
        inner[way[-1]] = mark
    text = json.dumps(document)
    for mark, raw in zip(marks, raws, strict=True):
        text = text.replace(json.dumps(mark), raw)
    return text.encode("utf-8", "surrogatepass")


def field_wrong(good: dict[str, Any], rng: Random) -> bytes:
    """An unknown field or a doubled one, in any of the document's objects."""
    document = shuffled(good, rng)
    objects = [document, *(value for _, value in leaves(document) if isinstance(value, dict))]
    chosen = rng.choice(objects)
    if rng.random() < 0.5:
        chosen[f"un{word(rng, 3, 12)}"] = rng.choice((1, None, "x", [], {}, True, word(rng)))
        return json.dumps(document).encode()
    mark, name = f"\u0001{word(rng)}", rng.choice(list(chosen))
    value = json.dumps(chosen[name])
    chosen[mark] = 0
    return json.dumps(document).replace(f"{json.dumps(mark)}: 0", f"{json.dumps(name)}: {value}").encode()


def cut(good: dict[str, Any], rng: Random) -> bytes:
    """A true prefix of an object is no JSON."""
    text = text_of(good, rng).rstrip()
    return text[: rng.randrange(len(text))]


def beyond_ascii(good: dict[str, Any], rng: Random) -> bytes:
    """One byte with its top bit set among plain ones is no UTF-8."""
    text = bytearray(text_of(good, rng))
    text[rng.randrange(len(text))] |= 0x80
    return bytes(text)


def bent(good: dict[str, Any], rng: Random) -> bytes:
    """Bits flipped, bytes lost, added, swapped or doubled, until it is no JSON."""
    text = text_of(good, rng)
    while is_json(text):
        data, at, to = bytearray(text), rng.randrange(len(text)), rng.randrange(len(text))
        match rng.randrange(5):
            case 0:
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                del data[at : at + rng.randint(1, 4)]
            case 2:
                data[at:at] = rng.randbytes(rng.randint(1, 4))
            case 3:
                data[at], data[to] = data[to], data[at]
            case _:
                data[at:at] = data[min(at, to) : max(at, to)][:40]
        text = bytes(data) or b"{"
    return text


def noise(good: dict[str, Any], rng: Random) -> bytes:
    while is_json(raw := rng.randbytes(rng.randint(1, 200))):
        continue
    return raw


def other_document(good: dict[str, Any], rng: Random) -> bytes:
    """JSON, but no object."""
    text = text_of(good, rng).decode()
    other = (f"[{text}]", f"[{text},{text}]", json.dumps(text), str(rng.uniform(-9, 9)), f'"{word(rng)}"')
    return rng.choice(other).encode()


def too_deep(good: dict[str, Any], rng: Random) -> bytes:
    depth = rng.randint(33, 400)
    opened, closed = rng.choice((("[", "]"), ('{"a":', "}")))
    return (opened * depth + "1" + closed * rng.choice((depth, depth - 1, 0))).encode()


def no_length(rng: Random) -> str:
    """Of a body: no number, or too large a one."""
    few = rng.randint(0, 999)
    return rng.choice((
        f"{rng.choice('+-')}{few}", f"{few}{word(rng)}", word(rng), f"{few}e{rng.randint(0, 3)}", f"{few}.{few}",
        f"0x{few:x}", str(rng.randint(LONGEST + 1, 10**40)),
    ))  # fmt: skip


BODY_WAYS: tuple[tuple[int, Callable[[dict[str, Any], Random], bytes]], ...] = (
    (4, lambda good, rng: places_wrong(good, rng, 1)),
    (5, lambda good, rng: places_wrong(good, rng, 1, readable=True)),
    (4, lambda good, rng: places_wrong(good, rng, 2)),
    (6, lambda good, rng: places_wrong(good, rng, 2, readable=True)),
    (4, lambda good, rng: places_wrong(good, rng, rng.randint(3, 6), readable=True)),
    (4, field_wrong),
    (4, cut),
    (4, beyond_ascii),
    (6, bent),
    (1, noise),
    (1, other_document),
    (1, too_deep),
)


def wrong_body(good: dict[str, Any], rng: Random) -> bytes:
    (way,) = rng.choices([way for _, way in BODY_WAYS], [weight for weight, _ in BODY_WAYS])
    return way(good, rng)


# ------------------------------------------------------------------ tokens


def tampered(token: str, rng: Random) -> bytes:
    """A good token that is none any more: another signature, other claims under the old one, or parts of it."""
    head, claims, signature = token.split(".")
    match rng.randrange(5):
        case 0:
            raw = bytearray(base64.urlsafe_b64decode(signature + "=="))
            raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(8)
            signature = base64.urlsafe_b64encode(raw).rstrip(b"=").decode()
            return f"{head}.{claims}.{signature}".encode()
        case 1:
            signed = f"{head}.{claims}"
            at = rng.randrange(len(signed))
            letter = rng.choice([letter for letter in BASE64 if letter != signed[at]])
            return f"{signed[:at]}{letter}{signed[at + 1 :]}.{signature}".encode()
        case 2:
            return token[: rng.randint(1, len(token) - 1)].encode()
        case 3:
            parts = [head, claims, signature]
            while parts == [head, claims, signature]:
                parts = rng.choices((head, claims, signature, "", "e30"), k=rng.randint(2, 4))
            return ".".join(parts).encode()
        case _:
            return bytes(rng.choices(range(0x21, 0x100), k=rng.randint(1, 300)))


# ------------------------------------------------------------------ addresses


def strange_id(rng: Random) -> str:
    """A name that nobody has, written for a path."""
    if rng.random() < 0.2:
        return rng.choice(STRANGE_IDS)
    if rng.random() < 0.3:
        author = rng.choice(("plant-1", "plant-2", "robot-1", word(rng)))
        return f"{author}%3A{rng.randint(0, 999)}%3A{rng.randint(0, 10**6)}"
    raw = rng.randbytes(rng.randint(1, 60)) if rng.random() < 0.5 else f"un{word(rng, 1, 90)}".encode()
    return quote(raw, safe="") if raw not in (b".", b"..") else "un"


def strange_path(known: list[str], rng: Random) -> str:
    """A known path with some characters changed, or made of words."""
    if rng.random() < 0.3:
        return "/" + "/".join(word(rng, 1, 20) for _ in range(rng.randint(1, 6)))
    path = rng.choice(known)
    for _ in range(rng.randint(1, 3)):
        at = rng.randint(1, len(path))
        more = rng.choice((word(rng, 1, 3), "/", ";", "%00", "%2e%2e", "%2F", "%ff", ".", "~", "%20", "%0d%0a"))
        path = rng.choice((path[:at] + more + path[at:], path[: max(1, at - 1)] + path[at:], path[:at] + path[at:].upper()))
    return path


def leads_nowhere(path: str, templates: list[re.Pattern[str]]) -> bool:
    """No route has this path, nor what a client tidies it up to."""
    if path.startswith("//") or any(part in (".", "..") for part in path.split("/")):
        return False
    told = unquote_to_bytes(path).decode("utf-8", "replace")
    return not any(template.fullmatch(told) for template in templates)


# ------------------------------------------------------------------ requests


class Malformed:
    """What can be asked wrongly of one kind of service; `one()` asks for the next."""

    def __init__(self, doors: Doors, kind: str, rng: Random) -> None:
        self._kind, self._rng = kind, rng
        self._all = [each for each in doors.operations() if each.kind == kind]
        self._changing = [each for each in self._all if each.changing]
        self._takers = [each for each in self._all if each.takes_body]
        self._bodiless = [each for each in self._changing if not each.takes_body]
        self._with_id = [each for each in self._all if "{" in each.path]
        self._asking = [(each, p) for each in self._all for p in each.query]
        callers = {each.key: caller(doors, each) if each.changing else token_for(doors, each) for each in self._all}
        self._token = {key: token.encode() for key, token in callers.items()}
        self._operator = {"authorization": b"Bearer " + doors.token("operator").encode()}
        self._role = {role: doors.token(role) for role in ROLES}
        self._strangers = [(each, role) for each in self._changing for role in ROLES if role not in MAY[each.key]]
        self._bad = [token.encode() for token in tokens(doors).values() if token]
        self._finite = {each.key: list(_finite(GOOD[each.key])) for each in self._takers}
        document = doors.apps[kind].openapi()
        schemas = document["components"]["schemas"]
        self._required = {each.key: schemas[type_name(document, each)].get("required", []) for each in self._takers}
        paths = sorted({path for _, path, _ in routes(doors.apps[kind])})
        self._templates = [re.compile(re.sub(r"\\\{.*?\\\}", ".*", re.escape(path)), re.DOTALL) for path in paths]
        self._known = sorted({each.url().partition("?")[0] for each in self._all})
        self._methods: dict[str, set[str]] = {}
        for each in self._all:
            self._methods.setdefault(each.url().partition("?")[0], set()).add(each.method)
        ways = (
            (44, self._body), (2, self._missing), (1, self._too_long), (4, self._surplus), (5, self._header),
            (11, self._forged), (4, self._role_wrong), (2, self._scheme), (6, self._id), (7, self._path), (4, self._method),
            (4, self._query), (4, self._unknown_query), (6, self._several),
        )  # fmt: skip
        self._weights = [weight for weight, way in ways if self._can(way)]
        self._ways = [way for _, way in ways if self._can(way)]

    def one(self) -> Asked:
        (way,) = self._rng.choices(self._ways, self._weights)
        return way()

    def _can(self, way: Callable[[], Asked]) -> bool:
        needs = {self._query: self._asking, self._surplus: self._bodiless, self._missing: any(self._required.values())}
        return bool(needs.get(way, True))

    # with a good token and at the right place

    def _wrong_body(self, each: Operation) -> bytes:
        if self._rng.random() < 0.15:
            return self._rng.choice(self._finite[each.key])
        return wrong_body(GOOD[each.key], self._rng)

    def _good(self, each: Operation) -> bytes:
        return text_of(GOOD[each.key], self._rng) if each.takes_body else b""

    def _ask(self, each: Operation, wrong: str, *statuses: int, **more: Any) -> Asked:
        """With the right path, token and body, but for what is given."""
        headers = {"authorization": b"Bearer " + self._token[each.key]} | more.pop("headers", {})
        more = {"path": each.url(), "content": self._good(each)} | more
        return Asked(self._kind, each.method, wrong=wrong, headers=headers, statuses=statuses, **more)

    def _body(self) -> Asked:
        each = self._rng.choice(self._takers)
        return self._ask(each, "body", 400, 422, content=self._wrong_body(each))

    def _missing(self) -> Asked:
        each = self._rng.choice([each for each in self._takers if self._required[each.key]])
        names, rng = self._required[each.key], self._rng
        gone = set(rng.sample(names, rng.randint(1, len(names))))
        kept = {name: value for name, value in shuffled(GOOD[each.key], rng).items() if name not in gone}
        return self._ask(each, "a field is missing", 422, content=json.dumps(kept).encode())

    def _too_long(self) -> Asked:
        each, size = self._rng.choice(self._takers), LONGEST + self._rng.randint(1, 5000)
        return self._ask(each, "too long", 413, content=self._good(each).ljust(size))

    def _surplus(self) -> Asked:
        each = self._rng.choice(self._bodiless)
        while (raw := wrong_body(GOOD["plant", "POST", "/tasks"], self._rng)).strip() in (b"", b"{}"):
            continue
        return self._ask(each, "a body where none is taken", 400, content=raw)

    def _header(self) -> Asked:
        rng, each = self._rng, self._rng.choice(self._changing)
        events = [each for each in self._all if each.path == "/events"]
        match rng.choice(("length", "lengths", "key", "event") if events else ("length", "lengths", "key")):
            case "event":
                headers = {"last-event-id": str(rng.randint(10**20, 10**300)).encode()}
                return self._ask(events[0], "an event's number too long", 422, path="/events?follow=false", headers=headers)
            case "key" if each.method == "POST":
                headers = {"idempotency-key": bytes(rng.choices(range(0x21, 0x7F), k=rng.randint(129, 3000)))}
                return self._ask(each, "a key too long", 422, headers=headers)
            case "lengths":
                encoding = rng.choice(("chunked", word(rng))).encode()
                headers = {"content-length": b"%d" % rng.randint(0, 10**6), "transfer-encoding": encoding}
                return self._ask(each, "two lengths", 400, headers=headers)
            case _:
                headers = {"content-length": no_length(rng).encode()}
                return self._ask(each, "a length that is none", 400, 413, headers=headers)

    # by somebody else

    def _forged(self) -> Asked:
        each = self._rng.choice(self._changing)
        return self._ask(each, "a token that is none", 401, headers={"authorization": b"Bearer " + self._no_token()})

    def _no_token(self) -> bytes:
        if self._rng.random() < 0.1:
            return self._rng.choice(self._bad)
        return tampered(self._role[self._rng.choice(list(self._role))], self._rng)

    def _role_wrong(self) -> Asked:
        each, role = self._rng.choice(self._strangers)
        headers = {"authorization": b"Bearer " + self._role[role].encode()}
        return self._ask(each, f"the token of: {role}", 403, headers=headers)

    def _scheme(self) -> Asked:
        each, rng = self._rng.choice(self._changing), self._rng
        scheme = rng.choice((*SCHEMES, f"{word(rng, 2, 12)} {{}}", f"Bearer{word(rng)} {{}}"))
        headers = {"authorization": scheme.encode().replace(b"{}", self._token[each.key])}
        return self._ask(each, "another scheme", 401, headers=headers)

    # elsewhere

    def _id(self) -> Asked:
        each = self._rng.choice(self._with_id)
        head, _, tail = each.path.partition("{")
        there = replace(each, path=head + strange_id(self._rng) + tail.partition("}")[2])
        return self._ask(each, "nobody's name", path=there.url())

    def _path(self) -> Asked:
        while not leads_nowhere(path := strange_path(self._known, self._rng), self._templates):
            continue
        method = self._rng.choice(("GET", "POST", "PUT", "PATCH", "DELETE"))
        return Asked(self._kind, method, path, "no such path", self._operator, statuses=(404,))

    def _method(self) -> Asked:
        rng, path = self._rng, self._rng.choice(self._known)
        taken = {*self._methods[path], "HEAD"}
        while (method := rng.choice((*METHODS, "".join(rng.choices("BFJKQVWXZ", k=rng.randint(3, 9)))))).upper() in taken:
            continue
        content = b"{}" if method != "GET" else b""
        return Asked(self._kind, method, path, "no such method", self._operator, content, (405,))

    def _query(self) -> Asked:
        each, parameter = self._rng.choice(self._asking)
        values = list(wrong_queries(parameter))
        if "1;2" in values or "maybe" in values:
            values += [f"{self._rng.randint(0, 9999)}{word(self._rng)}", word(self._rng, 1, 40), f"1.{word(self._rng)}"] * 9
        elif "JSON" in values:
            values += [f"!{word(self._rng, 1, 40)}"] * 20
        else:
            values.append(word(self._rng, 5000, 6000))
        path = each.url().partition("?")[0]
        return self._ask(each, "a query's value", 422, path=f"{path}?{parameter['name']}={self._rng.choice(values)}")

    def _unknown_query(self) -> Asked:
        each, rng = self._rng.choice(self._all), self._rng
        asked = f"un{word(rng, 1, 30)}={word(rng, 0, 9)}"
        if not each.changing and rng.random() < 0.1:
            asked = rng.choice(BROKEN_QUERIES)
        return self._ask(each, "a query nobody knows", 422, path=f"{each.url().partition('?')[0]}?{asked}")

    # several at once

    def _several(self) -> Asked:
        """Two or more of body, query, length and token."""
        each, rng = self._rng.choice(self._takers), self._rng
        wrong = rng.sample(("body", "query", "length", "token"), rng.randint(2, 4))
        more: dict[str, Any] = {"headers": {}}
        if "body" in wrong:
            more["content"] = self._wrong_body(each)
        if "query" in wrong:
            more["path"] = f"{each.url()}?un{word(rng)}={word(rng)}"
        if "length" in wrong:
            more["headers"]["content-length"] = f"-{rng.randint(0, 10**6)}".encode()
        if "token" in wrong:
            more["headers"]["authorization"] = b"Bearer " + self._no_token()
        return self._ask(each, " and ".join(sorted(wrong)), 400, 401, 413, 422, **more)


def _finite(good: dict[str, Any]) -> Iterator[bytes]:
    """The bodies of `test_bad_bodies`."""
    for text in (*one_place_wrong(good), *one_field_wrong(good)):
        yield text.encode("utf-8", "surrogatepass")
    yield from not_documents(good)


class Unseen:
    """Tells what was asked before, in two megabytes whatever comes; fewer than 1 % of new ones are taken for old."""

    def __init__(self) -> None:
        self._bits = bytearray(b"\xff") * (1 << 21)

    def __call__(self, asked: Asked) -> bool:
        at = hash(asked_key(asked)) % (8 * len(self._bits))
        bit = 1 << at % 8
        new = bool(self._bits[at // 8] & bit)
        self._bits[at // 8] &= 0xFF ^ bit
        return new


def asked_key(asked: Asked) -> tuple[Any, ...]:
    return asked.kind, asked.method, asked.path, *sorted(asked.headers.items()), asked.content


def malformed(doors: Doors, seed: int) -> Iterator[Asked]:
    """For ever, one kind of service after the other, no two alike."""
    sources = [Malformed(doors, kind, Random(f"{seed}/{kind}")) for kind in KINDS]
    unseen = Unseen()
    while True:
        for source in sources:
            while not unseen(asked := source.one()):
                continue
            yield asked
