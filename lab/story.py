"""Small gardens, things to wait for and the judge's questions: what whole stories are told with."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from itertools import combinations
from pathlib import Path
from typing import Any

from core.robots import gardener
from core.scenario import Plant, Robot, Scenario, find
from core.virtual import run_virtual
from core.wire.market import FINAL_STATES
from lab.garden import Garden
from lab.quiet import hush
from sim.faults import Fault, FaultRequest
from sim.truth import RobotTruth

DRY_RATIO, MOIST_RATIO = 0.175, 0.35
DOSE_ML = 90.0
"""Twelve seconds of pumping: the soil of three litres rises by three hundredths, beyond the target."""
SOAK_S = 40.0
WATER_ONLY = {"PLANT_INVENTORY": "false", "PLANT_HARVEST": "false"}
"""Of a pot that asks neither for scans nor for picks."""
PUMP_ERROR_RATIO = 0.04
STOP_WITHIN_S = 0.3
TICK_S = 0.02
STILL_MPS = 0.002
"""A base whose wheels were told to stand still rocks this much for a moment."""

Story = Callable[[Garden], Awaitable[None]]


def dry(plant: Plant, dose_ml: float = DOSE_ML) -> Plant:
    """A pot that one dose satisfies."""
    return plant.model_copy(update={"moisture_ratio": DRY_RATIO, "target_ratio": 0.202, "dose_ml": dose_ml})


def moist(plant: Plant) -> Plant:
    return plant.model_copy(update={"moisture_ratio": MOIST_RATIO})


def garden_of(
    dry_pots: tuple[str, ...], moist_pots: tuple[str, ...] = (), robots: tuple[Robot, ...] | None = None
) -> Scenario:
    """The default garden with only these pots, and these robots if given."""
    base = find("garden")
    kept = [p for p in base.plants if p.id in dry_pots + moist_pots]
    plants = tuple(dry(p) if p.id in dry_pots else moist(p) for p in kept)
    return base.model_copy(update={"plants": plants, "robots": robots or base.robots})


def near_robot(**changes: Any) -> Robot:
    """A robot that stands half a metre from the launch point of `plant-1`."""
    robot = find("garden").robots[0]
    return robot.model_copy(update={"x_m": -1.60, "y_m": 0.42, "yaw_deg": 90.0} | changes)


def one_pot(**changes: Any) -> Scenario:
    """One dry pot, one robot near it."""
    return garden_of(("plant-1",), robots=(near_robot(**changes),))


def water_only(scenario: Scenario) -> Scenario:
    """The same garden, its pots asking for nothing but water."""
    plants = tuple(plant.model_copy(update={"inventory": False, "harvest": False}) for plant in scenario.plants)
    return scenario.model_copy(update={"plants": plants})


@asynccontextmanager
async def growing(scenario: Scenario, seed: int | None = None, **more: Any) -> AsyncIterator[Garden]:
    """The garden in a folder of its own, with a short soak, its pots asking for water only.

    What a service died of is raised at the end.
    """
    care = WATER_ONLY | {"PLANT_SOAK_S": f"{SOAK_S:g}"}
    pots = {plant.id: care for plant in scenario.plants}
    with tempfile.TemporaryDirectory() as folder:
        async with Garden(scenario, Path(folder), seed=seed, settings=pots, **more) as garden:
            yield garden
            garden.check()


def tell(scenario: Scenario, story: Story, seed: int | None = None) -> None:
    """Play a story in a garden on virtual time."""
    hush()
    print(f"seed {scenario.seed if seed is None else seed}")

    async def play() -> None:
        async with growing(scenario, seed) as garden:
            await story(garden)

    run_virtual(play())


# ------------------------------------------------------------------ tasks


async def tasks(garden: Garden, plant_id: str) -> list[dict[str, Any]]:
    """A pot's tasks; empty while it does not answer."""
    if plant_id not in garden.running:
        return []
    return list(await garden.get(plant_id, "/tasks"))


async def ended(garden: Garden, plant_id: str, within_s: float = 240.0) -> dict[str, Any]:
    """The pot's first task once it has ended; fails with what is known when it does not end."""
    found: dict[str, Any] = {}

    async def over() -> bool:
        found.update(next(iter(await tasks(garden, plant_id)), {}))
        return found.get("state") in FINAL_STATES

    assert await garden.until(over, within_s), f"{plant_id} after {within_s} s: {await standing(garden)}"
    return found


async def served(garden: Garden, plant_id: str, within_s: float = 240.0) -> dict[str, Any]:
    """As `ended`, and it must have ended done."""
    task = await ended(garden, plant_id, within_s)
    assert task["state"] == "done", task["events"]
    return task


async def phase(garden: Garden, plant_id: str, *words: str, within_s: float = 120.0) -> dict[str, Any]:
    """Wait until the newest task's state or phase begins with one of `words`; looks every control period."""
    found: dict[str, Any] = {}

    async def so() -> bool:
        found.update((await tasks(garden, plant_id) or [{}])[-1])
        return any(found.get("state") == w or str(found.get("phase", "")).startswith(w) for w in words)

    assert await garden.until(so, within_s, every_s=0.1), f"never {words}: {await standing(garden)}"
    return found


