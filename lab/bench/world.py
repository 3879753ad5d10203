"""`garden bench world`: the world's physics beside bare MuJoCo, the whole garden busy and at rest, and its idle processes.

Everything is counted in CPU seconds, so that other work on the machine disturbs little; the ratio to MuJoCo, interleaved,
is disturbed least.
"""

from __future__ import annotations

import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import mujoco

from console import toml
from console.folder import Folder
from console.ports import on_free_ports
from core.errors import ConfigError
from core.scenario import Scenario, find
from core.virtual import run_virtual
from lab.garden import Garden
from lab.quiet import hush
from lab.story import WATER_ONLY
from sim.scene.build import DT_S
from sim.world import World

PHYSICS_S = 4.0
IDLE_X_MIN, DRIVING_X_MIN, BUSY_X_MIN = 20.0, 12.0, 8.0
BUSY_AFTER_S, BUSY_S = 3.0, 42.0
"""From the first award to the last arm in place: both robots drive, dock and reach."""
DAY_S, DAY_CPU_S_MAX = 86400.0, 60.0
IDLE_CORES_MAX, IDLE_WALL_S, IDLE_SETTLE_S, IDLE_WITHIN_S = 0.3, 20.0, 50.0, 240.0
THIRSTY_RATIO, MOIST_RATIO = 0.15, 0.38
FIRST_SHIFT = 1000

Row = dict[str, Any]


def bench_world(n: int = 5) -> list[Row]:
    """Rows `{name, ours, peer, ratio, unit, n, target, ok}`; the peer of the physics is `mj_step` of the same model.

    `n` interleaved pairs of physics, up to 3 busy gardens, one whole quiet day, one `garden up`.
    """
    return [*bench_physics(n), bench_busy(min(n, 3)), bench_quiet_day(), bench_idle_cores()]


def bench_physics(n: int, seconds: float = PHYSICS_S) -> list[Row]:
    """Garden seconds a CPU second of the world's ticks, robots awake: standing still, and both driving in circles."""
    return [
        _physics("physics_idle_x", 0.0, 0.0, IDLE_X_MIN, n, seconds),
        _physics("physics_driving_x", 0.20, 0.05, DRIVING_X_MIN, n, seconds),
    ]


def _physics(name: str, left_mps: float, right_mps: float, least: float, n: int, seconds: float) -> Row:
    scenario = find("garden")
    world, bare = World(scenario, scenario.seed), World(scenario, scenario.seed)
    for each in (world, bare):
        for robot in each.robots.values():
            robot.set_wheels(left_mps, right_mps)
        each.advance(1.0)
    steps = round(seconds / DT_S)
    ours, peers = [], []
    for _ in range(n):
        ours.append(seconds / _cpu_s(lambda: world.advance(seconds)))
        peers.append(seconds / _cpu_s(lambda: mujoco.mj_step(bare.model, bare.data, nstep=steps)))
    x, peer = statistics.median(ours), statistics.median(peers)
    return _row(name, x, peer, "garden s / CPU s", n, f"ours >= {least:g}", x >= least)


def bench_busy(n: int = 1, seconds: float = BUSY_S) -> Row:
    """The whole garden on the virtual clock, every pot thirsty, both robots at work, cameras off."""

    async def main(folder: Path) -> float:
        scenario = _with_moisture(find("garden"), THIRSTY_RATIO)
        pots = {plant.id: WATER_ONLY for plant in scenario.plants}
        async with Garden(scenario, folder, settings=pots) as garden:
            await garden.clock.sleep(BUSY_AFTER_S)
            return await _spent_s(garden, seconds)

    runs = [seconds / _virtual(main) for _ in range(n)]
    x = statistics.median(runs)
    return _row("garden_busy_x", x, None, "garden s / CPU s", n, f"ours >= {BUSY_X_MIN:g}", x >= BUSY_X_MIN)


def bench_quiet_day(seconds: float = DAY_S) -> Row:
    """CPU seconds of a day in which no pot gets thirsty: probes, batteries, a charge, talk. Nothing is scaled."""
    scenario = _with_moisture(find("garden"), MOIST_RATIO)
    scenario = scenario.model_copy(update={"climate": scenario.climate.model_copy(update={"litres_per_day": 0.0})})

    async def main(folder: Path) -> float:
        async with Garden(scenario, folder, settings={plant.id: WATER_ONLY for plant in scenario.plants}) as garden:
            return await _spent_s(garden, seconds)

    day_s = _virtual(main)
    row = _row("quiet_day_s", day_s, None, "CPU s", 1, f"ours <= {DAY_CPU_S_MAX:g}", day_s <= DAY_CPU_S_MAX)
    return row if seconds == DAY_S else row | {"unit": f"CPU s / {seconds:g} garden s"}


