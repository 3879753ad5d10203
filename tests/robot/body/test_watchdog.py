"""A body whose loop hangs, in real time: what was moving is stopped on the wire while it still hangs."""

from __future__ import annotations

import asyncio
import importlib.util
import random
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from core.clock import WallClock
from core.robots import gardener
from core.wire.body import Setpoint
from hw.drivers.ssc32 import Ssc32Driver
from hw.links import MemoryNet, open_link
from hw.protocols.create import Op
from robot_service.body.body import Drivers, build_body
from robot_service.body.settings import BodySettings
from robot_service.body.watchdog import LATE_S, Watchdog, Wires, last_words
from sim.devices.bench_ssc32 import BenchRig
from sim.devices.host import EmulatorHost
from sim.devices.ssc32 import Ssc32Emulator

_spec = importlib.util.spec_from_file_location("body_stand_ins", Path(__file__).with_name("stand_ins.py"))
assert _spec is not None
assert _spec.loader is not None
stand_ins = sys.modules.setdefault("body_stand_ins", importlib.util.module_from_spec(_spec))
_spec.loader.exec_module(stand_ins)

HANGS_S = 2.0
PUMP = Setpoint(seq=0, pump=True, permit_id="plant-1/p1", dose_ml=400.0, arm=gardener.ARM_HOME_RAD)


class Recorded(BenchRig):
    """Remembers when the pump's relay was switched."""

    def __init__(self) -> None:
        super().__init__()
        self.relay: list[tuple[float, bool]] = []

    def set_output(self, channel: int, high: bool) -> None:
        if channel == gardener.PUMP_CHANNEL and high is not self.outputs.get(channel, False):
            self.relay.append((time.monotonic(), high))
        super().set_output(channel, high)


class Board(threading.Thread):
    """A servo board that has a loop of its own, and a base's wire that only remembers what it was told."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.rig, self.base = Recorded(), bytearray()
        self.urls: list[str] = []
        self._ready, self._over = threading.Event(), asyncio.Event()
        self._loop: asyncio.AbstractEventLoop

    def run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        host = EmulatorHost(Ssc32Emulator(self.rig, random.Random(1)), WallClock())
        servers = [await host.serve_tcp("127.0.0.1", 0), await asyncio.start_server(self._hear, "127.0.0.1", 0)]
        self.urls = ["socket://{}:{}".format(*server.sockets[0].getsockname()) for server in servers]
        running = asyncio.create_task(host.run())
        self._ready.set()
        await self._over.wait()
        running.cancel()
        for server in servers:
            server.close()
        await host.close()

    async def _hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(100):
            self.base += data
        writer.close()

    def __enter__(self) -> Board:
        self.start()
        assert self._ready.wait(5.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._over.set)
        self.join(5.0)


async def until(true: Any, within_s: float = 10.0) -> None:
    async with asyncio.timeout(within_s):
        while not true():  # noqa: ASYNC110 (the board is another thread's)
            await asyncio.sleep(0.02)


@pytest.mark.alone
def test_a_body_whose_loop_hangs_while_it_pumps_stops_on_the_wire_and_goes_on_afterwards(tmp_path: Path) -> None:
    async def main(board: Board) -> None:
        clock = WallClock()
        net, wires = MemoryNet(clock), Wires(open_link)
        servo_url, base_url = board.urls
        urls = {"base_url": base_url, "servo_url": servo_url, "marker_url": "memory://markers"}
        settings = BodySettings(id="robot-1", listen="memory://body", data=tmp_path, secret=stand_ins.SECRET, **urls)
        base = stand_ins.FakeBase(clock)
        base.sense = dict(stand_ins.DOCKED)
        link = await wires.open(base_url)
        servos = Ssc32Driver(servo_url, wires.open, clock, outputs=(gardener.PUMP_CHANNEL,))
        drivers = Drivers(base=base, servos=servos, localizer=stand_ins.FakeLocalizer())
        body = build_body(settings, clock, net.open, net.listen, drivers)
        dog = Watchdog(body, wires, last_words(settings))
        tasks = [asyncio.create_task(body.run()), asyncio.create_task(dog.run())]
        await asyncio.sleep(0.2)
        brain = stand_ins.Brain(await net.open("memory://body"), clock)
        brain.hello()
        tasks += [asyncio.create_task(brain.listen()), asyncio.create_task(brain.talk())]
        brain.wish = PUMP
        await until(lambda: board.rig.outputs.get(gardener.PUMP_CHANNEL))
        await asyncio.sleep(0.3)
        assert dog.spoke == 0
        began_s, switched = time.monotonic(), len(board.rig.relay)
        while time.monotonic() - began_s < HANGS_S:
            pass
        assert board.rig.relay[switched:], "the pump ran on"
        off_s, high = board.rig.relay[switched]
        assert not high
        assert off_s - began_s < LATE_S + 0.3
        assert dog.spoke >= 1
        assert bytes(board.base).startswith(last_words(settings)[base_url])
        assert bytes((Op.START.value,)) in board.base
        assert len(board.rig.relay) == switched + 1, "and it stayed off"
        await until(lambda: board.rig.outputs[gardener.PUMP_CHANNEL])
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        await link.close()
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
        assert signal.getsignal(signal.SIGALRM) in (signal.SIG_DFL, None)

    with Board() as board:
        asyncio.run(main(board))
