"""Watering from a standing start (paper 000, section 8.2): the whole system, judged by the water in the soil.

One robot starts in the arena's top-left corner; one pot is dry, by turns the nearest and the farthest. The pot asks, the
robot bids, is awarded, drives, docks, takes a permit, pours and reports; the pot measures again. Every trial is a garden
of its own, in a world of its own seed.
"""

from __future__ import annotations

import math
import os
import statistics
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from core.errors import ConfigError
from core.scenario import Plant, Scenario, find
from core.virtual import run_virtual
from core.wire.market import FINAL_STATES
from lab.garden import Garden
from lab.quiet import hush
from lab.results import Result, held
from lab.story import WATER_ONLY
from sim.truth import Collisions

TRIALS = 10
NEAR, FAR = "plant-1", "plant-4"
START = {"x_m": -1.70, "y_m": 1.22, "yaw_deg": -90.0}
DRY_RATIO, WET_RATIO = 0.15, 0.35
TRIAL_WITHIN_S = 420.0
DOSE_TOLERANCE_ML = 10.0

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """What the world says of one watering. Times are garden seconds; NaN where it never came to that."""

    seed: int
    plant_id: str
    state: str
    reason: str
    poured_ml: float
    dose_ml: float
    spilt_ml: float
    drive_s: float
    water_s: float
    rise_ratio: float
    collisions: int

    @property
    def success(self) -> bool:
        """Done by its own word, and by the world's: the dose is in the right soil and nothing was hit."""
        right = abs(self.poured_ml - self.dose_ml) <= DOSE_TOLERANCE_ML and self.rise_ratio > 0
        return self.state == "done" and right and self.spilt_ml == 0 and self.collisions == 0


def one_dry_pot(plant_id: str) -> Scenario:
    """The default garden with one robot in the corner and one dry pot."""
    garden = find("garden")

    def potted(plant: Plant) -> Plant:
        return plant.model_copy(update={"moisture_ratio": DRY_RATIO if plant.id == plant_id else WET_RATIO})

    robot = garden.robots[0].model_copy(update=START)
    return garden.model_copy(update={"plants": tuple(map(potted, garden.plants)), "robots": (robot,)})


def trial(seed: int, plant_id: str) -> Trial:
    """One whole story in a garden of its own; a picklable unit of work for a pool."""
    hush()
    with tempfile.TemporaryDirectory() as folder:
        return run_virtual(_trial(seed, plant_id, Path(folder)))


async def _trial(seed: int, plant_id: str, folder: Path) -> Trial:
    scenario = one_dry_pot(plant_id)
    pots = {plant.id: WATER_ONLY for plant in scenario.plants}
    async with Garden(scenario, folder, seed=seed, settings=pots) as garden:
        before = garden.truth().plant(plant_id)
        times: dict[str, float] = {}
        task: dict[str, Any] = {}

        async def over() -> bool:
            nonlocal task
            task = next(iter(await garden.get(plant_id, "/tasks")), {})
            _note_times(garden, task, times)
            return task.get("state") in FINAL_STATES

        await garden.until(over, TRIAL_WITHIN_S, every_s=0.5)
        truth = garden.truth()
        after = truth.plant(plant_id)
        return Trial(
            seed=seed,
            plant_id=plant_id,
            state=task.get("state", "never asked for"),
            reason=task.get("reason", ""),
            poured_ml=after.poured_ml - before.poured_ml,
            dose_ml=task.get("dose_ml", math.nan),
            spilt_ml=truth.spilt_ml,
            drive_s=times.get("docked", math.nan) - times.get("awarded", math.nan),
            water_s=times.get("poured", math.nan) - times.get("docked", math.nan),
            rise_ratio=after.moisture_ratio - before.moisture_ratio,
            collisions=sum(_hits(robot.collisions) for robot in truth.robots),
        )


def _note_times(garden: Garden, task: dict[str, Any], times: dict[str, float]) -> None:
    """When the award left, when the world saw the robot on the dock, when the robot said it had poured."""
    now_s = garden.clock.now()
    if task.get("state") == "awarded" or task.get("state") == "running":
        times.setdefault("awarded", task["updated_s"] if task["state"] == "awarded" else now_s)
    if "awarded" in times and garden.truth().robots[0].docked_at == task["plant_id"]:
        times.setdefault("docked", now_s)
    for event in task.get("events", ()):
        if "reports done" in event["what"]:
            times.setdefault("poured", event["t_s"])


def _hits(touches: Collisions) -> int:
    """What must not be touched; a nudge of the dock's face is part of docking."""
    return touches.robot_robot + touches.robot_pot + touches.arm


def watering(trials: int | None, seed: int, swap: object, progress: Tell) -> Result:
    """Trials alternate between the near and the far dock; two processes share them."""
    if swap is not None:
        raise ConfigError("watering has no part to swap", hint="--with works with square-loop")
    trials = trials or TRIALS
    done: list[Trial] = []
    for outcome in _run_all(trials, seed):
        done.append(outcome)
        verdict = "ok" if outcome.success else f"FAILED: {outcome}"
        progress(f"{len(done)}/{trials} seed {outcome.seed} {outcome.plant_id} drive {outcome.drive_s:.1f} s {verdict}")
    return _judge(seed, done)


def _run_all(trials: int, seed: int) -> Iterator[Trial]:
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        yield from pool.map(trial, range(seed, seed + trials), [(NEAR, FAR)[k % 2] for k in range(trials)])


def _judge(seed: int, done: list[Trial]) -> Result:
    near = [t.drive_s for t in done if t.plant_id == NEAR]
    far = [t.drive_s for t in done if t.plant_id == FAR]
    ours = {
        "success_ratio": sum(t.success for t in done) / len(done),
        "spilt_ml": sum(t.spilt_ml for t in done),
        "drive_near_s": _mean(near),
        "drive_near_sd_s": _spread(near),
        "drive_far_s": _mean(far),
        "drive_far_sd_s": _spread(far),
        "water_s": _mean([t.water_s for t in done]),
        "dose_error_ml": max(abs(t.poured_ml - t.dose_ml) for t in done),
    }
    promises = (
        ("success_ratio", ">=", 1.0),
        ("spilt_ml", "<=", 0.0),
        ("drive_near_s", "<=", 60.0),
        ("drive_far_s", "<=", 75.0),
    )
    paper = {"success_ratio": 1.0, "drive_near_s": 79.5, "drive_near_sd_s": 11.3}
    paper |= {"drive_far_s": 94.25, "drive_far_sd_s": 8.9, "water_s": 20.0}
    notes = tuple(f"failed: {t}" for t in done if not t.success)
    return Result(
        name="watering",
        seed=seed,
        trials=len(done),
        paper=paper,
        ours=ours,
        bars=held(ours, *promises),
        notes=notes,
        series={"near dock": near, "far dock": far},
        axes=("trial", "award to charge current [s]"),
    )


def _mean(values: list[float]) -> float:
    return statistics.fmean(values) if values else math.nan


def _spread(values: list[float]) -> float:
    return statistics.stdev(values) if len(values) > 1 else math.nan
