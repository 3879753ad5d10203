"""Byte links open by URL and say plainly why they cannot."""

import asyncio
import os

import pytest

from core.clock import VirtualClock
from core.errors import ConfigError, LinkDown
from core.virtual import run_virtual
from hw.links import MemoryNet, memory_pair, open_link


def test_bytes_cross_a_memory_pair_in_order_and_never_at_once():
    async def main():
        clock = VirtualClock()
        here, there = memory_pair(clock, latency_s=0.01)
        here.write(b"ab")
        here.write(b"c")
        got = await there.read()
        return got, clock.now()

    got, now_s = run_virtual(main())
    assert got == b"abc"
    assert now_s >= 0.01


def test_a_closed_memory_link_says_so_on_both_ends():
    async def main():
        here, there = memory_pair(VirtualClock())
        await here.close()
        with pytest.raises(LinkDown, match="closed by the other side"):
            await there.read()
        with pytest.raises(LinkDown):
            here.write(b"x")

    run_virtual(main())


def test_bytes_sent_before_the_close_still_arrive():
    async def main():
        here, there = memory_pair(VirtualClock())
        here.write(b"last words")
        await here.close()
        return await there.read()

    assert run_virtual(main()) == b"last words"


def test_a_muted_link_swallows_bytes_without_a_word():
    async def main():
        clock = VirtualClock()
        here, there = memory_pair(clock)
        here.muted = True
        here.write(b"lost")
        with pytest.raises(TimeoutError):
            async with clock.timeout(1.0):
                await there.read()

    run_virtual(main())


def test_nobody_listening_is_a_link_down():
    async def main():
        net = MemoryNet(VirtualClock())
        with pytest.raises(LinkDown, match="nobody listens"):
            await net.open("memory://robot-9.create")

    run_virtual(main())


@pytest.mark.parametrize("url", ["http://x", "socket://nohost", "tty7"])
def test_a_url_of_no_known_kind_is_a_configuration_error(url):
    with pytest.raises(ConfigError):
        asyncio.run(open_link(url))


@pytest.mark.parametrize("url", ["/dev/no-such-port", "unix:///no/such/socket"])
def test_a_missing_port_is_a_link_down_that_names_it(url):
    with pytest.raises(LinkDown, match="no"):
        asyncio.run(open_link(url))


def test_a_tcp_link_carries_bytes_both_ways():
    async def main():
        async def echo(reader, writer):
            writer.write(await reader.read(10))
            writer.close()

        server = await asyncio.start_server(echo, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        link = await open_link(f"socket://127.0.0.1:{port}")
        link.write(b"ping")
        assert await link.read() == b"ping"
        with pytest.raises(LinkDown):
            await link.read()
        await link.close()
        server.close()
        await server.wait_closed()

    asyncio.run(main())


def test_a_pty_opens_as_a_serial_port():
    master, slave = os.openpty()

    async def main():
        link = await open_link(os.ttyname(slave) + "?baud=57600")
        link.write(b"\x80")
        got = await asyncio.to_thread(os.read, master, 1)
        await link.close()
        return got

    assert asyncio.run(main()) == b"\x80"
    os.close(master)
    os.close(slave)
