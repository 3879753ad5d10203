"""An Arduino with StandardFirmata: soil probes on analog channels, taps on digital pins.

StandardFirmata answers each "report this channel" with a fresh conversion at once, so a set of samples is asked for in one
message that also ends the reporting. An older firmware, which does not, is listened to at the sampling interval instead.
A quiet board costs nothing. The firmware has no watchdog: while a tap is open its pin is asked for every quarter second,
and silence breaks the connection, whose successor shuts all taps first.
"""

from __future__ import annotations

import asyncio
import math

from core.clock import Clock
from core.errors import DriverTimeout, LinkDown, Refused
from hw.drivers.session import Pulse, Session
from hw.links import Opener
from hw.ports import LinkStatus
from hw.protocols import firmata as wire
from hw.protocols.vh400 import code_volts

GREET_S = 0.5
GREETING_S_MAX = 6.0
"""An Arduino restarts when its port is opened and answers about two seconds later."""
BURST_S = 0.25
"""A board that gives a set of samples at once does it within this time."""
BURST_SAMPLES_MAX = 16
"""What is asked at once must fit into an Uno's 64 bytes of receive buffer."""
SAMPLE_INTERVAL_MS = 20
SILENCE_S = 1.0
TEND_S = 0.25
OPEN_S_MAX = 600.0


class FirmataBoard(Session):
    """One board at `url`. Hand out its parts with `probe` and `valve`; `run` (any part's will do) serves them all."""

    def __init__(
        self,
        url: str,
        opener: Opener,
        clock: Clock,
        *,
        vref_v: float = 5.0,
        bits: int = 10,
        name: str = "firmata",
    ) -> None:
        super().__init__(url, opener, clock, name=name, silence_s=GREETING_S_MAX)
        self._vref_v, self._bits = vref_v, bits
        self._reader = wire.FirmataReader(to_host=True)
        self._running, self._sampling = asyncio.Lock(), asyncio.Lock()
        self._greeted, self._arrived, self._wake = Pulse(), Pulse(), Pulse()
        self._version: wire.Version | None = None
        self._channel, self._codes, self._wanted = -1, list[int](), 0
        self._shut_at_s: dict[int, float] = {}
        """Taps: when to shut; -inf while a shut tap has not confirmed, absent once it has."""
        self._taps: set[int] = set()

    def probe(self, channel: int) -> FirmataProbe:
        """The soil probe on analog input `channel` (A0 is 0)."""
        return FirmataProbe(self, channel)

    def valve(self, pin: int) -> FirmataValve:
        """The tap on digital output `pin`: shut at every connection."""
        self._taps.add(pin)
        return FirmataValve(self, pin)

    async def run(self) -> None:
        """As `Session.run`; a second caller waits, and takes over should the first end."""
        async with self._running:
            await super().run()

    async def sample(self, channel: int, count: int) -> tuple[float, ...]:
        """`count` fresh voltages of one channel [V]; DriverTimeout when they are a second late.

        They come as fast as the wire takes them (0.35 ms apart at 57600 baud), or 20 ms apart from an older firmware.
        """
        async with self._sampling:
            await self._wait_up()
            self._channel, self._codes, self._wanted = channel, [], count
            try:
                if count > BURST_SAMPLES_MAX or not await self._burst(channel, count):
                    await self._stream(channel, count)
            finally:
                self._channel = -1
            return tuple(code_volts(code, self._vref_v, self._bits) for code in self._codes[:count])

    async def _burst(self, channel: int, count: int) -> bool:
        """Ask for all samples at once; False when they do not come so."""
        once, end = wire.encode_report_analog(channel, True), wire.encode_report_analog(channel, False)
        return await self._collected(once * count + end, BURST_S)

    async def _stream(self, channel: int, count: int) -> None:
        """Let the channel report at the sampling interval until the samples are there."""
        within_s = SILENCE_S + count * SAMPLE_INTERVAL_MS / 1000.0
        try:
            if not await self._collected(wire.encode_report_analog(channel, True), within_s - BURST_S):
                self.silence_s = SILENCE_S  # unless it speaks now, this connection ends and the board is set up anew
                raise DriverTimeout(self._url, within_s)
        finally:
            self._send(wire.encode_report_analog(channel, False))

    def now(self) -> float:
        """Garden time [s]."""
        return self._clock.now()

    def set_tap(self, pin: int, shut_at_s: float) -> None:
        """Open a tap until garden time `shut_at_s`, or shut it when that is past. Raises LinkDown when it cannot open."""
        opening = shut_at_s > self._clock.now()
        sent = self._version is not None and self._send(wire.encode_pin_value(pin, opening))
        if opening and not sent:
            raise LinkDown(f"{self._url} is down: {self.link.why}", hint="the tap stays shut")
        if sent:
            self._shut_at_s[pin] = shut_at_s if opening else -math.inf
            self._watch_taps()

    async def _wait_up(self) -> None:
        if self.link.up:
            return
        try:
            async with self._clock.timeout(SILENCE_S):
                await self.wait_link()
        except TimeoutError:
            raise LinkDown(f"{self._url} is down: {self.link.why}") from None

    async def _collected(self, request: bytes, within_s: float) -> bool:
        """Ask; True once all samples are there, False when they are late. Raises LinkDown."""
        if not self._send(request):
            raise LinkDown(f"{self._url} is down: {self.link.why}")
        try:
            async with self._clock.timeout(within_s):
                await self._arrived.wait()
        except TimeoutError:
            return False
        if self._version is None:
            raise LinkDown(f"{self._url} went down while sampling")
        return True

    def _watch_taps(self) -> None:
        """Silence matters while a tap is open, and only then."""
        if self._shut_at_s and self.silence_s > SILENCE_S:
            self._heard_s = self._clock.now()
            self.silence_s = SILENCE_S
        self._wake.fire()

    async def _converse(self) -> None:
        while self._version is None:
            self._send(bytes((wire.REPORT_VERSION,)))
            await self._pause(GREET_S, self._greeted)
        while True:
            if not self._shut_at_s:
                await self._wake.wait()
            self._tend()
            now_s = self._clock.now()
            ends_s = [end_s - now_s for end_s in self._shut_at_s.values() if end_s > now_s]
            await self._pause(min([TEND_S, *ends_s]), self._wake)

    def _tend(self) -> None:
        """Shut what is due, and ask every tap that is not known to be shut how it stands."""
        now_s = self._clock.now()
        for pin, end_s in self._shut_at_s.items():
            if end_s <= now_s + 1e-6:
                self._shut_at_s[pin] = -math.inf
                self._send(wire.encode_pin_value(pin, False))
            self._send(wire.sysex(wire.PIN_STATE_QUERY, bytes((pin,))))

    async def _pause(self, seconds: float, until: Pulse) -> None:
        try:
            async with self._clock.timeout(seconds):
                await until.wait()
        except TimeoutError:
            return

    def _received(self, data: bytes) -> None:
        for message in self._reader.feed(data):
            self._take(message)

    def _take(self, message: wire.Message) -> None:
        match message:
            case wire.Version():
                self._begin(message)
            case wire.Analog(channel, value) if channel == self._channel:
                self._codes.append(value)
                if len(self._codes) >= self._wanted:
                    self._arrived.fire()
            case wire.Sysex(wire.PIN_STATE_RESPONSE, data) if len(data) >= 3:
                self._confirm(data[0], bool(data[2]))
        if self._version is not None:
            self._heard()

    def _begin(self, version: wire.Version) -> None:
        """The board has answered, or has restarted by itself: shut the taps, stop old reports, set the pace."""
        self._version = version
        self.silence_s = math.inf
        self._shut_at_s = dict.fromkeys(self._taps, -math.inf)
        self._send(b"".join(self._shutting(pin) for pin in sorted(self._taps)))
        self._send(wire.encode_sampling_interval(SAMPLE_INTERVAL_MS))
        self._greeted.fire()
        self._watch_taps()

    def _shutting(self, pin: int) -> bytes:
        return wire.encode_pin_mode(pin, wire.MODE_OUTPUT) + wire.encode_pin_value(pin, False)

    def _confirm(self, pin: int, high: bool) -> None:
        if self._shut_at_s.get(pin) == -math.inf and not high:
            del self._shut_at_s[pin]
            if not self._shut_at_s:
                self.silence_s = math.inf

    def _gone(self) -> None:
        self._reader = wire.FirmataReader(to_host=True)
        self._version = None
        self._shut_at_s.clear()
        self.silence_s = GREETING_S_MAX
        self._arrived.fire()

    def _farewell(self) -> bytes:
        reports = b"" if self._channel < 0 else wire.encode_report_analog(self._channel, False)
        return b"".join(self._shutting(pin) for pin in sorted(self._taps)) + reports


