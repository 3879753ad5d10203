"""`python -m lab.experiments.sender URL COUNT RATE_HZ`: tells a pot of fruit, prints the delays [s] of its answers.

The token comes on stdin.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time

from core.clock import WallClock
from core.mesh.auth import Identity
from core.mesh.client import Mesh
from core.mesh.http import HttpTransport
from core.mesh.peers import Peer

FRUIT = json.dumps({"colour": "red", "x_m": 0.1, "y_m": 0.0, "z_m": 0.3, "radius_m": 0.014}).encode()
WARM = 3
"""Messages that open connections and are not counted."""


async def main(url: str, count: int, rate_hz: float, token: str) -> list[float]:
    peer = Peer(id="plant-1", kind="plant", url=url)
    mesh = Mesh(HttpTransport(), Identity("operator", "operator", token), WallClock(), timeout_s=10.0)
    delays_s: list[float] = []

    async def one(at_s: float) -> None:
        await asyncio.sleep(max(0.0, at_s - time.perf_counter()))
        began_s = time.perf_counter()
        answer = await mesh.exchange(peer, "POST", "/inventory/fruits", FRUIT)
        if answer.status >= 300:
            raise RuntimeError(f"the pot answered {answer.status}: {answer.body[:200]!r}")
        delays_s.append(time.perf_counter() - began_s)

    for _ in range(WARM):
        await one(0.0)
    delays_s.clear()
    start_s = time.perf_counter() + 0.2
    async with asyncio.TaskGroup() as group:
        for number in range(count):
            group.create_task(one(start_s + number / rate_hz))
    await mesh.aclose()
    return delays_s


if __name__ == "__main__":
    print(json.dumps(asyncio.run(main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.stdin.readline().strip()))))