_SHOWN = ("job", "waiting", "down", "docked_at", "stopped", "battery_ratio", "tank_ml")


async def standing(garden: Garden) -> str:
    """How everything stands, for a failed assertion."""
    lines = [f"t {garden.clock.now():.1f} s"]
    for name, running in garden.running.items():
        if running.process.kind == "plant":
            state = await garden.get(name, "/state")
            lines.append(f"{name}: soil {state['soil']} waiting {state['waiting']!r}")
            lines += [_told(task) for task in await tasks(garden, name)]
        elif running.process.kind == "robot":
            state = await garden.get(name, "/state")
            lines.append(f"{name}: " + ", ".join(f"{key} {state[key]}" for key in _SHOWN))
            lines += [f"   {e['t_s']:.1f} {e['what']}" for e in (await garden.get(name, "/history"))[-12:]]
    return "\n".join(lines)


def _told(task: dict[str, Any]) -> str:
    story = [f"   {e['t_s']:.1f} {e['what']}" for e in task["events"]]
    return "\n".join([f"  {task['task_id']} {task['state']} {task['phase']!r}", *story])


async def said(garden: Garden, name: str, *words: str, within_s: float = 60.0) -> dict[str, Any]:
    """Wait until a service's `/state` holds one of `words` in `waiting`, `down` or the probe's `why`."""
    state: dict[str, Any] = {}

    async def so() -> bool:
        state.update(await garden.get(name, "/state"))
        told = " ".join([state["waiting"], *state.get("down", ()), state.get("soil", {}).get("why", "")])
        return any(word in told for word in words)

    assert await garden.until(so, within_s, every_s=0.2), f"{name} never said {words}: {await standing(garden)}"
    return state


def fault(garden: Garden, kind: str, target: str, for_s: float | None = None, strength: float | None = None) -> Fault:
    """Bring a fault about, now."""
    return garden.rig.faults.add(FaultRequest(kind=kind, target=target, duration_s=for_s, strength=strength))


# ------------------------------------------------------------------ the judge


async def when(garden: Garden, true: Callable[[], bool], within_s: float = 120.0) -> None:
    """Wait until the world says so, to a control period."""

    async def so() -> bool:
        return true()

    assert await garden.until(so, within_s, every_s=TICK_S), await standing(garden)


def robot(garden: Garden, robot_id: str = "robot-1") -> RobotTruth:
    return garden.truth().robot(robot_id)


def stands(truth: RobotTruth) -> bool:
    """Wheels, body and pump at rest."""
    return truth.wheels_mps == (0.0, 0.0) and abs(truth.v_mps) <= STILL_MPS and not truth.pumping


async def stops(garden: Garden, robot_id: str = "robot-1") -> float:
    """Seconds from now until wheels, arm and pump stand, and stay so; fails when that takes longer than it may."""
    began_s, arm = garden.clock.now(), robot(garden, robot_id).arm_rad
    moved_s = 0.0
    while (spent_s := garden.clock.now() - began_s) < 1.0:
        await garden.clock.sleep(TICK_S)
        truth = robot(garden, robot_id)
        turned = max(abs(a - b) for a, b in zip(truth.arm_rad, arm, strict=True))
        arm = truth.arm_rad
        if not stands(truth) or turned > 0.01:
            moved_s = spent_s + TICK_S
    assert moved_s <= STOP_WITHIN_S + TICK_S + 1e-9, f"{robot_id} moved for {moved_s:.2f} s"
    return moved_s


def allowed_ml(task: dict[str, Any]) -> float:
    """The most that a task's permits let into the soil: a pump gives a few hundredths more or less than its calibration."""
    return float(task["permits"]) * DOSE_ML * (1.0 + PUMP_ERROR_RATIO)


def unhurt(garden: Garden) -> None:
    """Nobody touched anything that must not be touched, nothing was spilt."""
    truth = garden.truth()
    for each in truth.robots:
        hits = each.collisions
        assert (hits.robot_robot, hits.robot_pot, hits.arm, each.fallen) == (0, 0, 0, False), each
    assert truth.spilt_ml == 0.0


def nearest_m(garden: Garden) -> float:
    """The smallest distance between two robots' centres now."""
    at = [(r.pose.x_m, r.pose.y_m) for r in garden.truth().robots]
    return min((math.dist(a, b) for a, b in combinations(at, 2)), default=math.inf)


async def keep_apart(garden: Garden, found: list[float]) -> None:
    """Record the smallest distance ever, for ever."""
    found.append(math.inf)
    while True:
        found[0] = min(found[0], nearest_m(garden))
        await garden.clock.sleep(0.1)


TOUCHING_M = 2 * gardener.BODY_RADIUS_M


async def trace(garden: Garden) -> str:
    """A hash of everything that was said about tasks and of where every joint of the world is, to the last bit."""
    told = [await garden.get(plant.id, "/tasks") for plant in garden.scenario.plants]
    garden.truth()
    return hashlib.sha256(repr(told).encode() + garden.world.data.qpos.tobytes()).hexdigest()
