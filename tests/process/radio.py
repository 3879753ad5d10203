"""A bad radio: carries Ethernet frames between TAP devices of network namespaces, and loses, doubles, delays and swaps them.

`python radio.py SEED NAMESPACE...` opens the device `radio` in each and reads weathers as JSON lines from stdin:
`{"loss": 0.2, "double": 0.05, "swap": 0.2, "delay_s": 0.1, "spread_s": 0.08}`. It tells its counts at the end of stdin.
"""

from __future__ import annotations

import fcntl
import heapq
import itertools
import json
import os
import random
import select
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator

from pyroute2 import netns

DEVICE = "radio"
FRAME_BYTES = 2048
TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
EVERYBODY = 1
"""Bit of a destination address that is meant for more than one."""


def opened(space: str) -> int:
    """The TAP device `radio` of a namespace, as a file."""
    netns.pushns(space)
    try:
        fd = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(fd, TUNSETIFF, struct.pack("16sH", DEVICE.encode(), IFF_TAP | IFF_NO_PI))
    finally:
        netns.popns()
    return fd


class Radio:
    def __init__(self, seed: int, fds: list[int]) -> None:
        self._rng, self._fds = random.Random(seed), fds
        self.weather = {"loss": 0.0, "double": 0.0, "swap": 0.0, "delay_s": 0.0, "spread_s": 0.0}
        self.counts: Counter[str] = Counter()
        self._homes: dict[bytes, int] = {}
        self._air: list[tuple[float, int, int, bytes]] = []
        self._last: dict[tuple[int, int], float] = {}
        self._number = itertools.count()

    def take(self, source: int, frame: bytes, now_s: float) -> None:
        """Put a frame into the air, once for everybody who shall hear it."""
        self._homes[frame[6:12]] = source
        home = None if frame[0] & EVERYBODY else self._homes.get(frame[:6])
        for target in self._fds if home is None else [home]:
            if target != source:
                for at_s in self._fates(source, target, now_s):
                    heapq.heappush(self._air, (at_s, next(self._number), target, frame))

    def _fates(self, source: int, target: int, now_s: float) -> Iterator[float]:
        rng, weather = self._rng, self.weather
        self.counts["frames"] += 1
        if rng.random() < weather["loss"]:
            self.counts["lost"] += 1
            return
        doubled = rng.random() < weather["double"]
        self.counts["doubled"] += doubled
        for _ in range(1 + doubled):
            at_s = now_s + max(0.0, weather["delay_s"] + rng.uniform(-1.0, 1.0) * weather["spread_s"])
            if rng.random() < weather["swap"]:
                self.counts["swapped"] += 1
            else:
                at_s = max(at_s, self._last.get((source, target), 0.0))
                self._last[source, target] = at_s
            yield at_s

    def give(self, now_s: float) -> None:
        """Deliver what has arrived."""
        while self._air and self._air[0][0] <= now_s:
            _, _, target, frame = heapq.heappop(self._air)
            try:
                os.write(target, frame)
            except OSError:
                self.counts["refused"] += 1

    def next_s(self, now_s: float) -> float:
        return max(0.0, self._air[0][0] - now_s) if self._air else 1.0


def main() -> None:
    radio = Radio(int(sys.argv[1]), [opened(space) for space in sys.argv[2:]])
    os.set_blocking(0, False)
    print("ready", flush=True)
    while True:
        ready, _, _ = select.select([0, *radio._fds], [], [], radio.next_s(time.monotonic()))
        for fd in ready:
            if fd == 0:
                line = sys.stdin.readline()
                if not line:
                    print(json.dumps(radio.counts), flush=True)
                    return
                radio.weather |= json.loads(line)
                continue
            try:
                radio.take(fd, os.read(fd, FRAME_BYTES), time.monotonic())
            except BlockingIOError:
                continue
        radio.give(time.monotonic())


if __name__ == "__main__":
    main()
