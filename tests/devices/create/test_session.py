"""The reconnecting session, against an echo device."""

import asyncio
from collections.abc import Awaitable, Callable

from structlog.testing import capture_logs

from core.clock import VirtualClock
from core.errors import DriverError
from core.virtual import run_virtual
from hw.drivers.session import Session
from hw.links import ByteLink, MemoryLink, MemoryNet


class Pinger(Session):
    """Sends `?` ten times a second; any byte but `!` is an answer, `!` is nonsense."""

    greeted = 0

    def _received(self, data: bytes) -> None:
        if b"!" in data:
            raise DriverError("nonsense on the wire")
        self._heard()

    async def _converse(self) -> None:
        self.greeted += 1
        while True:
            self._send(b"?")
            await self._clock.sleep(0.1)

    def _farewell(self) -> bytes:
        return b"bye"


class Bench:
    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.net = MemoryNet(self.clock)
        self.heard = bytearray()
        self.links: list[ByteLink] = []
        self.answering = True
        self.pinger = Pinger("memory://dev", self.net.open, self.clock, name="dev", silence_s=0.5)
        self.plug()

    def plug(self) -> None:
        self.net.listen("dev", lambda link: self.links.append(link) or asyncio.ensure_future(self.echo(link)))

    async def echo(self, link: ByteLink) -> None:
        while True:
            data = await link.read()
            self.heard += data
            if self.answering:
                link.write(b".")


def on_bench(story: Callable[[Bench], Awaitable[None]]) -> list[dict]:
    async def main() -> None:
        bench = Bench()
        task = asyncio.create_task(bench.pinger.run())
        async with asyncio.timeout(100):
            await story(bench)
        task.cancel()

    with capture_logs() as logs:
        run_virtual(main())
    return logs


def test_a_device_that_answers_is_up_and_this_is_said_once() -> None:
    async def story(bench: Bench) -> None:
        await bench.pinger.wait_link()
        await bench.clock.sleep(5)
        assert bench.pinger.link.up

    assert [entry["event"] for entry in on_bench(story)] == ["link up"]


def test_silence_makes_it_down_and_answers_make_it_up_again() -> None:
    async def story(bench: Bench) -> None:
        await bench.pinger.wait_link()
        bench.answering = False
        begun_s = bench.clock.now()
        await bench.pinger.wait_link(False)
        assert 0.4 < bench.clock.now() - begun_s < 0.7
        assert "no reply" in bench.pinger.link.why
        await bench.clock.sleep(10)
        bench.answering = True
        await bench.pinger.wait_link()

    assert [entry["event"] for entry in on_bench(story)] == ["link up", "link down", "link up"]


def test_nonsense_drops_the_connection_and_greets_anew() -> None:
    async def story(bench: Bench) -> None:
        await bench.pinger.wait_link()
        bench.links[-1].write(b"!")
        await bench.pinger.wait_link(False)
        assert bench.pinger.link.why == "nonsense on the wire"
        await bench.pinger.wait_link()
        assert bench.pinger.greeted == 2

    on_bench(story)


def test_an_unplugged_device_is_found_again_within_the_longest_backoff() -> None:
    async def story(bench: Bench) -> None:
        await bench.pinger.wait_link()
        bench.net.close("dev")
        await bench.links[-1].close()
        await bench.pinger.wait_link(False)
        await bench.clock.sleep(60)
        bench.plug()
        begun_s = bench.clock.now()
        await bench.pinger.wait_link()
        assert bench.clock.now() - begun_s < 2.2

    assert [entry["event"] for entry in on_bench(story)] == ["link up", "link down", "link up"]


def test_a_port_that_was_never_there_is_said_once() -> None:
    async def story(bench: Bench) -> None:
        bench.net.close("dev")
        await bench.clock.sleep(30)
        assert not bench.pinger.link.up
        assert "nobody listens" in bench.pinger.link.why

    assert [entry["event"] for entry in on_bench(story)] == ["link down"]


def test_cancelling_says_farewell() -> None:
    async def main() -> bytes:
        bench = Bench()
        task = asyncio.create_task(bench.pinger.run())
        await bench.pinger.wait_link()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await bench.clock.sleep(0.1)
        assert isinstance(bench.links[-1], MemoryLink)
        return bytes(bench.heard)

    with capture_logs():
        assert run_virtual(main()).endswith(b"bye")
