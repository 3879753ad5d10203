"""pyfirmata2, unchanged, against the Firmata emulator over a pseudo-terminal."""

from __future__ import annotations

import asyncio
import importlib
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from core.clock import WallClock
from sim.devices.bench_firmata import BenchPins
from sim.devices.emulate import PtyLink
from sim.devices.firmata import FirmataEmulator
from sim.devices.host import EmulatorHost

pyfirmata2 = pytest.importorskip("pyfirmata2", reason="pip install robot-garden[conformance]")


class Arduino:
    """An emulator on a thread of its own, at `path`."""

    def __init__(self) -> None:
        self.pins = BenchPins(random.Random(1))
        self.path = ""
        self._serving = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))
        self._thread.start()
        assert self._serving.wait(5.0)

    def end(self) -> None:
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()

    async def _serve(self) -> None:
        self._loop, self._ended, link = asyncio.get_running_loop(), asyncio.Event(), PtyLink()
        self.path = link.path
        self._serving.set()
        host = EmulatorHost(FirmataEmulator(self.pins, random.Random(1)), WallClock())
        host.attach(link)
        running = asyncio.create_task(host.run())
        await self._ended.wait()
        running.cancel()
        await host.close()


@pytest.fixture
def arduino() -> Iterator[Arduino]:
    board = Arduino()
    yield board
    board.end()


@pytest.fixture(autouse=True)
def _short_boot(monkeypatch: pytest.MonkeyPatch) -> None:
    """The client spins for five seconds while a real board boots; ours needs no boot."""
    monkeypatch.setattr(importlib.import_module("pyfirmata2.pyfirmata2"), "BOARD_SETUP_WAIT_TIME", 0.2)


def eventually(condition: Callable[[], bool], within_s: float = 3.0) -> bool:
    end_s = time.monotonic() + within_s
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.01)
    return condition()


def test_a_board_with_a_known_layout_reads_and_switches(arduino: Arduino) -> None:
    client: Any = pyfirmata2.Arduino(arduino.path)
    try:
        values: list[float] = []
        client.samplingOn(20)
        client.sp.write(bytes((pyfirmata2.REPORT_VERSION,)))
        client.send_sysex(pyfirmata2.REPORT_FIRMWARE, [])
        assert eventually(lambda: client.get_firmata_version() == (2, 5))
        assert eventually(lambda: client.firmware == "StandardFirmata.ino")
        probe = client.get_pin("a:0:i")
        probe.register_callback(values.append)
        assert eventually(lambda: len(values) >= 10)
        assert values[-1] * 5.0 == pytest.approx(1.44, abs=0.05)
        client.get_pin("d:8:o").write(1)
        assert eventually(lambda: arduino.pins.levels.get(8, False))
        client.digital[8].write(0)
        assert eventually(lambda: not arduino.pins.levels[8])
    finally:
        client.exit()


def test_a_board_sets_itself_up_by_its_capabilities(arduino: Arduino) -> None:
    client: Any = pyfirmata2.Board(arduino.path)
    try:
        assert len(client.analog) == 6
        assert [pin.pin_number for pin in client.digital if pin.PWM_CAPABLE] == [3, 5, 6, 9, 10, 11]
        client.get_pin("d:9:p").write(1.0)
        assert eventually(lambda: arduino.pins.levels.get(9, False))
    finally:
        client.exit()


def test_the_emulate_command_is_a_board_too(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sim.devices.emulate", "firmata", "--pty", str(tmp_path / "ttyACM0")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            client: Any = pyfirmata2.Board(process.stdout.readline().strip())
            assert len(client.digital) == 14
            client.exit()
        finally:
            process.terminate()
            assert process.wait(10.0) == 0
