"""A whole pot whose system calls fail, injected by strace: it never says 2xx to what is not there afterwards."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from pot_process import FRUIT, born, call, forker, free_port
from tracing import untraceable

LIVES, WRITES, EVERY = 3, 12, 4
KEPT = ("inventory.json", "inventory.json.tmp", "inventory.json.1")


@pytest.mark.parametrize(
    ("trace", "error"), [("write", "ENOSPC"), ("fsync,fdatasync", "EIO"), ("rename,renameat", "EIO"), ("link,linkat", "EIO")]
)
def test_a_pot_whose_disk_fails_answers_no_false_2xx(tmp_path: Path, trace: str, error: str) -> None:
    if why := untraceable():
        pytest.skip(why)
    port, data = free_port(), tmp_path / "data"
    data.mkdir()
    log = tmp_path / "strace.log"
    paths = [part for name in KEPT for part in ("-P", str(data / name))]
    inject = f"inject={trace}:error={error}:when={EVERY}+{EVERY}"
    under = ["strace", "-f", "-q", "-o", str(log), *paths, "-e", f"trace={trace}", "-e", inject]
    acknowledged: set[str] = set()
    refused = 0
    with forker(tmp_path, port, under) as process:
        token = (tmp_path / "keys" / "operator" / "token").read_text().strip()
        for _ in range(LIVES):
            pid = born(process, port)
            assert acknowledged <= known(port)
            for _ in range(WRITES):
                status, answer = call(port, "POST", "/inventory/fruits", token, FRUIT)
                assert status in (201, 503, 507), (status, answer)
                if status == 201:
                    acknowledged.add(json.loads(answer)["fruit_id"])
                    assert acknowledged <= known(port)
                else:
                    refused += 1
                    assert json.loads(answer)["hint"]
            os.kill(pid, signal.SIGKILL)
    with forker(tmp_path, port) as process:
        born(process, port)
        assert acknowledged <= known(port)
    injected = log.read_text().count("(INJECTED)")
    print(f"{len(acknowledged)} acknowledged, {refused} refused, {injected} calls failed")
    assert injected >= LIVES
    assert refused >= LIVES
    assert len(acknowledged) >= LIVES


def known(port: int) -> set[str]:
    status, answer = call(port, "GET", "/inventory")
    assert status == 200
    return {fruit["fruit_id"] for fruit in json.loads(answer)["fruits"]}
