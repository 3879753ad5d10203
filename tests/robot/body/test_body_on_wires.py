"""The body with its real drivers, over bytes, against emulators that do not stop by themselves."""

from __future__ import annotations

import asyncio
import importlib.util
import random
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from core.clock import VirtualClock
from core.planning.docking import BeamDocking
from core.robots import gardener
from core.virtual import run_virtual
from core.wire.body import Setpoint
from hw.links import MemoryNet
from robot_service.body.body import BodyNode, build_body
from robot_service.body.settings import BodySettings
from sim.devices.bench import BenchCreate, BenchedCreate, Model, Pose
from sim.devices.bench_ssc32 import BenchRig
from sim.devices.bench_stargazer import BenchCamera
from sim.devices.host import EmulatorHost
from sim.devices.ssc32 import Ssc32Emulator
from sim.devices.stargazer import StargazerEmulator

_spec = importlib.util.spec_from_file_location("body_stand_ins", Path(__file__).with_name("stand_ins.py"))
assert _spec is not None
assert _spec.loader is not None
stand_ins = sys.modules.setdefault("body_stand_ins", importlib.util.module_from_spec(_spec))
_spec.loader.exec_module(stand_ins)

LIFE_S = 0.3
HOME = gardener.ARM_HOME_RAD
DRIVE = Setpoint(seq=0, base="drive", v_mps=0.2, arm=HOME)
SEEK = Setpoint(seq=0, base="seek_dock", arm=HOME)
PUMP = Setpoint(seq=0, pump=True, permit_id="plant-1/p1", dose_ml=60.0, arm=HOME)


class Wired:
    """One robot's devices as emulators on one in-memory net, stepped every 5 ms."""

    def __init__(self, folder: Path, pose: Pose) -> None:
        self.clock = VirtualClock(500.0)
        self.net = MemoryNet(self.clock)
        rng = random.Random(3)
        self.plane = BenchCreate(rng, pose=pose)
        self.rig = BenchRig()
        devices = {
            "base": BenchedCreate(Model.CREATE2, self.plane, rng),
            "servos": Ssc32Emulator(self.rig, rng),
            "markers": StargazerEmulator(BenchCamera(rng), rng),
        }
        self.hosts = [EmulatorHost(device, self.clock) for device in devices.values()]
        for name, host in zip(devices, self.hosts, strict=True):
            host.listen(self.net, name)
            host.plug()
        urls = {"base_url": "memory://base", "servo_url": "memory://servos", "marker_url": "memory://markers"}
        self.settings = BodySettings(id="robot-1", listen="memory://body", data=folder, secret=stand_ins.SECRET, **urls)
        self.tasks: list[asyncio.Task[None]] = []
        self.body: BodyNode

    async def __aenter__(self) -> Wired:
        self.body = build_body(self.settings, self.clock, self.net.open, self.net.listen)
        self.tasks += [asyncio.create_task(self._world()), asyncio.create_task(self.body.run())]
        await self.clock.sleep(2.0)
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self.tasks:
            task.cancel()
        await asyncio.wait(self.tasks)

    async def _world(self) -> None:
        while True:
            for host in self.hosts:
                host.pump(self.clock.now())
            await self.clock.sleep(0.005)

    async def brain(self) -> Any:
        """Connected, and the arm folded."""
        brain = stand_ins.Brain(await self.net.open("memory://body"), self.clock)
        brain.hello()
        self.tasks += [asyncio.create_task(brain.listen()), asyncio.create_task(brain.talk())]
        brain.wish = Setpoint(seq=0, arm=HOME)
        await self.until(lambda: bool(brain.states) and brain.state.arm_rad is not None and not brain.state.arm_moving)
        return brain

    async def until(self, true: Callable[[], bool], within_s: float = 10.0) -> float:
        began_s = self.clock.now()
        while not true():
            assert self.clock.now() - began_s < within_s, "it did not happen"
            await self.clock.sleep(0.005)
        return self.clock.now() - began_s

    @property
    def pumping(self) -> bool:
        return self.rig.outputs.get(gardener.PUMP_CHANNEL, False)


def story(folder: Path, pose: Pose, tell: Callable[[Wired], Awaitable[None]]) -> None:
    async def main() -> None:
        async with Wired(folder, pose) as wired:
            await tell(wired)

    run_virtual(main())


@pytest.mark.parametrize("how", ["killed", "blocked"])
@pytest.mark.parametrize(
    ("wish", "pose"), [(DRIVE, Pose(-1.4)), (SEEK, Pose(-0.8)), (PUMP, Pose(0.0))], ids=["drives", "docks", "pumps"]
)
def test_within_0_3_s_of_the_brains_last_word_all_is_still(tmp_path: Path, wish: Setpoint, pose: Pose, how: str) -> None:
    async def tell(wired: Wired) -> None:
        brain = await wired.brain()
        if wish.pump:
            await wired.until(lambda: brain.state.docked)
        brain.wish = wish
        await wired.until(lambda: wired.pumping or wired.plane.wheels != (0.0, 0.0))
        await wired.clock.sleep(0.6)
        assert wired.pumping or wired.plane.wheels != (0.0, 0.0)
        brain.wish = None
        if how == "killed":
            await brain.link.close()
        assert await wired.until(lambda: not wired.pumping and wired.plane.wheels == (0.0, 0.0)) <= LIFE_S
        await wired.clock.sleep(2.0)
        assert not wired.pumping
        assert wired.plane.wheels == (0.0, 0.0)

    story(tmp_path, pose, tell)


