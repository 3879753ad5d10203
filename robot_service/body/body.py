"""The robot's body: three devices behind one gate, some 50 times a second while anything moves.

It boots with everything off. What the brain does not keep asking for stops within 0.3 s, because neither a Create nor an
SSC-32 stops by itself.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

import structlog

from core.clock import Clock
from core.errors import StorageError
from core.robots import gardener
from core.store import Disk
from core.wire.body import COMMAND_LIFE_S, BodyState, Control, Setpoint
from hw.drivers.create import CreateDriver
from hw.drivers.ssc32 import Ssc32Driver
from hw.drivers.stargazer import StargazerDriver
from hw.links import Opener
from hw.ports import Base, Localizer, ServoBoard
from hw.protocols.create import Mode, Model
from robot_service.body.actuators import Actuators
from robot_service.body.caps import Ledger, StopLatch
from robot_service.body.gate import STOP, GateState, Verdict, check
from robot_service.body.pump import Doser
from robot_service.body.senses import Senses
from robot_service.body.settings import BodySettings
from robot_service.body.stream import BrainPort, MemoryListen

DT_S = 0.02
RESTING_DT_S = 0.5
REST_AFTER_S = 2.0
LONG_REST_S, LONG_REST_DT_S = 120.0, 10.0
"""After so long a rest turns come so seldom; whatever is wanted wakes the body at once."""
WAKING_S = 1.0
"""After a rest the readings need a moment; a refusal for want of them is not worth telling so soon."""
KEEP_AGAIN_S = 5.0
"""A stop that the disk did not take is written down again so soon."""
_log = structlog.get_logger("robot.body")
Loop = Callable[[], Awaitable[None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drivers:
    """The body's devices; real drivers, or stand-ins of a test."""

    base: Base
    servos: ServoBoard
    localizer: Localizer


