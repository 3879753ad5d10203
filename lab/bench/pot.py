"""`garden bench pot`: a pot's process over HTTP beside the paper's pot (lighttpd and PHP over CGI), interleaved.

Eight connections read the inventory and add fruits, every added fruit being durable before its answer. The pot is the
real process with its keys and a soil probe on a socket. Without lighttpd and php-cgi the peer's rows say so.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

from console.ports import free_ports
from core.clock import WallClock
from core.mesh.auth import Enrolled, make_garden
from sim.devices.bench_firmata import bench_emulator
from sim.devices.host import EmulatorHost

CONNECTIONS = 8
REQUESTS = 4000
"""A burst, over all connections."""
GET_RATIO_MIN, POST_RATIO_MIN = 2.0, 1.5
RSS_MB_MAX, READY_S_MAX = 90.0, 1.5
FRUIT = json.dumps({"colour": "red", "x_m": 0.1, "y_m": 0.0, "z_m": 0.3, "radius_m": 0.014}).encode()
Row = dict[str, Any]


def bench_pot(n: int = 5) -> list[Row]:
    """Rows `{name, ours, peer, ratio, unit, n}`: medians of `n` bursts (ratio = ours / peer), start and memory."""
    return asyncio.run(_bench(n))


async def _bench(n: int) -> list[Row]:
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pot-bench-")))
        pot = await stack.enter_async_context(running_pot(folder, {}))
        peer = await stack.enter_async_context(_peer(folder))
        rates: dict[str, list[float]] = {}
        p99: dict[str, list[float]] = {}
        for _ in range(n):
            for name, served in (("ours", pot), ("peer", peer)):
                if served is not None:
                    for verb, (rate, slow_ms) in (await _bursts(served)).items():
                        rates.setdefault(f"{verb}/{name}", []).append(rate)
                        p99.setdefault(f"{verb}/{name}", []).append(slow_ms)
        rows = [_row(f"pot/{verb} per s", rates, verb, n, bar) for verb, bar in _BARS]
        rows.append(_row("pot/POST p99", p99, "POST", n, None, unit="ms"))
        idle_ratio = await _idle(pot["pid"])
    limits = [("pot/ready", pot["ready_s"], "s", READY_S_MAX), ("pot/memory", pot["rss_mb"], "MB", RSS_MB_MAX)]
    rows += [_limit(name, value, unit, most) for name, value, unit, most in limits]
    rows.append({"name": "pot/idle", "ours": idle_ratio, "peer": None, "ratio": None, "unit": "cores", "n": 1})
    return rows


_BARS = (("GET", GET_RATIO_MIN), ("POST", POST_RATIO_MIN))


async def _bursts(served: dict[str, Any]) -> dict[str, tuple[float, float]]:
    get = _request("GET", served["get"], b"", "")
    post = _request("POST", served["post"], FRUIT, served.get("token", ""))
    return {"GET": await _burst(served["port"], get), "POST": await _burst(served["port"], post)}


def _request(verb: str, path: str, body: bytes, token: str) -> bytes:
    head = [f"{verb} {path} HTTP/1.1", "Host: pot", f"Content-Length: {len(body)}", "Content-Type: application/json"]
    if token:
        head.append(f"Authorization: Bearer {token}")
    return "\r\n".join(head).encode() + b"\r\n\r\n" + body


async def _burst(port: int, request: bytes) -> tuple[float, float]:
    """Requests a second over all connections, and the 99th percentile of one [ms]."""
    taken_ms: list[float] = []
    began = time.perf_counter()
    await asyncio.gather(*(_one(port, request, REQUESTS // CONNECTIONS, taken_ms) for _ in range(CONNECTIONS)))
    passed_s = time.perf_counter() - began
    return len(taken_ms) / passed_s, statistics.quantiles(taken_ms, n=100)[98]


async def _one(port: int, request: bytes, count: int, taken_ms: list[float]) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    for _ in range(count):
        began = time.perf_counter()
        writer.write(request)
        head = await reader.readuntil(b"\r\n\r\n")
        status = int(head[9:12])
        if not 200 <= status < 300:
            raise RuntimeError(f"the benched pot answered {status}")
        await _body(reader, head.lower())
        taken_ms.append((time.perf_counter() - began) * 1000)
    writer.close()
    await writer.wait_closed()


async def _body(reader: asyncio.StreamReader, head: bytes) -> None:
    if b"content-length:" in head:
        await reader.readexactly(int(head.split(b"content-length:")[1].split(b"\r\n")[0]))
        return
    while (size := int(await reader.readline(), 16)) > 0:
        await reader.readexactly(size + 2)
    await reader.readline()


@asynccontextmanager
async def running_pot(folder: Path, more: Mapping[str, str]) -> AsyncIterator[dict[str, Any]]:
    """Our pot as a process with `more` settings: where it is, how long until it was ready, what it takes."""
    make_garden(folder / "keys", [Enrolled("plant-1", "plant")], time.time())
    board = EmulatorHost(bench_emulator(1), WallClock())
    server = await board.serve_tcp("127.0.0.1", 0)
    firmware = asyncio.create_task(board.run())
    (port,) = free_ports(1)
    began = time.perf_counter()
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "plant_service",
        env=_environment(folder, port, server.sockets[0].getsockname()[1]) | dict(more),
        stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    try:
        await _until(lambda: _answers(port, "/readyz"), 30.0)
        ready_s = time.perf_counter() - began
        token = (folder / "keys" / "operator" / "token").read_text().strip()
        yield {
            "port": port, "get": "/inventory", "post": "/inventory/fruits", "token": token, "pid": process.pid,
            "ready_s": ready_s, "rss_mb": rss_mb(process.pid),
        }  # fmt: skip
    finally:
        await _end(process)
        firmware.cancel()
        server.close()
        await board.close()


def _environment(folder: Path, port: int, probe_port: int) -> dict[str, str]:
    pose = json.dumps({"x_m": 0.55, "y_m": 0.0, "yaw_rad": 3.1})
    return os.environ | {
        "GARDEN_KEYS": str(folder / "keys" / "plant-1"), "GARDEN_PORT": str(port), "PLANT_ID": "plant-1",
        "PLANT_URL": f"http://127.0.0.1:{port}", "PLANT_DATA": str(folder / "data"), "PLANT_DOCK": pose,
        "PLANT_STEM": json.dumps({"x_m": 0.0, "y_m": 0.0, "z_m": 0.25}), "PLANT_THRESHOLD_RATIO": "0.1",
        "PLANT_PROBE_URL": f"socket://127.0.0.1:{probe_port}?pin=0",
    }  # fmt: skip


_PHP = """<?php
$file = '%s';
if ($_SERVER['REQUEST_METHOD'] === 'POST') {
  $document = json_decode(file_exists($file) ? file_get_contents($file) : '{"fruits":[]}', true);
  $document['fruits'][] = json_decode(file_get_contents('php://input'), true);
  $document['fruits'] = array_slice($document['fruits'], -500);
  $temporary = $file . '.' . getmypid();
  $out = fopen($temporary, 'w');
  fwrite($out, json_encode($document)); fflush($out); if (function_exists('fsync')) fsync($out); fclose($out);
  rename($temporary, $file);
}
header('Content-Type: application/json');
readfile($file);
"""
_LIGHTTPD = """server.document-root = "{folder}"
server.port = {port}
server.bind = "127.0.0.1"
server.modules = ("mod_fastcgi")
fastcgi.server = (".php" => (("bin-path" => "{php}", "socket" => "{folder}/php.sock", "max-procs" => 1,
  "bin-environment" => ("PHP_FCGI_CHILDREN" => "3", "PHP_FCGI_MAX_REQUESTS" => "100000"))))
