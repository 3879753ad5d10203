"""Services under TLS on real sockets: who is at the other end is known by certificate, on both ends."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable, Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from cryptography import x509

from console import health
from core.clock import WallClock, WorldClock
from core.errors import ConfigError, PeerDown, Unauthorised
from core.mesh import authority, tls, worldclock
from core.mesh import server as server_module
from core.mesh.auth import Caller, Enrolled, Identity, Verifier, make_garden
from core.mesh.authority import LIFE, RENEWED_BEFORE, certify
from core.mesh.chassis import allow, create_app
from core.mesh.client import Mesh
from core.mesh.http import HttpTransport
from core.mesh.node import Node, serve
from core.mesh.peers import Peer, Peers
from core.mesh.runtime import GardenSettings, links, make_runtime
from core.mesh.server import listen
from core.wire.documents import Document, NodeCard

NODES = [
    Enrolled("plant-1", "plant"),
    Enrolled("plant-2", "plant"),
    Enrolled("robot-1", "robot"),
    Enrolled("console", "viewer"),
]
NOW = datetime.now(UTC)


class Asked(Document):
    by: str


Story = Callable[[str], Awaitable[None]]


def enrol(folder: Path) -> Path:
    """A garden's key folders, certificates and all."""
    make_garden(folder, NODES, NOW.timestamp())
    certify(folder, NODES, NOW)
    return folder


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return enrol(tmp_path_factory.mktemp("keys"))


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another garden with nodes of the same names."""
    return enrol(tmp_path_factory.mktemp("others"))


def against(keys: Path, name: str, story: Story) -> None:
    """The story, told the address of the node `name`."""

    async def go() -> None:
        clock, card = WallClock(), NodeCard(id=name, kind="plant")
        app = create_app(card=lambda: card, clock=clock, verifier=Verifier.load(keys), ready=lambda: [])

        @app.post("/ask")
        async def ask(caller: Caller = allow("plant", "robot", "operator", "viewer")) -> Asked:
            return Asked(by=caller.subject)

        sock = listen("127.0.0.1", 0)
        url = f"https://127.0.0.1:{sock.getsockname()[1]}"
        serving = asyncio.create_task(serve(Node(name, "plant", app), "", 0, sock=sock, tls=tls.serving(keys / name)))
        try:
            async with asyncio.timeout(20):
                await story(url)
        finally:
            serving.cancel()
            with suppress(asyncio.CancelledError):
                await serving

    asyncio.run(go())


async def asked_by(keys: Path, name: str, url: str, expected: str = "plant-1", token_of: str = "") -> str:
    """Who `url` took us for; `name` shows its certificate, and its own token or that of another."""
    peer = Peer(id=expected, kind="plant", url=url)
    transport = HttpTransport(tls.asking(keys / name), Peers([peer]).at)
    mesh = Mesh(transport, Identity.load(keys / (token_of or name)), WallClock(), timeout_s=10.0)
    try:
        return (await mesh.call(peer, "POST", "/ask", expect=Asked)).by
    finally:
        await mesh.aclose()


def test_nodes_of_a_garden_ask_each_other_over_tls(keys: Path) -> None:
    async def story(url: str) -> None:
        assert await asked_by(keys, "robot-1", url) == "robot-1"
        assert await asked_by(keys, "plant-2", url) == "plant-2"

    against(keys, "plant-1", story)


def test_a_connection_is_used_again_and_looked_at_again(keys: Path) -> None:
    async def story(url: str) -> None:
        peers = Peers()
        transport = HttpTransport(tls.asking(keys / "robot-1"), peers.at)
        first = await transport.send("GET", url + "/healthz", {}, b"")
        assert first.status == 200, "a stranger of the garden may be asked"
        made: list[object] = []
        loop = asyncio.get_running_loop()
        create = loop.create_connection

        async def counted(*args: Any, **more: Any) -> Any:
            made.append(args)
            return await create(*args, **more)

        loop.create_connection = counted  # type: ignore[method-assign]
        peers.replace([Peer(id="plant-1", kind="plant", url=url)])
        assert (await transport.send("GET", url + "/healthz", {}, b"")).status == 200
        assert not made
        peers.replace([Peer(id="plant-2", kind="plant", url=url)])
        with pytest.raises(ConnectionError, match="plant-1 answers there, not plant-2"):
            await transport.send("GET", url + "/healthz", {}, b"")
        await transport.aclose()

    against(keys, "plant-1", story)


def test_a_node_that_answers_in_another_ones_place_is_told_nothing(keys: Path) -> None:
    async def story(url: str) -> None:
        with pytest.raises(PeerDown, match="plant-2 answers there, not plant-1"):
            await asked_by(keys, "robot-1", url, expected="plant-1")

    against(keys, "plant-2", story)


def test_a_node_of_another_garden_is_told_nothing(keys: Path, others: Path) -> None:
    async def story(url: str) -> None:
        with pytest.raises(PeerDown, match="certificate verify failed"):
            await asked_by(keys, "robot-1", url)

    against(others, "plant-1", story)


def test_a_caller_of_another_garden_is_hung_up_on(keys: Path, others: Path) -> None:
    async def story(url: str) -> None:
        context = tls.asking(keys / "operator")
        context.load_cert_chain(others / "robot-1" / tls.CERTIFICATE, others / "robot-1" / tls.KEY)
        transport = HttpTransport(context)
        with pytest.raises((ConnectionError, ssl.SSLError)):
            await transport.send("GET", url + "/healthz", {}, b"")
        await transport.aclose()

    against(keys, "plant-1", story)


@pytest.mark.parametrize(("showing", "why"), [("operator", "nobody"), ("plant-2", "plant-2"), ("console", "console")])
def test_a_nodes_token_is_worth_nothing_without_its_certificate(keys: Path, showing: str, why: str) -> None:
    """So that a token that was read somewhere opens nothing."""

    async def story(url: str) -> None:
        with pytest.raises(Unauthorised, match=f"the token is robot-1's, and {why} showed a certificate"):
            await asked_by(keys, showing, url, token_of="robot-1")

    against(keys, "plant-1", story)


@pytest.mark.parametrize("showing", ["operator", "console", "robot-1"])
def test_people_need_no_certificate_and_the_console_passes_their_words_on(keys: Path, showing: str) -> None:
    async def story(url: str) -> None:
        assert await asked_by(keys, showing, url, token_of="operator") == "operator"

    against(keys, "plant-1", story)


def test_a_garden_under_tls_asks_nobody_in_plain_http(keys: Path) -> None:
    async def story() -> None:
        async def spoken_to(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            heard.append(await reader.read(100))
            writer.close()

        heard: list[bytes] = []
        server = await asyncio.start_server(spoken_to, "127.0.0.1", 0)
        with pytest.raises(PeerDown, match="this garden speaks TLS"):
            await asked_by(keys, "robot-1", f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}")
        server.close()
        await server.wait_closed()
        assert not heard

    asyncio.run(story())


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_programs_that_look_at_addresses_find_a_name_they_know(keys: Path, host: str) -> None:
    async def story(url: str) -> None:
        place = url.replace("127.0.0.1", host)
        context = tls.by_address(keys / "operator")
        token = Identity.load(keys / "operator").token
        async with httpx.AsyncClient(verify=context, headers={"authorization": f"Bearer {token}"}) as client:
            assert (await client.get(place + "/healthz")).json() == {"status": "ok"}
            assert (await client.post(place + "/ask")).json() == {"by": "operator"}
        async with httpx.AsyncClient() as stranger:
            with pytest.raises(httpx.ConnectError):
                await stranger.get(place + "/healthz")

    against(keys, "plant-1", story)


def test_plain_http_gets_no_answer_from_a_node_under_tls(keys: Path) -> None:
    async def story(url: str) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", int(url.rpartition(":")[2]))
        writer.write(b"GET /healthz HTTP/1.1\r\nhost: a\r\n\r\n")
        assert b"HTTP" not in await reader.read(-1)
        writer.close()

    against(keys, "plant-1", story)


@pytest.mark.parametrize("said", [b"", b"\x16\x03\x01\x02\x00\x01"], ids=["silent", "half a hello"])
def test_who_does_not_finish_shaking_hands_is_dropped(keys: Path, said: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "REQUEST_WITHIN_S", 0.15)

    async def story(url: str) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", int(url.rpartition(":")[2]))
        writer.write(said)
        async with asyncio.timeout(5):
            await reader.read(-1)
        writer.close()

    against(keys, "plant-1", story)


def test_a_half_sent_request_is_dropped_under_tls_too(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "REQUEST_WITHIN_S", 0.15)

    async def story(url: str) -> None:
        port, context = int(url.rpartition(":")[2]), tls.asking(keys / "operator")
        reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=context)
        writer.write(b"GET / HT")
        assert b" 408 " in await reader.read(-1)
        writer.close()

    against(keys, "plant-1", story)


def test_a_worlds_time_is_followed_over_tls(keys: Path) -> None:
    async def go() -> None:
        async def feed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readuntil(b"\r\n\r\n")
            writer.write(b'HTTP/1.1 200 OK\r\nconnection: close\r\n\r\n{"garden_s": 42.0, "rate": 0}\n')
            await writer.drain()
            writer.close()

        context = tls.serving(keys / "console")
        server = await asyncio.start_server(feed, "127.0.0.1", 0, ssl=context)
        url = f"https://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        clock = WorldClock()
        following = asyncio.create_task(worldclock.follow(clock, url, tls=tls.by_address(keys / "robot-1")))
        async with asyncio.timeout(10):
            while clock.now() < 42.0:  # noqa: ASYNC110 (the clock has no event for its first word)
                await asyncio.sleep(0.01)
        following.cancel()
        server.close()

    asyncio.run(go())


def test_a_containers_health_is_asked_over_tls(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(url: str) -> None:
        monkeypatch.setenv("GARDEN_PORT", url.rpartition(":")[2])
        monkeypatch.setenv("GARDEN_KEYS", str(keys / "plant-1"))
        with pytest.raises(SystemExit, match="not reachable"):
            await asyncio.to_thread(health.main)
        monkeypatch.setenv("GARDEN_TLS", "true")
        await asyncio.to_thread(health.main)

    against(keys, "plant-1", story)


# ------------------------------------------------------------------ settings and files


def test_one_setting_is_enough(keys: Path) -> None:
    async def story(url: str) -> None:
        peer = Peer(id="plant-1", kind="plant", url=url)
        settings = GardenSettings(tls=True, keys=keys / "robot-1", peers=[peer])
        runtime = make_runtime(settings)
        assert (await runtime.mesh(10.0).call(peer, "POST", "/ask", expect=Asked)).by == "robot-1"
        assert links(settings, Node("robot-1", "robot", object(), url="https://x:1")) is not None  # type: ignore[arg-type]
        await runtime.transport.aclose()

    against(keys, "plant-1", story)


def test_a_node_that_would_announce_itself_in_plain_http_does_not_start(keys: Path) -> None:
    settings = GardenSettings(tls=True, keys=keys / "robot-1")
    with pytest.raises(ConfigError, match="http://x:1") as error:
        links(settings, Node("robot-1", "robot", object(), url="http://x:1"))  # type: ignore[arg-type]
    assert "https://" in error.value.hint


@pytest.mark.parametrize("missing", [tls.AUTHORITY, tls.KEY, tls.CERTIFICATE])
def test_missing_files_are_named_with_what_makes_them(tmp_path: Path, missing: str) -> None:
    folder = enrol(tmp_path / "keys") / "robot-1"
    (folder / missing).unlink()
    with pytest.raises(ConfigError, match=missing if missing == tls.AUTHORITY else "no certificate") as error:
        tls.serving(folder)
    assert "garden init" in error.value.hint


def test_files_that_hold_something_else_are_named(tmp_path: Path) -> None:
    folder = enrol(tmp_path / "keys")
    (folder / "robot-1" / tls.CERTIFICATE).write_text("hello")
    with pytest.raises(ConfigError, match="holds no certificate"):
        certify(folder, NODES, NOW)
    (folder / "robot-1" / tls.CERTIFICATE).unlink()
    (folder / "robot-1" / tls.KEY).write_text("hello")
    with pytest.raises(ConfigError, match="holds no key"):
        certify(folder, NODES, NOW)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_certificates_are_made_once_and_kept(tmp_path: Path) -> None:
    folder = enrol(tmp_path / "keys")
    before = contents(folder)
    assert certify(folder, NODES, NOW + timedelta(hours=1)) == []
    assert contents(folder) == before
    assert certify(folder, [*NODES, Enrolled("plant-9", "plant")], NOW) == ["plant-9"]


def test_only_the_garden_may_read_its_keys(tmp_path: Path) -> None:
    folder = enrol(tmp_path / "keys")
    for name in ("ca.key", f"robot-1/{tls.KEY}"):
        assert (folder / name).stat().st_mode & 0o777 == 0o600, name
    assert not (folder / "robot-1" / "ca.key").exists()


def test_a_certificate_is_made_anew_before_it_expires_and_its_key_stays(tmp_path: Path) -> None:
    folder = enrol(tmp_path / "keys")
    key = (folder / "robot-1" / tls.KEY).read_bytes()
    late = NOW + LIFE - RENEWED_BEFORE
    assert certify(folder, NODES, late - timedelta(days=1)) == []
    assert set(certify(folder, NODES, late + timedelta(seconds=1))) == {node.id for node in NODES}
    certificate = x509.load_pem_x509_certificate((folder / "robot-1" / tls.CERTIFICATE).read_bytes())
    assert certificate.not_valid_after_utc > late + timedelta(days=300)
    assert (folder / "robot-1" / tls.KEY).read_bytes() == key


def test_certificates_of_an_authority_that_is_gone_are_replaced(tmp_path: Path) -> None:
    folder = enrol(tmp_path / "keys")
    (folder / "ca.key").unlink()
    assert set(certify(folder, NODES, NOW)) == {tls.AUTHORITY} | {node.id for node in NODES}
    tls.serving(folder / "robot-1")
    assert (folder / "robot-1" / tls.AUTHORITY).read_bytes() == (folder / tls.AUTHORITY).read_bytes()


def test_a_stolen_node_key_makes_no_certificates(tmp_path: Path) -> None:
    """A node's certificate is no authority's."""
    folder = enrol(tmp_path / "keys")
    certificate = x509.load_pem_x509_certificate((folder / "robot-1" / tls.CERTIFICATE).read_bytes())
    assert certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca is False
    authority_s = x509.load_pem_x509_certificate((folder / tls.AUTHORITY).read_bytes())
    assert authority_s.extensions.get_extension_for_class(x509.BasicConstraints).value.path_length == 0


def test_a_name_of_every_form_comes_back_out_of_its_certificate(tmp_path: Path) -> None:
    for name in ("plant-1", "P.1_x", "green/house:3", "a" * 70):
        folder = tmp_path / name.replace("/", "-")
        folder.mkdir()
        make_garden(folder, [], NOW.timestamp())
        ours = authority._authority(folder, "garden-0", NOW)[0]
        ours.enrol(folder, Enrolled(name, "plant"), NOW)
        context = ssl.create_default_context(cafile=folder / tls.AUTHORITY)
        decoded = ssl._ssl._test_decode_cert(str(folder / tls.CERTIFICATE))  # type: ignore[attr-defined]
        assert tls.name_in(decoded) == name
        assert context.cert_store_stats()["x509_ca"] == 1


@pytest.mark.parametrize(
    "names",
    [
        (),
        (("DNS", "plant-1"),),
        (("URI", "https://garden/plant/plant-1"),),
        (("URI", "spiffe://garden/plant"),),
        (("URI", "spiffe://garden"),),
    ],
)
def test_a_certificate_without_such_a_name_names_nobody(names: tuple[tuple[str, str], ...]) -> None:
    assert tls.name_in({"subjectAltName": names}) == ""
    assert tls.name_in(None) == ""
