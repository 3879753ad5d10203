"""A writer killed with SIGKILL at any instant: nothing acknowledged is lost, nothing is corrupt, it always starts again."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

WRITER = """
import os, sys
from pathlib import Path
from core.clock import WallClock
from core.store import DurableDocument
file = DurableDocument(Path(sys.argv[1]), "kill/1", None)
n = (file.load() or {"n": 0})["n"]
os.write(1, b"%d\\n" % n)
while True:
    n += 1
    file.commit({"n": n, "ballast": "x" * (n * 97 % 5000)})
    os.write(1, b"%d\\n" % n)
"""


@pytest.mark.parametrize("kills", [500, pytest.param(10_000, marks=pytest.mark.soak)])
def test_kills_lose_nothing_that_was_acknowledged(kills: int, tmp_path: Path) -> None:
    seed = 11
    print("seed", seed)
    rng = random.Random(seed)
    acknowledged = 0
    forker = _Forker(tmp_path / "doc.json")
    try:
        for kill in range(kills):
            first, last = forker.life(rng.uniform(0.002, 0.04))
            assert first >= acknowledged, f"kill {kill}: {acknowledged} was acknowledged, {first} was found"
            assert first <= acknowledged + 1
            acknowledged = max(first, last)
    finally:
        forker.close()
    assert acknowledged > kills
    assert not list(tmp_path.glob("*.bad-*"))


class _Forker:
    """One warm interpreter that forks a writer for every life, so that a life costs milliseconds."""

    def __init__(self, path: Path) -> None:
        code = (
            "import os, sys\n"
            "import core.store\n"
            f"writer = compile({WRITER!r}, 'writer', 'exec')\n"
            "for line in sys.stdin:\n"
            "    pid = os.fork()\n"
            "    if pid == 0:\n"
            "        exec(writer, {'__name__': 'writer'})\n"
            "    os.write(2, b'%d\\n' % pid)\n"
            "    os.waitpid(pid, 0)\n"
            "    os.write(1, b'end\\n')\n"
        )
        self._process = subprocess.Popen(
            [sys.executable, "-c", code, str(path)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0,
        )  # fmt: skip

    def life(self, seconds: float) -> tuple[int, int]:
        """One writer, killed after so long: what it found, and what it acknowledged last."""
        assert self._process.stdin
        assert self._process.stderr
        self._process.stdin.write(b"go\n")
        pid = int(self._line(self._process.stderr))
        time.sleep(seconds)
        os.kill(pid, signal.SIGKILL)
        told = []
        while (line := self._line(self._process.stdout)) != b"end":
            told.append(int(line))
        return (told[0], told[-1]) if told else self.life(seconds + 0.01)

    def _line(self, stream: object) -> bytes:
        line = b""
        while not line.endswith(b"\n"):
            byte = stream.read(1)  # type: ignore[attr-defined]
            assert byte, "the writer's parent died"
            line += byte
        return line[:-1]

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            assert stream is not None
            stream.close()
