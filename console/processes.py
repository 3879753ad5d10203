"""A scenario as a list of processes: what `garden up` runs here and `garden compose` writes out for containers."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Literal

from pydantic import BaseModel

from core.mesh.auth import Enrolled
from core.mesh.peers import Peer, PeerKind
from core.robots import gardener
from core.robots.fence import fence_of
from core.robots.garden_map import map_of
from core.scenario import Plant, Robot, Scenario, device_ports
from core.wire.geometry import Point3

Kind = Literal["sim", "plant", "station", "body", "robot", "console"]
SOCKET_PATH_MAX = 100
"""A unix socket's path has about this much room."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where the processes run: the addresses and folders they see."""

    data: Callable[[str], PurePosixPath]
    """A process's own folder."""
    keys: Callable[[str], PurePosixPath]
    """A node's own key folder."""
    socket: Callable[[str], str]
    """The URL of the stream between a robot's brain and its body."""
    host: Callable[[str], str] = lambda name: "127.0.0.1"
    """How others reach a process."""
    bind: str = "127.0.0.1"
    scenario: str = "garden"
    """What `SIM_SCENARIO` is told."""


@dataclass(frozen=True, slots=True)
class Process:
    """One process of the garden: `python -m module` with `env`."""

    name: str
    kind: Kind
    module: str
    env: dict[str, str]
    keys: str
    """The node whose key folder it reads."""
    port: int | None = None
    depends: tuple[str, ...] = ()
    """What must be ready before it can be; started no earlier in compose."""
    devices: tuple[int, ...] = field(default=(), repr=False)
    """TCP ports of simulated devices it also opens."""


@dataclass(frozen=True, slots=True)
class World:
    """How this run of the simulated world differs from its file."""

    seed: int | None = None
    speed: float | None = None
    fresh: bool = False


def ports_of(scenario: Scenario) -> dict[str, int]:
    """The HTTP port of every service by its name."""
    first = scenario.ports
    ports = {"sim": first.sim, scenario.station.id: first.station, "console": first.console}
    ports |= {plant.id: first.plants + row for row, plant in enumerate(scenario.plants)}
    return ports | {robot.id: first.robots + row for row, robot in enumerate(scenario.robots)}


def enrolled(scenario: Scenario) -> list[Enrolled]:
    """Every node of a scenario and its role, for `make_garden`."""
    plants = [Enrolled(plant.id, "plant") for plant in scenario.plants]
    robots = [Enrolled(robot.id, "robot", secret=True) for robot in scenario.robots]
    others = [Enrolled(scenario.station.id, "plant"), Enrolled("sim", "viewer"), Enrolled("console", "viewer")]
    return [*plants, *robots, *others]


def peers_of(scenario: Scenario, host: Callable[[str], str]) -> list[Peer]:
    """Everybody's address."""
    kinds: dict[str, PeerKind] = {"sim": "sim", scenario.station.id: "station", "console": "console"}
    kinds.update({plant.id: "plant" for plant in scenario.plants})
    kinds.update({robot.id: "robot" for robot in scenario.robots})
    ports, scheme = ports_of(scenario), "https" if scenario.tls else "http"
    return [Peer(id=name, kind=kind, url=f"{scheme}://{host(name)}:{ports[name]}") for name, kind in kinds.items()]


def processes(scenario: Scenario, place: Place, world: World | None = None) -> list[Process]:
    """The whole garden, the world first; without the pots that others start."""
    maker = _Maker(scenario, place)
    listed = [maker.sim(world or World())]
    listed += [maker.plant(plant) for plant in scenario.plants if not plant.external]
    listed.append(maker.station())
    for robot in scenario.robots:
        listed += [maker.body(robot), maker.brain(robot)]
    return [*listed, maker.console()]


