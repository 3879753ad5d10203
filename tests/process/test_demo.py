"""`garden demo` shows what it says, and leaves nothing behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from signal import SIGTERM

import pytest

MARK = "DEMO_TEST"


def marked(value: str) -> list[str]:
    """Processes that have our mark in their environment."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and f"{MARK}={value}" in (entry / "environ").read_text().split("\0"):
                found.append((entry / "cmdline").read_text())
        except (OSError, UnicodeDecodeError):
            continue
    return found


@pytest.mark.soak
@pytest.mark.alone
@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for processes in /proc")
def test_the_killed_robots_task_is_done_by_the_other_and_no_process_is_left(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "console.cli", "demo", "--json", "--data", str(tmp_path)],
        env=os.environ | {MARK: str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    print(done.stdout[-3000:], done.stderr)
    assert done.returncode == 0
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    verdict = next(line for line in lines if "done" in line)
    assert verdict["by"] != verdict["killed"]
    assert 100.0 < verdict["poured_ml"] < 165.0
    story = next(line["story"] for line in lines if "story" in line)
    awards = [step["target"] for step in story if step["what"].startswith("award, epoch")]
    assert awards == [verdict["killed"], verdict["by"]]
    told = [step["what"] for step in story]
    assert told.index("its brain is killed") < told.index(f"{verdict['killed']} fell silent for 8 s")
    assert sum(what.startswith("permit ") for what in told) == 1
    assert marked(str(tmp_path)) == []


@pytest.mark.soak
@pytest.mark.alone
@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for processes in /proc")
def test_ended_by_a_signal_it_leaves_no_process_either(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "console.cli", "demo", "--json", "--data", str(tmp_path)]
    with subprocess.Popen(command, env=os.environ | {MARK: str(tmp_path)}, stdout=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        started = next(line for line in demo.stdout if "asked for by soil" in line)
        assert len(marked(str(tmp_path))) >= 9, started
        demo.send_signal(SIGTERM)
        assert demo.wait(30) == 1
    assert marked(str(tmp_path)) == []
