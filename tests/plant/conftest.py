"""A garden of real pots and scripted robots on virtual time: pots read Firmata bytes, robots are a few lines each."""

from __future__ import annotations

import asyncio
import json
import math
import random
import sys
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import httpx
import pytest

from core.clock import VirtualClock
from core.mesh.auth import GardenKey
from core.mesh.client import Answer
from core.mesh.node import Node
from core.mesh.peers import Peer, Peers
from core.store import Disk
from core.virtual import run_virtual
from core.wire.geometry import Point3, Pose2
from core.wire.market import Announcement, Award, Bid
from hw.links import MemoryNet
from hw.protocols.vh400 import volts_of
from plant_service.node import build
from plant_service.settings import DockSettings, PlantSettings
from sim.devices.firmata import FirmataEmulator
from sim.devices.host import EmulatorHost

sys.path.insert(0, str(Path(__file__).parent))

SOIL_ML = 3000.0
EYES = [(0.45, y, z) for z in (0.12, 0.32) for y in (-0.15, 0.0, 0.15)]
"""From where a scripted robot looks at a plant."""
JPEG = b"\xff\xd8\xff\xe0 a picture \xff\xd9"
KEY = GardenKey.from_seed(1)


@lru_cache
def token(subject: str, role: str) -> str:
    return KEY.issue(subject, role, 0.0).token


@dataclass
class Soil:
    """Fills `BoardPins`: one pot's soil behind a probe, and a tap on a digital pin."""

    rng: random.Random
    ratio: float
    fault: Callable[[], float] | None = None
    silent: bool = False
    """The board sends nothing, and its link stays up."""
    levels: dict[int, bool] = field(default_factory=dict)

    def analog_v(self, pin: int) -> float:
        return self.fault() if self.fault else volts_of(self.ratio) + self.rng.gauss(0.0, 0.003)

    def set_digital(self, pin: int, high: bool) -> None:
        self.levels[pin] = high

    def pour(self, ml: float) -> None:
        self.ratio += ml / SOIL_ML


class Robot:
    """A scripted robot: bids `cost`, does what it is awarded, unless told to misbehave."""

    def __init__(self, garden: Garden, robot_id: str, cost_s: float | None = 10.0) -> None:
        self.garden, self.id = garden, robot_id
        self.cost: Callable[[Announcement], float | None] = lambda _: cost_s
        self.reason = "no water"
        self.work_s, self.start_s = 10.0, 1.0
        self.down = False
        self.refuse_awards = ""
        self.overtaken = False
        """Whether it declines awards because others were quicker."""
        self.die_after_act = False
        self.die_before_act = False
        self.lose_done = 0
        self.pump_blocked = False
        self.asked, self.poured_ml = 0, 0.0
        self.log: list[tuple[float, str]] = []
        self.jobs: dict[str, asyncio.Task[None]] = {}
        self.epochs: dict[str, int] = {}

    def note(self, what: str) -> None:
        self.log.append((round(self.garden.clock.now(), 2), what))

    async def answer(self, method: str, path: str, body: bytes) -> Answer:
        if self.down:
            raise ConnectionRefusedError(f"{self.id} is off")
        if path == "/bids":
            self.asked += 1
            ask = Announcement.model_validate_json(body)
            cost_s = self.cost(ask)
            reason = "" if cost_s is not None else self.reason
            bid = Bid(task_id=ask.task_id, robot_id=self.id, cost_s=cost_s, reason=reason)
            return Answer(200, bid.model_dump_json().encode())
        if method == "POST" and path == "/tasks":
            return self._awarded(Award.model_validate_json(body))
        assert method == "DELETE", f"{method} {path}"
        self._killed(path.removeprefix("/tasks/").partition("?")[0])
        return Answer(204, b"")

    def _awarded(self, award: Award) -> Answer:
        task_id = award.announcement.task_id
        if self.overtaken and award.at_most_s is not None:
            return Answer(409, json.dumps({"title": "Overtaken", "status": 409, "detail": "90 s by now"}).encode())
        if self.refuse_awards:
            problem = {"title": "Refused", "status": 409, "detail": self.refuse_awards}
            return Answer(409, json.dumps(problem).encode())
        if self.epochs.get(task_id, -1) >= award.epoch:
            return Answer(200, b"{}")
        self._killed(task_id)
        self.note(f"award {task_id} {award.epoch}")
        self.epochs[task_id] = award.epoch
        self.jobs[task_id] = asyncio.get_running_loop().create_task(self.work(award))
        return Answer(201, b"{}")

    def _killed(self, task_id: str) -> None:
        if (job := self.jobs.pop(task_id, None)) is not None:
            self.note(f"kill {task_id}")
            job.cancel()

    def die(self) -> None:
        self.down = True
        for job in self.jobs.values():
            job.cancel()
        self.jobs.clear()

    async def work(self, award: Award) -> None:
        plant_id, task_id, epoch = award.announcement.plant.plant_id, award.announcement.task_id, award.epoch

        async def report(state: str, **more: Any) -> dict[str, Any]:
            body = {"robot_id": self.id, "epoch": epoch, "state": state, **more}
            return await self.garden.robot_post(self, plant_id, f"/tasks/{task_id}/reports", body)

        async def stay(state: str, seconds: float) -> bool:
            until_s = self.garden.clock.now() + seconds
            while (left_s := until_s - self.garden.clock.now()) > 1e-6:
                if not (await report(state)).get("keep", True):
                    self.note(f"dropped {task_id}")
                    return False
                await self.garden.clock.sleep(min(2.0, left_s))
            return True

        if not (await stay("awarded", self.start_s) and await stay("running", self.work_s)):
            return
        permit = await self.garden.robot_post(
            self, plant_id, f"/tasks/{task_id}/permits",
            {"robot_id": self.id, "epoch": epoch, "act": "water", "amount_ml": award.announcement.dose_ml},
            key=f"{task_id}/{epoch}",
        )  # fmt: skip
        if "permit_id" not in permit:
            await report("failed", reason=permit.get("detail", "no permit"))
            return
        if self.die_before_act:
            self.die()
            return
        await stay("running", permit["dose_ml"] / 7.5)
        self.note(f"dose {task_id} {epoch}")
        self.poured_ml += permit["dose_ml"]
        if not self.pump_blocked:
            self.garden.soils[plant_id].pour(permit["dose_ml"])
        if self.die_after_act:
            self.die()
            return
        while self.lose_done > 0:
            self.lose_done -= 1
            await self.garden.clock.sleep(2.0)
        await report("done", delivered_ml=permit["dose_ml"])


