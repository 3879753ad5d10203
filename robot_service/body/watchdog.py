"""A loop that hangs stops nothing, so a timer of the system looks after it: late, it is the interrupt that says stop.

No thread: the interrupt comes in between two instructions of whatever keeps the loop, and writes the devices' last words
straight to their wires. It cannot break into a library's single long call, and dies with the process: that is what the
relay of a real robot is for. On the virtual clock there is none, for nothing there can be late.
"""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Mapping

import structlog

from core.robots import gardener
from hw.links import ByteLink, Opener, StreamLink
from hw.protocols import create, ssc32
from robot_service.body.body import BodyNode
from robot_service.body.settings import BodySettings

LATE_S = 0.3
"""Wall seconds without a turn of the loop."""
DOUBT_S = 0.05
"""A process that was not let run at all gets so long to show that its loop turns."""
BEAT_S, RESTING_BEAT_S = 0.1, 0.5
_log = structlog.get_logger("robot.body.watchdog")


def last_words(settings: BodySettings) -> Mapping[str, bytes]:
    """By URL, what stops a device, said twice: half a message may stand before it."""
    channels = [servo.channel for servo in (*gardener.SERVOS.values(), gardener.ROLL_SERVO)]
    servos = ssc32.encode_outputs({gardener.PUMP_CHANNEL: False}) + ssc32.encode_stop(channels)
    return {
        settings.servo_url: 2 * (b"\x1b\r" + servos),
        settings.base_url: 2 * (create.drive_direct(0, 0) + create.bare(create.Op.START)),
    }


class Wires:
    """Opens links and remembers the newest of each URL."""

    def __init__(self, opener: Opener) -> None:
        self._opener = opener
        self._links: dict[str, ByteLink] = {}

    async def open(self, url: str) -> ByteLink:
        self._links[url] = link = await self._opener(url)
        return link

    def say(self, words: Mapping[str, bytes]) -> None:
        """At once, past the loop; a wire that is cut is passed over."""
        for url, data in words.items():
            if isinstance(link := self._links.get(url), StreamLink):
                link.write_past_the_loop(data)


class Watchdog:
    """Only in the main thread, and one a process: the system has one such timer."""

    def __init__(self, body: BodyNode, wires: Wires, words: Mapping[str, bytes]) -> None:
        self._body, self._wires, self._words = body, wires, words
        self._doubts = False
        self.spoke = 0
        """How often it had to say the last words."""

    async def run(self) -> None:
        """For ever: wind the timer up; after it has spoken, bring the body's memory in line with its devices."""
        before, spoke = signal.signal(signal.SIGALRM, self._late), self.spoke
        try:
            while True:
                beat_s = BEAT_S if self._body.busy else RESTING_BEAT_S
                self._doubts = False
                signal.setitimer(signal.ITIMER_REAL, beat_s - BEAT_S + LATE_S)
                await asyncio.sleep(beat_s)
                if self.spoke > spoke:
                    spoke = self.spoke
                    self._body.hung()
                    _log.error("the loop hung: everything was stopped", times=spoke)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)

    def _late(self, *_: object) -> None:
        if not self._doubts:
            self._doubts = True
            signal.setitimer(signal.ITIMER_REAL, DOUBT_S)
            return
        if self._body.busy:
            self._wires.say(self._words)
            self.spoke += 1
        signal.setitimer(signal.ITIMER_REAL, LATE_S)