def test_fingers_stop_where_they_squeeze_too_hard_and_open_all_the_same(tmp_path: Path) -> None:
    gripper = gardener.SERVOS["gripper"]

    async def tell(wired: Wired) -> None:
        def opening_m() -> float:
            return gardener.gripper_opening_m(gripper.angle_rad(wired.rig.pulses_us[gripper.channel]))

        brain = await wired.brain()
        wired.rig.volts[gardener.FORCE_INPUT] = 0.0
        brain.wish = Setpoint(seq=0, arm=HOME, gripper_m=0.04)
        await wired.until(lambda: gripper.channel in wired.rig.pulses_us and opening_m() > 0.039)
        await wired.clock.sleep(1.0)
        brain.wish = Setpoint(seq=0, arm=HOME, gripper_m=0.0)
        await wired.until(lambda: opening_m() < 0.03)
        wired.rig.volts[gardener.FORCE_INPUT] = gardener.FORCE_SENSOR_V_MAX
        began_m = opening_m()
        await wired.clock.sleep(0.3)
        held_m = opening_m()
        assert 0.005 < held_m < began_m
        await wired.clock.sleep(2.0)
        assert opening_m() == held_m
        assert "they may only open" in brain.state.refusal
        brain.wish = Setpoint(seq=0, arm=HOME, gripper_m=0.04)
        await wired.until(lambda: opening_m() > 0.039)
        wired.rig.volts[gardener.FORCE_INPUT] = 2.0
        brain.wish = Setpoint(seq=0, arm=HOME, gripper_m=0.0)
        await wired.until(lambda: opening_m() < 0.001)
        wired.rig.volts[gardener.FORCE_INPUT] = gardener.FORCE_SENSOR_V_MAX
        await wired.clock.sleep(1.0)
        assert (opening_m(), brain.state.refusal) == (pytest.approx(0.0, abs=1e-3), "")

    story(tmp_path, Pose(-1.4), tell)


def test_the_base_docks_by_itself_and_charges(tmp_path: Path) -> None:
    async def tell(wired: Wired) -> None:
        brain = await wired.brain()
        brain.wish = SEEK
        await wired.until(lambda: brain.state.docked, 30.0)
        brain.wish = None
        await wired.clock.sleep(5.0)
        assert brain.state.docked
        assert brain.state.battery_a > 0.0

    story(tmp_path, Pose(-0.6, 0.03, 0.05), tell)


def test_our_own_docking_mates_over_the_wires(tmp_path: Path) -> None:
    async def tell(wired: Wired) -> None:
        brain = await wired.brain()
        docking = BeamDocking((0.0, 0.0, 0.0), gardener.WHEELBASE_M["create2"])
        for _ in range(1000):
            command = docking.step(brain.state, None, wired.clock.now())
            if command.status != "running":
                break
            brain.wish = Setpoint(seq=0, base="drive", v_mps=command.v_mps, omega_radps=command.omega_radps, arm=HOME)
            await wired.clock.sleep(0.03)
        assert command.status == "docked"
        brain.wish = None
        await wired.clock.sleep(3.0)
        assert brain.state.docked

    story(tmp_path, Pose(-0.55, 0.04, -0.08), tell)


def test_a_dose_over_the_wires_ends_by_itself(tmp_path: Path) -> None:
    async def tell(wired: Wired) -> None:
        brain = await wired.brain()
        await wired.until(lambda: brain.state.docked)
        brain.wish = PUMP
        ran_s = -await wired.until(lambda: wired.pumping)
        ran_s = await wired.until(lambda: not wired.pumping, 20.0)
        assert ran_s * gardener.PUMP_MLPS == pytest.approx(60.0, abs=0.5)
        await wired.clock.sleep(2.0)
        assert not wired.pumping
        assert brain.state.pumped_ml == pytest.approx(60.0, abs=0.1)

    story(tmp_path, Pose(0.0), tell)


def test_ending_the_body_stops_what_it_moved(tmp_path: Path) -> None:
    async def tell(wired: Wired) -> None:
        brain = await wired.brain()
        brain.wish = DRIVE
        await wired.until(lambda: wired.plane.wheels != (0.0, 0.0))
        wired.tasks[1].cancel()
        await wired.until(lambda: wired.plane.wheels == (0.0, 0.0), LIFE_S)

    story(tmp_path, Pose(-1.4), tell)
