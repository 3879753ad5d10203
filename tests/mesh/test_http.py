"""The transport's own HTTP client against servers good and bad, on real sockets."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.errors import BadRequest
from core.mesh import http
from core.mesh.client import Answer
from core.mesh.http import CONNECTIONS_MAX, HttpTransport, _Reader

T = TypeVar("T")
Story = Callable[[str, HttpTransport], Awaitable[T]]


class Script:
    """A server that says the next prepared bytes to every request; None closes without a word."""

    def __init__(self, *says: bytes | None, then_close: bool = False) -> None:
        self._says = list(says)
        self._then_close = then_close
        self.connections = 0
        self.heard: list[bytes] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        try:
            while self._says:
                self.heard.append(await reader.readuntil(b"\r\n\r\n"))
                said = self._says.pop(0)
                if said is None:
                    return
                for at in range(0, len(said), 7):
                    writer.write(said[at : at + 7])
                    await writer.drain()
                if self._then_close:
                    return
            await reader.read()
        except (asyncio.IncompleteReadError, ConnectionError):
            return
        finally:
            writer.close()


def against(script: Script, story: Story[T]) -> T:
    async def go() -> T:
        serving: list[asyncio.Task[None]] = []

        def accepted(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            serving.append(asyncio.create_task(script.serve(reader, writer)))

        server = await asyncio.start_server(accepted, "127.0.0.1", 0)
        transport = HttpTransport()
        try:
            async with asyncio.timeout(5):
                return await story(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}", transport)
        finally:
            await transport.aclose()
            server.close()
            await asyncio.gather(*serving)
            await server.wait_closed()

    return asyncio.run(go())


def get(script: Script, path: str = "/a") -> Answer:
    return against(script, lambda url, transport: transport.send("GET", url + path, {"x": "y"}, b""))


SIZED = b"HTTP/1.1 200 OK\r\nX-Tag: a\r\ncontent-length: 5\r\n\r\nhello"
GOOD = {
    "sized": SIZED,
    "chunked": b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n3\r\nhel\r\n2;x=1\r\nlo\r\n0\r\n\r\n",
    "after a word on the way": b"HTTP/1.1 103 Early\r\nlink: x\r\n\r\n" + SIZED,
}


@pytest.mark.parametrize("name", GOOD)
def test_answers_are_read_however_they_are_framed_and_cut(name: str) -> None:
    answer = get(Script(GOOD[name]))
    assert (answer.status, answer.body) == (200, b"hello")


def test_an_answer_without_a_length_ends_with_the_connection() -> None:
    assert get(Script(b"HTTP/1.0 200 OK\r\n\r\nhello", then_close=True)).body == b"hello"


def test_answers_that_have_no_body_need_none() -> None:
    assert get(Script(b"HTTP/1.1 204 No Content\r\n\r\n")).status == 204
    head = b"HTTP/1.1 200 OK\r\ncontent-length: 5\r\n\r\n"
    assert against(Script(head), lambda url, t: t.send("HEAD", url, {}, b"")).body == b""


BAD = {
    "not http": b"SSH-2.0-OpenSSH_9.2\r\n\r\n",
    "a length that is none": b"HTTP/1.1 200 OK\r\ncontent-length: -5\r\n\r\nhello",
    "a length too great": b"HTTP/1.1 200 OK\r\ncontent-length: 99999999999\r\n\r\n",
    "a chunk size that is none": b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\nzz\r\n",
    "a chunk too long": b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n3\r\nhello\r\n",
    "a header without a name": b"HTTP/1.1 200 OK\r\n: x\r\n\r\n",
    "an endless head": b"HTTP/1.1 200 OK\r\nx: " + b"y" * 70_000,
    "broken off": b"HTTP/1.1 200 OK\r\ncontent-length: 50\r\n\r\nhello",
    "nothing": None,
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_answer_is_an_os_error(name: str) -> None:
    with pytest.raises(ConnectionError):
        get(Script(BAD[name], then_close=True))


def test_a_connection_is_used_again() -> None:
    script = Script(SIZED, SIZED, SIZED)

    async def story(url: str, transport: HttpTransport) -> None:
        for _ in range(3):
            await transport.send("POST", url, {}, b"")

    against(script, story)
    assert script.connections == 1


@pytest.mark.parametrize("last", [SIZED.replace(b"X-Tag: a", b"connection: close"), SIZED + b"more than was said"])
def test_a_connection_is_not_used_again_when_it_cannot_be(last: bytes) -> None:
    script = Script(last, SIZED)

    async def story(url: str, transport: HttpTransport) -> None:
        for _ in range(2):
            await transport.send("GET", url, {}, b"")

    against(script, story)
    assert script.connections == 2


def test_a_kept_connection_that_was_closed_costs_a_get_nothing_but_a_post_is_told() -> None:
    async def twice(method: str, url: str, transport: HttpTransport) -> Answer:
        await transport.send("GET", url, {}, b"")
        return await transport.send(method, url, {}, b"")

    script = Script(SIZED, None, SIZED)
    assert against(script, lambda url, t: twice("GET", url, t)).body == b"hello"
    with pytest.raises(ConnectionResetError):
        against(Script(SIZED, None, SIZED), lambda url, t: twice("POST", url, t))


async def gives_up(url: str, transport: HttpTransport, after_s: float = 0.1) -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(after_s):
            await transport.send("GET", url, {}, b"")


def test_no_other_request_gets_the_answer_to_one_that_was_given_up() -> None:
    script = Script(b"HTTP/1.1 200 OK\r\ncontent-length: 50\r\n\r\nhello", SIZED)

    async def story(url: str, transport: HttpTransport) -> Answer:
        await gives_up(url, transport)
        return await transport.send("GET", url, {}, b"")

    assert against(script, story).body == b"hello"
    assert script.connections == 2


class Slow(Script):
    """Answers only once it is let."""

    def __init__(self, *says: bytes | None) -> None:
        super().__init__(*says)
        self.may = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        heard = asyncio.create_task(reader.readuntil(b"\r\n\r\n"))
        while await _comes(heard):
            heard = asyncio.create_task(reader.readuntil(b"\r\n\r\n"))
            may = asyncio.create_task(self.may.wait())
            await asyncio.wait({may, heard}, return_when=asyncio.FIRST_COMPLETED)
            if not may.done():
                may.cancel()
                continue
            writer.write(self._says.pop(0) or b"")
        writer.close()


async def _comes(request: asyncio.Task[bytes]) -> bool:
    try:
        await request
    except (asyncio.IncompleteReadError, ConnectionError):
        return False
    return True


def test_a_peer_that_has_fallen_behind_is_not_asked_on_ever_more_connections() -> None:
    script = Slow(*[SIZED] * (CONNECTIONS_MAX + 1))

    async def story(url: str, transport: HttpTransport) -> bytes:
        await asyncio.gather(*(gives_up(url, transport) for _ in range(3 * CONNECTIONS_MAX)))
        script.may.set()
        return (await transport.send("GET", url, {}, b"")).body

    assert against(script, story) == b"hello"
    assert script.connections == CONNECTIONS_MAX


def test_requests_beyond_the_connections_wait_for_their_turn() -> None:
    script = Slow(*[SIZED] * 3 * CONNECTIONS_MAX)
    script.may.set()

    async def story(url: str, transport: HttpTransport) -> list[Answer]:
        return await asyncio.gather(*(transport.send("GET", url, {}, b"") for _ in range(3 * CONNECTIONS_MAX)))

    assert [answer.body for answer in against(script, story)] == [b"hello"] * 3 * CONNECTIONS_MAX
    assert script.connections == CONNECTIONS_MAX


def test_an_answer_that_never_comes_costs_no_connection_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "LATE_S", 0.05)
    script = Slow(*[SIZED] * 2 * CONNECTIONS_MAX)

    async def story(url: str, transport: HttpTransport) -> None:
        for _ in range(2):
            await asyncio.gather(*(gives_up(url, transport) for _ in range(CONNECTIONS_MAX)))

    against(script, story)
    assert script.connections == 2 * CONNECTIONS_MAX


def test_who_waits_for_a_connection_is_told_when_the_transport_closes() -> None:
    async def story(url: str, transport: HttpTransport) -> list[Answer | BaseException]:
        asked = [asyncio.create_task(transport.send("GET", url, {}, b"")) for _ in range(CONNECTIONS_MAX + 1)]
        await asyncio.sleep(0.1)
        await transport.aclose()
        return await asyncio.gather(*asked, return_exceptions=True)

    ends = against(Slow(SIZED), story)
    assert len(ends) == CONNECTIONS_MAX + 1
    assert all(isinstance(end, ConnectionResetError) for end in ends)


def test_nothing_can_be_smuggled_into_a_request() -> None:
    script = Script(SIZED)
    get(script, "/tasks/a b\r\nx-evil: 1")
    assert b"\r\nx-evil" not in script.heard[0]
    with pytest.raises(BadRequest, match="control"):
        against(Script(SIZED), lambda url, t: t.send("GET", url, {"x": "a\r\nx-evil: 1"}, b""))


@pytest.mark.parametrize("url", ["ftp://127.0.0.1/", "/state", "http:///x"])
def test_other_addresses_are_refused(url: str) -> None:
    with pytest.raises(BadRequest):
        asyncio.run(HttpTransport().send("GET", url, {}, b""))


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200), st.integers(1, 50))
def test_any_bytes_at_all_are_an_answer_or_an_error(data: bytes, piece: int) -> None:
    reader = _Reader(headless=False)
    begin = b"HTTP/1.1 200 OK\r\n" if data[:1] < b"\x80" else b""
    try:
        for at in range(0, len(begin + data), piece):
            if reader.feed((begin + data)[at : at + piece]) is not None:
                return
        reader.at_end()
    except ValueError:
        return
