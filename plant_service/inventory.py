"""The fruit inventory: one document at the plant, served as ready bytes."""

from __future__ import annotations

from core.errors import NotFound, PreconditionFailed
from core.wire.documents import Document
from core.wire.fruit import Fruit, Inventory, NewFruit, Scan

SCANS_KEPT = 32
FRUITS_MAX = 500


class InventoryDocument(Document):
    inventory: Inventory
    used: int = 0
    """Fruit numbers given so far."""
    scans: list[str] = []


class Fruits:
    """A machine for `Keeper`: every change makes a new generation."""

    def __init__(self, plant_id: str, document: InventoryDocument | None) -> None:
        document = document or InventoryDocument(inventory=Inventory(plant_id=plant_id))
        self._inventory, self._used, self._scans = document.inventory, document.used, list(document.scans)
        self.dirty = False

    def document(self) -> InventoryDocument:
        return InventoryDocument(inventory=self._inventory, used=self._used, scans=list(self._scans))

    @property
    def inventory(self) -> Inventory:
        return self._inventory

    def add(self, new: NewFruit, now_s: float) -> Fruit:
        """One more fruit; its id is ours to give."""
        self._used += 1
        fruit = Fruit(fruit_id=f"f{self._used}", **new.model_dump(exclude={"robot_pose"}), robot_pose=new.robot_pose,
                      first_seen_s=now_s, last_seen_s=now_s)  # fmt: skip
        self._replace([*self._inventory.fruits, fruit])
        return fruit

    def merge(self, scan: Scan, now_s: float) -> Inventory:
        """Upsert by id; a scan that came before changes nothing."""
        if scan.scan_id in self._scans:
            return self._inventory
        known = {fruit.fruit_id: fruit for fruit in self._inventory.fruits}
        for fruit in scan.fruits:
            before = known.get(fruit.fruit_id)
            first_s = before.first_seen_s if before else now_s
            known[fruit.fruit_id] = fruit.model_copy(update={"first_seen_s": first_s, "last_seen_s": now_s})
        self._scans = [*self._scans, scan.scan_id][-SCANS_KEPT:]
        self._replace(list(known.values()))
        return self._inventory

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

    def _replace(self, fruits: list[Fruit]) -> None:
        generation = self._inventory.generation + 1
        kept = fruits[-FRUITS_MAX:]
        self._inventory = self._inventory.model_copy(update={"generation": generation, "fruits": kept})
        self.dirty = True


def etag(inventory: Inventory) -> str:
    return f'"{inventory.generation}"'
