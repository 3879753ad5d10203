"""Asking other nodes: one document out, one checked document back."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from core.clock import Clock
from core.errors import (
    BadRequest,
    Conflict,
    Forbidden,
    GardenError,
    NotFound,
    PeerDown,
    PreconditionFailed,
    Refused,
    StorageError,
    TooLarge,
    Unauthorised,
    Unavailable,
    Unprocessable,
)
from core.mesh.auth import Identity
from core.mesh.peers import Peer
from core.mesh.plain import check
from core.wire.documents import Document, Problem

if TYPE_CHECKING:
    import httpx

D = TypeVar("D")
T = TypeVar("T")
ANSWER_BYTES_MAX = 4 * 1024 * 1024
AT_ONCE_MAX = 256
FLOOD_BYTES_MAX = 45_000
"""A longer body does not fit into a parcel."""
ROBOTS = "*robot"
"""All robots, as the address of a flood; here, since `core.mesh.parcels` is loaded only where flooding is on."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What came back, unread."""

    status: int
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict)
    """Names in lower case."""


class PeerTransport(Protocol):
    """Carries one request. An `OSError` means that nobody answered, or not in HTTP."""

    async def send(self, method: str, url: str, headers: Mapping[str, str], body: bytes) -> Answer: ...

    async def aclose(self) -> None: ...


class Carrier(Protocol):
    """A transport that also reaches peers beyond one hop, by neighbours that pass requests on (`core.mesh.courier`)."""

    async def carry(
        self, peer: Peer, method: str, path: str, headers: Mapping[str, str], body: bytes, within_s: float
    ) -> Answer:
        """An `OSError` means that nobody answered."""
        ...

    async def flood(
        self,
        to: str,
        method: str,
        path: str,
        headers: Mapping[str, str],
        body: bytes,
        within_s: float,
        heard: Callable[[Peer, Answer], None],
    ) -> None:
        """Ask all that `to` means, once each; returns when no more answers are awaited. Raises OSError."""
        ...


class HttpxTransport:
    """Any httpx transport (`httpx.ASGITransport`, the lab's in-memory mesh) as a PeerTransport."""

    def __init__(self, inner: httpx.AsyncBaseTransport) -> None:
        self._inner = inner

    async def send(self, method: str, url: str, headers: Mapping[str, str], body: bytes) -> Answer:
        import httpx  # only tests and the lab need it: a pot's process stays small

        request = httpx.Request(method, url, headers=headers, content=body)
        try:
            response = await self._inner.handle_async_request(request)
            try:
                content = await response.aread()
            finally:
                await response.aclose()
        except httpx.TransportError as error:
            raise ConnectionError(str(error)) from error
        return Answer(response.status_code, content, {name.lower(): value for name, value in response.headers.items()})

    async def aclose(self) -> None:
        await self._inner.aclose()


def _transport(given: PeerTransport | httpx.AsyncBaseTransport) -> PeerTransport:
    if hasattr(given, "handle_async_request"):
        return HttpxTransport(cast("httpx.AsyncBaseTransport", given))
    return given


