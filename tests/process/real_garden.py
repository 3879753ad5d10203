"""A garden of real processes on free loopback ports, some of them started by hand."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx

from console import toml
from console.folder import Folder
from console.ports import taken
from console.processes import Process, World, processes
from console.runner import environment, tail
from core.scenario import Scenario

POLL_S = 0.01


def on_free_ports(scenario: Scenario, folder: Folder) -> Scenario:
    """The scenario moved to where no port is in use."""
    first = 1000 + os.getpid() % 500 * 20
    for shift in range(first, first + 20000, 300):
        moved = toml.shifted(scenario, shift)
        if not taken(processes(moved, folder.place())):
            return moved
    raise RuntimeError("no free ports")


class RealGarden:
    """Processes by name; use as a context manager. Everything it started has ended when it ends."""

    def __init__(self, root: Path, scenario: Scenario, speed: float) -> None:
        self.folder = Folder(root)
        self.scenario = on_free_ports(scenario, self.folder)
        root.mkdir(parents=True, exist_ok=True)
        self.folder.scenario_file.write_text(toml.dump(self.scenario))
        self.folder.enrol(self.scenario)
        self.folder.logs.mkdir()
        self.listed = {p.name: p for p in processes(self.scenario, self.folder.place(), World(speed=speed))}
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        token = self.folder.identity().token
        self._http = httpx.Client(headers={"authorization": f"Bearer {token}"}, timeout=5.0)

    def __enter__(self) -> RealGarden:
        return self

    def __exit__(self, *_: object) -> None:
        for child in self.running.values():
            child.send_signal(signal.SIGCONT)
            child.kill()
        for child in self.running.values():
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
        return environment(process) | ({"SIM_FRESH": "false"} if process.kind == "sim" else {})

    def _log(self, name: str) -> Path:
        return self.folder.logs / f"{name}.log"

    def kill(self, name: str, how: signal.Signals = signal.SIGKILL) -> None:
        child = self.running[name]
        child.send_signal(how)
        if how is signal.SIGKILL:
            child.wait(5)
            del self.running[name]

    def get(self, name: str, path: str) -> Any:
        return self._http.get(self._url(name) + path).raise_for_status().json()

    def post(self, name: str, path: str, body: dict[str, Any]) -> httpx.Response:
        return self._http.post(self._url(name) + path, json=body)

    def _url(self, name: str) -> str:
        return f"http://127.0.0.1:{self.listed[name].port}"

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

    def robot(self) -> tuple[float, dict[str, Any]]:
        """Garden time, and the truth of the first robot."""
        truth = self.get("sim", "/truth")
        return float(truth["time_s"]), truth["robots"][0]
