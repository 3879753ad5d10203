"""`python -m robot_service`: one robot's brain as a process. Settings: `ROBOT_...` and `GARDEN_...`."""

from __future__ import annotations

import random

import httpx
from pydantic import ValidationError

from core.errors import ConfigError
from core.mesh.node import Node
from core.mesh.runtime import Runtime, key_folder, run
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
        cameras=httpx.AsyncHTTPTransport(verify=by_address(key_folder(runtime.settings))) if runtime.settings.tls else None,
    )


def main() -> None:
    run(make)


if __name__ == "__main__":
    main()