class Picker(Robot):
    """A scripted robot with an eye and a hand. `tree` is what really hangs there: place -> colour."""

    def __init__(self, garden: Garden, robot_id: str, tree: dict[tuple[float, float, float], str]) -> None:
        super().__init__(garden, robot_id)
        self.tree, self.basket, self.out_of_reach = tree, [], set[str]()
        self.die_holding, self.scans = False, 0

    async def work(self, award: Award) -> None:
        asked = award.announcement
        await {"inventory": self.scan, "harvest": self.pick}.get(asked.kind, super().work)(award)

    async def tell(self, award: Award, state: str, **more: Any) -> dict[str, Any]:
        body = {"robot_id": self.id, "epoch": award.epoch, "state": state, **more}
        asked = award.announcement
        return await self.garden.robot_post(self, asked.plant.plant_id, f"/tasks/{asked.task_id}/reports", body)

    def views(self) -> list[dict[str, Any]]:
        look, up = {"x": -1.0, "y": 0.0, "z": 0.0}, {"x": 0.0, "y": 0.0, "z": 1.0}
        places = [dict(zip(("x_m", "y_m", "z_m"), eye, strict=True)) for eye in EYES]
        return [place | {"look": look, "up": up, "fov_x_rad": 1.6, "fov_y_rad": 1.4} for place in places]

    def seen(self) -> list[dict[str, Any]]:
        places = [dict(zip(("x_m", "y_m", "z_m"), place, strict=True)) for place in self.tree]
        more = {"radius_m": 0.013, "confidence": 0.9, "sigma_m": 0.004, "views": list(range(6))}
        return [place | more | {"colour": colour} for place, colour in zip(places, self.tree.values(), strict=True)]

    async def scan(self, award: Award) -> None:
        await self.tell(award, "running", phase="scan")
        await self.garden.clock.sleep(5.0)
        asked, self.scans = award.announcement, self.scans + 1
        scan = {"scan_id": f"{asked.task_id}:{award.epoch}", "task_id": asked.task_id, "robot_id": self.id,
                "views": self.views(), "sightings": self.seen()}  # fmt: skip
        await self.garden.robot_post(self, asked.plant.plant_id, "/inventory/scans", scan)
        await self.tell(award, "done")

    async def pick(self, award: Award) -> None:
        asked, picks = award.announcement, list[dict[str, Any]]()
        for fruit in asked.fruits[: asked.count]:
            await self.tell(award, "running", phase="pick", picks=picks)
            if fruit.fruit_id in self.out_of_reach:
                picks.append({"fruit_id": fruit.fruit_id, "outcome": "unreachable", "reason": "too high"})
                continue
            wish = {"robot_id": self.id, "epoch": award.epoch, "act": "pick", "fruit_id": fruit.fruit_id}
            path, plant = f"/tasks/{asked.task_id}/permits", asked.plant.plant_id
            permit = await self.garden.robot_post(self, plant, path, wish, key=f"{award.epoch}/{fruit.fruit_id}")
            if "permit_id" not in permit:
                continue
            await self.garden.clock.sleep(2.0)
            place = min(self.tree, key=lambda at: math.dist(at, (fruit.x_m, fruit.y_m, fruit.z_m)))
            assert math.dist(place, (fruit.x_m, fruit.y_m, fruit.z_m)) < 0.03, f"{fruit.fruit_id} is a phantom"
            del self.tree[place]
            self.basket.append(fruit.fruit_id)
            if self.die_holding:
                return self.die()
            for when in ("before", "after"):
                await self.garden.call(
                    plant, "PUT", f"/ledger/{permit['permit_id']}/{when}.jpg", who=self.id, role="robot",
                    content=JPEG, headers={"content-type": "image/jpeg"},
                )  # fmt: skip
            picks.append({"fruit_id": fruit.fruit_id, "outcome": "picked", "permit_id": permit["permit_id"]})
        await self.tell(award, "done", picks=picks)


