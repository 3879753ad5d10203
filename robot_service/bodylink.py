"""The brain's end of the stream to the robot's body: newest state in, one setpoint out, reconnecting for ever."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import msgspec
import structlog

from core.clock import Clock
from core.errors import GardenError, LinkDown, Unprocessable
from core.wire.body import BodyState, Control, Hello, LineBuffer, Setpoint, decode, encode
from hw.links import ByteLink, Opener

SILENCE_S = 2.0
"""A body that says nothing for so long after it should have spoken is down."""
RETRY_S = (0.2, 0.5, 1.0, 2.0)

_log = structlog.get_logger("robot.bodylink")


class BodyLink:
    """Nothing is sent unless somebody wants something, so that a brain that hangs stops the body."""

    def __init__(self, url: str, secret: str, opener: Opener, clock: Clock) -> None:
        self._url, self._secret, self._opener, self._clock = url, secret, opener, clock
        self._link: ByteLink | None = None
        self._seq = 0
        self._patient_until_s = -1e9
        self._resting: bool | None = None
        self._bodys: BodyState | None = None
        """Its last word on this connection, as it said it."""
        self._ahead_s = 0.0
        self.state: BodyState | None = None
        """Its last word, in the brain's time and with one count of its wheels' beginnings, over its restarts."""
        self.why = "not connected yet"
        self.listeners: list[Callable[[BodyState], None]] = []
        self.sent = 0

    @property
    def down(self) -> str:
        """Why the body cannot be used; empty while it can."""
        if self._link is None:
            return f"body: {self.why}"
        if self.state is None or self._clock.now() > self._patient_until_s:
            return "body: connected, but silent"
        return ""

    async def run(self) -> None:
        """Connect, listen, connect again."""
        tries = 0
        while True:
            try:
                link = await self._opener(self._url)
                try:
                    tries = 0
                    self._greet(link)
                    await self._listen(link)
                finally:
                    self._link = None
                    await link.close()
            except GardenError as error:
                self._say_down(str(error))
            await self._clock.sleep(RETRY_S[min(tries, len(RETRY_S) - 1)])
            tries += 1

    def _greet(self, link: ByteLink) -> None:
        link.write(encode(Hello(secret=self._secret)))
        self._link, self._resting, self._bodys = link, None, None
        _log.info("body link up", url=self._url)

    def _say_down(self, why: str) -> None:
        if why != self.why:
            _log.warning("body link down", url=self._url, why=why)
        self.why = why

    async def _listen(self, link: ByteLink) -> None:
        lines = LineBuffer()
        while True:
            for line in lines.feed(await link.read()):
                message = decode(line)
                if not isinstance(message, BodyState):
                    raise Unprocessable("the body sent something else than its state")
                self._take(message)

    def _take(self, said: BodyState) -> None:
        now_s, before = self._clock.now(), self.state
        if self._bodys is None:
            # It may be another process than before: its clock and its wheels' counters may have begun anew.
            self._ahead_s = said.stamp_s - (now_s if before is None else max(now_s, before.stamp_s))
        epoch = 0 if before is None else before.odometry_epoch
        epoch += self._bodys is None or said.odometry_epoch != self._bodys.odometry_epoch
        self._bodys = said
        self.state = msgspec.structs.replace(said, stamp_s=said.stamp_s - self._ahead_s, odometry_epoch=epoch)
        self._patient_until_s = now_s + said.next_in_s + SILENCE_S
        for listener in self.listeners:
            listener(self.state)

    def want(
        self,
        base: Literal["stop", "drive", "seek_dock"] = "stop",
        v_mps: float = 0.0,
        omega_radps: float = 0.0,
        *,
        arm: tuple[float, float, float, float] | None = None,
        arm_s: float = 0.0,
        gripper_m: float | None = None,
        roll_rad: float | None = None,
        pump: bool = False,
        permit_id: str = "",
        dose_ml: float = 0.0,
    ) -> None:
        """Send one setpoint: the whole of what is wanted for the next 0.3 s."""
        self._seq += 1
        self._send(
            encode(
                Setpoint(
                    seq=self._seq,
                    base=base,
                    v_mps=v_mps,
                    omega_radps=omega_radps,
                    arm=arm,
                    arm_s=arm_s,
                    gripper_m=gripper_m,
                    roll_rad=roll_rad,
                    pump=pump,
                    permit_id=permit_id,
                    dose_ml=dose_ml,
                )
            )
        )

    def order(self, order: Literal["stop", "resume", "rest", "wake"], by: str = "", stop_number: int = 0) -> None:
        """Send a rare order. Raises LinkDown when there is no body to hear it."""
        if self._link is None:
            raise LinkDown(f"the body cannot be told to {order}: {self.why}")
        self._send(encode(Control(order=order, by=by, stop_number=stop_number)))

    def rest(self, resting: bool) -> None:
        """Ask for slow readings, or the full rate, once each way."""
        if resting != self._resting and self._link is not None:
            self._resting = resting
            self._patient_until_s = min(self._patient_until_s, self._clock.now() + SILENCE_S)
            self._send(encode(Control(order="rest" if resting else "wake")))

    def _send(self, data: bytes) -> None:
        if self._link is None:
            return
        try:
            self._link.write(data)
            self.sent += 1
        except LinkDown as error:
            self._say_down(str(error))
