"""Asking 2, 20 and 200 robots for a bid at once: our mesh beside one httpx client."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from statistics import median
from typing import Any

import httpx

from core.clock import WallClock
from core.mesh.auth import GardenKey
from core.mesh.client import Mesh
from core.mesh.http import HttpTransport
from core.mesh.peers import Peer
from core.wire.geometry import Point3, Pose2
from core.wire.market import Announcement, Bid, PlantCard

Row = dict[str, Any]
SIZES = {2: 1.0, 20: 5.0, 200: 60.0}
"""How many robots, and the target [ms]."""
CPU_US_MAX = 300.0
ROUNDS, MESSAGES = 5, 200
"""So many rounds, or more until they are so many messages, are one side of a pair; their median counts.

The first round of each side, which opens the connections, is left out.
"""
_ORIGIN = Point3(x_m=0.0, y_m=0.0, z_m=0.0)
_CARD = PlantCard(
    plant_id="plant-1", url="http://127.0.0.1:1", stem=_ORIGIN, dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0), nozzle=_ORIGIN
)
ANNOUNCEMENT = Announcement(task_id="plant-1:1:1", kind="water", plant=_CARD, dose_ml=150.0)
IDENTITY = GardenKey.from_seed(1).issue("plant-1", "plant", 0.0)
Ask = Callable[[], Awaitable[None]]


def bench_broadcast(n: int) -> list[Row]:
    """Milliseconds until all have answered, ours and httpx's interleaved, and our CPU for one message."""
    with responders(max(SIZES)) as ports:
        peers = [Peer(id=f"robot-{port}", kind="robot", url=f"http://127.0.0.1:{port}") for port in ports]
        return asyncio.run(_bench(peers, n))


@contextmanager
def responders(count: int) -> Iterator[list[int]]:
    """That many tiny robots in a process of their own; gives their ports."""
    command = [sys.executable, "-m", "lab.bench.responder", str(count)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.stdin.close()


async def _bench(peers: Sequence[Peer], n: int) -> list[Row]:
    rows: list[Row] = []
    for size, target_ms in SIZES.items():
        asked = peers[:size]
        mesh = Mesh(HttpTransport(), IDENTITY, WallClock(), timeout_s=30.0)
        async with httpx.AsyncClient(timeout=30.0, limits=httpx.Limits(max_keepalive_connections=size)) as client:
            lost: list[str] = []
            ours, theirs = _ours(mesh, asked), _theirs(client, asked, lost)
            await ours()
            await theirs()
            rounds = max(ROUNDS, MESSAGES // size)
            pairs = [(await _timed(ours, rounds), await _timed(theirs, 1 if size > 20 else rounds)) for _ in range(n)]
            cpu_us = await _cpu_us(ours, rounds) / size
        await mesh.aclose()
        rows.append(_row(f"broadcast_{size}", [a for a, _ in pairs], [b for _, b in pairs], target_ms))
        rows[-1] |= {"peer_lost": len(lost)}
        rows.append({"name": f"broadcast_{size}_cpu", "ours": cpu_us, "peer": None, "ratio": None, "unit": "us a message"})
        rows[-1] |= {"n": rounds * size, "target": CPU_US_MAX, "ok": cpu_us <= CPU_US_MAX}
    return rows


def _row(name: str, ours_ms: list[float], theirs_ms: list[float], target_ms: float) -> Row:
    ours, theirs = median(ours_ms), median(theirs_ms)
    row: Row = {"name": name, "ours": ours, "peer": theirs, "ratio": ours / theirs, "unit": "ms", "n": len(ours_ms)}
    return row | {"target": target_ms, "ok": ours <= target_ms, "peer_name": "httpx, one client"}


def _ours(mesh: Mesh, peers: Sequence[Peer]) -> Ask:
    async def ask() -> None:
        answers = await mesh.ask_all(peers, "POST", "/bids", ANNOUNCEMENT, expect=Bid)
        assert all(isinstance(answer, Bid) for answer in answers.values()), answers

    return ask


def _theirs(client: httpx.AsyncClient, peers: Sequence[Peer], lost: list[str]) -> Ask:
    """Its pool loses connections with very many hosts; who got no answer is noted in `lost`."""
    content = ANNOUNCEMENT.model_dump_json().encode()
    headers = {"authorization": f"Bearer {IDENTITY.token}", "content-type": "application/json"}

    async def one(peer: Peer) -> None:
        try:
            Bid.model_validate_json((await client.post(f"{peer.url}/bids", content=content, headers=headers)).content)
        except httpx.TransportError:
            lost.append(peer.id)

    async def ask() -> None:
        await asyncio.gather(*(one(peer) for peer in peers))

    return ask


async def _timed(ask: Ask, rounds: int) -> float:
    """Median milliseconds of some rounds."""
    times = []
    for _ in range(rounds):
        began_s = time.perf_counter()
        await ask()
        times.append(1e3 * (time.perf_counter() - began_s))
    return median(times)


async def _cpu_us(ask: Ask, rounds: int) -> float:
    """This process's CPU for one round, the validation of answers included [us]."""
    began_s = time.process_time()
    for _ in range(rounds):
        await ask()
    return 1e6 * (time.process_time() - began_s) / rounds
