"""Connects the world's bodies to emulated devices, and the devices to ports or to in-memory links."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass

from core.clock import Clock
from core.errors import ConfigError
from core.robots import gardener
from core.scenario import Robot, Scenario
from hw.links import MemoryNet
from hw.protocols.create import Model
from sim.clockwork import Clockwork
from sim.devices.create import CreateEmulator
from sim.devices.firmata import FirmataEmulator
from sim.devices.host import EmulatorHost
from sim.devices.ssc32 import Ssc32Emulator
from sim.devices.stargazer import StargazerEmulator
from sim.faults import FaultBoard
from sim.world import World


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """A world with everything that hangs on it."""

    world: World
    hosts: dict[str, EmulatorHost]
    """By the names of `core.scenario.device_ports`."""
    faults: FaultBoard
    clockwork: Clockwork


def assemble(scenario: Scenario, seed: int, clock: Clock, speed: float = 1.0) -> Rig:
    """A world, its devices and its clockwork, paced by `clock` (`rig.clockwork.run(clock)` sets it going)."""
    world = World(scenario, seed)
    hosts = connect(world, clock)
    faults = FaultBoard(world, hosts)
    clockwork = Clockwork(world, [*hosts.values(), faults], speed)
    for host in hosts.values():
        host.wake = clockwork.wake
    return Rig(world=world, hosts=hosts, faults=faults, clockwork=clockwork)


def connect(world: World, clock: Clock) -> dict[str, EmulatorHost]:
    """An emulator for every device of the scenario, by the names of `core.scenario.device_ports`; freshly powered up."""

    def rng(name: str) -> random.Random:
        return random.Random(f"{world.seed}/{name}")

    hosts: dict[str, EmulatorHost] = {}
    for robot in world.scenario.robots:
        hosts[f"{robot.id}.create"] = EmulatorHost(_create(world, robot, rng(f"{robot.id}.create")), clock)
        board = Ssc32Emulator(world.servo_rig(robot.id), rng(f"{robot.id}.ssc32"))
        hosts[f"{robot.id}.ssc32"] = EmulatorHost(board, clock)
        localizer = StargazerEmulator(world.marker_camera(robot.id), rng(f"{robot.id}.stargazer"))
        hosts[f"{robot.id}.stargazer"] = EmulatorHost(localizer, clock)
    boards = {f"{world.scenario.station.id}.board": world.scenario.station.id} | {f"{p}.soil": p for p in world.pots}
    for name, owner in boards.items():
        hosts[name] = EmulatorHost(FirmataEmulator(world.board_pins(owner), rng(name)), clock)
    power_up(world)
    return hosts


def _create(world: World, robot: Robot, rng: random.Random) -> CreateEmulator:
    create = CreateEmulator(Model(robot.create), world.create_body(robot.id), rng, red_side=gardener.DOCK_RED_SIDE)
    world.robots[robot.id].may_charge = lambda: create.may_charge
    return create


def power_up(world: World) -> None:
    """Boards that have just got power drive nothing and switch nothing on."""
    for robot in world.robots.values():
        robot.set_wheels(0.0, 0.0)
        robot.set_output(gardener.PUMP_CHANNEL, False)
    world.tap_board.open.clear()


def listen(hosts: Mapping[str, EmulatorHost], net: MemoryNet) -> None:
    """Every device as `memory://NAME`."""
    for name, host in hosts.items():
        host.listen(net, name)


@asynccontextmanager
async def serve(hosts: Mapping[str, EmulatorHost], address: str, ports: Mapping[str, int]) -> AsyncIterator[dict[str, int]]:
    """Every device on its TCP port (0: any) while the context lasts; raises ConfigError that names a port in use."""
    servers: list[asyncio.Server] = []
    bound: dict[str, int] = {}
    try:
        for name, port in ports.items():
            try:
                server = await hosts[name].serve_tcp(address, port)
            except OSError as error:
                raise ConfigError(
                    f"cannot listen on {address}:{port} for {name}: {error.strerror}",
                    hint="is another garden running? `ports.devices` of the scenario moves all device ports",
                ) from error
            servers.append(server)
            bound[name] = server.sockets[0].getsockname()[1]
        yield bound
    finally:
        for server in servers:
            server.close()
        for host in hosts.values():
            await host.close()
