"""A whole pot as a process on a real socket, for tests that kill it or let its system calls fail."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from core.mesh.auth import Enrolled, make_garden

FRUIT = {"colour": "red", "x_m": 0.1, "y_m": 0.0, "z_m": 0.3, "radius_m": 0.014}
FORKER = """
import os, sys
from plant_service.__main__ import main
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        main()
        os._exit(0)
    os.write(1, b"%d\\n" % pid)
    os.waitpid(pid, 0)
"""


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


@contextmanager
def forker(folder: Path, port: int, under: Sequence[str] = ()) -> Iterator[subprocess.Popen[bytes]]:
    """One warm interpreter that forks a pot for every life; `under` stands before its command (strace and its options)."""
    make_garden(folder / "keys", [Enrolled("plant-1", "plant")], time.time())
    environment = os.environ | {
        "GARDEN_KEYS": str(folder / "keys" / "plant-1"), "GARDEN_PORT": str(port), "PLANT_ID": "plant-1",
        "PLANT_DATA": str(folder / "data"), "PLANT_PROBE_URL": "socket://127.0.0.1:9?pin=0",
        "PLANT_STEM": '{"x_m":0,"y_m":0,"z_m":0.25}', "PLANT_DOCK": '{"x_m":0.55,"y_m":0,"yaw_rad":3.1}',
    }  # fmt: skip
    with subprocess.Popen(
        [*under, sys.executable, "-c", FORKER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env=environment, bufsize=0, start_new_session=True,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            os.killpg(process.pid, signal.SIGKILL)  # the pot as well


def call(port: int, method: str, path: str, token: str = "", body: object = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    try:
        connection.request(method, path, json.dumps(body) if body is not None else None, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def born(process: subprocess.Popen[bytes], port: int) -> int:
    """A pot that answers; its process id."""
    assert process.stdin
    assert process.stdout
    process.stdin.write(b"go\n")
    pid = int(process.stdout.readline())
    until = time.monotonic() + 20.0
    while time.monotonic() < until:
        try:
            call(port, "GET", "/healthz")
            return pid
        except OSError:
            time.sleep(0.01)
    raise AssertionError("the pot did not start")
