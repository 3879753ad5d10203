"""The byte exchanges of public SSC-32 and StarGazer clients, replayed against the emulators."""

from __future__ import annotations

import codecs
import random
from collections.abc import Iterator
from pathlib import Path

from sim.devices.bench_ssc32 import BenchRig
from sim.devices.plants import Emulator, MarkerSight
from sim.devices.ssc32 import Ssc32Emulator
from sim.devices.stargazer import StargazerEmulator

FIXTURES = Path(__file__).parent.parent / "fixtures"
ANSWER_S = 0.02


def script(name: str) -> Iterator[tuple[str, str, bytes]]:
    """(mark, text, bytes) of each line that is no comment."""
    for line in (FIXTURES / name).read_text(encoding="ascii").splitlines():
        if line and not line.startswith("#"):
            mark, text = line[0], line[2:]
            yield mark, text, codecs.decode(text, "unicode_escape").encode("latin-1")


class Player:
    def __init__(self, emulator: Emulator, byte_gap_s: float = 0.0) -> None:
        self.emulator, self.byte_gap_s = emulator, byte_gap_s
        self.now_s = 100.0
        self.heard = b""

    def wait(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while (due_s := self.emulator.due_s()) <= end_s:
            self.now_s = max(self.now_s, due_s)
            self.emulator.step(self.now_s)
            self.heard += self.emulator.transmit()
        self.now_s = end_s

    def write(self, data: bytes) -> None:
        pieces = [bytes((byte,)) for byte in data] if self.byte_gap_s else [data]
        for piece in pieces:
            self.emulator.receive(piece, self.now_s)
            assert self.emulator.transmit() == b"", "an answer in the same instant is lost on clients that flush"
            self.wait(self.byte_gap_s)

    def play(self, name: str) -> None:
        for mark, text, data in script(name):
            if mark == "+":
                self.wait(float(text))
            elif mark == ">":
                assert self.heard == b"", f"before {text}"
                self.write(data)
            else:
                self.wait(ANSWER_S)
                assert self.heard == data, text
                self.heard = b""
        assert self.heard == b""


class Ceiling:
    def sight(self, now_s: float) -> MarkerSight:
        return MarkerSight(marker_id=24706, theta_deg=-96.61, x_cm=-48.13, y_cm=-21.35, z_cm=221.64)


def test_ssc32_clients_get_the_answers_they_parse() -> None:
    Player(Ssc32Emulator(BenchRig(), random.Random(1))).play("ssc32_clients.txt")


def test_stargazer_clients_get_the_answers_they_parse() -> None:
    sensor = StargazerEmulator(Ceiling(), random.Random(1))
    sensor._phase_s = 5.0  # no pose before the first command
    Player(sensor, byte_gap_s=0.01).play("stargazer_clients.txt")
