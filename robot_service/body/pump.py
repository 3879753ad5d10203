"""One dose at a time: written off first, pumped under its own off-timer, counted by running time."""

from __future__ import annotations

import asyncio

import structlog

from core.clock import Clock
from core.errors import StorageError
from core.robots import gardener
from robot_service.body.actuators import Actuators
from robot_service.body.caps import Ledger
from robot_service.body.gate import Dose

_log = structlog.get_logger("robot.body.pump")


class Doser:
    """Knows the standing of the permit in hand, and stops the pump at its dose whatever the control loop does."""

    def __init__(self, ledger: Ledger, actuators: Actuators, clock: Clock) -> None:
        self._ledger, self._actuators, self._clock = ledger, actuators, clock
        self._wanted: tuple[str, float] | None = None
        self._debited_ml = 0.0
        self._asked, self._started = asyncio.Event(), asyncio.Event()
        self._failed: tuple[str, str] = ("", "")
        """The permit that could not be written off last, and why."""
        self.permit_id = ""

    def delivered_ml(self, now_s: float) -> float:
        """Under the permit in hand, by the pump's calibration and running time."""
        return self._actuators.pump_run_s(now_s) * gardener.PUMP_MLPS

    def standing(self, permit_id: str, dose_ml: float, now_s: float) -> Dose:
        """What the gate needs to know of the permit a setpoint names."""
        if not permit_id:
            return Dose()
        if permit_id == self.permit_id:
            return Dose(debited_ml=self._debited_ml, delivered_ml=self.delivered_ml(now_s))
        if self._wanted is not None:
            return Dose(refusal="the dose is being written down")
        if permit_id == self._failed[0]:
            return Dose(refusal=self._failed[1])
        return Dose(used=self._ledger.spent(permit_id), refusal=self._ledger.refusal(dose_ml))

    def want(self, permit_id: str, dose_ml: float) -> None:
        """The gate would let the pump run once this dose is written off."""
        if self._wanted is None:
            self._wanted = (permit_id, dose_ml)
            self._asked.set()

    def began(self) -> None:
        """The pump was switched on: the off-timer runs."""
        self._started.set()

    def forget(self) -> None:
        """Another brain: what was begun under the last one stays spent."""
        self.permit_id, self._debited_ml = "", 0.0

    async def write_off(self) -> None:
        """For ever: debit what is wanted; only then is it in hand."""
        while True:
            await self._asked.wait()
            self._asked.clear()
            if self._wanted is None:
                continue
            permit_id, dose_ml = self._wanted
            try:
                await self._ledger.debit(permit_id, dose_ml)
            except StorageError as error:
                self._failed = (permit_id, f"the dose could not be written down: {error}")
                _log.error("no dose", permit=permit_id, why=str(error))
            else:
                self._actuators.start_count()
                self.permit_id, self._debited_ml = permit_id, dose_ml
                _log.info("dose written off", permit=permit_id, dose_ml=dose_ml)
            finally:
                self._wanted = None

    async def off_timer(self) -> None:
        """For ever: switch the pump off when the dose must be out, independently of the control loop."""
        while True:
            await self._started.wait()
            self._started.clear()
            while self._actuators.said.pump:
                left_ml = self._debited_ml - self.delivered_ml(self._clock.now())
                if left_ml <= 1e-3:
                    self._actuators.pump_off(self._clock.now())
                    break
                await self._clock.sleep(left_ml / gardener.PUMP_MLPS)
