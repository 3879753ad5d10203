"""The fruit inventory: one document at the plant, and the evidence behind it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from core.errors import NotFound, PreconditionFailed
from core.growth.belief import Pace, learn
from core.growth.forecast import Hope
from core.growth.stages import DAY_S
from core.inventory.ledger import Merged, merge
from core.inventory.track import Evidence, Place, Track
from core.wire.documents import Document
from core.wire.fruit import Fruit, FruitCounts, Inventory, NewFruit, Pick, Scan

SCANS_KEPT = 64
FRUITS_MAX = 500
COUNTED_MIN = 0.5
"""Fruit less likely than this are listed, but not counted."""
LOOK_AGAIN_S, LOOK_AGAIN_S_MAX = 2 * 3600.0, DAY_S
"""Fruit that should have become ripe, or whose pick failed, are looked at again after this; at each failure after twice as
long, up to a day."""
TRY_AGAIN_S = DAY_S
"""An unreachable fruit that has not moved is tried again after a day: plants change without being looked at."""


class InventoryDocument(Document):
    inventory: Inventory
    used: int = 0
    """Fruit numbers given so far."""
    scans: list[str] = []
    evidence: dict[str, Evidence] = {}
    """By fruit id; a fruit that somebody only told of has none."""


class Fruits:
    """A machine for `Keeper`: every change makes a new generation."""

    def __init__(self, plant_id: str, document: InventoryDocument | None) -> None:
        document = document or InventoryDocument(inventory=Inventory(plant_id=plant_id))
        self._inventory, self._used, self._scans = document.inventory, document.used, list(document.scans)
        self._evidence = dict(document.evidence)
        self._outlook: tuple[Inventory | None, Pace, list[Hope]] = (None, Pace(), [])
        self.dirty = False

    def document(self) -> InventoryDocument:
        return InventoryDocument.model_construct(
            inventory=self._inventory, used=self._used, scans=list(self._scans), evidence=dict(self._evidence)
        )

    @property
    def inventory(self) -> Inventory:
        return self._inventory

    def fruit(self, fruit_id: str) -> Fruit | None:
        return next((fruit for fruit in self._inventory.fruits if fruit.fruit_id == fruit_id), None)

    def counts(self) -> FruitCounts:
        colours = [fruit.colour for fruit in self._inventory.fruits if fruit.confidence >= COUNTED_MIN]
        return FruitCounts(green=colours.count("green"), turning=colours.count("turning"), red=colours.count("red"))

    def tracks(self) -> list[Track]:
        return [Track.of(fruit, self._evidence.get(fruit.fruit_id)) for fruit in self._inventory.fruits]

    def outlook(self) -> tuple[Pace, list[Hope]]:
        """How this plant's fruit ripen, and what is believed of each."""
        if self._outlook[0] is not self._inventory:
            tracks = self.tracks()
            pace = learn([track.seen for track in tracks])
            self._outlook = self._inventory, pace, [Hope(track.fruit, track.belief(pace)) for track in tracks]
        return self._outlook[1:]

    def add(self, new: NewFruit, now_s: float) -> Fruit:
        """One more fruit; its id is ours to give."""
        fruit = Fruit(fruit_id=self._name(), **new.model_dump(exclude={"robot_pose"}), robot_pose=new.robot_pose,
                      first_seen_s=now_s, last_seen_s=now_s)  # fmt: skip
        self._replace([*self._inventory.fruits, fruit])
        return fruit

    def knows(self, scan_id: str) -> bool:
        return scan_id in self._scans

    def merge(self, scan: Scan, now_s: float, doubts: Collection[str] = (), undecided: Collection[str] = ()) -> Merged:
        """What a scan saw, and fruit that came with their ids; a scan that came before changes nothing.

        `doubts` are fruit whose pick nobody told the end of: this scan settles them, but for those `undecided`.
        """
        if scan.scan_id in self._scans:
            return Merged([])
        tracks = [track.with_fruit(in_doubt=track.fruit.fruit_id in doubts) for track in self.tracks()]
        pace, _ = self.outlook()
        looked = bool(scan.views or scan.sightings)
        merged = merge(tracks, scan, pace, now_s, self._name, undecided) if looked else Merged(tracks)
        known = {track.fruit.fruit_id: track for track in merged.tracks}
        if looked:
            lost = [n for n in doubts if n not in merged.settled and n not in known and n not in undecided]
            merged.settled.update(dict.fromkeys(lost, False))
        for fruit in scan.fruits:
            before = self.fruit(fruit.fruit_id)
            first_s = before.first_seen_s if before else now_s
            told = fruit.model_copy(update={"first_seen_s": first_s, "last_seen_s": now_s})
            known[fruit.fruit_id] = Track.of(told)
        self._scans = [*self._scans, scan.scan_id][-SCANS_KEPT:]
        self._replace([track.fruit for track in known.values()], scanned_s=now_s if looked else None)
        if looked:
            self._evidence = {name: track.evidence for name, track in known.items()}
        return merged

    def picked(self, picks: Iterable[Pick], now_s: float) -> list[Fruit]:
        """What robots told of their picks; returns the fruit as they were. Telling it again changes nothing."""
        met, fruits = [], list(self._inventory.fruits)
        for pick in picks:
            fruit = next((f for f in fruits if f.fruit_id == pick.fruit_id), None)
            if fruit is None:
                continue
            met.append(fruit)
            fruits.remove(fruit)
            if pick.outcome != "picked" and not pick.gone:
                fruits.append(self._mark(fruit, pick, now_s))
        if met:
            self._replace(fruits)
        return met

    def refresh(self, doubts: Collection[str], now_s: float) -> None:
        """Show which fruit are in doubt, and take away the marks of unreachable fruit that have grown old."""
        old = {name for name, e in self._evidence.items() if e.marked_at is not None and now_s - e.marked_s >= TRY_AGAIN_S}
        fruits = [_refreshed(fruit, fruit.fruit_id in doubts, fruit.fruit_id in old) for fruit in self._inventory.fruits]
        if any(after is not before for after, before in zip(fruits, self._inventory.fruits, strict=True)):
            self._replace(fruits)

    def ripe_since_s(self, fruit_id: str) -> float | None:
        evidence = self._evidence.get(fruit_id)
        return evidence.ripe_since_s if evidence else None

    def look_again_s(self, fruit_id: str) -> float:
        """When a fruit whose pick failed should be looked at: after each failure later, for robots have other work."""
        evidence = self._evidence.get(fruit_id)
        if evidence is None or not evidence.failures:
            return 0.0
        return evidence.failed_s + min(LOOK_AGAIN_S * 2.0 ** (evidence.failures - 1), LOOK_AGAIN_S_MAX)

    def remove(self, fruit_id: str, if_match: str) -> Inventory:
        """Raises PreconditionFailed unless `if_match` is the ETag (or `*`), NotFound for an unknown fruit."""
        if if_match != "*" and etag(self._inventory) not in [part.strip() for part in if_match.split(",")]:
            now = etag(self._inventory)
            raise PreconditionFailed(f"the inventory is at {now}", hint=f"read it again and send If-Match: {now}")
        left = [fruit for fruit in self._inventory.fruits if fruit.fruit_id != fruit_id]
        if len(left) == len(self._inventory.fruits):
            raise NotFound(f"no fruit {fruit_id} here", hint="GET /inventory lists them")
        self._replace(left)
        return self._inventory

    def _mark(self, fruit: Fruit, pick: Pick, now_s: float) -> Fruit:
        """It hangs there still, and why."""
        why = pick.reason or f"{pick.outcome}, no reason given"
        evidence = self._evidence.get(fruit.fruit_id) or Track.of(fruit).evidence
        if pick.outcome == "failed":
            if fruit.failed == why:
                return fruit.model_copy(update={"in_doubt": False})
            tried = {"failures": evidence.failures + 1, "failed_s": now_s}
            self._evidence[fruit.fruit_id] = evidence.model_copy(update=tried)
            return fruit.model_copy(update={"failed": why, "in_doubt": False})
        place = Place(x_m=fruit.x_m, y_m=fruit.y_m, z_m=fruit.z_m)
        self._evidence[fruit.fruit_id] = evidence.model_copy(update={"marked_at": place, "marked_s": now_s})
        return fruit.model_copy(update={"unreachable": why, "in_doubt": False})

    def _name(self) -> str:
        self._used += 1
        return f"f{self._used}"

    def _replace(self, fruits: Sequence[Fruit], scanned_s: float | None = None) -> None:
        changes: dict[str, object] = {"generation": self._inventory.generation + 1, "fruits": list(fruits)[-FRUITS_MAX:]}
        if scanned_s is not None:
            changes |= {"scans": self._inventory.scans + 1, "scanned_s": scanned_s}
        self._inventory = self._inventory.model_copy(update=changes)
        if len(self._evidence) > len(fruits):
            names = {fruit.fruit_id for fruit in self._inventory.fruits}
            self._evidence = {name: e for name, e in self._evidence.items() if name in names}
        self.dirty = True


def _refreshed(fruit: Fruit, in_doubt: bool, reachable: bool) -> Fruit:
    """The same object when nothing changes."""
    unreachable = "" if reachable else fruit.unreachable
    if (fruit.in_doubt, fruit.unreachable) == (in_doubt, unreachable):
        return fruit
    return fruit.model_copy(update={"in_doubt": in_doubt, "unreachable": unreachable})


def etag(inventory: Inventory) -> str:
    return f'"{inventory.generation}"'
