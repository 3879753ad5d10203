"""One peer asks two hundred times a second, or opens connections and says nothing: everybody else is served as before."""

from __future__ import annotations

import asyncio
import json
import statistics
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import httpx
import pytest
from real_garden import RealGarden

from core.mesh.http import HttpTransport
from core.scenario import find
from core.wire.geometry import Point3
from core.wire.market import Announcement, PlantCard

pytestmark = [pytest.mark.soak, pytest.mark.alone]
RATE_HZ = 200.0
FLOOD_S = 10.0
SILENT = 200
"""Connections of somebody who says nothing, or half a request."""
OTHERS_P99_S = 0.5
STOP_WITHIN_S = 0.1
SERVICES = ("sim", "station", "plant-1", "robot-1-body", "robot-1")


Asked = tuple[str, str, bytes]
"""Method, path and body."""


async def flood(url: str, asked: Sequence[Asked], headers: dict[str, str], until: asyncio.Event) -> list[int]:
    """Ask these in turn at the rate, whatever comes back; the statuses."""
    statuses: list[int] = []
    transport = HttpTransport()

    async def once(method: str, path: str, body: bytes) -> None:
        try:
            async with asyncio.timeout(10.0):
                statuses.append((await transport.send(method, url + path, headers, body)).status)
        except (OSError, TimeoutError):
            statuses.append(0)

    began_s, sent = time.monotonic(), 0
    async with asyncio.TaskGroup() as group:
        while not until.is_set():
            while sent < (time.monotonic() - began_s) * RATE_HZ:
                group.create_task(once(*asked[sent % len(asked)]))
                sent += 1
            await asyncio.sleep(0.005)
    await transport.aclose()
    return statuses


async def others(url: str, until_s: float) -> list[float]:
    """Somebody who asks now and then: how long each answer took [s]."""
    taken: list[float] = []
    async with httpx.AsyncClient(base_url=url, timeout=10.0) as client:
        while time.monotonic() < until_s:
            began_s = time.monotonic()
            (await client.get("/state")).raise_for_status()
            taken.append(time.monotonic() - began_s)
            await asyncio.sleep(0.05)
    return taken


def url_of(garden: RealGarden, name: str) -> str:
    return f"http://127.0.0.1:{garden.listed[name].port}"


def ready(garden: RealGarden) -> None:
    garden.start(*SERVICES)
    for name in ("plant-1", "robot-1"):
        garden.until(lambda n=name: bool(garden.get(n, "/readyz")["ready"]), 60.0)


def told(garden: RealGarden, story: Callable[[], Awaitable[None]]) -> None:
    ready(garden)
    asyncio.run(story())  # type: ignore[arg-type]


@pytest.mark.parametrize("token", ["", "a stranger's", "viewer"])
def test_a_flood_of_one_does_not_keep_others_waiting_nor_the_e_stop(tmp_path: Path, token: str) -> None:
    with RealGarden(tmp_path, find("garden"), 1.0) as garden:

        async def story() -> None:
            real = (garden.folder.keys / "viewer" / "token").read_text().strip() if token == "viewer" else token
            headers = {"content-type": "application/json"} | ({"authorization": f"Bearer {real}"} if real else {})
            end, until_s = asyncio.Event(), time.monotonic() + FLOOD_S
            flooding = [
                asyncio.create_task(
                    flood(url_of(garden, "robot-1"), [("POST", "/bids", b'{"task_id": "x"}')], headers, end)
                ),
                asyncio.create_task(
                    flood(url_of(garden, "plant-1"), [("POST", "/tasks", b'{"kind": "water"}')], headers, end)
                ),
            ]
            await asyncio.sleep(1.0)
            robot, plant = await asyncio.gather(*(others(url_of(garden, n), until_s) for n in ("robot-1", "plant-1")))
            operator = {"authorization": f"Bearer {garden.folder.identity().token}"}
            async with httpx.AsyncClient(base_url=url_of(garden, "robot-1"), headers=operator) as client:
                await client.get("/state")
                began_s = time.monotonic()
                stopped = await client.post("/stop", json={"reason": "flood"})
                stop_s = time.monotonic() - began_s
            end.set()
            statuses = [status for task in flooding for status in await task]
            for name, taken in (("robot-1", robot), ("plant-1", plant)):
                p99_s = statistics.quantiles(taken, n=100)[98]
                print(f"{name}: {len(taken)} answers, p99 {p99_s * 1000:.0f} ms")
                assert p99_s < OTHERS_P99_S
            print(f"e-stop after {stop_s * 1000:.0f} ms; {len(statuses)} requests of the flood")
            assert stopped.status_code == 200
            assert stop_s < STOP_WITHIN_S
            assert len(statuses) > 1.6 * RATE_HZ * FLOOD_S
            assert set(statuses) <= {401, 403}
            assert all(task["why"] != "asked by hand" for task in garden.get("plant-1", "/tasks"))

        told(garden, story)


def in_name_of(garden: RealGarden, name: str) -> dict[str, str]:
    token = (garden.folder.keys / name / "token").read_text().strip()
    return {"authorization": f"Bearer {token}", "content-type": "application/json"}


