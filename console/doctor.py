"""`garden doctor`: looks at everything a garden needs, and says in one line each what it found."""

from __future__ import annotations

import asyncio
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator
from ctypes.util import find_library
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

from console.ask import open_line
from console.folder import Folder
from console.ports import holder, is_free
from console.processes import processes
from core import scenario as scenarios
from core.errors import GardenError
from core.mesh.chassis import Readiness

MARKS = {"ok": "[green]ok  [/green]", "note": "[yellow]note[/yellow]", "bad": "[red]BAD [/red]"}
PACKAGES = ("numpy", "numba", "mujoco", "opencv-python-headless", "fastapi", "uvicorn", "pydantic", "pyserial")
TOOLS = {
    "cgi-pot": (("lighttpd", "php", "php-cgi", "curl", "flock"), "examples/cgi-pot: `make -C examples/cgi-pot install`"),
    "routing": (("babeld", "ip"), "finding peers by routes, and for its tests: `make debian`"),
    "tracing": (("strace",), "tests of failing system calls: `make debian`"),
}
"""Programs that the garden itself does without: what they are for, and how Debian gives them."""


@dataclass(frozen=True, slots=True)
class Finding:
    what: str
    state: str
    """`ok`, `note` or `bad`."""
    told: str


def doctor(data: Path, as_json: bool) -> None:
    """Print every finding; exit status 1 when one is bad."""
    findings = [*_machine(), *_packages(), *_folder(data), *asyncio.run(_services(data))]
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        console = Console(highlight=False)
        for finding in findings:
            console.print(f"{MARKS[finding.state]} {finding.what:<12} {finding.told}", soft_wrap=True)
    if any(finding.state == "bad" for finding in findings):
        sys.exit(1)


def _machine() -> Iterator[Finding]:
    fits = (3, 11) <= sys.version_info[:2] < (3, 14)
    yield Finding("python", "ok" if fits else "bad", f"{platform.python_version()} (3.11 to 3.13 is right)")
    yield Finding("processors", "ok" if (os.cpu_count() or 1) >= 2 else "note", f"{os.cpu_count()}")
    yield _drawing()
    docker = shutil.which("docker")
    told = (
        f"{docker}, DOCKER_HOST={os.environ.get('DOCKER_HOST') or 'default'}" if docker else "not found (only for compose)"
    )
    yield Finding("docker", "ok" if docker else "note", told)
    yield from _tools()


def _tools() -> Iterator[Finding]:
    places = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
    for what, (tools, use) in TOOLS.items():
        missing = [tool for tool in tools if shutil.which(tool, path=places) is None]
        told = f"missing: {', '.join(missing)} (only for {use})" if missing else f"found: {', '.join(tools)}"
        yield Finding(what, "note" if missing else "ok", told)


def _drawing() -> Finding:
    """What draws the cameras of a simulated garden; the overview is always ours."""
    if os.environ.get("MUJOCO_GL", "").lower() != "egl":
        return Finding("drawing", "ok", "built-in rasteriser; MUJOCO_GL=egl would draw the cameras with MuJoCo's renderer")
    needed = {"libEGL": find_library("EGL"), "PyOpenGL": importlib.util.find_spec("OpenGL")}
    missing = [name for name, found in needed.items() if found is None]
    if missing:
        return Finding("drawing", "note", f"built-in rasteriser, though MUJOCO_GL=egl: {' and '.join(missing)} not found")
    return Finding("drawing", "ok", "cameras on EGL by MuJoCo, as MUJOCO_GL says; the overview by the built-in rasteriser")


def _packages() -> Iterator[Finding]:
    missing, found = [], []
    for name in PACKAGES:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        yield Finding("packages", "bad", f"missing: {', '.join(missing)}; run `make install`")
    yield Finding("packages", "ok", ", ".join(found))
    cache = os.environ.get("NUMBA_CACHE_DIR")
    planning = importlib.util.find_spec("core.planning")
    where = Path(cache) if cache else Path((planning and planning.origin) or ".").parent / "__pycache__"
    warm = any(where.rglob("*.nbi")) if where.is_dir() else False
    told = (
        f"compiled code in {where}" if warm else f"{where} is empty: the first plan waits for a compiler; run `make install`"
    )
    yield Finding("numba", "ok" if warm else "note", told)


def _folder(data: Path) -> Iterator[Finding]:
    folder = Folder(data)
    try:
        data.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=data):
            pass
        free_gb = shutil.disk_usage(data).free / 1e9
        yield Finding("data", "ok" if free_gb > 0.5 else "bad", f"{data.resolve()}, {free_gb:.1f} GB free")
    except OSError as error:
        yield Finding("data", "bad", f"{data}: {error.strerror}; take another --data DIR")
    try:
        yield Finding("keys", "ok", f"operator's token in {folder.keys / folder.identity().subject}")
    except GardenError as error:
        yield Finding("keys", "note", f"{error}; `garden up` makes them, or {error.hint}")


async def _services(data: Path) -> list[Finding]:
    async with open_line(data) as line:
        answers = await line.mesh.ask_all(line.peers.all(), "GET", "/readyz", expect=Readiness)
    up = [name for name, answer in answers.items() if isinstance(answer, Readiness)]
    if not up:
        return [Finding("services", "note", "none runs here; `garden up` starts them"), *_ports(data)]
    down = {name: str(answer) for name, answer in answers.items() if isinstance(answer, GardenError)}
    findings = [Finding("services", "ok", f"ready: {', '.join(up)}")]
    return findings + [
        Finding("services", "bad", f"{name}: {why}; see {data}/logs/{name}.log") for name, why in down.items()
    ]


def _ports(data: Path) -> Iterator[Finding]:
    listed = processes(scenarios.find("garden"), Folder(data).place())
    wanted = [port for process in listed for port in (process.port, *process.devices) if port]
    busy = [port for port in wanted if not is_free(port)]
    if not busy:
        yield Finding("ports", "ok", f"all {len(wanted)} are free")
    for port in busy:
        yield Finding("ports", "bad", f"{port} is held by {holder(port)}; stop it, or `garden up --shift 100`")
