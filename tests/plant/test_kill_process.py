"""A whole pot, as a process on a real socket, killed with SIGKILL while it acknowledges: nothing acknowledged is lost."""

from __future__ import annotations

import http.client
import json
import os
import random
import signal
import time
from pathlib import Path

from pot_process import FRUIT, born, call, forker, free_port

KILLS, WRITES_MAX = 20, 20
"""All that they add is less than an inventory holds."""


def add_until_killed(port: int, token: str, pid: int, writes: int, dies_after_s: float) -> set[str]:
    """Ids acknowledged before the kill, which comes so long after one more request was sent."""
    acknowledged: set[str] = set()
    for _ in range(writes):
        status, answer = call(port, "POST", "/inventory/fruits", token, FRUIT)
        assert status == 201
        acknowledged.add(json.loads(answer)["fruit_id"])
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    connection.request("POST", "/inventory/fruits", json.dumps(FRUIT), headers)
    time.sleep(dies_after_s)
    os.kill(pid, signal.SIGKILL)
    connection.close()
    return acknowledged


def test_twenty_kills_of_a_whole_pot_lose_nothing_acknowledged(tmp_path: Path) -> None:
    seed = 5
    print("seed", seed)
    rng, port = random.Random(seed), free_port()
    acknowledged: set[str] = set()
    with forker(tmp_path, port) as process:
        token = (tmp_path / "keys" / "operator" / "token").read_text().strip()
        for kill in range(KILLS + 1):
            pid = born(process, port)
            status, answer = call(port, "GET", "/inventory")
            assert status == 200
            found = [fruit["fruit_id"] for fruit in json.loads(answer)["fruits"]]
            assert len(found) == len(set(found))
            assert acknowledged <= set(found), f"kill {kill}: lost {acknowledged - set(found)}"
            acknowledged |= add_until_killed(port, token, pid, rng.randint(1, WRITES_MAX), rng.uniform(0.0, 0.004))
    assert len(acknowledged) > KILLS
    assert not list((tmp_path / "data").glob("*.bad-*"))
