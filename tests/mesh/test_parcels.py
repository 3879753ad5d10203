"""Without routing, neighbours pass questions on: within a hop limit, each once, and nobody on the way can change a word."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import httpx
import jwt
import pytest
from fastapi import FastAPI
from fastapi.responses import StreamingResponse

from core.clock import VirtualClock
from core.errors import ConfigError, Forbidden, GardenError, PeerDown
from core.mesh.auth import Caller, Enrolled, Identity, Verifier, make_garden
from core.mesh.chassis import allow, body, create_app
from core.mesh.client import ROBOTS, Answer, HttpxTransport, Mesh
from core.mesh.courier import LOST_S, Courier
from core.mesh.introduction import Introducer
from core.mesh.node import Node
from core.mesh.parcels import BODY_BYTES_MAX, EVERYBODY, LIFE_S, Parcel, ParcelAnswer, packed, sealed
from core.mesh.peers import FLOOD, Peer, Peers
from core.mesh.presence import add_presence, introducer
from core.mesh.relay import FLOODS_BURST, WORKS_MAX, Relay
from core.mesh.runtime import GardenSettings, joining, make_courier
from core.virtual import run_virtual
from core.wire.documents import Document, NodeCard
from lab.mesh import MemoryMesh

Links = Iterable[tuple[str, str]]
LINE = [("plant-1", "plant-2"), ("plant-2", "plant-3"), ("plant-3", "robot-1")]
RING = [*LINE, ("robot-1", "plant-4"), ("plant-4", "plant-1")]
MESHED = [*RING, ("plant-1", "plant-3"), ("plant-2", "robot-1"), ("plant-2", "plant-4"), ("plant-3", "plant-4")]


class Word(Document):
    """What the nodes of these tests take, and answer."""

    said: str
    by: str = ""


@dataclass
class Host:
    """One node: its app does as it is told, and remembers it."""

    id: str
    clock: VirtualClock
    app: FastAPI
    relay: Relay
    courier: Courier
    mesh: Mesh
    peers: Peers
    identity: Identity
    me: Introducer
    did: list[tuple[str, str]] = field(default_factory=list)
    way_out: Any = None

    def peer(self, id: str, kind: str = "robot") -> Peer:
        known = self.peers.find(id)
        return known or Peer(id=id, kind=kind, url="http://10.9.9.9:1")  # type: ignore[arg-type]


class Air:
    """Hosts that hear only those they are linked with. Requests are counted by link."""

    def __init__(self, keys: Path, links: Links, hops: int) -> None:
        self.keys, self.links, self.hops = keys, [*links], hops
        self.clock = VirtualClock()
        self.mesh = MemoryMesh(self.clock, Random(1))
        self.hosts: dict[str, Host] = {}
        self.running: list[asyncio.Future[None]] = []
        self.urls = {id: f"http://10.0.0.{n}:8100" for n, id in enumerate(self.names(), 1)}

    def names(self) -> list[str]:
        return sorted({id for link in self.links for id in link})

    def host(self, id: str) -> Host:
        kind = id.partition("-")[0]
        reach = [b if a == id else a for a, b in self.links if id in (a, b)]
        peers = Peers(Peer(id=other, kind=other.partition("-")[0], url=self.urls[other]) for other in reach)  # type: ignore[arg-type]
        identity, verifier = Identity.load(self.keys / id), Verifier.load(self.keys)
        transport = self.mesh.transport(id)
        relay = Relay(self.hops, peers, verifier, identity, HttpxTransport(transport), self.clock)
        courier = Courier(relay, Random(id))
        mesh = Mesh(courier, identity, self.clock)
        app = create_app(card=lambda: NodeCard(id=id, kind=kind), clock=self.clock, verifier=verifier, ready=list)
        me = introducer(identity, kind, self.urls[id])
        assert me is not None
        add_presence(app, peers, self.clock, identity, kind, self.urls[id])
        host = Host(id, self.clock, app, relay, courier, mesh, peers, identity, me, way_out=transport)
        routes(host)
        host.courier.join(me, app)
        self.mesh.attach(id, self.urls[id].removeprefix("http://"), app)
        return host

    def __getitem__(self, id: str) -> Host:
        return self.hosts[id]

    def kill(self, id: str) -> None:
        self.hosts[id].way_out.alive = False
        self.mesh.detach(self.urls[id].removeprefix("http://"))

    def restart(self, id: str) -> None:
        """As a process that begins now and remembers nothing. Inside `up`."""
        self.kill(id)
        self.hosts[id] = self.host(id)
        self.running.append(asyncio.ensure_future(self.hosts[id].relay.run()))

    @asynccontextmanager
    async def up(self, *, look: bool = False) -> AsyncIterator[Air]:
        """With look, everybody also looks around."""
        self.hosts = {id: self.host(id) for id in self.names()}
        loops = [host.relay.run for host in self.hosts.values()]
        loops += [host.courier.run for host in self.hosts.values() if look]
        self.running = [asyncio.ensure_future(loop()) for loop in loops]
        await self.clock.sleep(5.0 if look else 0.0)
        try:
            yield self
        finally:
            for task in self.running:
                task.cancel()
            await asyncio.wait(self.running)


def routes(host: Host) -> None:
    """A toy node."""

    @host.app.post("/say")
    async def say(caller: Caller = allow("plant", "robot"), word: Word = body(Word)) -> Word:
        host.did.append((word.said, caller.subject))
        if word.said == "slowly":
            await host.clock.sleep(0.6)
        return Word(said=f"{host.id} heard {word.said}", by=caller.subject)

    @host.app.post("/robots-only")
    async def robots_only(caller: Caller = allow("robot"), word: Word = body(Word)) -> Word:
        host.did.append((word.said, caller.subject))
        return word

    @host.app.get("/long")
    async def long() -> list[str]:
        return ["x" * 1000] * 60

    @host.app.get("/endless")
    async def endless() -> StreamingResponse:
        async def told() -> AsyncIterator[bytes]:
            while True:
                yield b"on\n"
                await host.clock.sleep(0.1)

        return StreamingResponse(told())


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    nodes = [Enrolled(f"plant-{n}", "plant") for n in range(1, 6)] + [Enrolled(f"robot-{n}", "robot") for n in (1, 2)]
    make_garden(folder, nodes, now_s=0.0)
    make_garden(folder / "other", nodes, now_s=0.0)
    return folder


def play(air: Air, story: Callable[[Air], Awaitable[Any]], *, look: bool = False) -> Any:
    async def go() -> Any:
        async with air.up(look=look):
            return await story(air)

    return run_virtual(go())


async def flooded(host: Host, to: str, word: str = "hello", path: str = "/say") -> dict[str, Answer]:
    found: dict[str, Answer] = {}
    content = Word(said=word).model_dump_json().encode()

    def heard(peer: Peer, answer: Answer) -> None:
        assert peer.id not in found
        found[peer.id] = answer

    await host.courier.flood(to, "POST", path, {"content-type": "application/json"}, content, 2.0, heard)
    return found


# ------------------------------------------------------------------ how far


@pytest.mark.parametrize(("hops", "reached"), [(1, set()), (2, set()), (3, {"robot-1"}), (9, {"robot-1"})])
def test_a_question_reaches_robots_within_the_hop_limit_and_no_farther(keys: Path, hops: int, reached: set[str]) -> None:
    async def story(air: Air) -> None:
        assert set(await flooded(air["plant-1"], ROBOTS)) == reached
        assert {id for id, host in air.hosts.items() if host.did} == reached

    play(Air(keys, LINE, hops), story)


def test_a_relay_with_a_smaller_limit_passes_nothing_on_that_came_so_far(keys: Path) -> None:
    async def story(air: Air) -> None:
        air["plant-3"].relay.hops = 2
        assert set(await flooded(air["plant-1"], EVERYBODY)) == {"plant-2", "plant-3"}

    play(Air(keys, LINE, 3), story)


@pytest.mark.parametrize("links", [RING, MESHED], ids=["ring", "meshed"])
def test_everybody_answers_a_flood_once_for_at_most_two_messages_a_link(keys: Path, links: Links) -> None:
    async def story(air: Air) -> None:
        others = set(air.hosts) - {"plant-1"}
        assert set(await flooded(air["plant-1"], EVERYBODY)) == others
        assert {id for id, host in air.hosts.items() if host.did == [("hello", "plant-1")]} == others
        assert air.mesh.requests <= 2 * len(air.links) - len(others)

    play(Air(keys, links, 8), story)


def test_the_answers_of_a_flood_are_matched_to_those_asked_and_who_is_missing_was_silent(keys: Path) -> None:
    async def story(air: Air) -> None:
        asked = [air["plant-1"].peer("robot-1"), air["plant-1"].peer("robot-2")]
        came: list[str] = []
        answers = await air["plant-1"].mesh.ask_all(
            asked, "POST", "/say", Word(said="bids"), expect=Word, each=lambda id, answer: came.append(id), flood_to=ROBOTS
        )
        assert answers["robot-1"] == Word(said="robot-1 heard bids", by="plant-1")
        assert isinstance(answers["robot-2"], PeerDown)
        assert came == ["robot-1", "robot-2"]

    play(Air(keys, LINE, 3), story)


def test_a_silent_neighbour_does_not_keep_the_answers_of_others_and_is_left_out_after_two(keys: Path) -> None:
    air = Air(keys, [*LINE, ("plant-1", "plant-5")], 3)

    async def story(air: Air) -> None:
        air.mesh.leg("plant-1", "plant-5").cut = True
        took_s = []
        for _ in range(3):
            began_s = air.clock.now()
            assert set(await flooded(air["plant-1"], ROBOTS)) == {"robot-1"}
            took_s.append(air.clock.now() - began_s)
        assert [t < 0.1 for t in took_s] == [False, False, True]
        assert max(took_s) < 2.0

    play(air, story)


# ------------------------------------------------------------------ there and back


def test_whoever_was_found_is_asked_along_the_way_and_answers_come_back_as_they_were(keys: Path) -> None:
    async def story(air: Air) -> None:
        plant, robot = air["plant-1"], air["robot-1"]
        await flooded(plant, ROBOTS)
        for one, other, way in (
            (plant, robot, ("plant-2", "plant-3", "robot-1")),
            (robot, plant, ("plant-3", "plant-2", "plant-1")),
        ):
            contact = one.peers.contact(other.id)
            assert contact is not None
            assert (contact.source, contact.hops, contact.way) == (FLOOD, 3, way)
            assert contact.peer.url == air.urls[other.id]
            before = air.mesh.requests
            word = await one.mesh.call(contact.peer, "POST", "/say", Word(said="back"), expect=Word)
            assert word == Word(said=f"{other.id} heard back", by=one.id)
            assert air.mesh.requests - before == 3
        with pytest.raises(Forbidden, match="plant-1 is a plant"):
            await plant.mesh.call(plant.peer("robot-1"), "POST", "/robots-only", Word(said="x"), expect=Word)
        missing = await plant.mesh.exchange(plant.peer("robot-1"), "GET", "/nothing?here=1")
        assert missing.status == 404
        assert json.loads(missing.body)["instance"] == "/nothing"

    play(Air(keys, LINE, 3), story)


def test_looking_around_finds_everybody_within_the_limit_tells_how_far_and_loses_who_went(keys: Path) -> None:
    async def story(air: Air) -> None:
        async def seen() -> dict[str, tuple[str, int, list[str], bool]]:
            transport = httpx.ASGITransport(air["plant-1"].app)
            async with httpx.AsyncClient(transport=transport, base_url="http://plant") as client:
                lines = (await client.get("/peers")).json()
            return {line["id"]: (line["source"], line["hops"], line["way"], line["present"]) for line in lines}

        assert await seen() == {
            "plant-2": ("static list", 1, [], True),
            "plant-3": ("flood", 2, ["plant-2", "plant-3"], True),
        }
        assert [peer.id for peer in air["robot-1"].peers.of_kind("plant")] == ["plant-3", "plant-2"]
        air.kill("plant-3")
        await air.clock.sleep(LOST_S + 25.0)
        assert (await seen())["plant-3"] == ("flood", 2, [], False)

    play(Air(keys, LINE, 2), story, look=True)


def test_who_came_into_reach_is_asked_directly_and_who_left_it_by_a_way(keys: Path) -> None:
    """Both list each other, as nodes do that can sometimes hear one another."""
    air = Air(keys, [*LINE, ("plant-1", "robot-1")], 3)

    async def story(air: Air) -> None:
        plant = air["plant-1"]
        robot, legs = (
            plant.peer("robot-1"),
            [air.mesh.leg(*link) for link in (("plant-1", "robot-1"), ("robot-1", "plant-1"))],
        )
        ways = []
        for cut in (False, True, False):
            for leg in legs:
                leg.cut = cut
            for _ in range(3):
                try:
                    await plant.mesh.call(robot, "POST", "/say", Word(said="hello"), expect=Word)
                except PeerDown:
                    assert cut
                await air.clock.sleep(10.0)
            contact = plant.peers.contact("robot-1")
            assert contact is not None
            ways.append(contact.way)
        assert ways == [(), ("plant-2", "plant-3", "robot-1"), ()]

    play(air, story, look=True)


def test_when_a_relay_dies_the_same_call_finds_another_way_and_is_done_once(keys: Path) -> None:
    async def story(air: Air) -> None:
        plant = air["plant-1"]
        await flooded(plant, "robot-1")
        first = plant.peers.contact("robot-1")
        assert first is not None
        assert first.way == ("plant-4", "robot-1")
        air.kill("plant-4")
        assert (await plant.mesh.call(first.peer, "POST", "/say", Word(said="on"), expect=Word)).said == "robot-1 heard on"
        after = plant.peers.contact("robot-1")
        assert after is not None
        assert after.way == ("plant-2", "plant-3", "robot-1")
        assert Counter(air["robot-1"].did) == {("hello", "plant-1"): 1, ("on", "plant-1"): 1}

    play(Air(keys, RING, 3), story)


def test_a_lost_answer_is_asked_for_again_by_another_way_and_nothing_is_done_twice(keys: Path) -> None:
    async def story(air: Air) -> None:
        plant = air["plant-1"]
        await flooded(plant, "robot-1")
        air.mesh.leg("robot-1", "plant-4").cut = True
        said = await plant.mesh.call(plant.peer("robot-1"), "POST", "/say", Word(said="slowly"), expect=Word)
        assert said.said == "robot-1 heard slowly"
        assert air["robot-1"].did == [("hello", "plant-1"), ("slowly", "plant-1")]

    play(Air(keys, RING, 3), story)


def test_an_idempotency_key_holds_for_a_node_whichever_way_it_asks(keys: Path) -> None:
    async def story(air: Air) -> None:
        plant, robot = air["plant-1"], air["robot-1"]
        await flooded(plant, ROBOTS)
        peer, word = plant.peer("robot-1"), Word(said="once")
        by_way = [await plant.mesh.call(peer, "POST", "/say", word, expect=Word, key="k1") for _ in range(2)]
        straight = Mesh(air.mesh.transport("plant-1"), plant.identity, air.clock)
        assert [await straight.call(peer, "POST", "/say", word, expect=Word, key="k1")] * 2 == by_way
        assert robot.did == [("hello", "plant-1"), ("once", "plant-1")]
        other = air["plant-2"]
        await flooded(other, ROBOTS)
        await other.mesh.call(other.peer("robot-1"), "POST", "/say", word, expect=Word, key="k1")
        assert robot.did[2:] == [("hello", "plant-2"), ("once", "plant-2")]

    play(Air(keys, LINE, 3), story)


# ------------------------------------------------------------------ what is refused


def letter(air: Air, author: str, to: str = "robot-1", **changes: Any) -> Parcel:
    """A parcel as the author would hand it to its neighbour, but for what is changed."""
    content = changes.pop("content", b'{"said": "hello"}')
    me: Introducer = changes.pop("me", air[author].me)
    at_s, method, path = changes.pop("at_s", air.clock.now()), changes.pop("method", "POST"), changes.pop("path", "/say")
    seal = sealed(me, changes.pop("number", "1"), to, method, path, {}, content, at_s)
    whole = {"seal": seal, "body": packed(content), "via": [author], "hops_left": 3, "within_s": 1.0}
    return Parcel.model_validate(whole | changes)


async def handed(air: Air, hop: str, target: str, parcel: Parcel, token: str | None = None) -> httpx.Response:
    token = air[hop].identity.token if token is None else token
    headers = {"authorization": f"Bearer {token}"} if token else {}
    async with httpx.AsyncClient(transport=air.mesh.transport(hop), headers=headers, timeout=5.0) as client:
        return await client.post(f"{air.urls[target]}/parcels", content=parcel.model_dump_json())


def _altered(seal: str, **changes: Any) -> str:
    head, _, signature = seal.split(".")
    told = jwt.decode(seal, options={"verify_signature": False}) | changes
    other = jwt.encode(told, "x" * 32, algorithm="HS256").split(".")[1]
    return f"{head}.{other}.{signature}"


def _other_body(air: Air) -> Parcel:
    return letter(air, "plant-3").model_copy(update={"body": packed(b'{"said": "bye"}')})


def _other_path(air: Air) -> Parcel:
    parcel = letter(air, "plant-3", path="/robots-only")
    return parcel.model_copy(update={"seal": _altered(parcel.seal, path="/say")})


def _other_addressee(air: Air) -> Parcel:
    parcel = letter(air, "plant-3", to="plant-2")
    return parcel.model_copy(update={"seal": _altered(parcel.seal, to="robot-1")})


def _expired(air: Air) -> Parcel:
    return letter(air, "plant-3", at_s=air.clock.now() - LIFE_S - 1.0)


def _of_the_future(air: Air) -> Parcel:
    return letter(air, "plant-3", at_s=air.clock.now() + LIFE_S + 1.0)


def _of_before_a_restart(air: Air) -> Parcel:
    return letter(air, "plant-3", at_s=air.clock.now() - 20.0)


def _another_garden(air: Air) -> Parcel:
    stranger = introducer(Identity.load(air.keys / "other" / "plant-3"), "plant", air.urls["plant-3"])
    return letter(air, "plant-3", me=stranger)


def _anothers_card(air: Air) -> Parcel:
    true, thief = air["plant-3"].me, air["plant-2"].me
    return letter(air, "plant-3", me=Introducer(true.id, true.kind, true.url, true.card, thief.key))


def _with_its_own_card_in_anothers_name(air: Air) -> Parcel:
    true, thief = air["plant-3"].me, air["plant-2"].me
    return letter(air, "plant-3", me=Introducer(true.id, true.kind, true.url, thief.card, thief.key))


def _sealed_as_an_answer(air: Air) -> Parcel:
    parcel = letter(air, "plant-3")
    claims = jwt.decode(parcel.seal, options={"verify_signature": False})
    return parcel.model_copy(update={"seal": air["plant-3"].me.sign(claims | {"aud": "answer"})})


def _in_anothers_name(air: Air) -> Parcel:
    return letter(air, "plant-3", me=air["plant-1"].me)


def _an_operators(air: Air) -> Parcel:
    me = introducer(Identity.load(air.keys / "operator"), "plant", air.urls["plant-3"])
    return letter(air, "plant-3", me=me)


def _an_introduction(air: Air) -> Parcel:
    return letter(air, "plant-3").model_copy(update={"seal": air["plant-3"].me.introduce("0123456789abcdef").proof})


def _nonsense(air: Air) -> Parcel:
    return letter(air, "plant-3").model_copy(update={"seal": "bm9u.c2Vuc2U.eA"})


def _no_request(air: Air) -> Parcel:
    return letter(air, "plant-3", path="http://10.0.0.9/say")


def _a_parcel_in_a_parcel(air: Air) -> Parcel:
    return letter(air, "plant-3", path="/%70arcels?x=1", content=letter(air, "plant-3").model_dump_json().encode())


def _too_far(air: Air) -> Parcel:
    return letter(air, "plant-3", via=["plant-1", "plant-2", "plant-4", "plant-3"], me=air["plant-1"].me)


BAD = [
    _other_body,
    _other_path,
    _other_addressee,
    _expired,
    _of_the_future,
    _of_before_a_restart,
    _another_garden,
    _anothers_card,
    _with_its_own_card_in_anothers_name,
    _sealed_as_an_answer,
    _in_anothers_name,
    _an_operators,
    _an_introduction,
    _nonsense,
    _no_request,
    _a_parcel_in_a_parcel,
    _too_far,
]


@pytest.mark.parametrize("forge", BAD, ids=lambda forge: forge.__name__[1:])
@pytest.mark.parametrize("way", [None, []], ids=["flood", "way"])
def test_what_is_not_a_whole_word_of_its_author_is_refused_and_nothing_is_done(
    keys: Path, forge: Callable[[Air], Parcel], way: list[str] | None
) -> None:
    air = Air(keys, LINE, 3)

    async def story(air: Air) -> None:
        await air.clock.sleep(100.0)
        air.restart("robot-1")
        await air.clock.sleep(10.0)
        answer = await handed(air, "plant-3", "robot-1", forge(air).model_copy(update={"way": way}))
        assert answer.status_code == 422, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        assert air["robot-1"].did == []
        good = await handed(air, "plant-3", "robot-1", letter(air, "plant-3", way=way))
        assert good.status_code == 200
        assert air["robot-1"].did == [("hello", "plant-3")]

    play(air, story)


def test_a_parcel_is_taken_from_enrolled_nodes_only_and_from_the_one_who_names_itself(keys: Path) -> None:
    async def story(air: Air) -> None:
        parcel = letter(air, "plant-3")
        viewer, operator = (Identity.load(keys / name).token for name in ("viewer", "operator"))
        for token, status in (("", 401), ("nonsense", 401), (air["plant-3"].me.card, 401), (viewer, 403), (operator, 403)):
            assert (await handed(air, "plant-3", "robot-1", parcel, token)).status_code == status
        assert (await handed(air, "plant-2", "robot-1", parcel)).status_code == 403
        assert air["robot-1"].did == []
        assert air["robot-1"].relay.counts == {"refused": 1}

    play(Air(keys, LINE, 3), story)


@pytest.mark.parametrize("way", [None, []], ids=["flood", "way"])
def test_a_parcel_that_is_repeated_is_done_once_and_not_again_after_a_restart(keys: Path, way: list[str] | None) -> None:
    async def story(air: Air) -> None:
        parcel = letter(air, "plant-3", way=way)
        first, *more = [await handed(air, "plant-3", "robot-1", parcel) for _ in range(3)]
        assert len(first.json()["answers"]) == 1
        assert [again.json() for again in more] == [first.json()] * 2
        assert air["robot-1"].did == [("hello", "plant-3")]
        await air.clock.sleep(1.0)
        air.restart("robot-1")
        assert (await handed(air, "plant-3", "robot-1", parcel)).status_code == 422
        assert air["robot-1"].did == []

    play(Air(keys, LINE, 3), story)


def test_a_parcel_is_still_known_when_its_answer_is_forgotten(keys: Path) -> None:
    async def story(air: Air) -> None:
        robot, first = air["robot-1"], letter(air, "plant-3", way=[])
        await handed(air, "plant-3", "robot-1", first)
        for n in range(WORKS_MAX + 5):
            await handed(air, "plant-3", "robot-1", letter(air, "plant-3", number=f"more-{n}", way=[]))
        assert len(robot.did) == WORKS_MAX + 6
        assert (await handed(air, "plant-3", "robot-1", first)).json() == {"answers": []}
        assert len(robot.did) == WORKS_MAX + 6
        assert robot.relay.counts["refused"] == 1

    play(Air(keys, LINE, 3), story)


def test_no_way_is_learnt_through_somebody_who_is_not_listed_here(keys: Path) -> None:
    async def story(air: Air) -> None:
        air["robot-1"].peers.replace([])
        assert set(await flooded(air["plant-1"], ROBOTS)) == {"robot-1"}
        assert air["robot-1"].peers.contacts() == []

    play(Air(keys, LINE, 3), story)


def _bent(told: ParcelAnswer) -> ParcelAnswer:
    return told.model_copy(update={"body": packed(b'{"said": "it costs nothing", "by": ""}')})


def _other_status(told: ParcelAnswer) -> ParcelAnswer:
    return told.model_copy(update={"seal": _altered(told.seal, status=404)})


def _as_another(told: ParcelAnswer) -> ParcelAnswer:
    return told.model_copy(update={"seal": _altered(told.seal, sub="robot-2")})


def _by_another_way(told: ParcelAnswer) -> ParcelAnswer:
    return told.model_copy(update={"way": ["plant-2", "plant-3"]})


@pytest.mark.parametrize("forge", [_bent, _other_status, _as_another, _by_another_way], ids=lambda forge: forge.__name__[1:])
def test_a_relay_cannot_forge_an_answer(keys: Path, forge: Callable[[ParcelAnswer], ParcelAnswer]) -> None:
    async def story(air: Air) -> None:
        take = air["plant-2"].relay.pass_on

        async def false(parcel: Parcel, within_s: float, found: Callable[[list[ParcelAnswer]], None], **more: Any) -> None:
            await take(parcel, within_s, lambda answers: found([forge(told) for told in answers]), **more)

        air["plant-2"].relay.pass_on = false  # type: ignore[method-assign]
        assert await flooded(air["plant-1"], ROBOTS) == {}
        with pytest.raises(PeerDown):
            await air["plant-1"].mesh.call(
                Peer(id="robot-1", kind="robot", url=air.urls["robot-1"]), "GET", "/", expect=Word
            )
        assert air["plant-1"].relay.counts["forged"] == 1
        assert air["plant-1"].peers.find("robot-1") is None

    play(Air(keys, LINE, 3), story)


def test_an_answer_to_an_earlier_question_answers_no_other(keys: Path) -> None:
    async def story(air: Air) -> None:
        kept: list[ParcelAnswer] = []
        take = air["plant-2"].relay.pass_on

        async def stale(parcel: Parcel, within_s: float, found: Callable[[list[ParcelAnswer]], None], **more: Any) -> None:
            await take(parcel, within_s, kept.extend, **more)
            found(kept[:1])

        air["plant-2"].relay.pass_on = stale  # type: ignore[method-assign]
        assert set(await flooded(air["plant-1"], ROBOTS)) == {"robot-1"}
        assert await flooded(air["plant-1"], ROBOTS) == {}
        assert len(kept) == 2

    play(Air(keys, LINE, 3), story)


def test_nobody_is_sent_a_token_but_those_listed_or_met_at_their_own_address(keys: Path) -> None:
    """A peer that a flood found says itself where it answers: nothing is ever sent there."""

    async def story(air: Air) -> None:
        plant = air["plant-1"]
        await flooded(plant, ROBOTS)
        tokens: list[tuple[str, str]] = []
        carry = air.mesh.carry

        async def watched(source: str, request: httpx.Request) -> httpx.Response:
            tokens.append((source, f"http://{request.url.netloc.decode()}"))
            assert request.headers["authorization"] == f"Bearer {air[source].identity.token}"
            return await carry(source, request)

        air.mesh.carry = watched  # type: ignore[method-assign]
        await plant.mesh.call(plant.peer("robot-1"), "POST", "/say", Word(said="hello"), expect=Word)
        air.kill("plant-3")
        for _ in range(3):
            with pytest.raises(PeerDown):
                await plant.mesh.call(plant.peer("robot-1"), "POST", "/say", Word(said="hello"), expect=Word)
        assert plant.relay.counts["flooded"] == 2, "it is looked for once a second at most"
        await air.clock.sleep(1.0)
        with pytest.raises(PeerDown):
            await plant.mesh.call(plant.peer("robot-1"), "POST", "/say", Word(said="hello"), expect=Word)
        assert plant.relay.counts["flooded"] == 3
        assert {url for source, url in tokens if source == "plant-1"} == {air.urls["plant-2"]}

    play(Air(keys, LINE, 3), story)


# ------------------------------------------------------------------ bounds


def test_an_author_that_floods_without_end_is_passed_on_so_often_and_others_still_are(keys: Path) -> None:
    async def story(air: Air) -> None:
        reached = [set(await flooded(air["plant-1"], ROBOTS)) for _ in range(60)]
        assert FLOODS_BURST <= reached.count({"robot-1"}) < FLOODS_BURST + 10
        assert set(await flooded(air["plant-2"], ROBOTS)) == {"robot-1"}
        await air.clock.sleep(5.0)
        assert set(await flooded(air["plant-1"], ROBOTS)) == {"robot-1"}

    play(Air(keys, LINE, 3), story)


def test_what_is_too_long_or_never_ends_is_refused_and_what_just_fits_is_carried(keys: Path) -> None:
    async def story(air: Air) -> None:
        plant = air["plant-1"]
        await flooded(plant, ROBOTS)
        peer = plant.peer("robot-1")
        frame = len(Word(said="").model_dump_json())
        fits = Word(said="x" * (BODY_BYTES_MAX - frame))
        assert (await plant.mesh.exchange(peer, "POST", "/say", fits.model_dump_json().encode())).status == 502
        assert air["robot-1"].did[-1] == (fits.said, "plant-1")
        with pytest.raises(PeerDown, match="do not fit into a parcel"):
            await plant.mesh.call(peer, "POST", "/say", Word(said=fits.said + "x"), expect=Word)
        long = await plant.mesh.exchange(peer, "GET", "/long")
        assert (long.status, b"does not fit into a parcel" in long.body) == (502, True)
        with pytest.raises(PeerDown):
            await plant.mesh.exchange(peer, "GET", "/endless")
        await air.clock.sleep(12.0)
        assert all(work.done() for work in air["robot-1"].relay._works.values())
        assert (await plant.mesh.call(peer, "POST", "/say", Word(said="still here"), expect=Word)).by == "plant-1"

    play(Air(keys, LINE, 3), story)


def test_one_neighbour_cannot_take_all_the_room(keys: Path) -> None:
    air = Air(keys, [*LINE, ("plant-5", "robot-1")], 3)

    async def story(air: Air) -> None:
        slow = [letter(air, "plant-3", number=f"{n}", content=b'{"said": "slowly"}', way=[]) for n in range(40)]
        asking = [asyncio.ensure_future(handed(air, "plant-3", "robot-1", parcel)) for parcel in slow]
        await air.clock.sleep(0.1)
        assert (await handed(air, "plant-5", "robot-1", letter(air, "plant-5"))).status_code == 200
        statuses = Counter([(await one).status_code for one in asking])
        assert statuses == {200: 32, 503: 8}

    play(air, story)


def test_a_call_straight_to_a_neighbour_sends_what_it_sends_without_flooding(keys: Path) -> None:
    async def story(air: Air) -> None:
        plant = air["plant-1"]
        await plant.mesh.call(plant.peer("plant-2"), "POST", "/say", Word(said="hello"), expect=Word)
        assert air.mesh.requests == 1
        assert plant.relay.counts == {}

    play(Air(keys, LINE, 3), story)


def test_metrics_tell_what_became_of_parcels(keys: Path) -> None:
    async def story(air: Air) -> None:
        await flooded(air["plant-1"], ROBOTS)
        told = httpx.AsyncClient(transport=httpx.ASGITransport(air["plant-2"].app), base_url="http://plant")
        async with told as client:
            text = (await client.get("/metrics")).text
        assert 'garden_parcels_total{what="handed_over"} 1.0' in text

    play(Air(keys, LINE, 3), story)


def test_a_refusal_of_the_far_node_is_the_callers_to_read(keys: Path) -> None:
    async def story(air: Air) -> None:
        await flooded(air["plant-1"], ROBOTS)
        peer = air["plant-1"].peer("robot-1")
        with pytest.raises(GardenError) as told:
            await air["plant-1"].mesh.call(peer, "POST", "/say", None, expect=Word)
        assert told.value.status == 400
        assert "empty" in str(told.value)

    play(Air(keys, LINE, 3), story)


# ------------------------------------------------------------------ off by default


def test_a_process_that_does_not_flood_loads_nothing_of_it_and_knows_no_parcels() -> None:
    assert GardenSettings(flood_hops=0) == GardenSettings()
    code = "import sys, plant_service.__main__; print(*sys.modules)"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(told.stdout.split())
    assert "core.mesh.runtime" in loaded
    assert loaded & {f"core.mesh.{name}" for name in ("parcels", "relay", "courier", "inside")} == set()


@pytest.mark.parametrize(("kind", "url"), [("plant", ""), ("console", "http://10.0.0.1:8090")])
def test_who_cannot_prove_itself_or_is_no_node_of_the_garden_cannot_pass_on(keys: Path, kind: str, url: str) -> None:
    async def go() -> None:
        identity, clock, peers = Identity.load(keys / "plant-1"), VirtualClock(), Peers()
        transport = MemoryMesh(clock, Random(1)).transport("plant-1")
        settings = GardenSettings(flood_hops=2)
        courier = make_courier(settings, clock, identity, Verifier.load(keys), peers, HttpxTransport(transport))
        app = create_app(card=lambda: NodeCard(id="plant-1", kind=kind), clock=clock, verifier=None, ready=list)
        with pytest.raises(ConfigError, match="cannot pass requests on") as told:
            joining(courier, identity, Node("plant-1", kind, app, url=url))
        assert "GARDEN_FLOOD_HOPS" in told.value.hint

    run_virtual(go())
