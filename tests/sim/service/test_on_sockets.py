"""The world as `python -m sim` runs it, on free ports of the loopback."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path

import httpx
import pytest

from core.clock import WallClock, WorldClock
from core.mesh.node import serve
from core.mesh.server import listen
from core.mesh.worldclock import follow
from core.scenario import device_ports, find
from hw.links import open_link
from sim.keeping import Keeper
from sim.service import make_node
from sim.wiring import assemble

SPEED = 10.0
SAFE_AHEAD = bytes([128, 131, 145, 0, 200, 0, 200])
HALT = bytes([145, 0, 0, 0, 0])


async def drive(address: str, http: httpx.AsyncClient) -> float:
    """Half a wall second ahead; how far the wheels went [m]."""
    card = (await http.get(address)).json()
    link = await open_link(f"socket://127.0.0.1:{card['links']['robot-1.create'].removeprefix('tcp port ')}")
    link.write(SAFE_AHEAD)
    await asyncio.sleep(0.5)
    link.write(HALT)
    await link.close()
    truth = (await http.get(f"{address}/truth")).json()
    return float(truth["robots"][0]["travel_m"][0])


async def visit(address: str) -> None:
    clock = WorldClock()
    async with httpx.AsyncClient() as http:
        following = asyncio.create_task(follow(clock, address, http))
        for _ in range(200):
            if (await http.get(f"{address}/readyz")).status_code == 200:
                break
            await asyncio.sleep(0.02)
        assert 0.3 < await drive(address, http) < 2.5
        told_s = (await http.get(f"{address}/clock")).json()["garden_s"]
        assert clock.now() == pytest.approx(told_s, abs=1.5)
        following.cancel()


@pytest.mark.alone
def test_the_world_serves_bytes_time_and_truth_and_ends_cleanly_on_sigterm(tmp_path: Path) -> None:
    async def main() -> None:
        clock = WallClock()
        rig = assemble(find("garden"), 7, clock, SPEED)
        keeper = Keeper(tmp_path, rig.world, rig.faults, rig.clockwork)
        ports = dict.fromkeys(device_ports(rig.world.scenario), 0)
        node = make_node(rig, clock, None, ports=ports, loops=[lambda: keeper.run(clock)])
        sock = listen("127.0.0.1", 0)
        serving = asyncio.create_task(serve(node, "127.0.0.1", 0, sock=sock))
        await visit(f"http://127.0.0.1:{sock.getsockname()[1]}")
        os.kill(os.getpid(), signal.SIGTERM)
        async with asyncio.timeout(5.0):
            await serving

    asyncio.run(main())
    assert [path.name for path in tmp_path.iterdir()] == ["world.json"]
