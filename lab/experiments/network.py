"""Messages between hosts (paper 000, section 8.1, figure 14), and how soon a plant has given a task away.

Real processes on loopback: four senders tell one pot of fruit, each message answered once it is durable; and the same pot
gives tasks to two robots that answer at once. What the air adds at 1, 13 and 27 m comes from a model of the paper's radio
(`lab.experiments.radio`), on top of the times the pot itself took.
"""

from __future__ import annotations

import asyncio
import json
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from random import Random
from typing import Any

from core.clock import WallClock
from core.mesh.auth import Caller, Identity, Verifier
from core.mesh.chassis import allow, body, create_app
from core.mesh.client import Mesh
from core.mesh.http import HttpTransport
from core.mesh.peers import Peer
from core.mesh.server import listen, make_server
from core.wire.documents import NodeCard
from core.wire.market import Announcement, Award, Bid, Breakdown, Task
from core.wire.robot import QueuedTask
from lab.bench.pot import running_pot
from lab.experiments.radio import exchanged, fade_ratio
from lab.results import Result, held

SENDERS = 4
RATE_HZ = 25.0
"""Of each sender."""
MESSAGES = 250
"""Of each sender."""
AWARDS = 20
DISTANCES_M = (1, 13, 27)
WITHIN_S = 0.05
REQUEST_BYTES, ANSWER_BYTES, TCP_ACK_BYTES = 700, 420, 0
"""A fruit with its token, the answer with its headers, and a bare acknowledgement; as measured on loopback."""
PAPER = {"within_50ms_ratio": "> 0.95", "award_s": "< 1"}
PROMISES = (
    ("within_50ms_ratio", ">=", 0.999),
    *((f"within_50ms_{distance}m", ">=", 0.999) for distance in DISTANCES_M),
    ("award_s", "<=", 0.1),
)


def network(trials: int | None, seed: int, swap: object, progress: Callable[[str], None]) -> Result:
    """`trials` counts the messages of each sender."""
    count = trials or MESSAGES
    delays_s, awards_s = asyncio.run(_measured(count, progress))
    ours: dict[str, Any] = {
        "within_50ms_ratio": _within(delays_s),
        "message_p50_s": statistics.median(delays_s),
        "message_p99_s": statistics.quantiles(delays_s, n=100)[98],
        "message_worst_s": max(delays_s),
    }
    series: dict[str, list[float]] = {"loopback, 4 senders": _spread(delays_s)}
    for distance_m in DISTANCES_M:
        progress(f"radio at {distance_m} m")
        on_air_s = over_the_air(distance_m, delays_s, Random(f"{seed}/{distance_m}"))
        ours[f"within_50ms_{distance_m}m"] = _within(on_air_s)
        ours[f"message_p99_{distance_m}m_s"] = statistics.quantiles(on_air_s, n=100)[98]
        series[f"{distance_m} m"] = _spread(on_air_s)
    ours |= {"award_s": max(awards_s), "award_median_s": statistics.median(awards_s)}
    return Result(
        name="network",
        seed=seed,
        trials=count,
        paper=PAPER,
        ours=ours,
        bars=held(ours, *PROMISES),
        notes=(
            f"{SENDERS} senders, {RATE_HZ:g} messages a second each, answered when durable; the slowest of {AWARDS} awards",
            "at a distance: the pot's own times plus a model of 802.11b, all senders on one channel",
        ),
        series=series,
        axes=("share of messages [%]", "delay [s]"),
    )


def _within(delays_s: list[float]) -> float:
    return sum(delay_s <= WITHIN_S for delay_s in delays_s) / len(delays_s)


def _spread(delays_s: list[float]) -> list[float]:
    """The delay that so many hundredths of all messages do not exceed."""
    return statistics.quantiles(delays_s, n=100)


