"""Harvesting (paper 000, sections 6 and 8.4): a docked robot is told where ripe fruit hang, and picks them.

Every garden is scanned first; the red fruit of its inventory that can be reached are then harvested by a task of the plant.
Judged by the world: a pick counts when that fruit lies in the basket. Fruit torn off beside it count against us.
"""

from __future__ import annotations

import math
import statistics
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from core.errors import ConfigError
from core.virtual import run_virtual
from lab.experiments.inventory import ask, run_all
from lab.garden import Garden
from lab.orchard import PLANT, ROBOT, hanging, matched, one_plant, reachable
from lab.quiet import hush
from lab.results import Result, held
from lab.story import WATER_ONLY

TRIALS = 100
"""Reachable red fruit to be tried, at least."""
SEEDS_MIN = 10
SEEDS_MAX = 60
BATCH = 4
HARVEST_WITHIN_S = 900.0
FRUIT = 24

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """One reachable red fruit and what became of it."""

    fruit_id: str
    picked: bool
    took_s: float
    cause: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One garden."""

    seed: int
    tried: tuple[Tried, ...]
    unknown: int
    """Reachable red fruit that the inventory did not have: nobody was sent for them."""
    behind: int = 0
    """Red fruit that the hand could reach if no unripe fruit hung in its way: not tried."""
    torn_green: int
    torn_other: int
    failures: tuple[str, ...] = ()


def trial(seed: int, detector: str) -> Trial:
    """Scan, harvest, judge; a picklable unit of work for a pool."""
    hush()
    with tempfile.TemporaryDirectory() as folder:
        return run_virtual(_trial(seed, detector, Path(folder)))


async def _trial(seed: int, detector: str, folder: Path) -> Trial:
    settings = {ROBOT: {"ROBOT_DETECTOR": detector}, PLANT: WATER_ONLY}
    async with Garden(one_plant(FRUIT), folder, seed=seed, settings=settings) as garden:
        task, _ = await ask(garden, {"kind": "inventory"}, HARVEST_WITHIN_S)
        if task["state"] != "done":
            return Trial(seed=seed, tried=(), unknown=0, torn_green=0, torn_other=0, failures=(f"scan: {task['reason']}",))
        before = hanging(garden)
        known = (await garden.get(PLANT, "/inventory?colour=red"))["fruits"]
        pose = garden.truth().robot(ROBOT).pose
        red = [fruit for fruit in before if fruit.colour == "red"]
        others = [fruit for fruit in before if fruit.colour != "red"]
        reach = {fruit.id for fruit in red if reachable(pose, fruit, others)}
        behind = sum(reachable(pose, fruit) for fruit in red) - len(reach)
        named = {fruit_id: known[index]["fruit_id"] for index, fruit_id, _ in matched(known, before).pairs}
        wanted = {fruit_id: named[fruit_id] for fruit_id in sorted(reach) if fruit_id in named}
        picks: dict[str, dict[str, Any]] = {}
        failures: list[str] = []
        if wanted:
            request = {"kind": "harvest", "fruit_ids": list(wanted.values()), "count": len(wanted)}
            task, _ = await ask(garden, request, HARVEST_WITHIN_S)
            picks = {pick["fruit_id"]: pick for pick in task.get("picks", ())}
            if task["state"] not in ("done", "failed"):
                failures.append(f"harvest: {task['state']}: {task['reason']}")
        return _judged(garden, seed, wanted, len(reach) - len(wanted), behind, picks, failures)


def _judged(
    garden: Garden,
    seed: int,
    wanted: dict[str, str],
    unknown: int,
    behind: int,
    picks: dict[str, dict[str, Any]],
    failures: list[str],
) -> Trial:
    fruit = {f.id: f for f in garden.truth().plant(PLANT).fruit}
    tried = []
    for fruit_id, name in wanted.items():
        pick, now = picks.get(name, {}), fruit[fruit_id]
        picked = now.where == "basket"
        said = pick.get("reason") or ("the robot says picked" if pick.get("outcome") == "picked" else "never tried")
        cause = "" if picked else f"{now.where}: {said}"
        tried.append(Tried(fruit_id=fruit_id, picked=picked, took_s=pick.get("took_s", math.nan), cause=cause))
    others = [f for f in fruit.values() if f.torn_by is not None and (f.torn_how == "touch" or f.id not in wanted)]
    green = sum(f.colour == "green" for f in others)
    return Trial(
        seed=seed,
        tried=tuple(tried),
        unknown=unknown,
        behind=behind,
        torn_green=green,
        torn_other=len(others) - green,
        failures=tuple(failures),
    )


def grasp(trials: int | None, seed: int, swap: object, progress: Tell) -> Result:
    """Gardens until `trials` reachable red fruit were tried, of at least `SEEDS_MIN` seeds; and again with features."""
    if swap is not None:
        raise ConfigError("give the detector to `garden evaluate detector --with`", hint="grasp takes best and features")
    wanted = trials or TRIALS
    best = _until(wanted, seed, "best", progress)
    features = _until(max(1, wanted // 5), seed, "features", progress, seeds_min=2)
    return _judge(seed, best, features)


def _until(wanted: int, seed: int, detector: str, progress: Tell, seeds_min: int = SEEDS_MIN) -> list[Trial]:
    done: list[Trial] = []
    while len(done) < SEEDS_MAX and (len(done) < seeds_min or sum(len(t.tried) for t in done) < wanted):
        for outcome in run_all(trial, BATCH, seed + len(done), detector):
            done.append(outcome)
            good = sum(t.picked for t in outcome.tried)
            lost = "; ".join(f"{t.fruit_id} {t.cause}" for t in outcome.tried if not t.picked)
            progress(
                f"{detector} {sum(len(t.tried) for t in done)}/{wanted} seed {outcome.seed}: {good} of {len(outcome.tried)},"
                f" torn {outcome.torn_green} green {outcome.torn_other} other {lost} {'; '.join(outcome.failures)}"
            )
    return done


def _judge(seed: int, best: list[Trial], features: list[Trial]) -> Result:
    tried = [t for trial in best for t in trial.tried]
    count = len(tried)
    ours: dict[str, Any] = {
        "success_ratio": _success(best),
        "median_s": _median_s(best),
        "torn_green_per_100": 100.0 * sum(t.torn_green for t in best) / count if count else math.nan,
        "torn_other_per_100": 100.0 * sum(t.torn_other for t in best) / count if count else math.nan,
        "tried": count,
        "seeds": len(best),
        "not_in_inventory": sum(t.unknown for t in best),
        "behind_unripe": sum(t.behind for t in best),
        "features_success_ratio": _success(features),
        "features_median_s": _median_s(features),
        "features_tried": sum(len(t.tried) for t in features),
    }
    promises = (
        ("success_ratio", ">=", 0.95),
        ("median_s", "<=", 15.0),
        ("torn_green_per_100", "<=", 2.0),
        ("torn_other_per_100", "<=", 5.0),
    )
    causes = Counter(t.cause for t in tried if not t.picked)
    failures = [
        f"{name} seed {t.seed}: {f}"
        for name, all_ in (("best", best), ("features", features))
        for t in all_
        for f in t.failures
    ]
    return Result(
        name="grasp",
        seed=seed,
        trials=count,
        paper={"success_ratio": 0.75, "median_s": 28.3, "features_success_ratio": 0.5, "features_median_s": 30.6},
        ours=ours,
        bars=held(ours, *promises),
        notes=(*(f"{number} x {cause}" for cause, number in causes.most_common()), *failures),
        series={"pick": sorted(t.took_s for t in tried if t.picked)},
        axes=("pick, sorted", "from looking to basket [s]"),
    )


def _success(done: list[Trial]) -> float:
    tried = [t for trial in done for t in trial.tried]
    return sum(t.picked for t in tried) / len(tried) if tried else math.nan


def _median_s(done: list[Trial]) -> float:
    times = [t.took_s for trial in done for t in trial.tried if t.picked]
    return statistics.median(times) if times else math.nan
