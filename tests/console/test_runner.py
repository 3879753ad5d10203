"""The runner leaves nothing behind, and nothing down."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from console import runner as runner_module
from console.processes import Process
from console.runner import Runner
from core.errors import ConfigError

SLEEPS = "import os, time\nopen(os.environ['NOTE'], 'a').write(f'{os.getpid()}\\n')\ntime.sleep(60)\n"
"""Notes its process id, then waits."""


def module(folder: Path, name: str, code: str) -> Process:
    """A process that runs `code` as a module found in `folder`."""
    (folder / f"{name}.py").write_text(code)
    return Process(name, "plant", name, {"PYTHONPATH": str(folder), "NOTE": str(folder / f"{name}.pids")}, name)


def sleeper(folder: Path, name: str = "sleeper") -> Process:
    return module(folder, name, SLEEPS)


def pids(folder: Path, name: str = "sleeper") -> list[int]:
    path = folder / f"{name}.pids"
    return [int(line) for line in path.read_text().splitlines()] if path.exists() else []


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not true():  # noqa: ASYNC110 (another process gives no event)
            await asyncio.sleep(0.02)


async def running(runner: Runner, story: Callable[[], Awaitable[None]]) -> None:
    task = asyncio.create_task(runner.run())
    try:
        await story()
    finally:
        task.cancel()
        await asyncio.wait([task])


def test_a_killed_process_comes_back_and_all_end_with_the_runner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner_module, "BACKOFF_S", (0.02, 0.1))
    told: list[str] = []
    runner = Runner([sleeper(tmp_path)], tmp_path / "logs", lambda name, what: told.append(f"{name} {what}"))

    async def story() -> None:
        await until(lambda: len(pids(tmp_path)) == 1)
        os.kill(pids(tmp_path)[0], signal.SIGKILL)
        await until(lambda: len(pids(tmp_path)) == 2)

    asyncio.run(running(runner, story))
    assert told[0].startswith("sleeper ended (by SIGKILL), starting again")
    assert not any(alive(pid) for pid in pids(tmp_path))


def test_a_process_that_ignores_sigterm_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner_module, "GRACE_S", 0.2)
    deaf = "import signal\nsignal.signal(15, signal.SIG_IGN)\n"
    stubborn = module(tmp_path, "stubborn", deaf + SLEEPS)

    async def story() -> None:
        await until(lambda: len(pids(tmp_path, "stubborn")) == 1)

    asyncio.run(running(Runner([stubborn], tmp_path / "logs", lambda name, what: None), story))
    assert not alive(pids(tmp_path, "stubborn")[0])


def test_what_cannot_start_is_given_up_with_its_last_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner_module, "BACKOFF_S", (0.01, 0.01))
    broken = module(tmp_path, "broken", "raise SystemExit('the tank is upside down')\n")
    with pytest.raises(ExceptionGroup) as caught:
        asyncio.run(Runner([broken, sleeper(tmp_path)], tmp_path / "logs", lambda name, what: None).run())
    assert isinstance(caught.value.exceptions[0], ConfigError)
    assert "upside down" in str(caught.value.exceptions[0])
    assert not any(alive(pid) for pid in pids(tmp_path))


PARENT = """
import asyncio, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from console.processes import Process
from console.runner import Runner
folder = Path(sys.argv[1])
env = {"PYTHONPATH": str(folder), "NOTE": str(folder / "sleeper.pids")}
asyncio.run(Runner([Process("sleeper", "plant", "sleeper", env, "s")], folder / "logs", print).run())
"""


def test_a_killed_runner_leaves_no_process(tmp_path: Path) -> None:
    sleeper(tmp_path)
    root = str(Path(__file__).resolve().parents[2])
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(tmp_path), root])
    try:
        asyncio.run(until(lambda: len(pids(tmp_path)) == 1))
    finally:
        parent.kill()
        parent.wait()
    asyncio.run(until(lambda: not alive(pids(tmp_path)[0])))


def test_settings_meant_for_others_do_not_leak_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PLANT_DOSE_ML", "1")
    monkeypatch.setenv("HOME", "/home/x")
    environment = runner_module.environment(sleeper(tmp_path))
    assert "PLANT_DOSE_ML" not in environment
    assert environment["HOME"] == "/home/x"


def test_what_is_killed_on_purpose_stays_down_until_it_is_started(tmp_path: Path) -> None:
    told: list[str] = []
    runner = Runner([sleeper(tmp_path)], tmp_path / "logs", lambda name, what: told.append(what))

    async def story() -> None:
        await until(lambda: len(pids(tmp_path)) == 1)
        runner.children["sleeper"].ready = True
        assert runner.kill("sleeper") == pids(tmp_path)[0]
        await until(lambda: not alive(pids(tmp_path)[0]))
        await asyncio.sleep(2 * runner_module.BACKOFF_S[0])
        assert len(pids(tmp_path)) == 1
        with pytest.raises(ConfigError, match="does not run"):
            runner.kill("sleeper")
        runner.start("sleeper")
        await until(lambda: len(pids(tmp_path)) == 2)

    asyncio.run(running(runner, story))
    assert told == []
    assert not alive(pids(tmp_path)[1])