class Mesh:
    """Calls to peers, signed with this node's token. Time-outs are seconds of the loop, not of the garden."""

    def __init__(
        self,
        transport: PeerTransport | httpx.AsyncBaseTransport,
        identity: Identity | None,
        clock: Clock,
        timeout_s: float = 2.0,
    ) -> None:
        self._transport = _transport(transport)
        self._carrier = cast(Carrier, self._transport) if hasattr(self._transport, "carry") else None
        self._headers = {"authorization": f"Bearer {identity.token}"} if identity else {}
        self._clock = clock
        self._timeout_s = timeout_s
        self.outcomes: Counter[tuple[str, str]] = Counter()
        """Requests by peer and how they ended: `answered`, `refused`, `silent`."""

    async def call(
        self,
        peer: Peer,
        method: str,
        path: str,
        body: Document | None = None,
        *,
        expect: type[D],
        key: str = "",
        timeout_s: float | None = None,
    ) -> D:
        """Ask one peer; `expect` is the answer's model (or `list[Model]`). `key` makes a POST safe to repeat.

        Raises PeerDown when nobody answered in time or the answer is nonsense, else the error the peer's problem names.
        """
        answer = await self.exchange(peer, method, path, _dump(body), key=key, timeout_s=timeout_s)
        return read(peer, answer, expect)

    async def exchange(
        self,
        peer: Peer,
        method: str,
        path: str,
        body: bytes = b"",
        *,
        key: str = "",
        headers: Mapping[str, str] | None = None,
        timeout_s: float | None = None,
    ) -> Answer:
        """The raw answer, whatever its status; raises PeerDown when there is none."""
        sent = self._sent(body, key) | dict(headers or {})
        limit_s = self._timeout_s if timeout_s is None else timeout_s
        try:
            async with asyncio.timeout(limit_s):
                if self._carrier is not None:
                    answer = await self._carrier.carry(peer, method, path, sent, body, limit_s)
                else:
                    answer = await self._transport.send(method, peer.url + path, sent, body)
        except TimeoutError as error:
            self.outcomes[peer.id, "silent"] += 1
            raise PeerDown(f"{peer.id} did not answer {method} {path} within {limit_s:g} s") from error
        except OSError as error:
            self.outcomes[peer.id, "silent"] += 1
            raise PeerDown(f"{peer.id} is not reachable at {peer.url}: {error or type(error).__name__}") from error
        self.outcomes[peer.id, "answered" if answer.status < 400 else "refused"] += 1
        return answer

    async def ask_all(
        self,
        peers: Iterable[Peer],
        method: str,
        path: str,
        body: Document | None = None,
        *,
        expect: type[D],
        timeout_s: float | None = None,
        each: Callable[[str, D | GardenError], None] | None = None,
        flood_to: str = "",
    ) -> dict[str, D | GardenError]:
        """Ask many at once, the body serialised once; every peer has its entry, an error in place of a missing answer.

        `each` is called with every peer's answer as it comes in. Where requests may be flooded, `flood_to` (`ROBOTS`
        or another address of `core.mesh.parcels`) lets one flood ask them all.
        """
        content = _dump(body)
        if flood_to and self._carrier is not None and len(content) <= FLOOD_BYTES_MAX:
            return await self._ask_by_flood(
                self._carrier, flood_to, list(peers), method, path, content, expect, timeout_s, each
            )
        answers: dict[str, D | GardenError] = {}
        gate = asyncio.Semaphore(AT_ONCE_MAX)

        async def ask(peer: Peer) -> None:
            try:
                async with gate:
                    answer = await self.exchange(peer, method, path, content, timeout_s=timeout_s)
                answers[peer.id] = read(peer, answer, expect)
            except GardenError as error:
                answers[peer.id] = error
            if each is not None:
                each(peer.id, answers[peer.id])

        asked = list(peers)
        async with asyncio.TaskGroup() as group:
            for peer in asked:
                group.create_task(ask(peer))
        return {peer.id: answers[peer.id] for peer in asked}

    async def _ask_by_flood(
        self, carrier: Carrier, to: str, peers: list[Peer], method: str, path: str, content: bytes, expect: type[D],
        timeout_s: float | None, each: Callable[[str, D | GardenError], None] | None,
    ) -> dict[str, D | GardenError]:  # fmt: skip
        limit_s = self._timeout_s if timeout_s is None else timeout_s
        missing = {peer.id: peer for peer in peers}
        answers: dict[str, D | GardenError] = {}

        def ended(peer: Peer, answer: D | GardenError, how: str) -> None:
            self.outcomes[peer.id, how] += 1
            answers[peer.id] = answer
            if each is not None:
                each(peer.id, answer)

        def heard(peer: Peer, answer: Answer) -> None:
            if missing.pop(peer.id, None) is None:
                return
            try:
                ended(peer, read(peer, answer, expect), "answered")
            except GardenError as error:
                ended(peer, error, "refused")

        try:
            async with asyncio.timeout(limit_s):
                await carrier.flood(to, method, path, self._sent(content, ""), content, limit_s, heard)
        except (OSError, TimeoutError):
            pass
        for peer in list(missing.values()):
            ended(peer, PeerDown(f"{peer.id} did not answer {method} {path} within {limit_s:g} s"), "silent")
        return {peer.id: answers[peer.id] for peer in peers}

    def _sent(self, body: bytes, key: str) -> dict[str, str]:
        headers = dict(self._headers)
        if body:
            headers["content-type"] = "application/json"
        if key:
            headers["idempotency-key"] = key
        return headers

    async def aclose(self) -> None:
        await self._transport.aclose()


def _dump(body: Document | None) -> bytes:
    return b"" if body is None else body.model_dump_json().encode()


@lru_cache(maxsize=256)
def _adapter(expect: Any) -> TypeAdapter[Any]:
    return TypeAdapter(expect)


def read(peer: Peer, answer: Answer, expect: type[D]) -> D:
    """The answer's document; raises as `Mesh.call` does."""
    if answer.status >= 400:
        raise _error(peer, answer)
    if len(answer.body) > ANSWER_BYTES_MAX:
        raise PeerDown(f"{peer.id} answered with {len(answer.body)} bytes, more than we read")
    try:
        check(answer.body)
        value: D = _adapter(cast(Any, expect)).validate_json(answer.body)
    except (ValidationError, ValueError) as error:
        raise PeerDown(f"{peer.id} answered something else than expected: {str(error)[:200]}") from error
    return value


_ERRORS: dict[int, type[GardenError]] = {
    400: BadRequest,
    401: Unauthorised,
    403: Forbidden,
    404: NotFound,
    409: Conflict,
    412: PreconditionFailed,
    413: TooLarge,
    422: Unprocessable,
    503: Unavailable,
    507: StorageError,
}


def _error(peer: Peer, answer: Answer) -> GardenError:
    """The error a problem document stands for; its `status` is the answer's."""
    try:
        check(answer.body)
        problem = Problem.model_validate_json(answer.body)
    except (ValidationError, ValueError):
        problem = Problem(title="", status=answer.status, detail=f"{peer.id} answered {answer.status} without saying why")
    cls = Refused if problem.title == Refused.title else _ERRORS.get(answer.status)
    if cls is None:
        cls = BadRequest if answer.status < 500 else GardenError
    error = cls(problem.detail or problem.title, hint=problem.hint)
    error.status = answer.status
    return error


class Chance(Protocol):
    """`random.Random` and `numpy.random.Generator` both are one."""

    def random(self) -> float: ...


async def retry(
    clock: Clock,
    rng: Chance,
    attempt: Callable[[], Awaitable[T]],
    *,
    tries: int = 5,
    base_s: float = 0.2,
    cap_s: float = 5.0,
) -> T:
    """Try again while the answer is Unavailable, after a random part of a doubling, capped wait [garden s].

    The last error is raised as it came. (Full jitter: Brooker, Exponential Backoff and Jitter.)
    """
    for done in range(tries - 1):
        try:
            return await attempt()
        except Unavailable:
            await clock.sleep(min(cap_s, base_s * 2**done) * rng.random())
    return await attempt()
