"""What only a real socket can be sent: bodies without end and two lengths at once, at the real server."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

import pytest
from doors import Doors

from core.mesh.server import Server, listen, make_server
from core.wire.documents import Problem

HEAD = "POST /tasks HTTP/1.1\r\nhost: a\r\ncontent-type: application/json\r\nauthorization: Bearer {token}\r\n"
CHUNK = b"10000\r\n" + b" " * 65536 + b"\r\n"


def talk(doors: Doors, pieces: Iterable[bytes]) -> bytes:
    """Send the pieces for as long as the server listens; what it answered."""
    return asyncio.run(_talk(doors, pieces))


async def _talk(doors: Doors, pieces: Iterable[bytes]) -> bytes:
    server = make_server(doors.apps["plant"])
    with listen("127.0.0.1", 0) as sock:
        serving = asyncio.create_task(server.serve(sockets=[sock]))
        try:
            async with asyncio.timeout(8):
                return await _exchange(sock.getsockname()[1], pieces)
        finally:
            await _end(server, serving)


async def _exchange(port: int, pieces: Iterable[bytes]) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        for piece in pieces:
            writer.write(piece)
            await writer.drain()
            await asyncio.sleep(0)
    except ConnectionError:
        pass
    try:
        return await reader.read(-1)
    except ConnectionError:
        return b""
    finally:
        writer.close()


async def _end(server: Server, serving: asyncio.Task[None]) -> None:
    server.should_exit = True
    await serving


def problem_of(answer: bytes) -> Problem:
    head, _, body = answer.partition(b"\r\n\r\n")
    assert b"application/problem+json" in head, answer[:300]
    problem = Problem.model_validate_json(body)
    assert problem.hint
    return problem


def chunked(doors: Doors, count: int) -> Iterable[bytes]:
    yield (HEAD.format(token=doors.token("operator")) + "transfer-encoding: chunked\r\n\r\n").encode()
    for _ in range(count):
        yield CHUNK


def test_a_chunked_body_without_end_is_cut_off(doors: Doors) -> None:
    before, sent = doors.standing(), 0

    def counted() -> Iterable[bytes]:
        nonlocal sent
        for piece in chunked(doors, 1600):
            sent += len(piece)
            yield piece

    answer = talk(doors, counted())
    assert sent < 100_000_000
    assert not answer or problem_of(answer).status == 413
    assert doors.standing() == before


def test_a_chunked_body_a_little_too_long_is_413(doors: Doors) -> None:
    before = doors.standing()
    assert problem_of(talk(doors, [*chunked(doors, 1), b"1\r\n \r\n"])).status == 413
    assert doors.standing() == before


@pytest.mark.parametrize("order", [0, 1])
def test_a_length_beside_chunks_is_refused_and_the_door_closed(doors: Doors, order: int) -> None:
    """Whoever believed the one would read the rest as a second request."""
    before = doors.standing()
    lines = ["content-length: 4\r\n", "transfer-encoding: chunked\r\n"]
    smuggled = "0\r\n\r\nDELETE /tasks/x HTTP/1.1\r\nhost: a\r\n\r\n"
    head = HEAD.format(token=doors.token("operator")) + lines[order] + lines[1 - order] + "connection: close\r\n\r\n"
    answer = talk(doors, [(head + smuggled).encode()])
    assert answer.count(b"HTTP/1.1 ") == 1
    assert problem_of(answer).status == 400
    assert doors.standing() == before


@pytest.mark.parametrize(
    "lines",
    [
        "content-length: 3\r\ncontent-length: 4\r\n",
        "content-length: -1\r\n",
        "transfer-encoding: gzip\r\n",
        "bad header\r\n",
    ],
)
def test_heads_that_cannot_be_believed_are_400(doors: Doors, lines: str) -> None:
    head = HEAD.format(token=doors.token("operator")) + lines + "connection: close\r\n\r\n{}"
    answer = talk(doors, [head.encode()])
    assert answer.startswith(b"HTTP/1.1 4") or answer.startswith(b"HTTP/1.1 501")
    problem_of(answer)


@pytest.mark.parametrize(
    "path", ["/../../etc/passwd", "/state/../../keys", "//", "/tasks/../state", "*", "http://evil/state"]
)
def test_paths_that_clients_tidy_up_lead_nowhere(doors: Doors, path: str) -> None:
    token = doors.token("operator")
    head = f"DELETE {path} HTTP/1.1\r\nhost: a\r\nauthorization: Bearer {token}\r\nconnection: close\r\n\r\n"
    assert problem_of(talk(doors, [head.encode()])).status in (400, 404, 405)
