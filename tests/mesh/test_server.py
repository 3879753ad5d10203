"""The real server on a real socket: impatient, bounded, clean in its end."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import time
from collections.abc import Awaitable, Callable

import pytest
from starlette.responses import Response
from structlog.testing import capture_logs

from core.clock import WallClock
from core.errors import ConfigError, PeerDown
from core.mesh import server as server_module
from core.mesh.chassis import Health, body, create_app, serve_ready
from core.mesh.client import Mesh
from core.mesh.events import EventLog
from core.mesh.http import HttpTransport
from core.mesh.node import Node, serve
from core.mesh.peers import Peer
from core.mesh.server import listen
from core.wire.documents import NodeCard, Problem

pytestmark = pytest.mark.alone

Story = Callable[[int], Awaitable[None]]


async def with_server(story: Story, *loops: Callable[[], Awaitable[None]]) -> None:
    """Serve on a free port, run the story against it, end by SIGTERM as a process manager would."""
    clock = WallClock()
    card = NodeCard(id="pot", kind="plant")
    app = create_app(card=lambda: card, clock=clock, verifier=None, ready=lambda: [], events=EventLog(clock))

    @app.post("/x")
    async def takes_a_body(health: Health = body(Health)) -> Health:
        return health

    @app.get("/ready")
    async def careful() -> Health:
        return Health(status="careful")

    serve_ready(app, "/ready", lambda: Response("ready", media_type="text/plain"))
    sock = listen("127.0.0.1", 0)
    serving = asyncio.create_task(serve(Node("pot", "plant", app, loops), "", 0, sock=sock))
    try:
        async with asyncio.timeout(20):
            await story(sock.getsockname()[1])
            os.kill(os.getpid(), signal.SIGTERM)
            await serving
    finally:
        serving.cancel()


async def talk(port: int, data: bytes) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(data)
    answer = await reader.read(-1)
    writer.close()
    return answer


HALVES = (
    b"",
    b"GET / HT",
    b"GET / HTTP/1.1\r\nhost: a\r\n",
    b"POST /x HTTP/1.1\r\nhost: a\r\ncontent-length: 9\r\n\r\n{",
)


def test_requests_that_do_not_arrive_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    assert server_module.REQUEST_WITHIN_S == 5.0, "what the documents promise"
    monkeypatch.setattr(server_module, "REQUEST_WITHIN_S", 0.15)

    async def story(port: int) -> None:
        for half in HALVES:
            assert b" 408 " in await talk(port, half)
        counted = await talk(port, b"GET /metrics HTTP/1.1\r\nhost: a\r\nconnection: close\r\n\r\n")
        assert b'garden_http_requests_total{method="POST",route="/x",status="408"} 1.0' in counted

    with capture_logs() as logged:
        asyncio.run(with_server(story))
    assert [entry for entry in logged if entry["log_level"] in ("error", "critical")] == []


@pytest.mark.soak
def test_half_a_request_is_dropped_after_five_seconds() -> None:
    async def story(port: int) -> None:
        async def dropped(half: bytes) -> float:
            began_s = time.monotonic()
            assert b" 408 " in await talk(port, half)
            return time.monotonic() - began_s

        await talk(port, b"GET /healthz HTTP/1.1\r\nhost: a\r\nconnection: close\r\n\r\n")  # it serves from here on
        taken = await asyncio.gather(*map(dropped, HALVES))
        print([f"{taken_s:.2f} s" for taken_s in taken])
        assert all(4.5 <= taken_s <= 6.0 for taken_s in taken)

    asyncio.run(with_server(story))


@pytest.mark.parametrize(
    "nonsense",
    [
        b"\x16\x03\x01\x02\x00\n\n",
        b"GET\r\n\r\n",
        b"GET / HTTP/1.1\r\nno colon here\r\n\r\n",
        b"GET /\xff\xfe HTTP/1.1\r\nhost: a\r\n\r\n",
        b"GET / HTTP/1.1\r\nhost: a\r\nx: " + b"y" * 20000,
    ],
)
def test_what_is_not_http_gets_a_problem_and_a_closed_door(nonsense: bytes) -> None:
    async def story(port: int) -> None:
        answer = await talk(port, nonsense)
        assert answer.startswith(b"HTTP/1.1 400 ")
        Problem.model_validate_json(answer.partition(b"\r\n\r\n")[2])

    asyncio.run(with_server(story))


def test_two_lengths_are_refused_on_the_wire() -> None:
    async def story(port: int) -> None:
        head = b"POST / HTTP/1.1\r\nhost: a\r\nconnection: close\r\ncontent-length: 3\r\ntransfer-encoding: chunked\r\n\r\n"
        assert b" 400 " in await talk(port, head + b"0\r\n\r\n")

    asyncio.run(with_server(story))


@pytest.mark.parametrize("length", [200, 17_000, 60_000])
def test_a_body_may_be_longer_than_a_head_also_when_both_come_in_one_piece(length: int) -> None:
    async def story(port: int) -> None:
        body = b'{"status":"' + b"a" * (length - 13) + b'"}'
        head = b"POST /x HTTP/1.1\r\nhost: a\r\nconnection: close\r\ncontent-type: application/json\r\n"
        assert b" 200 " in await talk(port, head + b"content-length: %d\r\n\r\n" % length + body)

    asyncio.run(with_server(story))


def test_the_real_transport_reaches_the_real_server_and_events_stream() -> None:
    async def story(port: int) -> None:
        transport = HttpTransport()
        mesh = Mesh(transport, None, WallClock())
        peer = Peer(id="pot", kind="plant", url=f"http://127.0.0.1:{port}")
        assert await mesh.call(peer, "GET", "/healthz", expect=Health) == Health()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /events HTTP/1.1\r\nhost: a\r\n\r\n")
        assert b": listening" in await reader.readuntil(b"listening")
        writer.close()
        with pytest.raises(PeerDown, match="nobody"):
            await mesh.call(
                Peer(id="nobody", kind="plant", url=f"http://127.0.0.1:{free_port()}"), "GET", "/", expect=Health
            )
        await transport.aclose()

    asyncio.run(with_server(story))


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


def test_a_loop_that_dies_ends_the_node() -> None:
    async def dies() -> None:
        await asyncio.sleep(0.05)
        raise ZeroDivisionError

    async def forever(port: int) -> None:
        await asyncio.sleep(5)

    async def go() -> None:
        app = create_app(card=lambda: NodeCard(id="a", kind="b"), clock=WallClock(), verifier=None, ready=lambda: [])
        await serve(Node("a", "b", app, [dies]), "127.0.0.1", 0)

    with pytest.raises(ExceptionGroup) as caught:
        asyncio.run(go())
    assert caught.group_contains(ZeroDivisionError)


def test_loops_are_cancelled_when_the_node_ends() -> None:
    ended: list[bool] = []

    async def loop() -> None:
        try:
            await asyncio.sleep(100)
        finally:
            ended.append(True)

    async def story(port: int) -> None:
        await asyncio.sleep(0)

    asyncio.run(with_server(story, loop))
    assert ended == [True]


def test_a_taken_port_is_named() -> None:
    with listen("127.0.0.1", 0) as sock:
        port = sock.getsockname()[1]
        with pytest.raises(ConfigError, match=str(port)):
            listen("127.0.0.1", port)


def test_an_open_stream_does_not_keep_a_node_from_ending() -> None:
    ended_s = []

    async def story(port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /events HTTP/1.1\r\nhost: a\r\n\r\n")
        await reader.readuntil(b"listening")
        ended_s.append(asyncio.get_running_loop().time())
        streams.append(writer)

    async def go() -> None:
        await with_server(story)
        ended_s.append(asyncio.get_running_loop().time())
        streams[0].close()

    streams: list[asyncio.StreamWriter] = []
    asyncio.run(go())
    assert ended_s[1] - ended_s[0] < 0.9


async def ask_in_turn(port: int, *requests: bytes) -> list[bytes]:
    """Over one connection; each answer's body."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    bodies = []
    for request in requests:
        writer.write(request)
        head = await reader.readuntil(b"\r\n\r\n")
        length = int(head.lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])
        bodies.append(await reader.readexactly(length))
    writer.close()
    return bodies


