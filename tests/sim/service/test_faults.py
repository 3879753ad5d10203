from __future__ import annotations

import asyncio

import pytest

from core.clock import VirtualClock
from core.errors import NotFound, Unprocessable
from core.scenario import find
from core.virtual import run_virtual
from hw.links import MemoryNet
from sim.faults import KINDS, FaultRequest
from sim.physics.water import PumpFault
from sim.pot import ProbeFault
from sim.wiring import Rig, assemble, listen


def rig_of() -> Rig:
    return assemble(find("garden"), 7, VirtualClock())


def fault(kind: str, target: str, duration_s: float | None = None, strength: float | None = None) -> FaultRequest:
    return FaultRequest(kind=kind, target=target, duration_s=duration_s, strength=strength)


def test_each_kind_befalls_its_target_and_is_lifted_again() -> None:
    rig = rig_of()
    robot, pot = rig.world.robots["robot-1"], rig.world.pots["plant-2"]
    looks = {
        "marker_blindness": lambda: robot.faults.marker_blind is True,
        "wheel_slip": lambda: robot.faults.wheel_slip == 3.0,
        "pump_stuck": lambda: robot.faults.pump is PumpFault.STUCK_OFF,
        "dead_battery": lambda: robot.faults.dead_battery is True,
        "soil_stuck": lambda: pot.probe_fault is ProbeFault.STUCK,
        "soil_open": lambda: pot.probe_fault is ProbeFault.OPEN,
        "soil_short": lambda: pot.probe_fault is ProbeFault.SHORT,
    }
    for kind, befallen in looks.items():
        assert not befallen()
        made = rig.faults.add(fault(kind, "robot-1" if KINDS[kind][0] == "robot" else "plant-2"))
        assert befallen(), kind
        rig.faults.remove(made.id)
        assert not befallen(), kind


@pytest.mark.parametrize(
    ("request_", "named"),
    [
        (fault("rain", "plant-1"), "soil_short"),
        (fault("soil_open", "robot-1"), "plant-3"),
        (fault("serial_noise", "robot-1"), "robot-1.create"),
        (fault("wheel_slip", "robot-3"), "robot-2"),
        (fault("dead_battery", "robot-1", strength=1.0), "the pack"),
        (fault("serial_noise", "robot-1.create", strength=1.5), "share of bytes"),
    ],
)
def test_a_wrong_fault_is_refused_and_the_hint_names_what_is_allowed(request_: FaultRequest, named: str) -> None:
    rig = rig_of()
    with pytest.raises(Unprocessable) as refusal:
        rig.faults.add(request_)
    assert named in refusal.value.hint
    assert rig.faults.all() == []


def test_lifting_an_unknown_fault_is_refused() -> None:
    with pytest.raises(NotFound):
        rig_of().faults.remove("fault-9")


def test_of_two_faults_of_one_probe_the_later_counts_and_the_earlier_comes_back() -> None:
    rig = rig_of()
    rig.faults.add(fault("soil_open", "plant-1"))
    later = rig.faults.add(fault("soil_short", "plant-1"))
    assert rig.world.pots["plant-1"].probe_fault is ProbeFault.SHORT
    rig.faults.remove(later.id)
    assert rig.world.pots["plant-1"].probe_fault is ProbeFault.OPEN


def test_a_fault_ends_by_itself_when_its_garden_seconds_are_over() -> None:
    async def main() -> None:
        clock = VirtualClock()
        rig = assemble(find("garden"), 7, clock)
        ended = []
        rig.faults.on_end = ended.append
        running = asyncio.create_task(rig.clockwork.run(clock))
        rig.faults.add(fault("dead_battery", "robot-2", duration_s=5.0))
        await clock.sleep(4.9)
        assert rig.world.robots["robot-2"].faults.dead_battery
        await clock.sleep(0.2)
        assert not rig.world.robots["robot-2"].faults.dead_battery
        assert [f.kind for f in ended] == ["dead_battery"]
        running.cancel()

    run_virtual(main())


def test_a_silent_wire_swallows_bytes_both_ways_and_recovers() -> None:
    async def main() -> None:
        clock, version = VirtualClock(), b"VER\r"
        net, rig = MemoryNet(clock), assemble(find("garden"), 7, clock)
        listen(rig.hosts, net)
        running = asyncio.create_task(rig.clockwork.run(clock))
        link = await net.open("memory://robot-1.ssc32")
        silence = rig.faults.add(fault("serial_silence", "robot-1.ssc32"))
        link.write(version)
        with pytest.raises(TimeoutError):
            async with clock.timeout(2.0):
                await link.read()
        rig.faults.remove(silence.id)
        link.write(version)
        async with clock.timeout(1.0):
            assert (await link.read()).startswith(b"SSC32")
        running.cancel()

    run_virtual(main())
