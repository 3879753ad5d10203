"""A garden of real processes on free loopback ports: started by hand, or by `garden up`."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from signal import Signals
from typing import Any

import httpx

from console import toml
from console.folder import Folder
from console.ports import on_free_ports
from console.processes import Process, World, processes
from console.runner import environment, tail
from core.scenario import Scenario
from core.wire.market import FINAL_STATES
from lab import story
from sim.truth import RobotTruth, Truth

POLL_S = 0.01
WATCH_S = 0.6
"""How long a robot that should stand is watched [garden s]."""
AGREED_S = 0.02
"""A robot whose clock is no further ahead of the world than this [garden s] follows it."""
MARK = "REAL_GARDEN_TEST"


class Watched:
    """What can be asked of a garden over HTTP, and waited for."""

    def __init__(self, root: Path, scenario: Scenario, speed: float) -> None:
        self.folder = Folder(root)
        self.scenario = on_free_ports(scenario, self.folder.place(), 1000 + os.getpid() % 500 * 20)
        self.speed = speed
        root.mkdir(parents=True, exist_ok=True)
        self.folder.scenario_file.write_text(toml.dump(self.scenario))
        self.folder.enrol(self.scenario)
        self.folder.logs.mkdir()
        self.listed = {p.name: p for p in processes(self.scenario, self.folder.place(), World(speed=speed))}
        token = self.folder.identity().token
        headers = {"authorization": f"Bearer {token}"}
        self._http = httpx.Client(headers=headers, timeout=5.0, verify=self.folder.trusted() or True)

    def get(self, name: str, path: str) -> Any:
        return self._http.get(self._url(name) + path).raise_for_status().json()

    def post(self, name: str, path: str, body: dict[str, Any]) -> httpx.Response:
        return self._http.post(self._url(name) + path, json=body)

    def picture(self, robot: str) -> httpx.Response:
        """What its hand sees, fruit ringed."""
        return self._http.get(self._url(robot) + "/camera.jpg", timeout=20.0).raise_for_status()

    def _url(self, name: str) -> str:
        return f"{'https' if self.scenario.tls else 'http'}://127.0.0.1:{self.listed[name].port}"

    def until(self, true: Callable[[], bool], within_s: float) -> None:
        """Poll; a service that does not answer yet is not an error. Wall seconds."""
        end_s = time.monotonic() + within_s
        while time.monotonic() < end_s:
            try:
                if true():
                    return
            except httpx.HTTPError:
                time.sleep(0.1)
            time.sleep(POLL_S)
        logs = "\n".join(f"{name}: {tail(self._log(name))}" for name in self.listed if self._log(name).exists())
        raise AssertionError(f"not within {within_s} s\n{logs}")

    def _log(self, name: str) -> Path:
        return self.folder.logs / f"{name}.log"

    # ------------------------------------------------------------------ the judge

    def truth(self) -> Truth:
        return Truth.model_validate_json(self._http.get(self._url("sim") + "/truth").raise_for_status().content)

    def robot(self) -> RobotTruth:
        """The first robot, as it is."""
        return self.truth().robots[0]

    def poured_ml(self, plant_id: str) -> float:
        return self.truth().plant(plant_id).poured_ml

    def unhurt(self) -> None:
        """Nobody touched anything that must not be touched, nothing was spilt."""
        story.unhurt(self)

    # ------------------------------------------------------------------ tasks

    def served(self, plant_id: str, within_s: float) -> dict[str, Any]:
        """The pot's first task once it has ended; it must have ended done, and once. Wall seconds."""
        task: dict[str, Any] = {}

        def over() -> bool:
            task.update((self.get(plant_id, "/tasks") or [{}])[0])
            return task.get("state") in FINAL_STATES

        self.until(over, within_s)
        assert task["state"] == "done", task["events"]
        assert sum(event["what"].startswith("done") for event in task["events"]) == 1, task["events"]
        return task

    # ------------------------------------------------------------------ time

    def run_at(self, speed: float) -> None:
        """Returns when the first robot follows: a clock that was ahead of a world that lagged waits for it."""
        self._http.patch(self._url("sim") + "/clock", json={"speed": speed}).raise_for_status()
        slower, self.speed = speed < self.speed, speed
        if slower:
            self.until(lambda: self.get("robot-1", "/state")["now_s"] <= self.truth().time_s + AGREED_S, 60.0)