class _Maker:
    def __init__(self, scenario: Scenario, place: Place) -> None:
        self._scenario, self._place = scenario, place
        self._ports = ports_of(scenario)
        self._devices = device_ports(scenario)
        self._peers = peers_of(scenario, place.host)
        self._urls = {peer.id: peer.url for peer in self._peers}

    def sim(self, world: World) -> Process:
        env = {"SIM_SCENARIO": self._place.scenario, "SIM_DATA": self._data("sim")}
        if world.seed is not None:
            env["SIM_SEED"] = str(world.seed)
        if world.speed is not None:
            env["SIM_SPEED"] = f"{world.speed:g}"
        if world.fresh:
            env["SIM_FRESH"] = "true"
        return self._process("sim", "sim", "sim", env, (), clock="wall", devices=tuple(self._devices.values()))

    def plant(self, plant: Plant) -> Process:
        stem = Point3(x_m=plant.x_m, y_m=plant.y_m, z_m=gardener.SOIL_HEIGHT_M)
        env = {
            "PLANT_ID": plant.id,
            "PLANT_KIND": "pot",
            "PLANT_URL": self._urls[plant.id],
            "PLANT_DATA": self._data(plant.id),
            "PLANT_STEM": _json(stem),
            "PLANT_DOCK": _json(plant.dock),
            "PLANT_PROBE_URL": f"{self._device(plant.id + '.soil')}?pin=0",
            "PLANT_THRESHOLD_RATIO": f"{plant.threshold_ratio:g}",
            "PLANT_TARGET_RATIO": f"{plant.target_ratio:g}",
            "PLANT_DOSE_ML": f"{plant.dose_ml:g}",
        }
        env |= {"PLANT_INVENTORY": "false"} if not plant.inventory else {}
        env |= {"PLANT_HARVEST": "false"} if not plant.harvest else {}
        return self._process(plant.id, "plant", "plant_service", env, ("sim",))

    def station(self) -> Process:
        station = self._scenario.station
        docks = [{"id": dock.id, "pose": dock.dock.model_dump(), "tap": dock.tap} for dock in station.docks]
        env = {
            "PLANT_ID": station.id,
            "PLANT_KIND": "station",
            "PLANT_URL": self._urls[station.id],
            "PLANT_DATA": self._data(station.id),
            "PLANT_DOCKS": json.dumps(docks),
            "PLANT_TAP_URL": f"{self._device(station.id + '.board')}?valve=8",
        }
        return self._process(station.id, "station", "plant_service", env, ("sim",))

    def body(self, robot: Robot) -> Process:
        env = {
            "BODY_ID": robot.id,
            "BODY_CREATE": robot.create,
            "BODY_BASE_URL": self._device(f"{robot.id}.create"),
            "BODY_SERVO_URL": self._device(f"{robot.id}.ssc32"),
            "BODY_MARKER_URL": self._device(f"{robot.id}.stargazer"),
            "BODY_LISTEN": self._place.socket(robot.id),
            "BODY_DATA": self._data(f"{robot.id}-body"),
            "BODY_SECRET_FILE": str(self._place.keys(robot.id) / "body.secret"),
            "BODY_FENCE": _json(fence_of(self._scenario.arena)),
        }
        name = f"{robot.id}-body"
        return self._process(name, "body", "robot_service.body", env, ("sim",), keys=robot.id, port=None)

    def brain(self, robot: Robot) -> Process:
        env = {
            "ROBOT_ID": robot.id,
            "ROBOT_URL": self._urls[robot.id],
            "ROBOT_BODY_URL": self._place.socket(robot.id),
            "ROBOT_BODY_SECRET_FILE": str(self._place.keys(robot.id) / "body.secret"),
            "ROBOT_CREATE": robot.create,
            "ROBOT_WRIST": robot.wrist,
            "ROBOT_CAMERA_URL": f"{self._urls['sim']}/cameras/{robot.id}/hand.jpg",
            "ROBOT_DOCKING": robot.docking,
            "ROBOT_HOME": _json(robot.home),
            "ROBOT_SPREAD_AFTER_S": f"{robot.spread_after_s:g}",
            "ROBOT_MAP": _json(map_of(self._scenario)),
            "ROBOT_STATION": self._scenario.station.id,
            "ROBOT_DATA": self._data(robot.id),
            "ROBOT_KEYS": str(self._place.keys(robot.id)),
        }
        return self._process(robot.id, "robot", "robot_service", env, ("sim", f"{robot.id}-body"))

    def console(self) -> Process:
        env = {"CONSOLE_DATA": self._data("console")}
        return self._process("console", "console", "console", env, ("sim",))

    def _process(
        self,
        name: str,
        kind: Kind,
        module: str,
        own: dict[str, str],
        depends: tuple[str, ...],
        *,
        keys: str = "",
        port: int | None = -1,
        clock: str = "",
        devices: tuple[int, ...] = (),
    ) -> Process:
        port = self._ports[name] if port == -1 else port
        env = {
            "GARDEN_CLOCK": clock or self._urls["sim"],
            "GARDEN_KEYS": str(self._place.keys(keys or name)),
            "GARDEN_PEERS": json.dumps([peer.model_dump() for peer in self._peers]),
            "GARDEN_HOST": self._place.bind,
            "GARDEN_LOG": "json",
            "GARDEN_SEED": str(self._scenario.seed),
        }
        if port is not None:
            env["GARDEN_PORT"] = str(port)
        if self._scenario.tls:
            env["GARDEN_TLS"] = "true"
        return Process(name, kind, module, env | own, keys or name, port, depends, devices)

    def _data(self, name: str) -> str:
        return str(self._place.data(name))

    def _device(self, name: str) -> str:
        return f"socket://{self._place.host('sim')}:{self._devices[name]}"


def _json(document: BaseModel) -> str:
    return document.model_dump_json()
