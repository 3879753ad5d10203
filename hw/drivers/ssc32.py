"""Lynxmotion SSC-32 driver: fills `hw.ports.ServoBoard`.

The board acknowledges no move and stops nothing by itself, so this driver polls what it commands (pulses, `Q`, analog
inputs) and starts every connection by setting all known outputs low and stopping every channel the board still drives.
What was asked while the link was down is dropped, never replayed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from core.clock import Clock
from core.errors import DriverError
from hw.drivers.session import LONG_REST_S, Pulse, Session
from hw.links import Opener
from hw.ports import ServoReading
from hw.protocols import ssc32 as wire

POLL_S = 0.1
"""While servos move or an output is high."""
POLL_STILL_S = 0.5
POLL_RESTING_S = 1.0
LULL_S = 9.0
"""After a long rest it is left alone for so long between polls."""
SETTLE_S = 0.5
"""A move is watched this much longer than it should take."""
ASK_VERSION_S = 0.4
SILENCE_POLLS = 2.5
SILENCE_S_MIN = 0.8
SILENCE_S_MAX = SILENCE_POLLS * POLL_RESTING_S
BUFFER_BYTES_MAX = 256


class Ssc32Driver(Session):
    """An SSC-32 at `url`.

    `outputs` are its discrete outputs (relays): low at connection, at `stop` and at the end. The first `analog_inputs`
    of VA, VB, VC, VD are read.
    """

    def __init__(
        self,
        url: str,
        opener: Opener,
        clock: Clock,
        *,
        outputs: Iterable[int] = (),
        analog_inputs: int = 2,
        name: str = "ssc32",
    ) -> None:
        super().__init__(url, opener, clock, name=name, silence_s=SILENCE_S_MAX)
        self._outputs = set(outputs)
        self._high: set[int] = set()
        self._analog_inputs = analog_inputs
        self._busy_until_s = -math.inf
        self._period_s = POLL_RESTING_S
        self._resting = False
        self._resting_since_s = 0.0
        self._reading: ServoReading | None = None
        self._known: set[int] = set()
        self._moved: set[int] = set()
        self._told_us: dict[int, int] = {}
        self._buffer = bytearray()
        self._asked: tuple[int, ...] | None = None
        self._identified = False
        self._settled = False
        self._identity = Pulse()
        self._wake = Pulse()
        self.version = ""
        """What VER answered last."""
        self.garbled = 0
        """Answers thrown away because they did not fit their question."""

    @property
    def reading(self) -> ServoReading | None:
        return self._reading

    def move(self, pulses_us: Mapping[int, float], duration_s: float) -> None:
        """Group move, clamped to 500..2500 us. Channels the board does not know jump; the others share `duration_s`.

        Raises ValueError for a pulse or a duration that is not finite, or a channel the board does not have.
        """
        if not all(math.isfinite(value) for value in (*pulses_us.values(), duration_s)):
            raise ValueError(f"a pulse or the duration is not finite: {dict(pulses_us)} in {duration_s} s")
        if not all(0 <= channel < wire.CHANNELS for channel in pulses_us):
            raise ValueError(f"no such channel among {sorted(pulses_us)}; the board has 0 to {wire.CHANNELS - 1}")
        pulses = {channel: min(wire.PULSE_US_MAX, max(wire.PULSE_US_MIN, p)) for channel, p in pulses_us.items()}
        first = {channel: pulse for channel, pulse in pulses.items() if channel not in self._known}
        later = {channel: pulse for channel, pulse in pulses.items() if channel in self._known}
        lines = (wire.encode_move(first) if first else b"") + (wire.encode_move(later, duration_s) if later else b"")
        if lines and self._identified and self._send(lines):
            self._known |= first.keys()
            self._moved |= pulses.keys()
            self._told_us |= {channel: round(pulse) for channel, pulse in pulses.items()}
            self._busy_until_s = max(self._busy_until_s, self._clock.now() + duration_s + SETTLE_S)
            self._wake.fire()

    def output(self, channel: int, high: bool) -> None:
        """Discrete output; remembered as one to set low."""
        self._outputs.add(channel)
        if not high:
            self._high.discard(channel)
            # Said twice: what a flipped bit makes of one, the other sets right at once.
            self._send(2 * wire.encode_outputs({channel: False}))
        elif self._identified and self._send(wire.encode_outputs({channel: True})):
            self._high.add(channel)
            self._wake.fire()

    def stop(self) -> None:
        """One write: outputs low first, then STOP for every channel ever moved."""
        self._high.clear()
        self._send(self._quiet())

    def rest(self, resting: bool) -> None:
        """Poll at 1 Hz, or at 2 Hz; while something moves always at 10 Hz."""
        if resting != self._resting:
            self._resting, self._resting_since_s = resting, self._clock.now()
            self._wake.fire()

    def _quiet(self) -> bytes:
        low = wire.encode_outputs(dict.fromkeys(sorted(self._outputs), False)) if self._outputs else b""
        return low + wire.encode_stop(sorted(self._moved))

    def _farewell(self) -> bytes:
        return self._quiet()

    def _gone(self) -> None:
        self._buffer.clear()
        self._known.clear()
        self._told_us.clear()
        self._high.clear()
        self._asked = None
        self._identified = self._settled = False
        self._busy_until_s = -math.inf
        self.silence_s = SILENCE_S_MAX

    async def _converse(self) -> None:
        self._send(b"\x1b\r" + self._quiet())
        while not self._identified:
            self._buffer.clear()
            self._send(wire.VERSION)
            await self._pause(ASK_VERSION_S, self._identity)
        self._ask(tuple(range(wire.CHANNELS)))
        while True:
            self._period_s = self._poll_s()
            self.silence_s = max(self.silence_s, self._patience_s())
            await (self._clock.sleep(POLL_S) if self._period_s == POLL_S else self._pause(self._period_s, self._wake))
            if self._lulled():
                self.silence_s = SILENCE_S_MAX + LULL_S
                await self._pause(LULL_S, self._wake)
            self._ask(tuple(sorted(self._known)))

    def _lulled(self) -> bool:
        """Resting for long, and the last poll was answered."""
        still = self._resting and self._poll_s() != POLL_S
        return still and self._asked is None and self._clock.now() - self._resting_since_s > LONG_REST_S

    def _poll_s(self) -> float:
        if self._high or self._clock.now() < self._busy_until_s:
            return POLL_S
        return POLL_RESTING_S if self._resting else POLL_STILL_S

    def _patience_s(self) -> float:
        return max(SILENCE_S_MIN, SILENCE_POLLS * self._period_s)

    async def _pause(self, seconds: float, until: Pulse) -> None:
        try:
            async with self._clock.timeout(seconds):
                await until.wait()
        except TimeoutError:
            return

    def _ask(self, channels: tuple[int, ...]) -> None:
        """One write for everything: pulses, analog inputs, and `Q`, whose answer marks the end.

        Outputs are said again each time: nothing can be read back, and one flipped bit makes an H of an L.
        """
        self._buffer.clear()
        self._asked = channels
        levels = {output: output in self._high for output in sorted(self._outputs)}
        outputs = wire.encode_outputs(levels) if levels else b""
        pulses = wire.encode_query_pulses(channels) if channels else b""
        self._send(outputs + pulses + wire.encode_query_analog(range(self._analog_inputs)) + wire.QUERY_MOVING)

    def _received(self, data: bytes) -> None:
        self._buffer += data
        if not self._identified:
            self._identify()
        elif self._asked is not None and len(self._buffer) >= (size := len(self._asked) + self._analog_inputs + 1):
            self._take(bytes(self._buffer), size)
            self._buffer.clear()
        del self._buffer[:-BUFFER_BYTES_MAX]

    def _identify(self) -> None:
        text, end, _ = self._buffer.partition(b"\r")
        if not end:
            return
        if b"SSC32" not in text:
            self._buffer.clear()
            raise DriverError(f"{self._url} answers VER with {bytes(text[-40:])!r}", hint="is this an SSC-32?")
        self.version = text[text.index(b"SSC32") :].decode("ascii", "replace")
        self._identified = True
        self._buffer.clear()
        self._identity.fire()

    def _take(self, answer: bytes, size: int) -> None:
        """A whole answer; one of a wrong length or without `Q`'s mark is thrown away and asked again."""
        channels, self._asked = self._asked or (), None
        if len(answer) != size or answer[-1:] not in (wire.DONE, wire.MOVING):
            self.garbled += 1
            return
        counts = dict(zip(channels, answer, strict=False))
        self._learn(counts)
        analog = tuple(wire.volts_of(count) for count in answer[len(channels) : -1]) if self._settled else ()
        self._settled = True
        self._reading = ServoReading(
            stamp_s=self._clock.now(),
            pulses_us={channel: self._pulse_us(channel, count) for channel, count in counts.items() if count},
            moving=answer[-1:] == wire.MOVING,
            analog_v=analog,
        )
        self.silence_s = self._patience_s()
        self._heard()

    def _pulse_us(self, channel: int, count: int) -> float:
        """`QP` answers in tens of microseconds: where that agrees with what the channel was told, this is the finer word."""
        seen_us, told_us = count * wire.QUERY_PULSE_US, self._told_us.get(channel)
        return float(told_us) if told_us is not None and abs(told_us - seen_us) < wire.QUERY_PULSE_US else float(seen_us)

    def _learn(self, counts: Mapping[int, int]) -> None:
        """Channels the board drives are known; one that it drives no more tells of a lost supply."""
        driven = {channel for channel, count in counts.items() if count}
        lost = self._known & counts.keys() - driven
        if lost:
            self._log.warning("the board forgot channels: did it lose its supply?", channels=sorted(lost))
            self._settled = False
            self._known -= lost
        if inherited := driven - self._known - self._moved:
            self._send(wire.encode_stop(sorted(inherited)))
        self._moved |= driven
        self._known |= driven