class RealGarden(Watched):
    """Processes by name; use as a context manager. Everything it started has ended when it ends."""

    def __init__(
        self, root: Path, scenario: Scenario, speed: float, settings: dict[str, dict[str, str]] | None = None
    ) -> None:
        """`settings` adds environment variables by process name."""
        super().__init__(root, scenario, speed)
        self._settings = settings or {}
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self._dead: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> RealGarden:
        return self

    def __exit__(self, *_: object) -> None:
        for child in self.running.values():
            child.kill()
        for child in (*self.running.values(), *self._dead):
            child.wait(10)
        self._http.close()

    def start(self, *names: str) -> None:
        for name in names:
            process = self.listed[name]
            (self.folder.root / name).mkdir(exist_ok=True)
            with self._log(name).open("ab") as log:
                self.running[name] = subprocess.Popen(
                    [sys.executable, "-m", process.module], env=self._env(process), stdout=log, stderr=log
                )

    def _env(self, process: Process) -> dict[str, str]:
        return environment(process) | self._settings.get(process.name, {})

    def signal(self, name: str, how: Signals) -> None:
        """What has got SIGKILL no longer counts as running."""
        self.running[name].send_signal(how)
        if how is Signals.SIGKILL:
            self._dead.append(self.running.pop(name))

    def stops_after(self, name: str, how: Signals) -> tuple[float, float]:
        """Hang or kill the first robot's brain; when the wheels and the pump were told to stop, and when all stood.

        Garden seconds from the latest instant at which the signal can have come to the last look that still saw something
        on or moving; nothing may begin to move again.
        """
        asked_s, before = time.monotonic(), self.truth()
        self.signal(name, how)
        signalled_s = before.time_s + (time.monotonic() - asked_s) * self.speed
        on_s = moved_s = signalled_s
        arm, looks = before.robots[0].arm_rad, 0
        while (now := self.truth()).time_s < signalled_s + WATCH_S:
            truth = now.robots[0]
            if truth.wheels_mps != (0.0, 0.0) or truth.pumping:
                on_s = now.time_s
            if not story.stands(truth) or max(abs(a - b) for a, b in zip(truth.arm_rad, arm, strict=True)) > 0.01:
                moved_s = now.time_s
            arm = truth.arm_rad
            looks += 1
            time.sleep(POLL_S)
        assert looks >= 10, f"looked only {looks} times"
        return on_s - signalled_s, moved_s - signalled_s


class UpGarden(Watched):
    """`garden up` in a process of its own; use as a context manager. `ends` presses Ctrl-C."""

    def __enter__(self) -> UpGarden:
        words = ["up", "--scenario", str(self.folder.scenario_file), "--data", str(self.folder.root)]
        self.mark = f"{MARK}={self.folder.root}"
        self._out = self.folder.root / "out"
        with self._out.open("wb") as out:
            self.up = subprocess.Popen(
                [sys.executable, "-m", "console.cli", *words, "--speed", f"{self.speed:g}", "--json"],
                env=os.environ | {MARK: str(self.folder.root)},
                stdout=out,
                stderr=out,
            )
        return self

    def __exit__(self, *_: object) -> None:
        self.up.kill()
        self.up.wait(10)
        self._http.close()

    def told(self) -> str:
        """What it printed so far."""
        return self._out.read_text()

    def ready(self, within_s: float) -> None:
        """Wall seconds."""

        def so() -> bool:
            assert self.up.poll() is None, self.told()
            return '"garden": "ready"' in self.told()

        self.until(so, within_s)

    def ends(self) -> None:
        """Ctrl-C."""
        self.up.send_signal(Signals.SIGINT)
        assert self.up.wait(20.0) in (0, 130), self.told()

    def pids(self, module: str = "") -> list[int]:
        """All processes that this garden started, or those that run `module`."""
        found = []
        for entry in Path("/proc").iterdir():
            try:
                ours = entry.name.isdigit() and self.mark in (entry / "environ").read_text().split("\0")
                if ours and (not module or (entry / "cmdline").read_text().split("\0")[1:3] == ["-m", module]):
                    found.append(int(entry.name))
            except (OSError, UnicodeDecodeError):
                continue
        return found
