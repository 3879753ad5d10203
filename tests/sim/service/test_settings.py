from __future__ import annotations

import os
import subprocess
import sys

import pytest

from core.errors import ConfigError
from sim.settings import read


def test_settings_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SIM_SPEED", "12.5")
    monkeypatch.setenv("SIM_SEED", "3")
    monkeypatch.setenv("SIM_FRESH", "false")
    settings = read()
    assert (settings.speed, settings.seed, settings.fresh, settings.scenario) == (12.5, 3, False, "garden")


def test_wrong_settings_are_all_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SIM_SPEED", "-1")
    monkeypatch.setenv("SIM_SEED", "nan")
    with pytest.raises(ConfigError, match=r"SIM_SEED.*SIM_SPEED|SIM_SPEED.*SIM_SEED"):
        read()


def test_an_unknown_scenario_is_refused_on_the_command_line() -> None:
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("SIM_", "GARDEN_"))}
    command = [sys.executable, "-m", "sim", "--scenario", "nowhere"]
    ended = subprocess.run(command, env=kept, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert "nowhere" in ended.stderr
    assert "garden" in ended.stderr
    assert "Traceback" not in ended.stderr