def robots_questions(garden: RealGarden, robot_id: str) -> list[Asked]:
    """What a pot takes from a robot: readings, a reservation, a report and a question for a permit."""
    task_id = next(iter(garden.get("plant-1", "/tasks")), {"task_id": "plant-1:1:1"})["task_id"]
    me: dict[str, object] = {"robot_id": robot_id}
    report, permit = me | {"epoch": 1, "state": "running"}, me | {"epoch": 1, "act": "water", "amount_ml": 50.0}
    return [
        ("GET", "/state", b""),
        ("GET", "/inventory", b""),
        ("POST", "/dock/reservations", json.dumps(me | {"for_s": 5.0, "yielding": True}).encode()),
        ("POST", f"/tasks/{task_id}/reports", json.dumps(report).encode()),
        ("POST", f"/tasks/{task_id}/permits", json.dumps(permit).encode()),
    ]


def plants_question(garden: RealGarden, plant_id: str) -> list[Asked]:
    """A task of a pot that the robot knows, for which it bids."""
    plant = next(each for each in garden.scenario.plants if each.id == plant_id)
    card = PlantCard(
        plant_id=plant_id, url=f"http://{plant_id}", stem=Point3(x_m=plant.x_m, y_m=plant.y_m, z_m=0.3), dock=plant.dock,
        nozzle=Point3(x_m=0.05, y_m=0.0, z_m=0.1),
    )  # fmt: skip
    asked = Announcement(task_id=f"{plant_id}:9:9", kind="water", plant=card, dose_ml=50.0)
    return [("POST", "/bids", asked.model_dump_json().encode())]


def test_a_flood_of_enrolled_peers_keeps_neither_others_nor_the_e_stop_waiting(tmp_path: Path) -> None:
    with RealGarden(tmp_path, find("garden"), 1.0) as garden:

        async def story() -> None:
            end, until_s = asyncio.Event(), time.monotonic() + FLOOD_S
            asked = {
                "plant-1": (robots_questions(garden, "robot-2"), in_name_of(garden, "robot-2")),
                "robot-1": (plants_question(garden, "plant-2"), in_name_of(garden, "plant-2")),
            }
            flooding = {name: asyncio.create_task(flood(url_of(garden, name), *what, end)) for name, what in asked.items()}
            await asyncio.sleep(1.0)
            plant, robot, stops_s = await asyncio.gather(
                others(url_of(garden, "plant-1"), until_s),
                others(url_of(garden, "robot-1"), until_s),
                stops(garden, until_s),
            )
            end.set()
            for name, taken in (("plant-1", plant), ("robot-1", robot)):
                statuses = Counter(await flooding[name])
                p99_s = statistics.quantiles(taken, n=100)[98]
                print(f"{name}: {len(taken)} answers to others, p99 {p99_s * 1000:.0f} ms; the flood was told {statuses}")
                assert p99_s < OTHERS_P99_S
                assert statuses.total() > 0.8 * RATE_HZ * FLOOD_S
                assert statuses.keys() <= {200, 201, 404, 409, 429}
                assert statuses[200] > 0
            print("e-stops after", [f"{stop_s * 1000:.0f} ms" for stop_s in stops_s])
            assert len(stops_s) >= 5
            assert max(stops_s) < STOP_WITHIN_S

        told(garden, story)


async def stops(garden: RealGarden, until_s: float) -> list[float]:
    """An operator who presses the e-stop and releases it, again and again: how long each stop took [s]."""
    taken: list[float] = []
    async with httpx.AsyncClient(base_url=url_of(garden, "robot-1"), headers=in_name_of(garden, "operator")) as client:
        await client.get("/state")
        while time.monotonic() < until_s:
            began_s = time.monotonic()
            answer = (await client.post("/stop", json={"reason": "flood"})).raise_for_status()
            taken.append(time.monotonic() - began_s)
            (await client.post("/resume", json={"stop_number": answer.json()["stop_number"]})).raise_for_status()
            await asyncio.sleep(0.7)
    return taken


def test_clients_that_say_nothing_or_half_of_it_are_dropped_and_do_not_keep_others_waiting(tmp_path: Path) -> None:
    with RealGarden(tmp_path, find("garden"), 1.0) as garden:

        async def story() -> None:
            port = garden.listed["plant-1"].port
            halves = (b"", b"POST /tasks HTTP/1.1\r\nhost: x\r\n")
            silent = []
            for number in range(SILENT):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(halves[number % 2])
                silent.append((reader, writer))
            taken = await others(url_of(garden, "plant-1"), time.monotonic() + 4.0)
            p99_s = statistics.quantiles(taken, n=100)[98]
            print(f"{len(taken)} answers beside {SILENT} silent clients, p99 {p99_s * 1000:.0f} ms")
            assert p99_s < OTHERS_P99_S
            async with asyncio.timeout(10.0):
                ends = [await reader.read(-1) for reader, _ in silent]
            assert all(b" 408 " in end for end in ends[1::2])
            for _, writer in silent:
                writer.close()

        told(garden, story)
