"""`python -m robot_service`: one robot's brain as a process. Settings: `ROBOT_...` and `GARDEN_...`."""

from __future__ import annotations

import random

import httpx
from pydantic import ValidationError

from core.errors import ConfigError
from core.mesh.node import Node
from core.mesh.runtime import GardenSettings, Runtime, key_folder, reading, run
from core.mesh.tls import by_address
from hw.links import open_link
from robot_service.brain import build
from robot_service.settings import RobotSettings


async def make(runtime: Runtime) -> Node:
    try:
        settings = RobotSettings()
    except ValidationError as error:
        told = "; ".join(f"ROBOT_{'.'.join(map(str, e['loc'])).upper()}: {e['msg']}" for e in error.errors())
        raise ConfigError(told, hint="see docs/robot.md") from None
    keys = runtime.settings.keys
    if not settings.body_secret and settings.body_secret_file is None and keys is not None:
        settings = settings.model_copy(update={"body_secret_file": keys / "body.secret"})
    return build(
        settings,
        runtime.clock,
        open_link,
        runtime.transport,
        random.Random(f"{runtime.settings.seed}:{settings.id}"),
        identity=runtime.identity,
        verifier=runtime.verifier,
        peers=runtime.peers,
        open_reads=runtime.settings.open_reads,
        cameras=_cameras(runtime.settings),
    )


class _Shown(httpx.AsyncBaseTransport):
    """Shows this node's token to the world; no other camera is shown it."""

    def __init__(self, inner: httpx.AsyncBaseTransport, world: str, headers: dict[str, str]) -> None:
        self._inner, self._world, self._headers = inner, httpx.URL(world), headers

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        if _origin(request.url) == _origin(self._world):
            request.headers.update(self._headers)
        return await self._inner.handle_async_request(request)

    async def aclose(self) -> None:
        await self._inner.aclose()


def _origin(url: httpx.URL) -> tuple[str, str, int | None]:
    return url.scheme, url.host, url.port


def _cameras(settings: GardenSettings) -> httpx.AsyncBaseTransport | None:
    """The way to its cameras; None for plain HTTP that shows nothing."""
    closed = not settings.open_reads
    if not settings.tls and not closed:
        return None
    trusted = by_address(key_folder(settings), show=closed) if settings.tls else True
    inner = httpx.AsyncHTTPTransport(verify=trusted)
    return _Shown(inner, settings.clock, reading(settings)) if closed and settings.clock != "wall" else inner


def main() -> None:
    run(make)


if __name__ == "__main__":
    main()
