"""What goes wrong in a soaked garden: drawn by the seed, at random and at the worst instants by name, and mended again.

`Gremlin.touches` counts by node how often a fault met it, `touched_s` says when last, and `crossed` counts by what they
were about the messages that a fault met: judges allow for that.
"""

from __future__ import annotations

import asyncio
import contextvars
import errno
import json
import math
import random
from collections import Counter, defaultdict
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from core.mesh.client import Answer
from lab.soak.garden import Hooks, Running, SoakGarden
from lab.soak.life import NodeClock, skewed
from lab.soak.net import CLEAR, Message, Weather
from lab.soak.world import Dose, Truth

LEASE_S = 8.0
DOWN_S = (0.5, 4.0, 20.0, 90.0)
"""How long a dead process stays dead: shorter and longer than leases, permits and a pot's patience."""
PAUSE_S = (0.4, 3.0, 12.0, 40.0)
FAULT_EVERY_S = 240.0
CALM_EVERY_S, CALM_S = 3 * 3600.0, 2400.0
"""So often everything is mended and left alone for so long: what does not come right then never does."""
STORMS = (
    Weather(request_lost=0.1, reply_lost=0.1),
    Weather(reply_lost=0.4),
    Weather(duplicated=0.4, reordered=0.3),
    Weather(late=0.15, duplicated=0.2, reordered=0.4),
    Weather(request_lost=0.2, reply_lost=0.2, duplicated=0.05, late=0.05, reordered=0.2),
)
WORST = {
    "permit_reply_lost": 0.06, "award_reply_lost": 0.06, "end_report_lost": 0.08, "end_reply_lost": 0.08,
    "scan_reply_lost": 0.08, "kill_lost": 0.15,
}  # fmt: skip
"""Chance that just this message is lost, while faults are on."""
FATAL = {
    "death_after_act": 0.10, "death_before_act": 0.05, "crash_after_permit": 0.05, "crash_after_award": 0.05,
    "crash_on_end": 0.05, "crash_writing_award": 0.06, "crash_writing_permit": 0.10, "pause_under_permit": 0.10,
    "permit_lost_in_crash": 0.06, "permit_asked_late": 0.06, "power_cycle_while_stopped": 0.3,
    "probe_silent_after_act": 0.05,
}  # fmt: skip
"""Chance that a process dies or sleeps, or that a probe falls silent, at this instant."""
DISK = ("crash_before_write", "crash_in_write", "crash_after_write", "disk_eio", "disk_enospc", "torn_write", "fsync_error")
LATE_PERMIT_S = (10.0, 60.0)
SOAKING_S = (0.0, 75.0)
"""A probe falls silent so long after a dose: before, when, or just after it should tell whether the water arrived."""
MEND_AFTER_S = 45.0
WEAK_RATIO = 0.6
"""A robot with less than this would charge for most of a calm, and its tasks wait for it."""


class Died(BaseException):
    """Thrown where a process is killed in the middle of what it does."""