def test_the_plainest_reads_are_answered_at_once_and_all_others_with_care() -> None:
    plain, end = b"GET /ready HTTP/1.1\r\nhost: a\r\n", b"\r\n"
    careful = b'{"status":"careful"}'

    async def story(port: int) -> None:
        odd = [plain + b"If-None-Match: x\r\n" + end, b"GET /ready?a=1 HTTP/1.1\r\nhost: a\r\n\r\n"]
        answers = await ask_in_turn(port, plain + end, odd[0], plain + end, plain + b"Content-Length: 0\r\n" + end)
        assert answers == [b"ready", careful, b"ready", b"ready"]
        assert await ask_in_turn(port, plain + b"content-length: 00\r\n" + end, plain + end) == [careful, b"ready"]
        assert (await ask_in_turn(port, odd[1]))[0] != b"ready"
        told = (await ask_in_turn(port, b"GET /metrics HTTP/1.1\r\nhost: a\r\n\r\n"))[0]
        assert b'garden_http_requests_total{method="GET",route="/ready",status="200"} 6.0' in told

    asyncio.run(with_server(story))


def test_pipelined_and_cut_requests_keep_their_order() -> None:
    async def story(port: int) -> None:
        get = b"GET /ready HTTP/1.1\r\nhost: a\r\n"
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(get + b"if-match: x\r\n\r\n" + get + b"\r\n")
        for byte in get + b"connection: close\r\n\r\n":
            writer.write(bytes([byte]))
            await writer.drain()
        assert (await reader.read(-1)).count(b'{"status":"careful"}') == 3
        writer.close()

    asyncio.run(with_server(story))
