"""The body as the process it really is: a unix socket, a secret from a file, an end on SIGTERM."""

from __future__ import annotations

import os
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from core.wire.body import BodyState, Hello, LineBuffer, decode, encode

ROOT = Path(__file__).parents[3]
SECRET = "0123456789abcdef0123"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "secret").write_text(SECRET + "\n")
    return {
        "PATH": os.environ["PATH"],
        "BODY_ID": "robot-1",
        "BODY_BASE_URL": "/dev/does-not-exist-1",
        "BODY_SERVO_URL": "/dev/does-not-exist-2",
        "BODY_MARKER_URL": "/dev/does-not-exist-3",
        "BODY_LISTEN": f"unix://{tmp_path}/run/body.sock",
        "BODY_DATA": str(tmp_path / "data"),
        "BODY_SECRET_FILE": str(tmp_path / "secret"),
    }


def start(environment: dict[str, str]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "robot_service.body"]
    return subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE)


@pytest.fixture
def process(environment: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    process = start(environment)
    yield process
    process.kill()
    process.communicate()


def connect(path: Path) -> socket.socket:
    deadline = time.monotonic() + 20
    while True:
        link = socket.socket(socket.AF_UNIX)
        link.settimeout(10)
        try:
            link.connect(str(path))
        except OSError:
            link.close()
            assert time.monotonic() < deadline, "nobody listens"
            time.sleep(0.05)
        else:
            return link


def first_state(link: socket.socket) -> BodyState:
    lines = LineBuffer()
    while not (got := lines.feed(link.recv(4096))):
        continue
    state = decode(got[0])
    assert isinstance(state, BodyState)
    return state


def test_it_serves_its_brain_alone_and_ends_on_sigterm(process: subprocess.Popen[bytes], tmp_path: Path) -> None:
    path = tmp_path / "run" / "body.sock"
    with connect(path) as stranger:
        stranger.sendall(encode(Hello(secret="guess")))
        assert stranger.recv(4096) == b""
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with connect(path) as brain:
        brain.sendall(encode(Hello(secret=SECRET)))
        state = first_state(brain)
        assert [why.split(":")[0] for why in state.down] == ["base", "servos", "markers"]
        assert not state.stopped
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    assert not path.exists()


def test_without_a_secret_it_does_not_start_and_says_why(environment: dict[str, str]) -> None:
    process = start(environment | {"BODY_SECRET_FILE": "/does/not/exist"})
    _, said = process.communicate(timeout=20)
    assert process.returncode == 1
    assert b"garden init" in said


def test_a_second_body_does_not_touch_the_first_ones_files(
    process: subprocess.Popen[bytes], environment: dict[str, str], tmp_path: Path
) -> None:
    connect(tmp_path / "run" / "body.sock").close()
    second = start(environment)
    _, said = second.communicate(timeout=20)
    assert second.returncode == 1
    assert b"another writer" in said
