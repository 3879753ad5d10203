"""Asking peers: every answer is checked, and silence is an error with a name."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable

import httpx
import pytest

from core.clock import VirtualClock
from core.errors import Conflict, GardenError, NotFound, PeerDown, Refused, Unavailable
from core.mesh.auth import GardenKey
from core.mesh.client import Mesh, retry
from core.mesh.peers import Peer, Peers
from core.virtual import run_virtual
from core.wire.documents import Document

IDENTITY = GardenKey.from_seed(1).issue("plant-1", "plant", 0.0)


class Word(Document):
    word: str


Handler = Callable[[httpx.Request], Awaitable[httpx.Response]]


def mesh(handler: Handler, timeout_s: float = 2.0) -> Mesh:
    return Mesh(httpx.MockTransport(handler), IDENTITY, VirtualClock(), timeout_s)


def peer(name: str = "robot-1") -> Peer:
    return Peer(id=name, kind="robot", url=f"http://{name}:80")


def call(handler: Handler) -> Word:
    return run_virtual(mesh(handler).call(peer(), "POST", "/x", Word(word="hi"), expect=Word, key="k"))


def answer(code: int, **document: object) -> Handler:
    async def handler(request: httpx.Request) -> httpx.Response:
        return httpx.Response(code, json=document)

    return handler


def test_a_call_carries_token_key_and_body() -> None:
    async def echo(request: httpx.Request) -> httpx.Response:
        assert request.headers["authorization"] == f"Bearer {IDENTITY.token}"
        assert request.headers["idempotency-key"] == "k"
        assert request.headers["content-type"] == "application/json"
        return httpx.Response(200, content=request.content)

    assert call(echo) == Word(word="hi")


@pytest.mark.parametrize(
    ("status", "title", "error"),
    [(409, "Refused", Refused), (409, "Conflict", Conflict), (404, "", NotFound), (503, "", Unavailable)],
)
def test_a_problem_becomes_the_error_it_names(status: int, title: str, error: type[GardenError]) -> None:
    with pytest.raises(error, match="because") as caught:
        call(answer(status, title=title, status=status, detail="because", hint="do so"))
    assert (caught.value.status, caught.value.hint) == (status, "do so")


def test_a_refusal_without_a_problem_is_still_an_error() -> None:
    with pytest.raises(GardenError, match="418"):
        call(answer(418, nonsense=1))


@pytest.mark.parametrize("document", [{}, {"word": 1}, {"word": "a", "more": 1}])
def test_an_answer_of_another_shape_counts_as_down(document: dict[str, object]) -> None:
    with pytest.raises(PeerDown, match="robot-1"):
        call(answer(200, **document))


def test_a_closed_door_counts_as_down() -> None:
    async def closed(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("refused")

    with pytest.raises(PeerDown, match="not reachable"):
        call(closed)


async def silent(request: httpx.Request) -> httpx.Response:
    await asyncio.sleep(1e6)
    raise AssertionError


def test_silence_counts_as_down_after_the_time_limit() -> None:
    with pytest.raises(PeerDown, match="within 2 s"):
        call(silent)


def test_asking_all_takes_as_long_as_the_slowest_and_loses_nobody() -> None:
    async def some(request: httpx.Request) -> httpx.Response:
        if request.url.host == "robot-2":
            return await silent(request)
        await asyncio.sleep(0.5)
        return httpx.Response(200, content=request.content)

    async def go() -> tuple[dict[str, Word | GardenError], float]:
        peers = [peer(f"robot-{n}") for n in range(1, 40)]
        answers = await mesh(some).ask_all(peers, "POST", "/bids", Word(word="?"), expect=Word)
        return answers, asyncio.get_running_loop().time()

    answers, took_s = run_virtual(go())
    assert took_s == pytest.approx(2.0)
    assert list(answers) == [f"robot-{n}" for n in range(1, 40)]
    assert isinstance(answers.pop("robot-2"), PeerDown)
    assert all(found == Word(word="?") for found in answers.values())


def test_each_answer_is_told_as_it_comes() -> None:
    async def by_number(request: httpx.Request) -> httpx.Response:
        await asyncio.sleep(1.0 / int(request.url.host[-1]))
        return httpx.Response(200, content=request.content)

    heard: list[str] = []
    peers = [peer(f"robot-{n}") for n in (1, 2, 3)]
    run_virtual(
        mesh(by_number).ask_all(peers, "POST", "/", Word(word="?"), expect=Word, each=lambda name, _: heard.append(name))
    )
    assert heard == ["robot-3", "robot-2", "robot-1"]


def test_retry_waits_longer_each_time_and_gives_the_last_error() -> None:
    tried: list[float] = []

    async def attempt() -> None:
        tried.append(asyncio.get_running_loop().time())
        raise PeerDown(f"try {len(tried)}")

    class Most:
        def random(self) -> float:
            return 1.0

    with pytest.raises(PeerDown, match="try 5"):
        run_virtual(retry(VirtualClock(), Most(), attempt, tries=5, base_s=1.0, cap_s=3.0))
    assert tried == [0.0, 1.0, 3.0, 6.0, 9.0]


def test_retry_stops_at_an_answer_that_will_not_change() -> None:
    tried = []

    async def attempt() -> None:
        tried.append(1)
        raise Refused("no")

    with pytest.raises(Refused):
        run_virtual(retry(VirtualClock(), random.Random(1), attempt))
    assert len(tried) == 1


def test_peers_are_found_by_kind_and_name_and_strangers_are_not() -> None:
    peers = Peers([peer(), Peer(id="plant-1", kind="plant", url="http://p:1")])
    assert [p.id for p in peers.of_kind("robot")] == ["robot-1"]
    assert peers.get("plant-1").url == "http://p:1"
    with pytest.raises(NotFound) as caught:
        peers.get("robot-9")
    assert "robot-1" in caught.value.hint
