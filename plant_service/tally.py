"""How often what happened in a pot's market, since its process began; for `/metrics`."""

from __future__ import annotations

import re
from collections import Counter

from core.allocation.plant_state import Effect, Kill, Note, Solicit

WORDS = {
    "awards": re.compile("^awarded to "),
    "reawards": re.compile(": moved from "),
    "leases_lost": re.compile(" fell silent "),
    "awards_refused": re.compile(" refused the award: "),
    "permits": re.compile("^permit "),
    "doses_lost": re.compile("the dose did not arrive|doses: look at nozzle"),
}
"""By what a task's events say of it; tests hold these words against the market's machine."""


class Tally:
    """Counts the effects that a market carries out."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys((*WORDS, "rounds", "kills", "done", "failed", "cancelled"), 0))

    def take(self, effect: Effect) -> None:
        if isinstance(effect, Solicit):
            self.counts["rounds"] += 1
        elif isinstance(effect, Kill):
            self.counts["kills"] += 1
        elif isinstance(effect, Note):
            self._note(effect)

    def _note(self, note: Note) -> None:
        for name, words in WORDS.items():
            self.counts[name] += words.search(note.what) is not None
        if note.kind in ("done", "failed", "cancelled"):
            self.counts[note.kind] += 1
