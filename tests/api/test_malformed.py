"""A flood of malformed requests: each is refused with a hint, nothing stands otherwise, nothing moved, nothing piled up."""

from __future__ import annotations

import gc
import os
from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest
from acts import acts_told, world_of
from doors import KINDS, Doors, check_problem, open_doors
from malformed import Asked, malformed
from test_bad_bodies import GOOD, RESERVE

from lab.bench.pot import rss_mb

SEED = 11
GROWTH_MB_MAX = 50.0
PAUSE_EVERY, PAUSE_S = 1000, 1.0
"""Garden time for what a request may have set going."""
AFTERWARDS_S = 30.0
SETTLED_S = 150.0
"""A robot that rested for two minutes looks for a better place to wait, and loads its compiled planner (60 MB) for it."""


def memory_mb() -> float:
    gc.collect()
    return rss_mb(os.getpid())


async def refused(doors: Doors, requests: Iterator[Asked], count: int) -> Counter[str]:
    """Ask `count` of them, each of which must be refused; what was wrong how often."""
    wrong: Counter[str] = Counter()
    for number, asked in enumerate(islice(requests, count)):
        check_problem(await asked.of(doors), asked, *asked.statuses)
        wrong[asked.kind] += 1
        wrong[asked.wrong] += 1
        if number % PAUSE_EVERY == PAUSE_EVERY - 1:
            await doors.garden.clock.sleep(PAUSE_S)
    return wrong


def flood(folder: Path, warm_up: int, settle_s: float, count: int) -> None:
    """Refuse `warm_up` requests and `count` more, by which memory is judged, in a garden of which nobody wants anything."""
    print(f"seed {SEED}")
    with open_doors(folder) as doors, acts_told() as acts:
        requests = malformed(doors, SEED)
        before, world = doors.standing(), world_of(doors)
        doors.runner.run(refused(doors, requests, warm_up))
        doors.wait(settle_s)
        before_mb = memory_mb()
        wrong = doors.runner.run(refused(doors, requests, count))
        grown_mb = memory_mb() - before_mb
        print(f"{count} requests, {grown_mb:.1f} MB more than {before_mb:.0f} MB; what was wrong and the answers so far:")
        print(dict(wrong.most_common()), dict(sorted(doors.statuses.items())))
        doors.wait(AFTERWARDS_S)
        assert all(wrong[kind] == count // len(KINDS) for kind in KINDS)
        assert max(doors.statuses) < 500
        assert doors.standing() == before
        assert world_of(doors) == world
        assert not acts
        assert grown_mb < GROWTH_MB_MAX
        good_ones_act(doors, acts)


def good_ones_act(doors: Doors, acts: Counter[str]) -> None:
    """So that it was the requests: the same garden moves and opens its tap when it is asked well, and both are seen."""
    world = world_of(doors)
    assert doors.ask("robot", "POST", "/jobs", json=GOOD["robot", "POST", "/jobs"]).is_success
    robot = doors.token("robot")
    assert doors.ask("station", "POST", "/dock/reservations", token=robot, json=RESERVE | {"dock_id": "tap"}).is_success
    assert doors.ask("station", "POST", "/tap", token=robot, json=GOOD["station", "POST", "/tap"]).is_success
    doors.wait(5.0)
    assert {"CreateDriver.drive", "RobotBody.set_wheels", "Ssc32Driver.move", "RobotBody.set_pulse"} <= set(acts)
    assert {"FirmataValve.open_for", "FirmataBoard.set_tap", "TapBoard.set_digital"} <= set(acts)
    after = world_of(doors)
    assert after["tap_ml"] > world["tap_ml"]
    assert after["robots"] != world["robots"]


def test_two_thousand_malformed_requests_are_refused_and_nothing_acts(tmp_path: Path) -> None:
    flood(tmp_path, 200, 0.0, 2000)


@pytest.mark.soak
def test_a_hundred_thousand_malformed_requests_are_refused_and_nothing_acts(tmp_path: Path) -> None:
    flood(tmp_path, 5000, SETTLED_S, 100_000)
