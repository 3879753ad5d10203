"""Driver and emulator on a memory link, on virtual time."""

import asyncio
import random
from collections.abc import Awaitable, Callable

from structlog.testing import capture_logs

from core.clock import VirtualClock
from core.virtual import run_virtual
from hw.drivers.create import CreateDriver
from hw.links import MemoryNet
from hw.protocols.create import Model
from sim.devices.bench import BenchCreate, Pose
from sim.devices.create import CreateEmulator
from sim.devices.host import EmulatorHost

WHEELBASE_M = {Model.CREATE1: 0.258, Model.CREATE2: 0.235}
WHEEL_M = {Model.CREATE1: 0.066, Model.CREATE2: 0.072}


class Bench:
    def __init__(self, model: Model, pose: Pose | None = None, seed: int = 1) -> None:
        self.clock = VirtualClock()
        self.net = MemoryNet(self.clock)
        rng = random.Random(seed)
        self.body = BenchCreate(rng, wheelbase_m=WHEELBASE_M[model], pose=pose or Pose(x_m=-2.0))
        self.emulator = CreateEmulator(model, self.body, rng)
        self.body.may_charge = lambda: self.emulator.may_charge
        self.host = EmulatorHost(self.emulator, self.clock)
        self.host.listen(self.net, "base")
        self.driver = CreateDriver(
            "memory://base",
            model,
            self.net.open,
            self.clock,
            wheelbase_m=WHEELBASE_M[model],
            wheel_diameter_m=WHEEL_M[model],
        )

    async def drive_for(self, seconds: float, v_mps: float, omega_radps: float) -> None:
        """A body that repeats its setpoint at 50 Hz, and does not stop at the end."""
        for _ in range(round(seconds / 0.02)):
            self.driver.drive(v_mps, omega_radps)
            await self.clock.sleep(0.02)


Story = Callable[[Bench], Awaitable[None]]


def play(
    story: Story, model: Model = Model.CREATE2, pose: Pose | None = None, within_s: float = 600.0, step_s: float = 0.005
) -> list[dict]:
    """Run a story once the link is up; gives what was logged."""

    async def main() -> None:
        bench = Bench(model, pose)
        tasks = [
            asyncio.create_task(bench.host.run(bench.body.advance, step_s)),
            asyncio.create_task(bench.driver.run()),
        ]
        async with asyncio.timeout(within_s):
            await bench.driver.wait_link()
            await story(bench)
        for task in tasks:
            task.cancel()

    with capture_logs() as logs:
        run_virtual(main())
    return logs
