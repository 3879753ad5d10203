"""`python -m plant_service`: a pot or a station as a process."""

from __future__ import annotations

from random import Random

from pydantic import ValidationError

from core.errors import ConfigError
from core.mesh.node import Node
from core.mesh.runtime import Runtime, run
from hw.links import open_link
from plant_service.node import build
from plant_service.settings import PlantSettings


async def start(runtime: Runtime) -> Node:
    """The node this process's environment describes; raises ConfigError naming every wrong variable."""
    try:
        settings = PlantSettings()
    except ValidationError as error:
        told = "; ".join(f"PLANT_{'.'.join(map(str, e['loc'])).upper()}: {e['msg']}" for e in error.errors())
        raise ConfigError(told, hint="see docs/pot.md") from error
    common = runtime.settings
    return build(
        settings, runtime.clock, open_link, runtime.transport, Random(common.seed), identity=runtime.identity,
        verifier=runtime.verifier, peers=runtime.peers, open_reads=common.open_reads,
    )  # fmt: skip


def main() -> None:
    run(start)


if __name__ == "__main__":
    main()
