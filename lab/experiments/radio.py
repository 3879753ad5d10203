"""A radio cell of IEEE 802.11b stations, slot by slot: how long a frame takes from its queue to its acknowledgement.

The distributed coordination function of IEEE 802.11-2007 with the constants of its clause 18 (11 Mb/s, long preamble);
path loss in one office floor by ITU-R P.1238 at 2.4 GHz (N = 30); every try fades on its own (Rayleigh). Walls, other
networks and hidden stations are not in it.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from random import Random

SLOT_S, SIFS_S, DIFS_S = 20e-6, 10e-6, 50e-6
PREAMBLE_S = 192e-6
RATE_BPS, ACK_RATE_BPS = 11e6, 2e6
ACK_BYTES, HEAD_BYTES = 14, 28 + 8 + 20 + 32
"""MAC header and checksum, LLC, IP, TCP with its time stamps."""
CW_MIN, CW_MAX = 31, 1023
TRIES = 7
"""dot11ShortRetryLimit; a frame that fails so often is dropped, and TCP sends it again."""
RTO_S = 0.2
"""Linux' smallest retransmission time-out."""
TRANSMIT_DBM, NOISE_DBM = 15.0, -95.0
"""A common access point's power; thermal noise in 22 MHz and 6 dB of the receiver's."""
WANTED_SNR_DB = 10.0
"""For 11 Mb/s CCK at 8 % of lost frames of 1024 bytes (clause 18.4.8), with a little room."""


def fade_ratio(distance_m: float) -> float:
    """How often a single try fails at this distance for want of signal: Rayleigh's share below the wanted ratio."""
    loss_db = 20.0 * math.log10(2400.0) + 30.0 * math.log10(max(1.0, distance_m)) - 28.0
    snr_db = TRANSMIT_DBM - loss_db - NOISE_DBM
    return 1.0 - math.exp(-(10.0 ** ((WANTED_SNR_DB - snr_db) / 10.0)))


def frame_s(payload_bytes: int) -> float:
    """On the air, acknowledgement and its gap included."""
    data_s = PREAMBLE_S + (payload_bytes + HEAD_BYTES) * 8.0 / RATE_BPS
    return data_s + SIFS_S + PREAMBLE_S + ACK_BYTES * 8.0 / ACK_RATE_BPS


@dataclass(order=True, slots=True)
class Frame:
    """`station` wants to send `payload_bytes` at `ready_s`; `next` follows, from the other side, once it has arrived."""

    ready_s: float
    number: int
    station: int = field(compare=False)
    payload_bytes: int = field(compare=False)
    message: int = field(compare=False)
    then: tuple[tuple[int, int, float], ...] = field(compare=False, default=())
    """(station, bytes, seconds of work before) of what the other side sends in turn."""
    tries: int = field(compare=False, default=0)
    backoff: int = field(compare=False, default=-1)


def exchanged(
    messages: Iterable[tuple[float, int, tuple[tuple[int, int, float], ...]]], fade: float, rng: Random
) -> list[float]:
    """How long each message's whole exchange took [s], in the order given.

    A message is (when, sender, frames as (station, bytes, seconds of work before it)), carried one after another. All
    stations hear each other; two that choose the same slot collide.
    """
    waiting: list[Frame] = []
    began: dict[int, float] = {}
    for number, (at_s, _, frames) in enumerate(messages):
        station, size, work_s = frames[0]
        began[number] = at_s
        heapq.heappush(waiting, Frame(at_s + work_s, number, station, size, number, tuple(frames[1:])))
    ended = dict.fromkeys(began, math.nan)
    contending: dict[int, list[Frame]] = {}
    now_s = 0.0
    while waiting or contending:
        if not contending:
            now_s = max(now_s, waiting[0].ready_s)
        while waiting and waiting[0].ready_s <= now_s:
            frame = heapq.heappop(waiting)
            contending.setdefault(frame.station, []).append(frame)
        heads = [queue[0] for queue in contending.values()]
        for frame in heads:
            if frame.backoff < 0:
                frame.backoff = rng.randint(0, min(CW_MAX, (CW_MIN + 1) * 2**frame.tries - 1))
        slots = min(frame.backoff for frame in heads)
        senders = [frame for frame in heads if frame.backoff == slots]
        for frame in heads:
            frame.backoff -= slots
        busy_s = max(frame_s(frame.payload_bytes) for frame in senders)
        now_s += DIFS_S + slots * SLOT_S + busy_s
        for frame in senders:
            frame.backoff = -1
            failed = len(senders) > 1 or rng.random() < fade
            if failed and frame.tries + 1 < TRIES:
                frame.tries += 1
                continue
            queue = contending[frame.station]
            queue.pop(0)
            if not queue:
                del contending[frame.station]
            if failed:
                frame.tries, frame.ready_s = 0, now_s + RTO_S
                heapq.heappush(waiting, frame)
            elif frame.then:
                (station, size, work_s), *rest = frame.then
                following = Frame(now_s + work_s, frame.number, station, size, frame.message, tuple(rest))
                heapq.heappush(waiting, following)
            else:
                ended[frame.message] = now_s
    return [ended[number] - began[number] for number in sorted(began)]