def over_the_air(distance_m: float, served_s: list[float], rng: Random) -> list[float]:
    """Delays [s] of the same messages, from the senders' stations to the pot's and back, the pot as slow as measured."""
    pot, messages = SENDERS, []
    for sender in range(SENDERS):
        at_s = rng.random() / RATE_HZ
        for _ in range(len(served_s) // SENDERS):
            frames = (
                (sender, REQUEST_BYTES, 0.0),
                (pot, ANSWER_BYTES, rng.choice(served_s)),
                (sender, TCP_ACK_BYTES, 0.0),
            )
            messages.append((at_s, sender, frames))
            at_s += rng.uniform(0.5, 1.5) / RATE_HZ
    return exchanged(messages, fade_ratio(distance_m), rng)


# ------------------------------------------------------------------------------------------------- real processes


async def _measured(count: int, progress: Callable[[str], None]) -> tuple[list[float], list[float]]:
    """Delays of all messages, and of awards [s]."""
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="network-")))
        awarded: asyncio.Queue[float] = asyncio.Queue()
        ports = [listen("127.0.0.1", 0) for _ in range(2)]
        peers = [
            Peer(id=f"robot-{n}", kind="robot", url=f"http://127.0.0.1:{sock.getsockname()[1]}")
            for n, sock in enumerate(ports, 1)
        ]
        settings = {
            "GARDEN_PEERS": json.dumps([peer.model_dump() for peer in peers]), "PLANT_INVENTORY": "false",
            "PLANT_HARVEST": "false", "PLANT_PROBE_EVERY_S": "1",
        }  # fmt: skip
        pot = await stack.enter_async_context(running_pot(folder, settings))
        for peer, sock in zip(peers, ports, strict=True):
            await stack.enter_async_context(_robot(peer.id, sock, folder, awarded))
        progress(f"{SENDERS} senders, {count} messages each")
        delays_s = await _sent(pot, count)
        progress(f"{AWARDS} awards")
        return delays_s, await _awards(pot, awarded)


@asynccontextmanager
async def _robot(robot_id: str, sock: Any, folder: Path, awarded: asyncio.Queue[float]) -> AsyncIterator[None]:
    """A robot that answers at once, behind the real chassis and server."""
    clock = WallClock()
    app = create_app(
        card=lambda: NodeCard(id=robot_id, kind="robot"), clock=clock, ready=lambda: [],
        verifier=Verifier.load(folder / "keys" / "plant-1"),
    )  # fmt: skip

    @app.post("/bids")
    async def bids(caller: Caller = allow("plant"), asked: Announcement = body(Announcement)) -> Bid:
        cost_s = 30.0 if robot_id == "robot-1" else 40.0
        return Bid(task_id=asked.task_id, robot_id=robot_id, cost_s=cost_s, breakdown=Breakdown(work_s=cost_s))

    @app.post("/tasks")
    async def tasks(caller: Caller = allow("plant"), award: Award = body(Award)) -> QueuedTask:
        awarded.put_nowait(time.perf_counter())
        asked = award.announcement
        return QueuedTask(
            task_id=asked.task_id, kind=asked.kind, plant_id=asked.plant.plant_id, epoch=award.epoch, state="queued"
        )

    @app.delete("/tasks/{task_id}")
    async def kill(task_id: str, caller: Caller = allow("plant")) -> QueuedTask:
        return QueuedTask(task_id=task_id, kind="water", plant_id="plant-1", epoch=1, state="queued")

    server = make_server(app)
    serving = asyncio.create_task(server.serve(sockets=[sock]))
    try:
        yield
    finally:
        server.should_exit = True
        await serving


async def _sent(pot: dict[str, Any], count: int) -> list[float]:
    """Every sender is a process of its own."""
    command = [sys.executable, "-m", "lab.experiments.sender", f"http://127.0.0.1:{pot['port']}", str(count), f"{RATE_HZ:g}"]
    senders = [
        await asyncio.create_subprocess_exec(*command, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE)
        for _ in range(SENDERS)
    ]
    told = await asyncio.gather(*(sender.communicate(pot["token"].encode()) for sender in senders))
    if any(sender.returncode for sender in senders):
        raise RuntimeError("a sender failed")
    return [delay_s for out, _ in told for delay_s in json.loads(out)]


async def _awards(pot: dict[str, Any], awarded: asyncio.Queue[float]) -> list[float]:
    """From somebody's wish for water until the award is at the cheapest robot, again and again."""
    peer = Peer(id="plant-1", kind="plant", url=f"http://127.0.0.1:{pot['port']}")
    mesh = Mesh(HttpTransport(), Identity("operator", "operator", pot["token"]), WallClock())
    taken_s = []
    try:
        for number in range(AWARDS):
            began_s = time.perf_counter()
            answer = await mesh.exchange(peer, "POST", "/tasks", b'{"kind": "water"}', key=f"award-{number}")
            task = Task.model_validate_json(answer.body)
            async with asyncio.timeout(10.0):
                taken_s.append(await awarded.get() - began_s)
            await mesh.exchange(peer, "DELETE", f"/tasks/{task.task_id}")
    finally:
        await mesh.aclose()
    return taken_s
