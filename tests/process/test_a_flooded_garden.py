"""Real services on hosts that hear their neighbours only, without routing: a pot is served all the same."""

from __future__ import annotations

import json
import sys
import time
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
from namespaces import Namespaces, unable, until

from console import toml
from console.processes import Place, World, enrolled, peers_of, ports_of, processes
from console.runner import environment
from core.mesh.auth import make_garden
from core.scenario import Scenario
from lab import story

pytestmark = [pytest.mark.soak, pytest.mark.alone]
SPEED = 2.0
LINE = ["plant-1", "plant-2", "robot-1", "station"]
"""Everybody hears who stands beside it here."""
HOPS = 3
SERVED_WITHIN_S = 150.0


def scenario() -> Scenario:
    return story.water_only(story.garden_of(("plant-1",), ("plant-2",), (story.near_robot(),)))


class Hosts:
    """The garden's hosts: a wire to the world and to whoever watches, and links between neighbours that carry all else."""

    def __init__(self, mesh: Namespaces) -> None:
        self.mesh, self.garden = mesh, scenario()
        self.hosts = {name: number for number, name in enumerate(["sim", *LINE], 1)}
        self.ports = ports_of(self.garden)
        mesh.build(self.hosts.values(), [])
        self._wires()
        for one, other in pairwise(LINE):
            a, b = self.hosts[one], self.hosts[other]
            mesh.link(a, b)
            for here, there in ((a, b), (b, a)):
                mesh.ip(here, "route", "add", f"{mesh.address(there)}/32", "dev", f"to{there}", "src", mesh.address(here))
        for number in self.hosts.values():
            mesh.inside(number, "sysctl", "-qw", "net.ipv4.ip_forward=0")

    def _wires(self) -> None:
        mesh, world = self.mesh, self.hosts["sim"]
        mesh.ip(world, "link", "add", "wires", "type", "bridge")
        mesh.ip(world, "link", "set", "wires", "up")
        mesh.ip(world, "addr", "add", f"{self.wire('sim')}/24", "dev", "wires")
        for name in LINE:
            number = self.hosts[name]
            mesh.link(world, number)
            mesh.ip(world, "link", "set", f"to{number}", "master", "wires")
            mesh.ip(number, "addr", "add", f"{self.wire(name)}/24", "dev", f"to{world}")

    def wire(self, name: str) -> str:
        return f"10.78.0.{self.hosts[name]}"

    def url(self, name: str) -> str:
        """By radio."""
        return f"http://{self.mesh.address(self.hosts[name])}:{self.ports[name]}"

    def start(self, hops: int) -> None:
        root = self.mesh.folder
        place = Place(
            data=lambda name: PurePosixPath(root / "data" / name),
            keys=lambda name: PurePosixPath(root / "keys" / name),
            socket=lambda robot: f"unix://{root}/{robot}.sock",
            host=lambda name: self.wire("sim") if name in ("sim", "console") else self.mesh.address(self.hosts[name]),
            bind="0.0.0.0",
            scenario=str(root / "scenario.toml"),
        )
        (root / "scenario.toml").write_text(toml.dump(self.garden))
        make_garden(root / "keys", enrolled(self.garden), time.time())
        peers = {peer.id: peer.model_dump() for peer in peers_of(self.garden, place.host)}
        for process in processes(self.garden, place, World(speed=SPEED)):
            if process.kind == "console":
                continue
            env = environment(process) | {"PLANT_SOAK_S": f"{story.SOAK_S:g}"}
            if process.name in LINE:
                at = LINE.index(process.name)
                reach = [peers[name] for name in LINE[max(0, at - 1) : at + 2] if name != process.name]
                env |= {"GARDEN_PEERS": json.dumps(reach), "GARDEN_FLOOD_HOPS": str(hops)}
            (root / "data" / process.name).mkdir(parents=True)
            host = self.hosts[process.keys]
            self.mesh.start(host, [sys.executable, "-m", process.module], f"{process.name}.log", env)

    def get(self, name: str, path: str) -> Any:
        """Over the wire, from the world's host; None while nobody answers."""
        return self.mesh.ask(self.hosts["sim"], f"http://{self.wire(name)}:{self.ports[name]}{path}")


def test_a_pot_is_served_by_a_robot_that_only_its_neighbour_hears(tmp_path: Path) -> None:
    if why := unable():
        pytest.skip(why)
    with Namespaces(tmp_path, "fld") as mesh:
        hosts = Hosts(mesh)
        hosts.start(HOPS)

        def ended() -> bool:
            tasks = hosts.get("plant-1", "/tasks") or [{}]
            return tasks[0].get("state") in ("done", "failed", "cancelled")

        took_s = until(ended, SERVED_WITHIN_S, "plant-1's task ends")
        (task, *_) = hosts.get("plant-1", "/tasks")
        print(f"served after {took_s:.0f} s, {task['updated_s'] - task['created_s']:.0f} garden s")
        assert (task["state"], task["robot_id"], task["permits"], task["epoch"]) == ("done", "robot-1", 1, 1), task["events"]
        for one, other, way in (
            ("plant-1", "robot-1", ["plant-2", "robot-1"]),
            ("robot-1", "plant-1", ["plant-2", "plant-1"]),
        ):
            assert mesh.ask(hosts.hosts[one], hosts.url(other) + "/healthz") is None, "they hear each other"
            (seen,) = [peer for peer in hosts.get(one, "/peers") if peer["id"] == other]
            assert (seen["source"], seen["hops"], seen["way"]) == ("flood", 2, way)
        truth = hosts.get("sim", "/truth")
        (poured_ml,) = [pot["poured_ml"] for pot in truth["plants"] if pot["id"] == "plant-1"]
        assert 0.5 * story.DOSE_ML < poured_ml <= 1.05 * story.DOSE_ML
        assert truth["spilt_ml"] == 0.0
