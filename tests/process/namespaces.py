"""Radio meshes of network namespaces: one a host, a veth pair a link, babeld on every host, real services on top."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

from pyroute2 import netns

PORT = 8100
BABEL = """reflect-kernel-metric true
smoothing-half-life 0
default type wired rxcost 1 hello-interval 1 update-interval 4
redistribute local ip 10.77.0.0/24 eq 32 allow
redistribute local deny
"""


def unable(*tools: str) -> str:
    """Why no namespaces can be made here; empty when they can."""
    if os.geteuid() != 0:
        return "network namespaces take root"
    for tool in ("ip", *tools):
        if shutil.which(tool) is None:
            return f"{tool} is not installed: make debian"
    tried = subprocess.run(["ip", "netns", "add", "garden-try"], capture_output=True, text=True, check=False)
    subprocess.run(["ip", "netns", "del", "garden-try"], capture_output=True, check=False)
    return "" if tried.returncode == 0 else f"no namespaces here: {tried.stderr.strip()[:100]}"


class Namespaces:
    """Hosts 1, 2, ... with the address 10.77.0.N and links between them. Everything is gone at the end of the `with`."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self._name = folder, f"{name}{os.getpid() % 10000}"
        self._hosts: list[int] = []
        self._processes: list[subprocess.Popen[bytes]] = []
        self._links: dict[int, list[str]] = {}

    def __enter__(self) -> Namespaces:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self._processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for host in self._hosts:
            _run("ip", "netns", "del", self.space(host))

    def space(self, host: int) -> str:
        return f"{self._name}-{host}"

    @staticmethod
    def address(host: int) -> str:
        return f"10.77.0.{host}"

    def url(self, host: int) -> str:
        return f"http://{self.address(host)}:{PORT}"

    def build(self, hosts: Iterable[int], links: Iterable[tuple[int, int]]) -> None:
        """Hosts that forward, and who hears whom."""
        for host in hosts:
            self._hosts.append(host)
            self._links[host] = []
            _run("ip", "netns", "add", self.space(host))
            self.ip(host, "link", "set", "lo", "up")
            self.ip(host, "addr", "add", f"{self.address(host)}/32", "dev", "lo")
            # Addresses without a wait for duplicates: babeld must not begin while links have none.
            self.inside(host, "sysctl", "-qw", "net.ipv4.ip_forward=1", "net.ipv6.conf.default.accept_dad=0")
        for a, b in links:
            self.link(a, b)

    def link(self, a: int, b: int) -> None:
        one, other = f"to{b}", f"to{a}"
        _run("ip", "link", "add", one, "netns", self.space(a), "type", "veth", "peer", "name", other, "netns", self.space(b))
        for host, device in ((a, one), (b, other)):
            self.ip(host, "link", "set", device, "up")
            self._links[host].append(device)

    def cut(self, a: int, b: int) -> None:
        """The two hear each other no more."""
        self.ip(a, "link", "set", f"to{b}", "down")

    def route(self) -> None:
        """Start the routing daemon on every host."""
        config = self.folder / "babeld.conf"
        config.write_text(BABEL)
        for host in self._hosts:
            files = [f"{flag}{self.folder / f'babel-{host}.{what}'}" for flag, what in (("-I", "pid"), ("-S", "state"))]
            self.start(host, ["babeld", *files, "-c", str(config), *self._links[host]], f"babel-{host}.log")

    def start(self, host: int, command: list[str], log: str, env: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
        """Start a process on a host; it ends with the namespaces."""
        with (self.folder / log).open("wb") as told:
            process = subprocess.Popen(
                ["ip", "netns", "exec", self.space(host), *command], env=env, stdout=told, stderr=subprocess.STDOUT
            )
        self._processes.append(process)
        return process

    def station(self, host: int, discovery: str, keys: Path) -> subprocess.Popen[bytes]:
        """A real node: a station with one dock and no device."""
        docks = json.dumps([{"id": "spare", "pose": {"x_m": 0.0, "y_m": 0.0, "yaw_rad": 0.0}}])
        env = {
            "PATH": os.environ["PATH"], "PLANT_ID": f"station-{host}", "PLANT_KIND": "station", "PLANT_URL": self.url(host),
            "PLANT_DATA": str(self.folder / f"data-{host}"), "PLANT_DOCKS": docks,
            "GARDEN_KEYS": str(keys / f"station-{host}"), "GARDEN_HOST": self.address(host), "GARDEN_PORT": str(PORT),
            "GARDEN_DISCOVERY": discovery,
        }  # fmt: skip
        return self.start(host, [sys.executable, "-m", "plant_service"], f"station-{host}.log", env)

    def get(self, host: int, path: str) -> Any:
        """Ask a host's node from that host itself; None while it does not answer."""
        return self.ask(host, self.url(host) + path)

    def ask(self, host: int, url: str) -> Any:
        """GET a JSON document as if from that host; None while nobody answers."""
        netns.pushns(self.space(host))
        try:
            with urllib.request.urlopen(url, timeout=2) as answer:
                return json.loads(answer.read())
        except (urllib.error.URLError, ConnectionError, TimeoutError):
            return None
        finally:
            netns.popns()

    def hops(self, host: int) -> dict[int, int]:
        """How far away this host's node believes the others to be."""
        seen = self.get(host, "/peers") or []
        return {int(peer["id"].removeprefix("station-")): peer["hops"] for peer in seen if peer["present"]}

    def ip(self, host: int, *words: str) -> None:
        _run("ip", "-n", self.space(host), *words)

    def inside(self, host: int, *words: str) -> None:
        _run("ip", "netns", "exec", self.space(host), *words)


def until(true: Callable[[], bool], within_s: float, what: str) -> float:
    """Wait for it; the seconds it took. Raises AssertionError when it does not come."""
    began_s = time.monotonic()
    while not true():
        assert time.monotonic() - began_s < within_s, f"not within {within_s:g} s: {what}"
        time.sleep(0.25)
    return time.monotonic() - began_s


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)
