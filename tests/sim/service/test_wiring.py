from __future__ import annotations

import asyncio

import pytest

from core.clock import VirtualClock
from core.robots import gardener
from core.scenario import device_ports, find
from core.virtual import run_virtual
from hw.links import ByteLink, MemoryNet
from sim.wiring import Rig, assemble, listen

SAFE = bytes([128, 131])
AHEAD = bytes([145, 0, 200, 0, 200])
HALT = bytes([145, 0, 0, 0, 0])


async def garden(clock: VirtualClock) -> tuple[Rig, MemoryNet, asyncio.Task[None]]:
    net = MemoryNet(clock)
    rig = assemble(find("garden"), 7, clock)
    listen(rig.hosts, net)
    return rig, net, asyncio.create_task(rig.clockwork.run(clock))


def test_every_device_of_the_scenario_has_a_name_a_port_and_a_host() -> None:
    rig = assemble(find("garden"), 7, VirtualClock())
    ports = device_ports(rig.world.scenario)
    assert set(rig.hosts) == set(ports)
    assert len(set(ports.values())) == len(ports)


def test_bytes_for_the_wheels_move_the_robot_and_it_does_not_stop_because_the_link_closed() -> None:
    async def main() -> None:
        clock = VirtualClock()
        rig, net, running = await garden(clock)
        link = await net.open("memory://robot-1.create")
        link.write(SAFE + AHEAD)
        await clock.sleep(1.0)
        before = rig.world.truth().robot("robot-1")
        assert before.travel_m[0] == pytest.approx(0.15, abs=0.06)
        await link.close()
        await clock.sleep(1.0)
        assert rig.world.truth().robot("robot-1").travel_m[0] - before.travel_m[0] == pytest.approx(0.2, abs=0.02)
        again = await net.open("memory://robot-1.create")
        again.write(HALT)
        await clock.sleep(2.0)
        assert rig.world.at_rest
        running.cancel()

    run_virtual(main())


def test_the_pump_pumps_while_its_output_is_high() -> None:
    async def main() -> None:
        clock = VirtualClock()
        rig, net, running = await garden(clock)
        link = await net.open("memory://robot-2.ssc32")
        link.write(b"#%dH\r" % gardener.PUMP_CHANNEL)
        await clock.sleep(4.0)
        link.write(b"#%dL\r" % gardener.PUMP_CHANNEL)
        await clock.sleep(1.0)
        pumped_ml = rig.world.truth().robot("robot-2").pumped_ml
        assert pumped_ml == pytest.approx(4.0 * gardener.PUMP_MLPS, rel=0.05)
        assert rig.world.truth().robot("robot-1").pumped_ml == 0.0
        running.cancel()

    run_virtual(main())


async def _fix(link: ByteLink) -> bytes:
    heard = b""
    while b"~^I" not in heard:
        heard += await link.read()
    return heard


def test_a_resting_world_still_reports_markers_twice_a_second() -> None:
    async def main() -> None:
        clock = VirtualClock()
        rig, net, running = await garden(clock)
        link = await net.open("memory://robot-1.stargazer")
        await _fix(link)
        begun_s = clock.now()
        for _ in range(4):
            await _fix(link)
        assert clock.now() - begun_s == pytest.approx(2.0, abs=0.1)
        assert rig.clockwork.ticks == 0
        running.cancel()

    run_virtual(main())


def test_the_same_seed_gives_the_same_run() -> None:
    async def main() -> dict[str, object]:
        clock = VirtualClock()
        rig, net, running = await garden(clock)
        link = await net.open("memory://robot-1.create")
        link.write(SAFE + AHEAD)
        await clock.sleep(3.0)
        running.cancel()
        return rig.world.snapshot()

    assert run_virtual(main()) == run_virtual(main())
