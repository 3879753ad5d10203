"""Which ports are taken, and by whom."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from console import toml
from console.processes import Place, Process, processes
from core.errors import ConfigError
from core.scenario import Scenario

_LISTENING = "0A"
SHIFT, SHIFTS = 300, 70
"""Gardens beside one another lie so many ports apart; so many places are tried."""


@dataclass(frozen=True, slots=True)
class Taken:
    port: int
    process: str
    """Which of our processes wants it."""
    holder: str
    """Who has it, as far as we may see."""

    def told(self) -> str:
        return f"port {self.port} (wanted by {self.process}) is held by {self.holder}"


def taken(processes: Iterable[Process]) -> list[Taken]:
    """Every wanted port that cannot be bound now."""
    wanted = [(port, process.name) for process in processes for port in (process.port, *process.devices) if port]
    return [Taken(port, name, holder(port)) for port, name in wanted if not is_free(port)]


def on_free_ports(scenario: Scenario, place: Place, first: int = 0) -> Scenario:
    """The scenario moved by `first` ports or more to where none is in use; raises ConfigError when no room is left."""
    for shift in range(first, first + SHIFTS * SHIFT, SHIFT):
        moved = toml.shifted(scenario, shift)
        if not (busy := taken(processes(moved, place))):
            return moved
    raise ConfigError(busy[0].told(), hint="stop what holds the ports, then try again")


def is_free(port: int, host: str = "127.0.0.1") -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            sock.bind((host, port))
        except OSError:
            return False
    return True


def free_ports(count: int) -> list[int]:
    """So many different ports of loopback that nobody uses now."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [sock.getsockname()[1] for sock in sockets]
    for sock in sockets:
        sock.close()
    return ports


def holder(port: int) -> str:
    """`pid 123 (python -m http.server)`; Linux only, and only what this user may see."""
    inodes = _listening_inodes(port)
    for pid in (entry for entry in _listdir("/proc") if entry.isdigit()):
        for handle in _listdir(f"/proc/{pid}/fd"):
            try:
                target = os.readlink(f"/proc/{pid}/fd/{handle}")
            except OSError:
                continue
            if target.removeprefix("socket:[").removesuffix("]") in inodes:
                return f"pid {pid} ({_command(pid)})"
    return "another process"


def _listening_inodes(port: int) -> set[str]:
    inodes = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        try:
            lines = Path(table).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            cells = line.split()
            if cells[3] == _LISTENING and int(cells[1].rpartition(":")[2], 16) == port:
                inodes.add(cells[9])
    return inodes


def _command(pid: str) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return "?"
    return b" ".join(words).decode(errors="replace").strip()[:80]


def _listdir(path: str) -> list[str]:
    try:
        return os.listdir(path)
    except OSError:
        return []
