"""`garden bench market`: what a market of many plants and robots costs.

Three markets: 1,000 plants and 50 robots on a heap of events (`lab.crowd`), asking within 20 s and all at once; one round of
5,000 plants and 200 robots; and 200 pots and 20 robots as real services on loopback (`lab.bench.bazaar`).
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, replace
from random import Random
from statistics import median
from typing import Any

from console.ports import free_ports
from core.allocation.bidding import DOCKING_S, UNDOCKING_S, Condition, Stop, offer, work_s
from core.allocation.plant_side import Market
from core.allocation.plant_state import Solicit
from core.clock import WallClock
from core.errors import GardenError
from core.mesh.client import Mesh
from core.mesh.http import HttpTransport
from core.mesh.peers import Peer
from core.wire.geometry import Point3, Pose2
from core.wire.market import FINAL_STATES, PlantCard, Task, TaskRequest
from lab.bench.bazaar import FOR_EVER_S, KEY, Plan, shares
from lab.bench.clearing import clear, compiled
from lab.bench.pot import rss_mb
from lab.crowd import KIND, RULES, TOGETHER_S, Crowd, Instance, between_s

Row = dict[str, Any]
SEED = 1
ROUND_CPU_S_MAX = 0.5
AWARD_S_MAX = 1.0
"""The paper coordinates within a second (8.2)."""
ASK_AGAIN_S = 300.0
"""In the large crowd plants ask again so seldom, not every ten seconds: else nearly all of the time would go into that."""
RATE = 1.0
"""Garden seconds a wall second of the real services."""
WISH_EVERY_S = 0.25
"""Wall seconds from one pot's wish to the next: each asks 20 robots, all of which are one process here."""
POTS_A_PROCESS = 100
DONE_WITHIN_S = 1200.0
"""Wall seconds: ten tasks a robot are done after 560, at rate 1, on a machine that keeps up."""
LOOK_S = 2.0
TELL_S = 60.0


def bench_market(n: int) -> list[Row]:
    """Rows `{name, ours, peer, ratio, unit, n}`; `n` repeats the round, which takes a moment. The others run once."""
    tell("1000 plants and 50 robots on a heap of events")
    rows = crowd_rows(50, 1000)
    tell("a round of 5000 plants and 200 robots")
    rows += round_rows(200, 5000, n)
    tell("200 pots and 20 robots as services: about ten minutes")
    return rows + asyncio.run(service_rows(20, 200))


def tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


# ------------------------------------------------------------------------------------------------- on a heap of events


def crowd_rows(robots: int, plants: int) -> list[Row]:
    """Time to award, messages, CPU, and cost beside a bound that no plan can reach; wishes spread out, and all at once."""
    instance = Instance.drawn(robots, plants, Random(f"{SEED}/{robots}/{plants}"))
    rows: list[Row] = []
    for when, together_s in (("spread", TOGETHER_S), ("burst", 0.0)):
        name = f"market/{plants}x{robots} {when}"
        began_s = time.process_time()
        rules = replace(RULES, reallocate_s=ASK_AGAIN_S)
        outcome = Crowd(instance, Random(f"{SEED}/words"), together_s=together_s, rules=rules).run()
        cpu_s = time.process_time() - began_s
        served = sorted(plant for route in outcome.routes for plant in route)
        rows += _waits(name, outcome.award_s, AWARD_S_MAX if together_s else None)
        rows += [
            _row(f"{name}/messages", outcome.messages / plants, "a task", plants) | {"declined": outcome.declines},
            _row(f"{name}/cpu", 1e6 * cpu_s / outcome.messages, "us a message", outcome.messages),
            _beside(f"{name}/seconds", sum(outcome.busy_s), least_s(instance), plants),
            _beside(f"{name}/makespan", outcome.makespan_s, least_s(instance) / robots, plants),
            _row(f"{name}/served once", float(served == list(range(plants))), "", plants, 1.0, at_least=True),
        ]
    return rows


def least_s(instance: Instance) -> float:
    """A bound that no plan can reach: every plant comes after whatever is nearest to it."""
    return sum(_nearest_s(instance, plant) + DOCKING_S + work_s(KIND, 0.0) for plant in range(len(instance.plants)))


def _nearest_s(instance: Instance, plant: int) -> float:
    here = instance.plants[plant]
    others = (UNDOCKING_S + between_s(at, here) for number, at in enumerate(instance.plants) if number != plant)
    return min([*others, *(between_s(at, here) for at in instance.starts)])


# ------------------------------------------------------------------------------------------------- one round


