"""Real processes and real signals: what a kill stops, and what it cannot take away."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from real_garden import RealGarden

from console import toml
from core.scenario import Scenario
from lab import story

STOP_WITHIN_S = 0.3
LOOK_S = 0.25
"""At speed 1, looking at the truth over HTTP on a busy machine."""


def scenario() -> Scenario:
    return story.garden_of(("plant-1",), ("plant-3",), robots=(story.near_robot(),))


def drives(garden: RealGarden) -> bool:
    return all(abs(v) > 0.1 for v in garden.robot()[1]["wheels_mps"])


def stops_after(garden: RealGarden, how: signal.Signals) -> float:
    """Garden seconds from the signal until the wheels are told to stand; they must stay so."""
    garden.until(lambda: drives(garden), 60.0)
    since_s, _ = garden.robot()
    garden.kill("robot-1", how)
    garden.until(lambda: garden.robot()[1]["wheels_mps"] == [0.0, 0.0], 10.0)
    stood_s, _ = garden.robot()
    time.sleep(0.3)
    assert garden.robot()[1]["wheels_mps"] == [0.0, 0.0]
    assert abs(garden.robot()[1]["v_mps"]) < 0.01
    return stood_s - since_s


def test_a_brain_that_hangs_or_is_killed_stops_its_wheels_and_a_pot_keeps_its_word(tmp_path):
    with RealGarden(tmp_path / "g", scenario(), speed=1.0) as garden:
        garden.start("sim", "plant-1", "plant-3", "robot-1-body", "robot-1")
        assert stops_after(garden, signal.SIGSTOP) <= STOP_WITHIN_S + LOOK_S
        garden.kill("robot-1", signal.SIGCONT)
        assert stops_after(garden, signal.SIGKILL) <= STOP_WITHIN_S + LOOK_S

        answer = garden.post("plant-3", "/tasks", {"kind": "water", "dose_ml": 50.0})
        assert answer.status_code in (201, 202), answer.text
        garden.kill("plant-3")
        garden.start("plant-3")
        known = []
        garden.until(lambda: known.extend(garden.get("plant-3", "/tasks")) or bool(known), 20.0)
        assert [task["task_id"] for task in known] == [answer.json()["task_id"]]
        assert known[0]["state"] == "announced"


def whose(mark: str) -> list[str]:
    """Command lines of all processes that carry `mark` in their environment."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and int(entry.name) != os.getpid() and mark in (entry / "environ").read_text():
                found.append((entry / "cmdline").read_text().replace("\0", " "))
        except (OSError, UnicodeDecodeError):
            continue
    return found


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for processes in /proc")
def test_garden_up_ends_on_sigint_and_leaves_no_process(tmp_path):
    with RealGarden(tmp_path / "g", story.one_pot(), speed=3.0) as ports:
        shift = ports.scenario.ports.sim - story.one_pot().ports.sim
    mark = f"REAL_GARDEN_TEST={os.getpid()}"
    name, _, value = mark.partition("=")
    unshifted = tmp_path / "mine.toml"
    unshifted.write_text(toml.dump(story.one_pot()))
    command = [sys.executable, "-m", "console.cli", "up", "--scenario", str(unshifted), "--shift", str(shift)]
    with (tmp_path / "out").open("wb") as out:
        garden = subprocess.Popen(
            [*command, "--data", str(tmp_path / "d"), "--json"], stdout=out, stderr=out, env=os.environ | {name: value}
        )
    try:
        end_s = time.monotonic() + 60.0
        while b'"garden": "ready"' not in (tmp_path / "out").read_bytes() and time.monotonic() < end_s:
            assert garden.poll() is None, (tmp_path / "out").read_text()
            time.sleep(0.1)
        assert len(whose(mark)) >= 7
        garden.send_signal(signal.SIGINT)
        assert garden.wait(20.0) in (0, 130), (tmp_path / "out").read_text()
        assert whose(mark) == []
    finally:
        garden.kill()
