"""The Create's songs: sixteen notes each, played in their real duration."""

from __future__ import annotations

import math

from hw.protocols.create import SONG_NOTES_MAX, SONG_TICK_S


class Songs:
    """Opcodes 140 and 141, packets 36 and 37. `slots` songs can be kept."""

    def __init__(self, slots: int) -> None:
        self._slots = slots
        self._songs: dict[int, tuple[tuple[int, int], ...]] = {}
        self._until_s = -math.inf
        self.number = 0

    def define(self, data: bytes) -> None:
        """Data of opcode 140: number, count, then (note, duration in 1/64 s) pairs."""
        number, count = data[0], data[1]
        if number < self._slots and 1 <= count <= SONG_NOTES_MAX:
            self._songs[number] = tuple(zip(data[2::2], data[3::2], strict=True))

    def play(self, number: int, now_s: float) -> None:
        """Ignored while a song plays, or when there is no such song."""
        notes = self._songs.get(number)
        if notes is not None and not self.playing(now_s):
            self.number = number
            self._until_s = now_s + SONG_TICK_S * sum(duration for _, duration in notes)

    def playing(self, now_s: float) -> bool:
        return now_s < self._until_s
