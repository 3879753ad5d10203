"""Hagisonic StarGazer driver: fills `hw.ports.Localizer`.

A fix is the sensor's pose in the frame of the marker it saw; `core.estimation.markers.world_pose` takes it to the world.
The device takes commands one byte at a time with 30 to 50 ms between them and acknowledges each by an echo.
"""

from __future__ import annotations

import math

from core.clock import Clock
from core.errors import DriverTimeout
from hw.drivers.session import LONG_REST_S, Pulse, Session
from hw.links import Opener
from hw.ports import MarkerFix
from hw.protocols import stargazer as wire

SILENCE_S = 3.0
SILENCE_RESTING_S = 20.0
KEEPALIVE_S = 10.0
"""How often a resting device is asked to prove that it is there."""
LULL_S = 300.0
"""The same after a long rest: eleven bytes, each with a gap after it."""
ACK_S = 1.0
TRIES = 4
RANGE_CM_MAX = 1000.0
LATENCY_S = 0.06
"""From the image to the last byte of its frame: fixes are stamped that much before they came."""


class StargazerDriver(Session):
    """A StarGazer at `url`. `latency_s` is subtracted from the time of arrival to stamp a fix."""

    def __init__(
        self, url: str, opener: Opener, clock: Clock, *, latency_s: float = LATENCY_S, name: str = "stargazer"
    ) -> None:
        super().__init__(url, opener, clock, name=name, silence_s=SILENCE_S)
        self._latency_s = latency_s
        self._reader = wire.FrameReader()
        self._fix: MarkerFix | None = None
        self._arrived, self._acked, self._wake = Pulse(), Pulse(), Pulse()
        self._resting = False
        self._resting_since_s = 0.0
        self._ack = ""
        self.fixes = 0
        """Fixes with a marker since the driver was made."""
        self.dead_zones = 0
        """Reports of no marker in view."""
        self.garbled = 0
        """Frames that were no message, or out of range."""

    @property
    def fix(self) -> MarkerFix | None:
        return self._fix

    async def wait_fix(self) -> MarkerFix:
        """The next report, which may be a dead zone (`marker_id` None)."""
        await self._arrived.wait()
        assert self._fix is not None
        return self._fix

    def rest(self, resting: bool) -> None:
        """Stop the device's calculation, or start it again (which takes it half a second)."""
        if resting != self._resting:
            self._resting, self._resting_since_s = resting, self._clock.now()
            self._wake.fire()

    def _gone(self) -> None:
        self._reader = wire.FrameReader()
        self._ack = ""
        self.silence_s = SILENCE_S

    async def _converse(self) -> None:
        while True:
            resting = self._resting
            await self._command("CalcStop" if resting else "CalcStart")
            if self._resting == resting:
                await self._pause(self._keepalive_s() if resting else None, self._wake)

    def _keepalive_s(self) -> float:
        if self._clock.now() - self._resting_since_s <= LONG_REST_S:
            return KEEPALIVE_S
        self.silence_s = SILENCE_RESTING_S + LULL_S
        return LULL_S

    async def _command(self, name: str) -> None:
        """Send until acknowledged; pose frames come in between."""
        self.silence_s = max(self.silence_s, SILENCE_RESTING_S)
        for _ in range(TRIES):
            self._ack = ""
            for byte in wire.encode(wire.Command(name)):
                self._send(bytes((byte,)))
                await self._clock.sleep(wire.BYTE_GAP_S)
            if self._ack != name:
                await self._pause(ACK_S, self._acked)
            if self._ack == name:
                return
        raise DriverTimeout(self._url, TRIES * ACK_S)

    async def _pause(self, seconds: float | None, until: Pulse) -> None:
        try:
            async with self._clock.timeout(seconds):
                await until.wait()
        except TimeoutError:
            return

    def _received(self, data: bytes) -> None:
        for text in self._reader.feed(data):
            self._take(wire.parse(text))

    def _take(self, message: wire.Message | None) -> None:
        match message:
            case wire.Poses(kind, views) if kind in "I12":
                self._report(min(views, key=lambda view: math.hypot(view.x_cm, view.y_cm)))
            case wire.DeadZone():
                self.dead_zones += 1
                self._publish(MarkerFix(stamp_s=self._clock.now() - self._latency_s, marker_id=None))
            case wire.Ack(text):
                self._ack = text
                self._acked.fire()
                self._heard()
            case wire.Poses() | wire.Value() | wire.Note():
                self._heard()
            case _:
                self.garbled += 1

    def _report(self, view: wire.MarkerView) -> None:
        """The nearest marker's view as a fix; there is no checksum, so a wild one is taken for damage."""
        if max(abs(view.x_cm), abs(view.y_cm), view.z_cm) > RANGE_CM_MAX:
            self.garbled += 1
            return
        x_m, y_m, yaw_rad = view.pose()
        stamp_s = self._clock.now() - self._latency_s
        self.fixes += 1
        self._publish(
            MarkerFix(
                stamp_s=stamp_s,
                marker_id=view.marker_id,
                x_m=x_m,
                y_m=y_m,
                yaw_rad=yaw_rad,
                height_m=view.z_cm * 0.01,
            )
        )

    def _publish(self, fix: MarkerFix) -> None:
        self._fix = fix
        if self._ack == "CalcStart":
            self.silence_s = SILENCE_S
        self._heard()
        self._arrived.fire()