def round_rows(robots: int, plants: int, n: int) -> list[Row]:
    """A round: each plant asks every robot once, hears robots x plants prices, and gives its task away before the next asks.

    Once as one compiled function, and one plant's part of it by the real machines, with queues as the round left them.
    """
    instance = Instance.drawn(robots, plants, Random(f"{SEED}/{robots}/{plants}"))
    compiled()
    spent_s, queues = [], []
    for _ in range(n):
        began_s = time.process_time()
        queues = clear(instance)
        spent_s.append(time.process_time() - began_s)
    name = f"market/{plants}x{robots} round"
    one_s = [_asked_s(instance, queues) for _ in range(n)]
    return [
        _row(f"{name}, compiled", median(spent_s), "s of CPU", n, ROUND_CPU_S_MAX),
        _row(f"{name}, one plant's by the machines", median(one_s), "s of CPU", n, ROUND_CPU_S_MAX),
        _beside(f"{name}/seconds", sum(instance.route_s(r, q) for r, q in enumerate(queues)), least_s(instance), plants),
    ]


def _asked_s(instance: Instance, queues: Sequence[Sequence[int]]) -> float:
    """CPU seconds of one more plant's question: all robots' prices, and the plant's choice."""
    docks = {str(number): at for number, at in enumerate(instance.plants)}
    origin = Point3(x_m=0.0, y_m=0.0, z_m=0.0)
    card = PlantCard(plant_id="0", url="http://0", stem=origin, dock=Pose2(x_m=0.0, y_m=0.0, yaw_rad=0.0), nozzle=origin)
    plant = Market(card, None, 0.0, RULES)
    robots = [_robot(instance, robot, queue, docks) for robot, queue in enumerate(queues)]
    began_s = time.process_time()
    task_id = plant.ask(KIND, 0.0, "soil", "due", 0.0).task_id
    plant.tick(0.0, [me.robot_id for me in robots])
    (ask,) = (effect for effect in plant.take_effects() if isinstance(effect, Solicit))
    for me in robots:
        plant.bid(task_id, ask.round_number, me.robot_id, offer(ask.announcement, me)[0], 0.0)
    assert plant.task(task_id).state == "awarded"
    return time.process_time() - began_s