class Garden:
    """Pots, soils and robots in one process. Killing a pot cancels its loops; `start_pot` again reads the same folder."""

    def __init__(self, folder: Path, seed: int = 1) -> None:
        self.folder, self.rng = folder, random.Random(seed)
        self.clock = VirtualClock()
        self.net = MemoryNet(self.clock)
        self.disk: Disk | None = None
        """Of the pots that are started from now on; None for a good one."""
        self.soils: dict[str, Soil] = {}
        self.robots: dict[str, Robot] = {}
        self.nodes: dict[str, Node] = {}
        self.loops: dict[str, list[asyncio.Task[None]]] = {}
        self.cut: set[str] = set()
        """Robots that can neither be asked nor reach a pot."""
        self.deaf: set[str] = set()
        """Robots whose requests arrive, but never the answers."""
        self.requests = 0
        self.tasks: list[asyncio.Task[None]] = []

    def robot(self, robot_id: str, cost_s: float | None = 10.0) -> Robot:
        self.robots[robot_id] = Robot(self, robot_id, cost_s)
        return self.robots[robot_id]

    def picker(self, robot_id: str, tree: dict[tuple[float, float, float], str]) -> Picker:
        """One that scans and picks what hangs on `tree`."""
        picker = Picker(self, robot_id, tree)
        self.robots[robot_id] = picker
        return picker

    def soil(self, name: str, ratio: float) -> Soil:
        soil = self.soils[name] = Soil(random.Random(self.rng.random()), ratio)
        emulator = FirmataEmulator(soil, random.Random(self.rng.random()))
        woken = asyncio.Event()
        host = EmulatorHost(emulator, self.clock, wake=woken.set)
        host.listen(self.net, name)
        self.tasks.append(asyncio.get_running_loop().create_task(self._firmware(soil, host, woken)))
        return soil

    async def _firmware(self, soil: Soil, host: EmulatorHost, woken: asyncio.Event) -> None:
        while True:
            woken.clear()
            while soil.silent:
                await self.clock.sleep(0.1)
            host.pump(self.clock.now())
            wait_s = host.due_s() - self.clock.now()
            try:
                async with asyncio.timeout(None if wait_s == float("inf") else max(wait_s, 0.001)):
                    await woken.wait()
            except TimeoutError:
                continue

    def pot(self, plant_id: str = "plant-1", ratio: float = 0.15, **more: Any) -> Node:
        self.soil(plant_id, ratio)
        return self.start_pot(plant_id, **more)

    def start_pot(self, plant_id: str = "plant-1", **more: Any) -> Node:
        settings = PlantSettings(
            id=plant_id, url=f"http://{plant_id}", data=self.folder / plant_id,
            stem=Point3(x_m=0.0, y_m=0.0, z_m=0.25), dock=Pose2(x_m=0.55, y_m=0.0, yaw_rad=3.14),
            probe_url=f"memory://{plant_id}?pin=0", **({"soak_s": 20.0, "inventory": False, "harvest": False} | more),
        )  # fmt: skip
        return self._start(settings)

    def start_station(self, **more: Any) -> Node:
        pose = Pose2(x_m=-1.5, y_m=0.0, yaw_rad=3.14)
        docks = (DockSettings(id="tap", pose=pose, tap=True), DockSettings(id="spare", pose=pose))
        self.soils.setdefault("station", self.soil("station", 0.2))
        return self._start(
            PlantSettings(
                id="station",
                kind="station",
                url="http://station",
                data=self.folder / "station",
                docks=docks,
                tap_url="memory://station?valve=8",
                **more,
            )
        )

    def _start(self, settings: PlantSettings) -> Node:
        peers = Peers([Peer(id=name, kind="robot", url=f"http://{name}") for name in self.robots])
        node = build(
            settings, self.clock, self.net.open, self, self.rng, peers=peers, verifier=KEY.verifier(),
            identity=KEY.issue(settings.id, "plant", 0.0), disk=self.disk,
        )  # fmt: skip
        self.nodes[settings.id] = node
        loop = asyncio.get_running_loop()
        self.loops[settings.id] = [loop.create_task(run()) for run in node.loops]  # type: ignore[arg-type]
        return node

    async def kill_pot(self, plant_id: str = "plant-1") -> None:
        loops = self.loops.pop(plant_id)
        await asyncio.sleep(0)  # a task cancelled before its first step cleans nothing up
        for task in loops:
            task.cancel()
        await asyncio.gather(*loops, return_exceptions=True)
        del self.nodes[plant_id]

    # The mesh: what pots send

    async def send(self, method: str, url: str, headers: Any, body: bytes) -> Answer:
        self.requests += 1
        await self.clock.sleep(0.002)
        name, _, path = url.removeprefix("http://").partition("/")
        if name in self.cut:
            raise ConnectionRefusedError(f"{name} is cut off")
        return await self.robots[name].answer(method, f"/{path}", body)

    async def aclose(self) -> None:
        return

    # The mesh: what others send

    async def call(
        self, plant_id: str, method: str, path: str, *, who: str = "operator", role: str = "operator", **more: Any
    ) -> httpx.Response:
        headers = {"authorization": f"Bearer {token(who, role)}"} | more.pop("headers", {})
        transport = httpx.ASGITransport(self.nodes[plant_id].app)
        async with httpx.AsyncClient(transport=transport, base_url=f"http://{plant_id}") as client:
            return await client.request(method, path, headers=headers, **more)

    async def robot_post(self, robot: Robot, plant_id: str, path: str, body: Any, key: str = "") -> dict[str, Any]:
        """Answers `{}` when nobody answered."""
        await self.clock.sleep(0.002)
        if robot.id in self.cut or plant_id not in self.nodes or robot.down:
            return {}
        headers = {"idempotency-key": key} if key else {}
        response = await self.call(plant_id, "POST", path, who=robot.id, role="robot", json=body, headers=headers)
        return {} if robot.id in self.deaf else dict(response.json())

    async def state(self, plant_id: str = "plant-1") -> dict[str, Any]:
        return dict((await self.call(plant_id, "GET", "/state")).json())

    async def task(self, plant_id: str = "plant-1") -> dict[str, Any]:
        """The newest task."""
        return dict((await self.call(plant_id, "GET", "/tasks")).json()[-1])

    async def until(self, true: Callable[[], Coroutine[Any, Any, bool]], within_s: float) -> float:
        """Seconds until something is so; fails when it is not in time."""
        began_s = self.clock.now()
        while not await true():
            assert self.clock.now() - began_s < within_s, f"not within {within_s} s"
            await self.clock.sleep(0.5)
        return self.clock.now() - began_s

    async def until_task(self, state: str, within_s: float = 120.0, plant_id: str = "plant-1") -> dict[str, Any]:
        async def reached() -> bool:
            tasks = (await self.call(plant_id, "GET", "/tasks")).json()
            return bool(tasks) and tasks[-1]["state"] == state

        await self.until(reached, within_s)
        return await self.task(plant_id)

    async def close(self) -> None:
        for plant_id in list(self.nodes):
            await self.kill_pot(plant_id)
        for robot in self.robots.values():
            robot.die()
        for task in self.tasks:
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)


Story = Callable[[Garden], Coroutine[Any, Any, None]]


@pytest.fixture
def play(tmp_path: Path) -> Callable[[Story], None]:
    """Run a story in a fresh garden on virtual time."""

    def run(story: Story) -> None:
        async def main() -> None:
            garden = Garden(tmp_path)
            try:
                await story(garden)
            finally:
                await garden.close()

        run_virtual(main())

    return run