class Gremlin:
    """Works on one garden until cancelled. `on` is false while everything shall heal."""

    def __init__(self, rng: random.Random, truth: Truth, counts: Counter[str]) -> None:
        self.rng, self.truth, self.counts = rng, truth, counts
        self.garden: SoakGarden
        self.on = False
        self.touches: Counter[str] = Counter()
        self.crossed: Counter[str] = Counter()
        """Messages by the task they named, else by whose dock or tap they were about, else nothing: where a robot is."""
        self.touched_s: defaultdict[str, float] = defaultdict(lambda: -math.inf)
        self.stopped_s: dict[str, float] = {}
        """Robots whose e-stop somebody pressed."""
        self._disk: dict[str, str] = {}
        self._context = contextvars.copy_context()
        """Nobody's: what heals a process must not die with it."""
        self._healing: set[asyncio.Task[None]] = set()
        self.halted: Callable[[str], None] = lambda name: None
        """A brain died, or sleeps: its robot must stop."""

    def hooks(self, moved: Callable[[str], None], died: Callable[[str, BaseException], None]) -> Hooks:
        return Hooks(disk=self._at_disk, poured=self._poured, picked=self._picked, moved=moved, died=died, clock=self._clock)

    def attach(self, garden: SoakGarden) -> None:
        self.garden = garden
        garden.mesh.worst = self._worst
        garden.mesh.touched, garden.mesh.held_s, garden.mesh.at_hand = self._cross, self._held_s, self._at_hand

    def touch(self, *names: str) -> None:
        now_s = self.truth.now()
        for name in names:
            self.touches[name] += 1
            self.touched_s[name] = now_s

    def _cross(self, message: Message) -> None:
        """A fault met a message."""
        self.crossed[_about(message)] += 1
        self.touched_s[message.source] = self.touched_s[message.target] = self.truth.now()

    def strike(self, kind: str, *names: str) -> None:
        self.counts[kind] += 1
        self.touch(*names)

    # At random

    async def run(self, hurry: float) -> None:
        """Faults for a while, then calm, for ever."""
        while True:
            self.on = True
            until_s = self.truth.now() + CALM_EVERY_S - CALM_S
            while (wait_s := self.rng.expovariate(hurry / FAULT_EVERY_S)) < until_s - self.truth.now():
                await asyncio.sleep(wait_s)
                await self._one()
            await asyncio.sleep(until_s - self.truth.now())
            self.heal_all()
            await asyncio.sleep(CALM_S)

    async def _one(self) -> None:
        kinds: list[Callable[[], Coroutine[Any, Any, None]]] = [
            self._storm, self._storm, self._storm, self._cut, self._partition, self._crash, self._crash, self._crash,
            self._pause, self._pause, self._arm_disk, self._arm_disk, self._battery, self._pump, self._tap, self._probe,
            self._power_cycle, self._body_crash,
        ]  # fmt: skip
        self._later(self.rng.choice(kinds)())

    def _later(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work, context=self._context.copy())
        self._healing.add(task)
        task.add_done_callback(self._healing.discard)

    def heal_all(self) -> None:
        """Everything is mended now."""
        self.on = False
        for task in self._healing:
            task.cancel()
        self.garden.mesh.weather, self._disk = CLEAR, {}
        self.garden.mesh.cut.clear()
        self.truth.water_out = False
        for pot in self.truth.pots.values():
            pot.probe_silent = False
        for body in self.truth.robots.values():
            body.pump_broken = False
            self._carry(body.name, below_ratio=WEAK_RATIO)
        for name in self.garden.processes:
            running = self.garden.running.get(name)
            if running is None:
                self.garden.start(name)
            elif running.life.stopped:
                running.life.go_on()
            elif disk_failed(running):
                self.garden.kill(name)
                self.garden.start(name)
            self.touch(name)

    def _nodes(self) -> list[str]:
        return [name for name in self.garden.processes if self.garden.processes[name].kind != "body"]

    async def _storm(self) -> None:
        self.garden.mesh.weather = self.rng.choice(STORMS)
        await asyncio.sleep(self.rng.uniform(60.0, 900.0))
        self.garden.mesh.weather = CLEAR

    async def _cut(self) -> None:
        source, target = self.rng.sample(self._nodes(), 2)
        self.strike("one_way_cut", source, target)
        self.garden.mesh.cut.add((source, target))
        await asyncio.sleep(self.rng.uniform(3.0, 180.0))
        self.garden.mesh.cut.discard((source, target))
        self.touch(source, target)

    async def _partition(self) -> None:
        nodes = self._nodes()
        side = set(self.rng.sample(nodes, self.rng.randint(1, len(nodes) - 1)))
        links = [(a, b) for a in nodes for b in nodes if (a in side) != (b in side)]
        self.strike("partition", *nodes)
        self.garden.mesh.cut.update(links)
        await asyncio.sleep(self.rng.uniform(3.0, 120.0))
        self.rng.shuffle(links)
        for link in links:
            self.garden.mesh.cut.discard(link)
            self.touch(*link)
            await asyncio.sleep(self.rng.uniform(0.0, 2.0))
        self.counts["healed_out_of_order"] += 1

    async def _crash(self) -> None:
        await self.crash(self.rng.choice(self._nodes()))

    async def crash(self, name: str, kind: str = "", down_s: float = 0.0) -> None:
        """SIGKILL, or the power of a pot's machine, and a start some time later; `down_s` 0: by chance."""
        if self.garden.running.get(name) is None:
            return
        family = self.garden.processes[name].kind
        self.strike(kind or f"crash_{'brain' if family == 'robot' else 'pot' if family == 'plant' else family}", name)
        self.garden.kill(name)
        if family == "robot":
            self.halted(name)
        elif self.rng.random() < 0.5:
            self.counts["power_lost"] += 1
            if self.garden.platters[name].lose_power(self.rng):
                self.counts["unsynced_writes_lost"] += 1
        await asyncio.sleep(down_s or self.rng.choice(DOWN_S))
        self.touch(name)
        if self.garden.running.get(name) is None:
            self.garden.start(name)

    async def _power_cycle(self, robot_id: str = "", kind: str = "crash_robot") -> None:
        """The whole robot goes dark: brain and body."""
        robot_id = robot_id or self.rng.choice(self.garden.names("robot"))
        await self._goes_dark(kind, robot_id, f"{robot_id}-body", robot_id)

    async def _body_crash(self) -> None:
        """A robot's body dies, and its brain lives on."""
        robot_id = self.rng.choice(self.garden.names("robot"))
        await self._goes_dark("crash_body", robot_id, f"{robot_id}-body")

    async def _goes_dark(self, kind: str, robot_id: str, *names: str) -> None:
        """These of its processes die, and are started some time later in this order."""
        self.strike(kind, robot_id)
        for name in names:
            self.garden.kill(name)
        await asyncio.sleep(self.rng.choice(DOWN_S))
        self.touch(robot_id)
        for name in names:
            if self.garden.running.get(name) is None:
                self.garden.start(name)

    async def _pause(self, name: str = "", seconds: float = 0.0) -> None:
        name, seconds = name or self.rng.choice(self._nodes()), seconds or self.rng.choice(PAUSE_S)
        if self._falls_asleep(name, seconds):
            await self._sleeps(name, seconds)

    def _falls_asleep(self, name: str, seconds: float) -> bool:
        """At this very instant; not when it is dead or asleep already."""
        running = self.garden.running.get(name)
        if running is None or running.life.stopped:
            return False
        self.strike("pause_beyond_lease" if seconds > LEASE_S else "pause", name)
        running.life.stopped = True
        if running.process.kind == "robot":
            self.halted(name)
        return True

    async def _sleeps(self, name: str, seconds: float) -> None:
        life = self.garden.running[name].life
        await asyncio.sleep(seconds)
        self.touch(name)
        if life.stopped:
            life.go_on()

    async def _battery(self) -> None:
        body = self.truth.look(self.rng.choice(self.garden.names("robot")))
        if not body.dock:
            self.strike("battery_empty", body.name)
            body.battery_ratio = 0.0
            self.truth.command(body.name, "stop")
            await asyncio.sleep(self.rng.uniform(60.0, 600.0))
            self._carry(body.name)
        else:
            self.strike("battery_low", body.name)
            body.battery_ratio = self.rng.uniform(0.08, 0.2)

    def _carry(self, robot_id: str, below_ratio: float = 0.01) -> None:
        """A person puts a charged pack into a robot that has so little left."""
        body = self.truth.look(robot_id)
        if body.battery_ratio <= below_ratio:
            body.battery_ratio = 0.8
            self.touch(robot_id)

    async def _pump(self) -> None:
        body = self.truth.look(self.rng.choice(self.garden.names("robot")))
        self.strike("pump_broken", body.name)
        body.pump_broken = True
        await asyncio.sleep(self.rng.uniform(60.0, 1200.0))
        self.truth.look(body.name).pump_broken = False
        self.touch(body.name)

    async def _tap(self) -> None:
        self.strike("water_out", "station")
        self.truth.water_out = True
        body = self.truth.look(self.rng.choice(self.garden.names("robot")))
        body.tank_ml = min(body.tank_ml, self.rng.uniform(20.0, 120.0))
        await asyncio.sleep(self.rng.uniform(120.0, 1200.0))
        self.truth.water_out = False
        self.touch("station", body.name)

    async def _probe(self, plant_id: str = "", kind: str = "probe_silent", after_s: float = 0.0) -> None:
        plant_id = plant_id or self.rng.choice(self.garden.names("plant"))
        await asyncio.sleep(after_s)
        self.strike(kind, plant_id)
        self.truth.pots[plant_id].probe_silent = True
        await asyncio.sleep(self.rng.uniform(60.0, 900.0))
        self.truth.pots[plant_id].probe_silent = False
        self.touch(plant_id)

    # At the disk

    async def _arm_disk(self) -> None:
        """The next write of somebody meets it."""
        owners = [*self.garden.names("plant"), *self.garden.names("plant"), "station", *self.garden.names("body")]
        self._disk[self.rng.choice(owners)] = self.rng.choice(DISK)

    def _at_disk(self, running: Running, operation: str, path: Path) -> None:
        name = running.process.name
        if (kind := self._disk.get(name)) is None or operation == "read":
            return
        wanted = {
            "crash_before_write": "create", "crash_in_write": "fsync_dir", "crash_after_write": "synced",
            "disk_eio": "write", "disk_enospc": "create", "torn_write": "fsync", "fsync_error": "fsync",
        }[kind]  # fmt: skip
        if operation != wanted:
            return
        del self._disk[name]
        self.strike(kind, name, running.process.keys)
        if kind == "disk_eio":
            raise OSError(errno.EIO, "input/output error")
        if kind == "disk_enospc":
            raise OSError(errno.ENOSPC, "no space left on device")
        if kind == "fsync_error":
            self._later(self._mend(name))
            raise OSError(errno.EIO, "input/output error")
        self._die_here(running, lose_power=kind in ("torn_write", "crash_in_write") or self.rng.random() < 0.5)

    def _die_here(self, running: Running, *, lose_power: bool) -> None:
        name = running.process.name
        running.disk.dead = True
        running.life.alive = False
        if lose_power:
            self.counts["power_lost"] += 1
            if self.garden.platters[name].lose_power(self.rng):
                self.counts["unsynced_writes_lost"] += 1
        self._later(self._buried(name))
        raise Died(name)

    async def _buried(self, name: str) -> None:
        """What is left of a process that died within a write is taken away, and it starts again later."""
        self.garden.kill(name)
        robot_id = self.garden.processes[name].keys
        if self.garden.processes[name].kind == "body":
            self.garden.kill(robot_id)
        await asyncio.sleep(self.rng.choice(DOWN_S))
        for each in (name, robot_id):
            self.touch(each)
            if self.garden.running.get(each) is None:
                self.garden.start(each)

    async def _mend(self, name: str) -> None:
        """Somebody reads the alarm, mends the disk and starts the service anew."""
        await asyncio.sleep(MEND_AFTER_S)
        self.touch(name, self.garden.processes[name].keys)
        self.garden.kill(name)
        self.garden.start(name)

    # At the worst instants

    def _worst(self, message: Message, answer: Answer | None) -> bool:
        if not self.on:
            return False
        kind = _named(message, answer)
        self._at_the_worst(message, answer, kind)
        if kind in WORST and self._chance(WORST[kind]):
            self.counts[kind] += 1
            self._cross(message)
            return True
        if kind == "permit_reply_lost" and self._chance(FATAL["permit_lost_in_crash"]):
            self._later(self.crash(message.target, "permit_lost_in_crash", DOWN_S[0]))
            return True
        return False

    def _at_the_worst(self, message: Message, answer: Answer | None, kind: str) -> None:
        """A pot dies as it awards, permits or hears of an end, or while it writes that; a robot as it may act."""
        if message.path == "/bids" and answer is not None and self._chance(FATAL["crash_writing_award"]):
            self._arm("crash_writing_award", message.source)
        if message.path.endswith("/permits") and answer is None and self._chance(FATAL["crash_writing_permit"]):
            self._arm("crash_writing_permit", message.target)
        if kind == "permit_reply_lost":
            self._at_a_permit(message.source, message.target)
        if kind == "award_reply_lost" and self._chance(FATAL["crash_after_award"]):
            self._later(self.crash(message.source, "crash_after_award"))
        if kind == "end_report_lost" and self._chance(FATAL["crash_on_end"]):
            self._later(self.crash(message.target, "crash_on_end"))
        if message.path == "/stop" and answer is not None and self._chance(FATAL["power_cycle_while_stopped"]):
            self._later(self._power_cycle(message.target, "power_cycle_while_stopped"))

    def _at_a_permit(self, robot_id: str, plant_id: str) -> None:
        """A permit is about to leave its pot."""
        if self._chance(FATAL["crash_after_permit"]):
            self._later(self.crash(plant_id, "crash_after_permit"))
        if self._chance(FATAL["death_before_act"]):
            self._later(self.crash(robot_id, "death_before_act"))

    def _at_hand(self, message: Message, answer: Answer) -> None:
        """A robot falls asleep with a permit in its hand, often until that has run out."""
        if not self.on or _named(message, answer) != "permit_reply_lost" or not self._chance(FATAL["pause_under_permit"]):
            return
        seconds = self.rng.choice(PAUSE_S[2:])
        if self._falls_asleep(message.source, seconds):
            self.counts["pause_under_permit"] += 1
            self._later(self._sleeps(message.source, seconds))

    def _held_s(self, message: Message) -> float:
        """A robot falls asleep as it asks for a permit, and the question comes when its lease has long ended."""
        asks = self.on and message.method == "POST" and message.path.endswith("/permits")
        if not asks or not self._chance(FATAL["permit_asked_late"]):
            return 0.0
        self.counts["permit_asked_late"] += 1
        self._cross(message)
        self._later(self._pause(message.source, self.rng.choice(PAUSE_S[2:])))
        return self.rng.uniform(*LATE_PERMIT_S)

    def _chance(self, share: float) -> bool:
        return self.rng.random() < share

    def _arm(self, why: str, name: str) -> None:
        """Whatever this pot writes next is the last that it does."""
        self.counts[why] += 1
        self._disk[name] = self.rng.choice(("crash_before_write", "crash_in_write", "crash_after_write"))

    def _poured(self, dose: Dose) -> None:
        if self.on and dose.ml > 1.0 and self._chance(FATAL["death_after_act"]):
            self._later(self.crash(dose.robot_id, "death_after_act"))
        if self.on and self._chance(FATAL["probe_silent_after_act"]):
            self._later(self._probe(dose.plant_id, "probe_silent_after_act", self.rng.uniform(*SOAKING_S)))

    def _picked(self, robot_id: str, permit_id: str) -> None:
        if self.on and self._chance(FATAL["death_after_act"]):
            self._later(self.crash(robot_id, "death_after_act"))

    def _clock(self, name: str) -> NodeClock:
        self.counts["clock_skew"] += 1
        return skewed(self.rng)