def _robot(instance: Instance, robot: int, queue: Sequence[int], docks: dict[str, tuple[float, float]]) -> Condition:
    places = docks | {"here": instance.starts[robot]}
    stops = tuple(Stop(dock=str(plant), work_s=work_s(KIND, 0.0), task_id=f"{plant}:1") for plant in queue)
    return Condition(
        robot_id=f"robot-{robot}", can=frozenset({KIND}), queue=stops,
        travel=lambda place, dock: between_s(places[place], places[dock]),
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------- as real services


async def service_rows(robots: int, plants: int, rate: float = RATE) -> list[Row]:
    """Every pot is asked for a scan, one after the other; all is over when every task is done."""
    drawn = Instance.drawn(robots, plants, Random(f"{SEED}/{robots}/{plants}"))
    names = [f"robot-{number}" for number in range(robots)], [f"plant-{number}" for number in range(plants)]
    places = dict(zip([*names[0], *names[1]], [*drawn.starts, *drawn.plants], strict=True))
    peers = [
        Peer(id=id, kind="robot" if id in names[0] else "plant", url=f"http://127.0.0.1:{port}")
        for id, port in zip(places, free_ports(len(places)), strict=True)
    ]
    told = [peer.model_dump() for peer in peers]
    epoch_s = time.time()
    with tempfile.TemporaryDirectory(prefix="market-bench-") as folder:
        plans = [Plan("robot", names[0], told, places, folder, epoch_s, rate)]
        plans += [Plan("plant", ids, told, places, folder, epoch_s, rate) for ids in shares(names[1], POTS_A_PROCESS)]
        async with _running(plans) as processes:
            mesh = Mesh(HttpTransport(), KEY.issue("operator", "operator", 0.0, FOR_EVER_S), WallClock(), timeout_s=20.0)
            began_s = time.monotonic()
            tasks = await _until_done(mesh, [peer for peer in peers if peer.kind == "plant"], began_s)
            took_s = time.monotonic() - began_s
            await mesh.aclose()
            reports = [await _stop(process) for process in processes]
    return _told(f"market/{plants}x{robots} services", tasks, reports, took_s, rate)


def _told(name: str, tasks: list[Task], reports: list[Row], took_s: float, rate: float) -> list[Row]:
    counts = sum((Counter(report["counts"]) for report in reports), Counter[str]())
    sent = sum(counts[what] for what in ("bids", "awards", "kills", "reports", "scans"))
    served = Counter(task_id for report in reports for task_id in report["served"])
    once = all(task.state == "done" and served[task.task_id] == 1 for task in tasks) and len(served) == len(tasks)
    cpu_s = sum(report["cpu_s"] for report in reports)
    waits = [_award_s(task) / rate for task in tasks]
    return [
        *_waits(name, waits, None),
        _row(f"{name}/all done", took_s, "s at rate " + f"{rate:g}", len(tasks)),
        _row(f"{name}/messages", sent / len(tasks), "a task", len(tasks)) | {"sent": dict(counts)},
        _row(f"{name}/cpu", 1e6 * cpu_s / sent, "us a message", sent) | {"cores": cpu_s / took_s},
        *(_row(f"{name}/memory of a process", r["rss_mb"], "MB", 1) for r in reports),
        _row(f"{name}/done exactly once", float(once), "", len(tasks), 1.0, at_least=True),
    ]


def _award_s(task: Task) -> float:
    """From the wish to the award that was taken [garden s]; infinite when there was none."""
    at_s = math.inf
    for event in task.events:
        if event.what.startswith("awarded to") and at_s == math.inf:
            at_s = event.t_s
        elif "declined the award" in event.what:
            at_s = math.inf
    return at_s - task.created_s


async def _until_done(mesh: Mesh, pots: Sequence[Peer], began_s: float) -> list[Task]:
    """All pots' tasks: asked for one after the other, and looked at until they have ended."""
    tasks: dict[str, Task] = {}
    for number, pot in enumerate(pots):
        await asyncio.sleep(began_s + number * WISH_EVERY_S - time.monotonic())
        tasks[pot.id] = await mesh.call(pot, "POST", "/tasks", TaskRequest(kind="inventory"), expect=Task)
    left, told_s = list(pots), time.monotonic()
    while left and time.monotonic() < began_s + DONE_WITHIN_S:
        await asyncio.sleep(LOOK_S)
        if time.monotonic() > told_s + TELL_S:
            told_s = time.monotonic()
            tell(f"{len(pots) - len(left)} of {len(pots)} done after {told_s - began_s:.0f} s")
        for pot in left:
            with suppress(GardenError):  # looked at again soon
                tasks[pot.id] = await mesh.call(pot, "GET", f"/tasks/{tasks[pot.id].task_id}", expect=Task)
        left = [pot for pot in left if tasks[pot.id].state not in FINAL_STATES]
    return list(tasks.values())


@asynccontextmanager
async def _running(plans: Sequence[Plan]) -> AsyncIterator[list[asyncio.subprocess.Process]]:
    """A process for each plan, all of them ready; none is left behind."""
    pipe = asyncio.subprocess.PIPE
    command = (sys.executable, "-m", "lab.bench.bazaar")
    limit = 64 * 1024 * 1024
    processes = [await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe, limit=limit) for _ in plans]
    try:
        for process, plan in zip(processes, plans, strict=True):
            assert process.stdin is not None
            process.stdin.write(json.dumps(asdict(plan)).encode() + b"\n")
        for process in processes:
            await _line(process)
        yield processes
    finally:
        for process in processes:
            if process.returncode is None:
                process.kill()
            await process.wait()


async def _stop(process: asyncio.subprocess.Process) -> Row:
    assert process.stdin is not None
    taken_mb = rss_mb(process.pid)
    process.stdin.write(b"\n")
    return await _line(process) | {"rss_mb": taken_mb}


async def _line(process: asyncio.subprocess.Process) -> Row:
    assert process.stdout is not None
    if not (line := await process.stdout.readline()):
        raise GardenError("a process of the market ended early", hint="its last words are on standard error")
    told: Row = json.loads(line)
    return told


# ------------------------------------------------------------------------------------------------- rows


def _row(name: str, ours: float, unit: str, n: int, target: float | None = None, *, at_least: bool = False) -> Row:
    row: Row = {"name": name, "ours": ours, "peer": None, "ratio": None, "unit": unit, "n": n}
    if target is not None:
        row |= {"target": target, "ok": ours >= target if at_least else ours <= target}
    return row


def _beside(name: str, ours: float, bound: float, n: int) -> Row:
    row = _row(name, ours, "s", n)
    return row | {"peer": bound, "ratio": ours / bound, "peer_name": "a bound that no plan reaches"}


def _waits(name: str, waits_s: Sequence[float], target: float | None) -> list[Row]:
    """Median and 99th percentile of the time to award."""
    ordered = sorted(waits_s)
    p50, p99 = (ordered[min(len(ordered) - 1, int(share * len(ordered)))] for share in (0.5, 0.99))
    return [
        _row(f"{name}/award p50", p50, "s", len(ordered), target),
        _row(f"{name}/award p99", p99, "s", len(ordered), target),
    ]
