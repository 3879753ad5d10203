"""A node: an app and its loops, run as one process."""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field

from fastapi import FastAPI

from core.mesh.metrics import LoopLag, measure
from core.mesh.server import listen, make_server, on_signals

Loop = Callable[[], Awaitable[None]]


@dataclass(slots=True)
class Node:
    """What a service's `build` returns."""

    id: str
    kind: str
    app: FastAPI
    loops: Sequence[Loop] = field(default_factory=tuple)
    """Run for ever beside the server; whatever one raises ends the process. Each makes its devices safe in `finally`."""
    url: str = ""
    """Where others reach it; without one it is not announced."""


async def serve(
    node: Node,
    host: str,
    port: int,
    clock_loops: Sequence[Loop] = (),
    sock: socket.socket | None = None,
    tls: ssl.SSLContext | None = None,
) -> None:
    """Serve until SIGTERM or SIGINT; a loop that dies ends all, and its error is raised (as an ExceptionGroup)."""
    sock = sock or listen(host, port)
    server = make_server(node.app, tls)
    on_signals(server)
    lag = LoopLag()
    measure(node.app.state.registry, lag.readings)
    try:
        async with asyncio.TaskGroup() as group:
            loops = [group.create_task(_run(loop)) for loop in (*clock_loops, *node.loops, lag.run)]
            await server.serve(sockets=[sock])
            for task in loops:
                task.cancel()
    finally:
        sock.close()


async def _run(loop: Loop) -> None:
    await loop()
