"""Inventories of one plant (paper 000, section 5 and fig. 10): market, dock, six poses, detector, lifting, merging.

Judged by the world: which fruit could be seen from the poses, where they hang, and how the plant's document compares.
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
from core.virtual import run_virtual
from core.wire.market import FINAL_STATES
from lab.garden import Garden
from lab.orchard import COUNTED_CONFIDENCE, PLANT, ROBOT, Matched, hanging, matched, one_plant, visible
from lab.quiet import hush
from lab.results import Result, held
from lab.story import WATER_ONLY

TRIALS = 6
SCANS = 4
SCAN_WITHIN_S = 300.0

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scanned:
    """One scan: how long it took at the plant, what could be seen, what the inventory then said."""

    scan_s: float
    visible: int
    found: int
    entries: int
    right: int
    errors_m: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    seed: int
    scans: tuple[Scanned, ...]
    failures: tuple[str, ...] = ()


def trial(seed: int, detector: str) -> Trial:
    """`SCANS` inventories of one plant; a picklable unit of work for a pool."""
    hush()
    with tempfile.TemporaryDirectory() as folder:
        return run_virtual(_trial(seed, detector, Path(folder)))


async def _trial(seed: int, detector: str, folder: Path) -> Trial:
    scans: list[Scanned] = []
    failures: list[str] = []
    settings = {ROBOT: {"ROBOT_DETECTOR": detector}, PLANT: WATER_ONLY}
    async with Garden(one_plant(), folder, seed=seed, settings=settings) as garden:
        for _ in range(SCANS):
            task, scan_s = await ask(garden, {"kind": "inventory"}, SCAN_WITHIN_S)
            if task["state"] != "done":
                failures.append(f"seed {seed}: {task['state']}: {task['reason']}")
                continue
            known = [f for f in (await garden.get(PLANT, "/inventory"))["fruits"] if f["confidence"] >= COUNTED_CONFIDENCE]
            truth = hanging(garden)
            seen = visible(garden.world, garden.truth().robot(ROBOT).pose, truth)
            found: Matched = matched(known, truth)
            scans.append(
                Scanned(
                    scan_s=scan_s,
                    visible=len(seen),
                    found=len(seen & found.ids),
                    entries=found.entries,
                    right=len(found.pairs),
                    errors_m=tuple(gap_m for _, _, gap_m in found.pairs),
                )
            )
    return Trial(seed=seed, scans=tuple(scans), failures=tuple(failures))


async def ask(garden: Garden, request: dict[str, Any], within_s: float) -> tuple[dict[str, Any], float]:
    """Ask the plant for a task of a kind, or take the one it asks for by itself; (task at its end, seconds of work)."""
    answer = await garden.post(PLANT, "/tasks", request)
    if answer.status_code == 201:
        task_id = answer.json()["task_id"]
    else:
        task_id = next(t["task_id"] for t in await garden.get(PLANT, "/tasks") if t["kind"] == request["kind"])
    robot = garden.running[ROBOT].node.app.state.brain.robot  # type: ignore[union-attr]
    worked_s, task = 0.0, {}
    before_s = garden.clock.now()

    async def over() -> bool:
        nonlocal worked_s, before_s, task
        now_s = garden.clock.now()
        worked_s += now_s - before_s if robot.activity.job == "act" else 0.0
        before_s = now_s
        task = await garden.get(PLANT, f"/tasks/{task_id}")
        return task["state"] in FINAL_STATES

    await garden.until(over, within_s, every_s=0.25)
    return task, worked_s


def inventory(trials: int | None, seed: int, swap: object, progress: Tell) -> Result:
    """Each trial is a plant of its own seed, scanned `SCANS` times."""
    if swap is not None:
        raise ConfigError("give the detector to `garden evaluate detector --with`", hint="inventory takes the best one")
    done: list[Trial] = []
    for outcome in run_all(trial, trials or TRIALS, seed, "best"):
        done.append(outcome)
        last = outcome.scans[-1] if outcome.scans else None
        progress(f"{len(done)}/{trials or TRIALS} seed {outcome.seed}: {last} {'; '.join(outcome.failures)}")
    return _judge(seed, done)


def run_all(work: Callable[[int, str], Any], trials: int, seed: int, detector: str) -> Iterator[Any]:
    """The trials, shared by as many processes as there are cores."""
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        yield from pool.map(work, range(seed, seed + trials), [detector] * trials)


def _judge(seed: int, done: list[Trial]) -> Result:
    scans = [scan for t in done for scan in t.scans]
    errors = [error for scan in scans for error in scan.errors_m]
    changes = [
        abs(b.entries - a.entries) / a.entries
        for t in done
        for a, b in zip(t.scans[2:], t.scans[3:], strict=False)
        if a.entries
    ]
    ours: dict[str, Any] = {
        "scan_s": max((scan.scan_s for scan in scans), default=math.nan),
        "recall": _ratio([scan.found for scan in scans], [scan.visible for scan in scans]),
        "precision": _ratio([scan.right for scan in scans], [scan.entries for scan in scans]),
        "position_error_m": statistics.median(errors) if errors else math.nan,
        "count_change_ratio": statistics.fmean(changes) if changes else math.nan,
        "failed_scans": sum(len(t.failures) for t in done),
    }
    promises = (
        ("scan_s", "<=", 30.0),
        ("recall", ">=", 0.95),
        ("precision", ">=", 0.95),
        ("position_error_m", "<=", 0.02),
        ("count_change_ratio", "<=", 0.05),
        ("failed_scans", "<=", 0.0),
    )
    counts = {f"seed {t.seed}": [float(scan.entries) for scan in t.scans] for t in done}
    return Result(
        name="inventory",
        seed=seed,
        trials=len(done),
        paper={"scan_s": 45.0},
        ours=ours,
        bars=held(ours, *promises),
        notes=tuple(failure for t in done for failure in t.failures),
        series=counts,
        axes=("scan", "fruit in the inventory"),
    )


def _ratio(parts: list[int], wholes: list[int]) -> float:
    return sum(parts) / sum(wholes) if sum(wholes) else math.nan
