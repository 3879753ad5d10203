"""Runs a list of processes: starts them, watches them, starts again what died, ends all of them."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from console.processes import Process
from core.errors import ConfigError

_PR_SET_PDEATHSIG = 1
BACKOFF_S = (0.3, 10.0)
STEADY_S = 30.0
"""A process that lived this long starts again without delay growing."""
TRIES = 3
"""Deaths before it was ever ready, after which starting is given up."""
GRACE_S = 5.0
OURS = ("GARDEN_", "SIM_", "PLANT_", "ROBOT_", "BODY_", "CONSOLE_")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

Tell = Callable[[str, str], None]
"""Called with a process's name and what happened to it."""


@dataclass(slots=True)
class Child:
    """One process through all its lives."""

    process: Process
    log: Path
    running: asyncio.subprocess.Process | None = None
    ready: bool = False
    deaths: int = 0
    born_s: float = 0.0
    wanted: asyncio.Event = field(default_factory=asyncio.Event)
    """Cleared while it is to stay down."""

    def __post_init__(self) -> None:
        self.wanted.set()


@dataclass(slots=True)
class Runner:
    """`run` holds the processes up until cancelled; `ready` is called by who has seen one answer."""

    processes: Sequence[Process]
    logs: Path
    tell: Tell
    children: dict[str, Child] = field(default_factory=dict)

    async def run(self) -> None:
        """Raises ConfigError when a process dies again and again before it is ready."""
        self.logs.mkdir(parents=True, exist_ok=True)
        self.children = {p.name: Child(p, self.logs / f"{p.name}.log") for p in self.processes}
        try:
            async with asyncio.TaskGroup() as group:
                for child in self.children.values():
                    group.create_task(self._keep(child))
        finally:
            await asyncio.shield(self._end())

    def kill(self, name: str) -> int:
        """SIGKILL one process, and keep it down until `start`; the pid it had. Raises ConfigError when it does not run."""
        child = self.children[name]
        if child.running is None or child.running.returncode is not None:
            raise ConfigError(f"{name} does not run", hint=f"see {child.log}")
        child.wanted.clear()
        child.ready = False
        child.running.kill()
        return child.running.pid

    def start(self, name: str) -> None:
        """Let a process that was killed live again."""
        self.children[name].deaths = 0
        self.children[name].wanted.set()

    async def _keep(self, child: Child) -> None:
        """Start, wait for the end, wait a little longer each time, start again."""
        delay_s = BACKOFF_S[0] / 2
        while True:
            code = await self._live(child)
            child.deaths += 1
            if not child.ready and child.deaths >= TRIES:
                raise ConfigError(f"{child.process.name} does not start:\n{tail(child.log)}", hint=f"all of it: {child.log}")
            lived_s = asyncio.get_running_loop().time() - child.born_s
            delay_s = BACKOFF_S[0] if lived_s > STEADY_S else min(delay_s * 2, BACKOFF_S[1])
            if child.wanted.is_set():
                self.tell(child.process.name, f"ended ({ending(code)}), starting again in {delay_s:.1f} s")
                await asyncio.sleep(delay_s)
            await child.wanted.wait()

    async def _live(self, child: Child) -> int:
        child.born_s = asyncio.get_running_loop().time()
        with child.log.open("ab") as log:
            child.running = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                child.process.module,
                env=environment(child.process) | ({"SIM_FRESH": "false"} if child.deaths else {}),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=_die_with(os.getpid()),
            )
        return await child.running.wait()

    async def _end(self) -> None:
        """Ask everybody to end, world last to be missed; kill who does not."""
        alive = [child.running for child in self.children.values() if child.running and child.running.returncode is None]
        for running in alive:
            _signal(running.pid, signal.SIGTERM)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GRACE_S):
                await asyncio.gather(*(running.wait() for running in alive))
        for running in alive:
            _signal(running.pid, signal.SIGKILL)
        await asyncio.gather(*(running.wait() for running in alive))


def _signal(pid: int, number: int) -> None:
    """To the whole group, so that no grandchild is left."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, number)


def _die_with(parent: int) -> Callable[[], None]:
    """For the child before it becomes itself: end when the runner does, even if that was killed."""
    libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None

    def prepare() -> None:
        if libc is not None:
            libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
            if os.getppid() != parent:
                os._exit(1)

    return prepare


def environment(process: Process) -> dict[str, str]:
    """The runner's environment without settings meant for other services, plus the process's own."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(OURS)}
    return kept | ONE_THREAD | process.env


def ending(code: int) -> str:
    return f"by {signal.Signals(-code).name}" if code < 0 else f"status {code}"


def tail(path: Path, lines: int = 5) -> str:
    """The last lines of a log, each cut to a readable length."""
    try:
        return "\n".join(line[:400] for line in path.read_text(errors="replace").splitlines()[-lines:])
    except OSError:
        return "(no log)"