def _about(message: Message) -> str:
    """What this message is about, as `Gremlin.crossed` counts it."""
    if message.path.startswith("/tasks/"):
        return unquote(message.path.partition("?")[0].split("/")[2])
    if message.path in ("/bids", "/tasks") and message.target.startswith("robot"):
        asked = json.loads(message.body)
        return str(asked.get("announcement", asked)["task_id"])
    return message.target if message.path.startswith(("/dock", "/tap")) else ""


def _named(message: Message, answer: Answer | None) -> str:
    """The name under which this message is worth losing; empty for most."""
    if message.method == "DELETE" and message.target.startswith("robot"):
        return "kill_lost" if answer is None else ""
    if message.method != "POST":
        return ""
    if message.path.endswith("/permits"):
        return "permit_reply_lost" if answer is not None and answer.status == 200 else ""
    if message.path == "/tasks" and message.target.startswith("robot"):
        return "award_reply_lost" if answer is not None else ""
    if message.path == "/inventory/scans":
        return "scan_reply_lost" if answer is not None else ""
    if message.path.endswith("/reports") and json.loads(message.body)["state"] in ("done", "failed"):
        return "end_report_lost" if answer is None else "end_reply_lost"
    return ""


def disk_failed(running: Running) -> bool:
    """A service whose disk failed it acknowledges nothing until a person comes."""
    if running.body is not None:
        return bool(running.body.ledger.refusal(1.0).startswith("doses cannot"))
    pot = getattr(running.app.state, "pot", None) if running.app is not None else None
    return pot is not None and any("cannot be stored" in why for why in pot.ready())