class FirmataProbe:
    """Fills `hw.ports.SoilProbe` on one analog channel of a board."""

    def __init__(self, board: FirmataBoard, channel: int) -> None:
        self._board, self._channel = board, channel

    @property
    def link(self) -> LinkStatus:
        return self._board.link

    async def sample(self, count: int) -> tuple[float, ...]:
        return await self._board.sample(self._channel, count)

    async def run(self) -> None:
        await self._board.run()


class FirmataValve:
    """Fills `hw.ports.Valve` on one digital pin of a board."""

    def __init__(self, board: FirmataBoard, pin: int) -> None:
        self._board, self._pin = board, pin

    @property
    def link(self) -> LinkStatus:
        return self._board.link

    async def open_for(self, for_s: float) -> None:
        """Open now, return at once, shut after `for_s`. Raises LinkDown, or Refused for a time out of bounds."""
        if not 0.0 < for_s <= OPEN_S_MAX:
            raise Refused(f"a tap opens for more than 0 and at most {OPEN_S_MAX:g} s, not {for_s}")
        self._board.set_tap(self._pin, self._board.now() + for_s)

    async def shut(self) -> None:
        """Shut now; while the link is down, first thing when it is back."""
        self._board.set_tap(self._pin, -math.inf)

    async def run(self) -> None:
        await self._board.run()