class BodyNode:
    """Run all of `loops` together; when one ends, end them all."""

    def __init__(
        self,
        settings: BodySettings,
        clock: Clock,
        drivers: Drivers,
        memory: MemoryListen | None = None,
        disk: Disk | None = None,
    ) -> None:
        self._clock, self._drivers = clock, drivers
        self.ledger = Ledger(settings.data, settings.caps, clock, disk)
        self.latch = StopLatch(settings.data, clock, disk)
        wheelbase_m = gardener.WHEELBASE_M[settings.create]
        self.senses = Senses(drivers.base, drivers.servos, drivers.localizer, settings.fence, wheelbase_m)
        self.actuators = Actuators(drivers.base, drivers.servos)
        self.doser = Doser(self.ledger, self.actuators, clock)
        self.brain = BrainPort(
            settings.listen, settings.shared_secret(), clock, woken=self._wake, ordered=self._ordered, memory=memory
        )
        self._woken = asyncio.Event()
        self._orders: asyncio.Queue[Control] = asyncio.Queue(16)
        self._resting = False
        self._kept_awake = False
        self._long_rest = False
        self._active_s = self._woke_s = self._ticked_s = self._due_s = clock.now()
        self._brains = 0
        self._verdict = Verdict()
        self.ticks = 0
        try:
            self.latch.load()
            self.ledger.load()
        except StorageError:
            self.close()
            raise

    @property
    def loops(self) -> Sequence[Loop]:
        """Drivers last: what stops the devices runs while they still can be told."""
        d = self._drivers
        ours = (self._control, self.brain.run, self.doser.write_off, self.doser.off_timer, self._obey)
        return (*ours, d.base.run, d.servos.run, d.localizer.run)

    async def run(self) -> None:
        """All loops in one TaskGroup, until cancelled; the files are given back at the end."""
        try:
            async with asyncio.TaskGroup() as group:
                for loop in self.loops:
                    group.create_task(_run(loop))
        finally:
            self.close()

    def close(self) -> None:
        """Give the files to the next body."""
        self.latch.close()
        self.ledger.close()

    async def _control(self) -> None:
        """Look, judge, act, tell."""
        try:
            while True:
                self.tick()
                await self._pause()
        finally:
            self.actuators.halt(self._clock.now())

    def tick(self) -> None:
        """One turn of the control loop."""
        now_s = self._clock.now()
        self._long_rest = self._resting and now_s - self._active_s > LONG_REST_S
        self.senses.lull_s = LONG_REST_DT_S if self._long_rest or now_s - self._woke_s < WAKING_S else 0.0
        self.senses.look()
        if self.brain.brains != self._brains:
            self._brains = self.brain.brains
            self.doser.forget()
        setpoint = self.brain.setpoint
        self._verdict = verdict = check(setpoint, self._gate_state(setpoint, now_s), now_s)
        was_pumping = self.actuators.said.pump
        self.actuators.apply(verdict.command, now_s)
        if verdict.command.pump and not was_pumping:
            self.doser.began()
        if verdict.debit_ml > 0.0 and setpoint is not None:
            self.doser.want(setpoint.permit_id, verdict.debit_ml)
        self._ticked_s = now_s
        self.ticks += 1
        self._rest_or_wake(setpoint, now_s)
        if self.brain.connected:
            self.brain.send(self.state(now_s))

    @property
    def busy(self) -> bool:
        """Something was told to move, and not to stop."""
        return self.actuators.said != STOP or self.actuators.pumping

    def hung(self) -> None:
        """The watchdog stopped the devices past the loop: what they were told before holds no more."""
        self.actuators.halt(self._clock.now())

    def _gate_state(self, setpoint: Setpoint | None, now_s: float) -> GateState:
        said = self.actuators.said
        permit_id, dose_ml = ("", 0.0) if setpoint is None or not setpoint.pump else (setpoint.permit_id, setpoint.dose_ml)
        return self.senses.gate_state(
            now_s,
            heard_s=self.brain.heard_s,
            stopped=self.latch.stopped,
            stopped_by=self.latch.by,
            arm_moving=self.actuators.arm_moving(now_s),
            dose=self.doser.standing(permit_id, dose_ml, now_s),
            v_mps=said.v_mps,
            omega_radps=said.omega_radps,
            dt_s=now_s - self._ticked_s,
        )

    def state(self, now_s: float) -> BodyState:
        """What the brain is told."""
        waking = now_s - self._woke_s < WAKING_S and self._verdict.refusal.startswith("no fresh reading")
        return self.senses.body_state(
            now_s,
            arm_moving=self.actuators.arm_moving(now_s),
            pump=self.actuators.pumping,
            pumped_ml=self.doser.delivered_ml(now_s) if self.doser.permit_id else 0.0,
            permit_id=self.doser.permit_id,
            stopped=self.latch.stopped,
            stopped_by=self.latch.by,
            stop_kept=self.latch.kept,
            stop_number=self.latch.number,
            refusal="" if waking else self._verdict.refusal,
            next_in_s=self._next_in_s(),
        )

    # Resting

    def _next_in_s(self) -> float:
        return LONG_REST_DT_S if self._long_rest else RESTING_DT_S

    def _rest_or_wake(self, setpoint: Setpoint | None, now_s: float) -> None:
        if self._kept_awake or self._busy(now_s) or (setpoint is not None and self._wanting(setpoint, now_s)):
            self._active_s = now_s
        self._rest(now_s - self._active_s > REST_AFTER_S, now_s)

    def _busy(self, now_s: float) -> bool:
        command = self._verdict.command
        return command.base != "stop" or command.pump or self.actuators.arm_moving(now_s)

    def _wanting(self, setpoint: Setpoint, now_s: float) -> bool:
        """A fresh setpoint asks for something that does not stand so already."""
        new_arm = setpoint.arm is not None and setpoint.arm != self.actuators.said.arm
        wants = setpoint.base != "stop" or setpoint.pump or new_arm
        return wants and now_s - self.brain.heard_s < COMMAND_LIFE_S

    def _rest(self, resting: bool, now_s: float) -> None:
        if resting is self._resting:
            return
        self._resting = resting
        if not resting:
            self._woke_s = now_s
            self._long_rest = False
        for driver in (self._drivers.base, self._drivers.servos, self._drivers.localizer):
            driver.rest(resting)

    def _wake(self) -> None:
        """Somebody wants something: the next turn comes now. When the brain just went, nothing moves from now on."""
        if not self.brain.connected:
            self.actuators.halt(self._clock.now())
        if self._resting:
            self._active_s = self._clock.now()
            self._rest(False, self._active_s)
            self._woken.set()

    async def _pause(self) -> None:
        """Until the next turn; a resting body is woken early."""
        if not self._resting:
            # A turn that came a little late does not put off the next: 50 Hz on the whole.
            now_s, due_s = self._clock.now(), self._due_s + DT_S
            self._due_s = due_s if due_s > now_s else now_s + DT_S
            await self._clock.sleep(self._due_s - now_s)
            return
        self._woken.clear()
        try:
            async with self._clock.timeout(self._next_in_s()):
                await self._woken.wait()
        except TimeoutError:
            return

    # Orders

    def _ordered(self, control: Control) -> None:
        """A stop acts at once; what must be written down follows in its turn."""
        if control.order == "stop":
            self.latch.press(control.by)
            self.actuators.halt(self._clock.now())
        if control.order in ("rest", "wake"):
            self._kept_awake = control.order == "wake"
            if self._kept_awake:
                self._wake()
            else:
                self._active_s = self._clock.now() - REST_AFTER_S
            return
        try:
            self._orders.put_nowait(control)
        except asyncio.QueueFull:
            _log.warning("an order was dropped: too many at once", order=control.order)

    async def _obey(self) -> None:
        """Orders in their turn. A stop that could not be written down is written later: until then nobody can release it."""
        while True:
            try:
                async with self._clock.timeout(KEEP_AGAIN_S if self.latch.unwritten else None):
                    control = await self._orders.get()
            except TimeoutError:
                control = Control(order="stop", by=self.latch.by)
            try:
                done = await self._latch(control)
                _log.warning("e-stop", order=control.order, by=control.by, number=control.stop_number, done=done)
            except StorageError as error:
                _log.error("the stop latch is not durable", why=str(error))
            self._wake()

    async def _latch(self, control: Control) -> bool:
        if control.order == "resume":
            return await self.latch.release(control.stop_number)
        await self.latch.keep()
        return True


async def _run(loop: Loop) -> None:
    await loop()


def make_drivers(settings: BodySettings, clock: Clock, opener: Opener) -> Drivers:
    """The real drivers, on whatever wires the URLs name."""
    model = Model(settings.create)
    return Drivers(
        base=CreateDriver(
            settings.base_url,
            model,
            opener,
            clock,
            wheelbase_m=gardener.WHEELBASE_M[settings.create],
            wheel_diameter_m=gardener.WHEEL_DIAMETER_M[settings.create],
            mode=Mode.SAFE,
        ),
        servos=Ssc32Driver(settings.servo_url, opener, clock, outputs=(gardener.PUMP_CHANNEL,)),
        localizer=StargazerDriver(settings.marker_url, opener, clock),
    )


def build_body(
    settings: BodySettings,
    clock: Clock,
    opener: Opener,
    memory: MemoryListen | None = None,
    drivers: Drivers | None = None,
    disk: Disk | None = None,
) -> BodyNode:
    """A body ready to run. `memory` is `MemoryNet.listen` for a brain in the same process.

    Raises ConfigError without a secret and StorageError when its files cannot be trusted.
    """
    return BodyNode(settings, clock, drivers or make_drivers(settings, clock, opener), memory, disk)