"""


@asynccontextmanager
async def _peer(folder: Path) -> Any:
    """The paper's pot, or None when it is not installed."""
    lighttpd, php = shutil.which("lighttpd"), shutil.which("php-cgi")
    if lighttpd is None or php is None:
        yield None
        return
    home, (port,) = folder / "peer", free_ports(1)
    home.mkdir()
    (home / "inventory.json").write_text('{"fruits":[]}')
    (home / "index.php").write_text(_PHP % (home / "inventory.json"))
    (home / "lighttpd.conf").write_text(_LIGHTTPD.format(folder=home, port=port, php=php))
    process = await asyncio.create_subprocess_exec(lighttpd, "-D", "-f", str(home / "lighttpd.conf"))
    try:
        await _until(lambda: _answers(port, "/index.php"), 10.0)
        yield {"port": port, "get": "/index.php", "post": "/index.php"}
    finally:
        await _end(process)


async def _answers(port: int, path: str) -> bool:
    try:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET {path} HTTP/1.1\r\nHost: pot\r\nConnection: close\r\n\r\n".encode())
        status = (await reader.readline())[9:12]
        writer.close()
        return status == b"200"
    except OSError:
        return False


async def _until(true: Callable[[], Awaitable[bool]], within_s: float) -> None:
    async with asyncio.timeout(within_s):
        while not await true():  # noqa: ASYNC110
            await asyncio.sleep(0.01)


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.send_signal(signal.SIGTERM)
    await process.wait()


async def _idle(pid: int, over_s: float = 5.0) -> float:
    """Cores the idle pot takes."""

    def used_s() -> float:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    before_s = used_s()
    await asyncio.sleep(over_s)
    return (used_s() - before_s) / over_s


def rss_mb(pid: int) -> float:
    """What a process has in memory now."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return float("nan")


def _row(name: str, seen: dict[str, list[float]], verb: str, n: int, bar: float | None, unit: str = "1/s") -> Row:
    ours = statistics.median(seen[f"{verb}/ours"])
    row: Row = {"name": name, "ours": ours, "peer": None, "ratio": None, "unit": unit, "n": n}
    if f"{verb}/peer" not in seen:
        return row | {"missing": "lighttpd and php-cgi are not installed"}
    peer = statistics.median(seen[f"{verb}/peer"])
    row |= {"peer": peer, "ratio": ours / peer}
    return row if bar is None else row | {"target": f"ratio >= {bar:g}", "ok": ours / peer >= bar}


def _limit(name: str, value: float, unit: str, most: float) -> Row:
    row: Row = {"name": name, "ours": value, "peer": None, "ratio": None, "unit": unit, "n": 1}
    return row | {"target": f"<= {most:g}", "ok": value <= most}
