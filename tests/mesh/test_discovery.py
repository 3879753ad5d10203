"""Peers are found by hints that nobody has to believe, and lost when they fall silent."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from random import Random
from urllib.parse import parse_qs, urlsplit

import jwt
import pytest
from pydantic import ValidationError

from core.clock import VirtualClock
from core.errors import Unauthorised
from core.mesh.auth import Enrolled, Identity, Verifier, make_garden
from core.mesh.client import Answer
from core.mesh.discovery import AGAIN_S, MISSED_AGAIN_S, MISSES_MAX, Discovery, Hint
from core.mesh.introduction import Introducer, met
from core.mesh.peers import Peer, Peers
from core.mesh.presence import introducer
from core.mesh.routes import BABELD, hosts
from core.mesh.runtime import GardenSettings
from core.virtual import run_virtual

NONCE = "0123456789abcdef"
URL = "http://10.0.0.2:8100"
NODES = [Enrolled("plant-1", "plant"), Enrolled("robot-1", "robot"), Enrolled("robot-2", "robot")]


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    make_garden(tmp_path, NODES, now_s=0.0)
    return tmp_path


def someone(keys: Path, name: str = "robot-1", kind: str = "robot", url: str = URL) -> Introducer:
    who = introducer(Identity.load(keys / name), kind, url)
    assert who is not None
    return who


class Air:
    """Hosts by URL; whoever is not among them is silent. Remembers what was sent to whom."""

    def __init__(self, hosts: dict[str, Introducer]) -> None:
        self.hosts, self.asked = hosts, []
        self.headers: list[dict[str, str]] = []

    async def send(self, method: str, url: str, headers: dict[str, str], body: bytes) -> Answer:
        parts = urlsplit(url)
        where = f"{parts.scheme}://{parts.netloc}"
        self.asked.append(where)
        self.headers.append(dict(headers))
        if (who := self.hosts.get(where)) is None:
            raise ConnectionError("nobody there")
        return Answer(200, who.introduce(parse_qs(parts.query)["nonce"][0]).model_dump_json().encode())

    async def aclose(self) -> None: ...


class Rumour:
    name = "rumour"

    async def run(self, seen: Callable[[list[Hint]], None]) -> None: ...


def finder(air: Air, keys: Path, peers: Peers) -> Discovery:
    verifier = Verifier.load(keys / "plant-1")
    return Discovery("plant-1", peers, air, verifier, VirtualClock(), Random(1), [Rumour()])


def test_whoever_holds_a_card_and_its_key_is_met(keys: Path) -> None:
    proof = someone(keys).introduce(NONCE).proof
    assert met(proof, NONCE, URL, Verifier.load(keys), 1.0) == Peer(id="robot-1", kind="robot", url=URL)


def _other_nonce(keys: Path) -> str:
    return someone(keys).introduce("another question!").proof


def _passed_on(keys: Path) -> str:
    return someone(keys, url="http://10.0.0.9:8100").introduce(NONCE).proof


def _another_garden(keys: Path) -> str:
    make_garden(keys / "other", NODES, now_s=0.0)
    return someone(keys / "other").introduce(NONCE).proof


def _stolen_card(keys: Path) -> str:
    true, thief = someone(keys), someone(keys, "robot-2")
    return Introducer(true.id, true.kind, true.url, true.card, thief.key).introduce(NONCE).proof


def _another_name(keys: Path) -> str:
    true = someone(keys)
    return Introducer("robot-2", true.kind, true.url, true.card, true.key).introduce(NONCE).proof


def _plant_as_robot(keys: Path) -> str:
    return someone(keys, "plant-1", "robot").introduce(NONCE).proof


def _token_as_card(keys: Path) -> str:
    true = someone(keys)
    token = Identity.load(keys / "robot-1").token
    return Introducer(true.id, true.kind, true.url, token, true.key).introduce(NONCE).proof


def _no_signature(keys: Path) -> str:
    claims = jwt.decode(someone(keys).introduce(NONCE).proof, options={"verify_signature": False})
    return jwt.encode(claims, None, algorithm="none")


BAD = [
    _other_nonce,
    _passed_on,
    _another_garden,
    _stolen_card,
    _another_name,
    _plant_as_robot,
    _token_as_card,
    _no_signature,
]


@pytest.mark.parametrize("forge", BAD, ids=lambda forge: forge.__name__[1:])
def test_nobody_else_is_met(forge: Callable[[Path], str], keys: Path) -> None:
    with pytest.raises(Unauthorised):
        met(forge(keys), NONCE, URL, Verifier.load(keys), 1.0)


def test_a_card_expires_and_opens_nothing(keys: Path) -> None:
    card, verifier = Identity.load(keys / "robot-1").card, Verifier.load(keys)
    with pytest.raises(Unauthorised):
        verifier.verify(card, 1.0)
    with pytest.raises(Unauthorised, match="expired"):
        verifier.card(card, 1e9)


def test_a_garden_made_before_there_were_cards_gets_them(keys: Path) -> None:
    (keys / "robot-1" / "card").unlink()
    assert Identity.load(keys / "robot-1").card == ""
    assert make_garden(keys, NODES, now_s=0.0) == ["robot-1"]
    assert Identity.load(keys / "robot-1").card


def test_a_hint_becomes_a_peer_and_no_token_is_sent_to_find_out(keys: Path) -> None:
    air, peers = Air({URL: someone(keys)}), Peers()
    found = finder(air, keys, peers)

    async def story() -> None:
        found.hinted("rumour", [Hint(URL, 3)])
        await found.look()

    run_virtual(story())
    (contact,) = peers.contacts()
    assert (contact.peer.id, contact.hops, contact.source, contact.present) == ("robot-1", 3, "rumour", True)
    assert peers.of_kind("robot") == [contact.peer]
    assert peers.one_hop() == []
    assert all("authorization" not in headers for headers in air.headers)


def test_a_peer_that_falls_silent_is_lost_but_still_known_and_comes_back(keys: Path) -> None:
    air, peers = Air({URL: someone(keys)}), Peers()
    found = finder(air, keys, peers)

    async def story() -> None:
        loop = asyncio.ensure_future(found.run())
        found.hinted("rumour", [Hint(URL)])
        await asyncio.sleep(2.0)
        there = air.hosts.pop(URL)
        await asyncio.sleep(1.2 * AGAIN_S + MISSES_MAX * (MISSED_AGAIN_S + 1.0))
        assert peers.of_kind("robot") == []
        assert peers.find("robot-1") is not None
        air.hosts[URL] = there
        await asyncio.sleep(15.0)
        assert [peer.id for peer in peers.of_kind("robot")] == ["robot-1"]
        loop.cancel()

    run_virtual(story())


def test_what_a_source_sees_no_longer_is_lost_at_once_and_a_new_distance_is_taken_over(keys: Path) -> None:
    peers = Peers()
    found = finder(Air({URL: someone(keys)}), keys, peers)

    async def story() -> None:
        found.hinted("rumour", [Hint(URL, 1)])
        await found.look()
        assert [peer.id for peer in peers.one_hop()] == ["robot-1"]
        found.hinted("rumour", [Hint(URL, 2)])
        await found.look()
        assert peers.one_hop() == []
        found.hinted("rumour", [])
        assert peers.all() == []

    run_virtual(story())


FAR = [
    "http://8.8.8.8:8100",
    "http://127.0.0.1:8100",
    "http://robot-1:8100",
    "http://10.0.0.2",
    "http://10.0.0.2:8100/x",
    "ftp://10.0.0.2:21",
    "http://10.0.0.2:x",
    "nonsense",
]


@pytest.mark.parametrize("url", FAR)
def test_only_addresses_of_a_private_network_are_asked(url: str, keys: Path) -> None:
    air = Air({})
    found = finder(air, keys, Peers())

    async def story() -> None:
        found.hinted("rumour", [Hint(url), Hint(URL)])
        await found.look()

    run_virtual(story())
    assert air.asked == [URL]


def test_the_static_list_has_the_last_word(keys: Path) -> None:
    listed = Peer(id="robot-1", kind="robot", url="http://10.0.0.7:8100")
    peers = Peers([listed])
    found = finder(Air({URL: someone(keys)}), keys, peers)

    async def story() -> None:
        found.hinted("rumour", [Hint(URL, 4)])
        await found.look()
        found.hinted("rumour", [])

    run_virtual(story())
    assert peers.of_kind("robot") == [listed]
    assert peers.contacts()[0].hops == 4


def test_whoever_is_farther_than_the_hop_limit_is_not_asked() -> None:
    peers = Peers(hops_max=2)
    for hops in (1, 2, 3):
        peers.found(Peer(id=f"robot-{hops}", kind="robot", url=f"http://10.0.0.{hops}:80"), "test", hops, 0.0)
    assert [peer.id for peer in peers.of_kind("robot")] == ["robot-1", "robot-2"]
    assert [peer.id for peer in peers.one_hop()] == ["robot-1"]
    assert peers.find("robot-3") is not None


def route(dst: str, metric: int, proto: int = 42, kind: int = 1, bits: int = 32) -> dict[str, object]:
    return {"proto": proto, "type": kind, "dst_len": bits, "attrs": [("RTA_DST", dst), ("RTA_PRIORITY", metric)]}


def test_olsrds_routes_count_under_the_protocol_number_that_it_was_given(monkeypatch: pytest.MonkeyPatch) -> None:
    table = [route("10.0.0.2", 1, proto=100), route("10.0.0.3", 3, proto=100), route("10.0.0.4", 2, proto=3)]
    monkeypatch.setenv("GARDEN_HOP_PROTOCOLS", "42, 100")
    known = GardenSettings().hop_protocols
    assert known == (42, 100)
    assert hosts(table, 8100, protocols=known) == [Hint("http://10.0.0.2:8100", 1), Hint("http://10.0.0.3:8100", 3)]
    assert hosts(table, 8100) == []
    monkeypatch.delenv("GARDEN_HOP_PROTOCOLS")
    assert GardenSettings().hop_protocols == (BABELD,)
    monkeypatch.setenv("GARDEN_HOP_PROTOCOLS", "olsrd")
    with pytest.raises(ValidationError):
        GardenSettings()


def test_only_host_routes_of_a_mesh_daemon_count_hops() -> None:
    table = [
        route("10.0.0.3", 2),
        route("10.0.0.2", 1),
        route("10.0.0.4", 4294967295),
        route("10.0.0.5", 1, kind=7),
        route("10.0.0.6", 20, proto=188),
        route("10.0.1.0", 1, bits=24),
        {"proto": 2, "type": 1, "dst_len": 0, "attrs": [("RTA_OIF", 2)]},
    ]
    assert hosts(table, 8100) == [Hint("http://10.0.0.2:8100", 1), Hint("http://10.0.0.3:8100", 2)]
