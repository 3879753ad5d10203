"""One soaked garden from its seed: built, harassed, judged, told."""

from __future__ import annotations

import asyncio
import gc
import json
import logging
import random
import subprocess
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path

from core.mesh.chassis import version
from core.mesh.client import Answer
from core.robots.garden_map import map_of
from core.scenario import Scenario, find
from lab.quiet import hush
from lab.soak.case import Breach, Tally
from lab.soak.faults import CALM_EVERY_S, Gremlin
from lab.soak.garden import SoakGarden, _identity, coarse
from lab.soak.judge import Judge
from lab.soak.life import Life, SoakLoop
from lab.soak.routes import forget_the_dead
from lab.soak.world import Dose, Truth

DAY_S = 86400.0
END_CALM_S = 2400.0
ASK_EVERY_S = 900.0
MEMORY = Path("/dev/shm")
SIZES = ((1, 1), (2, 1), (2, 2), (3, 2), (3, 2), (4, 2))
"""Pots and robots of a garden; the seed chooses."""


@cache
def code() -> str:
    """`commit 39ea6d0`, with `+ changes` where files differ from it; the version where there is no repository."""
    try:
        told = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=10", "--exclude=*", "--dirty=+"]
        found = subprocess.run(told, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return f"version {version()}"
    return f"commit {found.removesuffix('+')}" + (" + changes" if found.endswith("+") else "")


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What one seed means."""

    seed: int
    days: float
    hurry: float = 1.0
    """How much more often something is asked for and goes wrong."""
    faults: bool = True
    one_breach: bool = False
    """End at the first broken invariant."""

    def replay(self) -> str:
        """The line that lives through the same garden again, and the code that it belongs to."""
        hurry = f" --hurry {self.hurry:g}" if self.hurry != 1.0 else ""
        return f"garden soak --days {self.days:g}{hurry} --seeds 1 --seed {self.seed}  # {code()}"


@dataclass(slots=True)
class Outcome:
    """What became of one garden."""

    seed: int
    plan: Plan
    tally: Tally = field(default_factory=Tally)
    faults: dict[str, int] = field(default_factory=dict)
    breaches: list[Breach] = field(default_factory=list)
    trace: str = ""
    """A digest of all that was said and of what became of water and fruit."""


def soak(plan: Plan, told: Callable[[float], None] = lambda share: None) -> Outcome:
    """Run one garden to its end; a function of the plan."""
    hush()
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    logging.getLogger("core.store").setLevel(logging.CRITICAL)
    base = MEMORY if MEMORY.is_dir() else None
    with tempfile.TemporaryDirectory(dir=base) as folder, coarse(), warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        with asyncio.Runner(loop_factory=lambda: SoakLoop(random.Random(f"{plan.seed}/loop"))) as runner:
            runner.get_loop().set_exception_handler(lambda loop, context: None)
            outcome = runner.run(_soak(plan, Path(folder), told))
    forget_the_dead()
    gc.collect()
    return outcome


def scenario_of(rng: random.Random) -> Scenario:
    """The default garden's first pots and robots, with small doses, so that there is much to do."""
    base = find("garden")
    pots, robots = rng.choice(SIZES)
    plants = tuple(
        p.model_copy(update={"dose_ml": 60.0, "target_ratio": 0.215, "fruit": rng.randint(2, 5)}) for p in base.plants[:pots]
    )
    return base.model_copy(update={"plants": plants, "robots": base.robots[:robots]})


async def _soak(plan: Plan, folder: Path, told: Callable[[float], None]) -> Outcome:
    rng = random.Random(f"soak/{plan.seed}")
    scenario, counts = scenario_of(rng), Counter[str]()
    truth = Truth(scenario, map_of(scenario), random.Random(rng.random()), rng.uniform(0.1, 0.5), rng.uniform(0.2, 1.0))
    gremlin = Gremlin(random.Random(rng.random()), truth, counts)
    judge = Judge(truth, gremlin)
    hooks = gremlin.hooks(judge.acts.moved, lambda name, error: _refused(judge, gremlin, name, error))
    poured, picked = hooks.poured, hooks.picked

    def ended(dose: Dose) -> None:
        judge.acts.ended(dose)
        poured(dose)

    def closed(robot_id: str, permit_id: str) -> None:
        judge.acts.picked(robot_id, permit_id)
        picked(robot_id, permit_id)

    hooks.poured, hooks.picked = ended, closed
    garden = SoakGarden(scenario, plan.seed, folder, truth, hooks, counts)
    gremlin.attach(garden)
    judge.attach(garden)
    garden.start_all()
    await asyncio.sleep(30.0)
    people = People(garden, judge, gremlin, random.Random(rng.random()), plan.hurry)
    jobs = [asyncio.ensure_future(judge.watch()), asyncio.ensure_future(people.run())]
    if plan.faults:
        jobs.append(asyncio.ensure_future(gremlin.run(plan.hurry)))
    jobs.append(asyncio.ensure_future(_calms(judge)))

    def stop() -> bool:
        return plan.one_breach and bool(judge.breaches)

    await _through(plan.days * DAY_S, jobs, told, stop)
    for job in jobs[1:]:
        job.cancel()
    gremlin.heal_all()
    if not stop():
        await people.mend()
        await asyncio.sleep(END_CALM_S)
        judge.look()
        judge.progress.drained()
    jobs[0].cancel()
    judge.tally.doses, judge.tally.picks, judge.tally.requests = len(truth.doses), truth.picks, garden.mesh.requests
    for name in list(garden.running):
        garden.kill(name)
    with suppress(asyncio.CancelledError):
        await asyncio.sleep(1.0)
    trace = f"{garden.mesh.trace()}/{truth.now():.6f}/{sum(d.ml for d in truth.doses):.6f}/{truth.picks}"
    return Outcome(plan.seed, plan, judge.tally, dict(sorted(counts.items())), judge.breaches, trace)


async def _through(
    seconds: float, jobs: list[asyncio.Task[None]], told: Callable[[float], None], stop: Callable[[], bool]
) -> None:
    """Let the days pass, or until `stop`; whatever a job of ours dies of is raised."""
    for step in range(100):
        await asyncio.sleep(seconds / 100)
        told((step + 1) / 100)
        for job in jobs:
            if job.done():
                job.result()
        if stop():
            return


async def _calms(judge: Judge) -> None:
    """At the end of every calm nothing may be left over."""
    while True:
        await asyncio.sleep(CALM_EVERY_S - 30.0)
        judge.progress.drained()
        await asyncio.sleep(30.0)


def _refused(judge: Judge, gremlin: Gremlin, name: str, error: BaseException) -> None:
    """A service ended by itself: its own decision, or one that no disk fault explains."""
    gremlin.counts["service_ended_itself"] += 1
    gremlin.touch(name)
    judge.ended_itself(name, _told(error))


def _told(error: BaseException) -> str:
    if isinstance(error, BaseExceptionGroup):
        return "; ".join(map(_told, error.exceptions))
    return f"{type(error).__name__}: {error}"


class People:
    """Somebody who asks for this and that, presses the e-stop and changes his mind."""

    def __init__(self, garden: SoakGarden, judge: Judge, gremlin: Gremlin, rng: random.Random, hurry: float) -> None:
        self._garden, self._judge, self._gremlin, self._rng, self._hurry = garden, judge, gremlin, rng, hurry
        self._life, self._number = Life("operator"), 0
        self._transport = garden.mesh.transport(self._life)
        self._releases: dict[str, dict[str, object]] = {}
        """The newest release of each robot: somebody heard it on the network and says it again after the next stop."""

    async def run(self) -> None:
        while True:
            await asyncio.sleep(self._rng.expovariate(self._hurry / ASK_EVERY_S))
            await self._rng.choice((self._ask, self._ask, self._ask, self._ask, self._change, self._cancel, self._stop))()

    async def _ask(self) -> None:
        wish: dict[str, object] = {"kind": self._rng.choice(("water", "inventory", "harvest", "harvest"))}
        wish |= {"priority": self._rng.choice((2, 5, 9))} if self._rng.random() < 0.3 else {}
        wish |= {"within_s": self._rng.choice((60.0, 300.0, 1200.0))} if self._rng.random() < 0.3 else {}
        await self._call(self._plant(), "POST", "/tasks", wish, tries=3)

    async def _change(self) -> None:
        patch = {"dose_ml": self._rng.choice((40.0, 50.0, 60.0)), "threshold_ratio": self._rng.choice((0.19, 0.20))}
        await self._call(self._plant(), "PATCH", "/settings", patch)

    async def _cancel(self) -> None:
        plant_id = self._plant()
        pot = self._garden.pot(plant_id)
        if pot is not None and (tasks := pot.place.market.open_tasks()):
            await self._call(plant_id, "DELETE", f"/tasks/{self._rng.choice(tasks).task_id}")

    async def _stop(self) -> None:
        robot_id = self._rng.choice(self._garden.names("robot"))
        self._gremlin.strike("estop", robot_id)
        await self._call(robot_id, "POST", "/stop", {"reason": "a child runs in"})
        if (wish := self._releases.get(robot_id)) is not None:
            await self._call(robot_id, "POST", "/resume", wish)
        await asyncio.sleep(self._rng.uniform(5.0, 240.0))
        await self._resume(robot_id)

    async def _resume(self, robot_id: str) -> None:
        for _ in range(20):
            self._gremlin.touch(robot_id)
            state = await self._call(robot_id, "GET", "/state")
            if state is not None and state.status < 300:
                told = json.loads(state.body)
                if not told["stopped"]:
                    return
                if told["stop_number"] and await self._release(robot_id, told["stop_number"]):
                    return
            await asyncio.sleep(15.0)

    async def _release(self, robot_id: str, stop_number: int) -> bool:
        wish = self._releases[robot_id] = {"stop_number": stop_number}
        answer = await self._call(robot_id, "POST", "/resume", wish)
        return answer is not None and answer.status < 300

    async def mend(self) -> None:
        for robot_id in self._garden.names("robot"):
            await asyncio.sleep(5.0)
            await self._resume(robot_id)

    def _plant(self) -> str:
        return self._rng.choice(self._garden.names("plant"))

    async def _call(self, target: str, method: str, path: str, body: object = None, tries: int = 1) -> Answer | None:
        self._number += 1
        headers = {"authorization": f"Bearer {_identity('operator', 'operator').token}"}
        headers |= {"content-type": "application/json"} if body is not None else {}
        headers |= {"idempotency-key": f"people-{self._number}"} if method == "POST" else {}
        content = b"" if body is None else json.dumps(body).encode()
        for _ in range(tries):
            try:
                async with asyncio.timeout(5.0):
                    return await self._transport.send(method, self._garden.urls[target] + path, headers, content)
            except (TimeoutError, ConnectionError):
                await asyncio.sleep(1.0)
        return None


def as_json(outcomes: list[Outcome]) -> dict[str, object]:
    """The document of `garden soak --json`."""
    faults = Counter[str]()
    for outcome in outcomes:
        faults.update(outcome.faults)
    broken = [b for outcome in outcomes for b in outcome.breaches]
    return {
        "simulated_days": round(sum(o.plan.days for o in outcomes), 3),
        "seeds": len(outcomes),
        "tasks": sum(o.tally.tasks for o in outcomes),
        "done": sum(o.tally.done for o in outcomes),
        "doses": sum(o.tally.doses for o in outcomes),
        "picks": sum(o.tally.picks for o in outcomes),
        "requests": sum(o.tally.requests for o in outcomes),
        "faults": dict(sorted(faults.items())),
        "broken_invariants": len(broken),
        "broken": [{"seed": o.seed, **asdict(b)} for o in outcomes for b in o.breaches],
        "replay": [o.plan.replay() for o in outcomes if o.breaches],
    }