def bench_idle_cores() -> Row:
    """Cores that `garden up` takes at its default speed when everything rests: all its processes over 20 wall seconds."""
    with tempfile.TemporaryDirectory() as folder, _up(Path(folder)) as (started, scenario):
        _until_resting(started, scenario)
        before_s, began_s = _family_cpu_s(started.pid), time.monotonic()
        time.sleep(IDLE_WALL_S)
        cores = (_family_cpu_s(started.pid) - before_s) / (time.monotonic() - began_s)
    return _row("idle_cores", cores, None, "cores", 1, f"ours <= {IDLE_CORES_MAX:g}", cores <= IDLE_CORES_MAX)


def _row(name: str, ours: float, peer: float | None, unit: str, n: int, target: str, ok: bool) -> Row:
    ratio = None if peer is None else ours / peer
    named = {"name": f"world.{name}", "ours": ours, "peer": peer, "ratio": ratio}
    return named | {"unit": unit, "n": n, "target": target, "ok": ok}


def _cpu_s(work: Callable[[], object]) -> float:
    began_s = time.process_time()
    work()
    return time.process_time() - began_s


def _with_moisture(scenario: Scenario, ratio: float) -> Scenario:
    plants = tuple(plant.model_copy(update={"moisture_ratio": ratio}) for plant in scenario.plants)
    return scenario.model_copy(update={"plants": plants})


def _virtual(main: Callable[[Path], Any]) -> float:
    hush()
    with tempfile.TemporaryDirectory() as folder:
        return float(run_virtual(main(Path(folder))))


async def _spent_s(garden: Garden, seconds: float) -> float:
    began_s = time.process_time()
    await garden.clock.sleep(seconds)
    garden.check()
    return time.process_time() - began_s


# A real garden


@contextmanager
def _up(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], Scenario]]:
    """`garden up` of a moist garden on free ports; ends with the context."""
    scenario = on_free_ports(_with_moisture(find("garden"), MOIST_RATIO), Folder(folder / "data").place(), FIRST_SHIFT)
    file = folder / "moist.toml"
    file.write_text(toml.dump(scenario))
    garden = "import sys; from console.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", garden, "up", "--scenario", str(file), "--data", str(folder / "data"), "--json"]
    with (folder / "up.log").open("w") as log:
        started = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    try:
        yield started, scenario
    finally:
        started.send_signal(signal.SIGTERM)
        try:
            started.wait(30.0)
        except subprocess.TimeoutExpired:
            started.kill()
            started.wait()


def _until_resting(started: subprocess.Popen[bytes], scenario: Scenario) -> None:
    """Returns when the world has been at rest and all robots idle for a while; raises ConfigError when it never is."""
    resting_since_s: float | None = None
    end_s = time.monotonic() + IDLE_WITHIN_S
    while (now_s := time.monotonic()) < end_s:
        resting_since_s = (resting_since_s or now_s) if _resting(scenario) else None
        if resting_since_s is not None and now_s - resting_since_s >= IDLE_SETTLE_S:
            return
        time.sleep(2.0)
        if started.poll() is not None:
            raise ConfigError("`garden up` ended by itself", hint="see what it says: garden up")
    raise ConfigError(f"the garden did not come to rest within {IDLE_WITHIN_S:g} s")


def _resting(scenario: Scenario) -> bool:
    ports = scenario.ports
    robots = [f"http://127.0.0.1:{ports.robots + row}/state" for row in range(len(scenario.robots))]
    try:
        truth = httpx.get(f"http://127.0.0.1:{ports.sim}/truth").raise_for_status().json()
        jobs = [httpx.get(url).raise_for_status().json()["job"] for url in robots]
    except httpx.HTTPError:
        return False
    return bool(truth["at_rest"]) and set(jobs) == {"idle"}


def _family_cpu_s(pid: int) -> float:
    """CPU seconds of a process and all its living descendants so far."""
    stats = {int(entry): stat for entry in os.listdir("/proc") if entry.isdigit() and (stat := _stat(int(entry)))}
    family, grown = {pid}, True
    while grown:
        more = {child for child, (parent, _) in stats.items() if parent in family} - family
        family, grown = family | more, bool(more)
    return sum(stats[member][1] for member in family if member in stats)


def _stat(pid: int) -> tuple[int, float] | None:
    """(parent, CPU seconds); None when the process has just ended."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return int(after_name[1]), (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")
