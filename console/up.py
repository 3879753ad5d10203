"""`garden up`: the whole scenario as local processes."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import os
import signal
import ssl
import sys
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import httpx
from pydantic import ValidationError

from console import toml
from console.folder import Folder
from console.ports import taken
from console.processes import Process, World, processes
from console.runner import Runner
from core import scenario as scenarios
from core.clock import WallClock
from core.errors import ConfigError, GardenError
from core.mesh.chassis import Readiness
from core.mesh.client import Mesh
from core.mesh.peers import Peer, Peers
from core.mesh.tls import AUTHORITY
from core.scenario import Scenario
from core.wire.documents import HistoryEntry

READY_WITHIN_S = 120.0
POLL_S = 0.15
TELL_S = 8.0
QUIET = frozenset({"soil", "measured", "probe", "tap"})
"""Kinds of events too frequent to be told to a person."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What was asked for on the command line."""

    scenario: str
    folder: Folder
    world: World
    shift: int = 0
    tls: bool = False
    as_json: bool = False


class Voice:
    """Tells a person, or with `--json` a program: one JSON object a line. Goes on when nobody listens any more."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._heard = True

    def say(self, text: str, **document: object) -> None:
        if not self._heard:
            return
        try:
            print(json.dumps(document or {"note": text}) if self._as_json else text, flush=True)
        except BrokenPipeError:
            self._heard = False
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def up(wish: Wish) -> None:
    """Start everything, tell what happens, end on SIGINT or SIGTERM; raises ConfigError when it cannot start."""
    scenario = prepared(wish)
    with only_one(wish.folder):
        listed = processes(scenario, wish.folder.place(), wish.world)
        if busy := taken(listed):
            told = "; ".join(port.told() for port in busy[:4])
            raise ConfigError(told, hint="stop it, or move ours: --shift 100 (or [ports] in the scenario file)")
        wish.folder.enrol(scenario)
        wish.folder.remember(scenario)
        for process in listed:
            (wish.folder.root / process.name).mkdir(parents=True, exist_ok=True)
        try:
            asyncio.run(_up(wish, scenario, listed))
        except* GardenError as errors:
            raise _first(errors) from None


def _first(group: BaseExceptionGroup[GardenError]) -> GardenError:
    error = group.exceptions[0]
    return _first(error) if isinstance(error, BaseExceptionGroup) else error


def prepared(wish: Wish) -> Scenario:
    """The scenario as it will run, written to the data folder; raises ConfigError naming every mistake."""
    scenario = scenarios.find(wish.scenario, wish.tls)
    try:
        scenario = toml.shifted(scenario, wish.shift)
    except ValidationError as error:
        raise ConfigError(f"--shift {wish.shift} moves a port out of range", hint="ports lie in 1024..65000") from error
    wish.folder.root.mkdir(parents=True, exist_ok=True)
    wish.folder.scenario_file.write_text(toml.dump(scenario))
    return scenario


@contextlib.contextmanager
def only_one(folder: Folder) -> Iterator[None]:
    """Hold the data folder; raises ConfigError when another garden runs in it."""
    with (folder.root / "garden.lock").open("a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            told = f"pid {lock.read().strip() or '?'} already runs a garden in {folder.root}"
            raise ConfigError(told, hint="end it with Ctrl-C there, or take another --data DIR and --shift 100") from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        yield


async def _up(wish: Wish, scenario: Scenario, listed: Sequence[Process]) -> None:
    voice = Voice(wish.as_json)
    told = f"Starting {len(listed)} processes of {scenario.name!r}; logs in {wish.folder.logs}"
    voice.say(told, starting=[process.name for process in listed])
    runner = Runner(listed, wish.folder.logs, lambda name, what: voice.say(f"{name} {what}", process=name, what=what))
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, ended.set)
    async with asyncio.TaskGroup() as group:
        work = [group.create_task(runner.run()), group.create_task(_greet(wish, scenario, runner, voice))]
        await ended.wait()
        voice.say("Ending ...", ending=True)
        for task in work:
            task.cancel()
    voice.say("All processes have ended.", ended=True)


async def _greet(wish: Wish, scenario: Scenario, runner: Runner, voice: Voice) -> None:
    """Wait until everybody answers, say so, then tell what the pots tell."""
    ours = {process.name for process in runner.processes}
    peers = {peer.id: peer for peer in wish.folder.peers_written() if peer.id in ours}
    mesh = Mesh(wish.folder.transport(Peers(peers.values())), None, WallClock(), timeout_s=5.0)
    began_s = asyncio.get_running_loop().time()
    try:
        async with asyncio.timeout(READY_WITHIN_S), asyncio.TaskGroup() as group:
            for name, peer in peers.items():
                group.create_task(_wait_ready(mesh, name, peer, runner, voice, began_s))
            group.create_task(_tell_late(peers, runner, voice))
    except TimeoutError:
        late = ", ".join(name for name in peers if not runner.children[name].ready)
        raise ConfigError(f"not ready after {READY_WITHIN_S:g} s: {late}", hint=f"see {wish.folder.logs}") from None
    finally:
        await mesh.aclose()
    for child in runner.children.values():
        child.ready = True
    _say_ready(wish, scenario, peers, voice, asyncio.get_running_loop().time() - began_s)
    pots = [peer for peer in peers.values() if peer.kind in ("plant", "station")]
    await tell_events(pots, voice, wish.folder.trusted() if scenario.tls else None)


async def _wait_ready(mesh: Mesh, name: str, peer: Peer, runner: Runner, voice: Voice, began_s: float) -> None:
    while not runner.children[name].ready:
        with contextlib.suppress(GardenError):
            await mesh.call(peer, "GET", "/readyz", expect=Readiness)
            runner.children[name].ready = True
            break
        await asyncio.sleep(POLL_S)
    seconds = asyncio.get_running_loop().time() - began_s
    voice.say(f"  {name:<12} ready after {seconds:4.1f} s   {peer.url}", ready=name, url=peer.url, seconds=round(seconds, 2))


async def _tell_late(peers: Iterable[str], runner: Runner, voice: Voice) -> None:
    """A word now and then, so that nobody thinks it hangs."""
    last = asyncio.get_running_loop().time()
    while late := [name for name in peers if not runner.children[name].ready]:
        await asyncio.sleep(POLL_S)
        if asyncio.get_running_loop().time() - last > TELL_S:
            last += TELL_S
            voice.say(f"  still starting: {', '.join(late)}", starting=late)


def _say_ready(wish: Wish, scenario: Scenario, peers: dict[str, Peer], voice: Voice, seconds: float) -> None:
    plant = next((peer for peer in peers.values() if peer.kind == "plant"), peers[scenario.station.id])
    robot = scenario.robots[0].id
    data = "" if wish.folder.root == Path("data") else f" --data {wish.folder.root}"
    curl = f"curl --cacert {wish.folder.keys / AUTHORITY} -s" if scenario.tls else "curl -s"
    lines = [
        f"Garden ready after {seconds:.1f} s. Ctrl-C ends it.",
        f"  the garden in a browser:  {peers['console'].url}",
        f"  the world from above:     {peers['sim'].url}/overview.jpg",
        f"  {curl} {plant.url}/state",
        f"  {curl} {peers[robot].url}/state",
        f'  {curl} -X POST {plant.url}/tasks -H "Authorization: Bearer $(.venv/bin/garden token{data})"'
        ' -d \'{"kind": "water", "dose_ml": 100}\'',
    ]
    urls = {peer.id: peer.url for peer in peers.values()}
    voice.say("\n".join(lines), garden="ready", urls=urls, seconds=round(seconds, 2))


async def tell_events(peers: Sequence[Peer], voice: Voice, tls: ssl.SSLContext | None = None) -> None:
    """Follow the event streams of `peers` for ever."""
    patience = httpx.Timeout(5.0, read=60.0)
    async with httpx.AsyncClient(timeout=patience, verify=tls or True) as http, asyncio.TaskGroup() as group:
        for peer in peers:
            group.create_task(_tell(http, peer, voice))


async def _tell(http: httpx.AsyncClient, peer: Peer, voice: Voice) -> None:
    last = ""
    while True:
        with contextlib.suppress(httpx.HTTPError, ValidationError):
            async for entry in _events(http, peer, last):
                last = str(entry.id)
                if entry.kind not in QUIET:
                    voice.say(f"{entry.t_s:9.1f} s  {peer.id:<9} {entry.what}", event=entry.model_dump(), node=peer.id)
        await asyncio.sleep(1.0)


async def _events(http: httpx.AsyncClient, peer: Peer, last: str) -> AsyncIterator[HistoryEntry]:
    headers = {"last-event-id": last} if last else {}
    query = "" if last else "?after=0"
    async with http.stream("GET", f"{peer.url}/events{query}", headers=headers) as response:
        response.raise_for_status()
        async for line in response.aiter_lines():
            if line.startswith("data: "):
                yield HistoryEntry.model_validate_json(line.removeprefix("data: "))
