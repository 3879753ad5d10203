"""`python -m sim`: the world as a process. Options set the variables that `docs/simulator.md` lists."""

from __future__ import annotations

import argparse
import os

from core.errors import ConfigError
from core.mesh.runtime import run
from core.scenario import find
from sim.service import build

OPTIONS = {
    "scenario": ("SIM_SCENARIO", "a built-in scenario's name, or a path"),
    "seed": ("SIM_SEED", "instead of the scenario's"),
    "speed": ("SIM_SPEED", "garden seconds a second"),
    "data": ("SIM_DATA", "folder for checkpoints"),
    "keys": ("GARDEN_KEYS", "the world's own key folder"),
    "host": ("GARDEN_HOST", "address to listen on"),
    "port": ("GARDEN_PORT", "HTTP port; the scenario's if not given"),
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m sim", description="The simulated garden.")
    for name, (variable, text) in OPTIONS.items():
        parser.add_argument(f"--{name}", help=f"{text} (else ${variable})")
    parser.add_argument("--fresh", action="store_true", help="begin anew although there is a checkpoint")
    given = vars(parser.parse_args())
    for name, (variable, _) in OPTIONS.items():
        if given[name] is not None:
            os.environ[variable] = given[name]
    if given["fresh"]:
        os.environ["SIM_FRESH"] = "true"
    if "GARDEN_PORT" not in os.environ:
        os.environ["GARDEN_PORT"] = str(_scenario_port(parser))
    run(build)


def _scenario_port(parser: argparse.ArgumentParser) -> int:
    try:
        return find(os.environ.get("SIM_SCENARIO", "garden")).ports.sim
    except ConfigError as error:
        parser.error(f"{error} ({error.hint})")


if __name__ == "__main__":
    main()
