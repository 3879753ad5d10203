"""The inventory as JSON: a fruit that has not changed is not encoded again."""

from __future__ import annotations

from core.wire.fruit import Fruit, Inventory
from plant_service.inventory import InventoryDocument


class FruitTexts:
    """Knows the JSON of the fruits it saw last, by object: documents are frozen. May be asked from several threads."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Fruit, bytes]] = {}
        self._last: tuple[Inventory | None, bytes] = (None, b"")

    def inventory(self, inventory: Inventory) -> bytes:
        """What is not known (null) is left out: it is the same document."""
        last, text = self._last
        if last is not inventory:
            text = self._encode(inventory)
            self._last = inventory, text
        return text

    def stored(self, document: InventoryDocument) -> bytes:
        """The whole document as it is kept on disk."""
        rest = document.model_dump_json(exclude={"inventory"}).encode()
        return b'{"inventory":' + self.inventory(document.inventory) + b"," + rest[1:]

    def _encode(self, inventory: Inventory) -> bytes:
        known, fruits = self._known, inventory.fruits
        if len(known) > 2 * len(fruits):
            known = self._known = {id(fruit): known[id(fruit)] for fruit in fruits if id(fruit) in known}
        # An entry holds its fruit, so that no other can have the fruit's number while we know it.
        texts = [(known.get(id(fruit)) or self._learn(fruit))[1] for fruit in fruits]
        head = inventory.model_dump_json(exclude={"fruits"}, exclude_none=True).encode()
        return head[:-1] + b',"fruits":[' + b",".join(texts) + b"]}"

    def _learn(self, fruit: Fruit) -> tuple[Fruit, bytes]:
        entry = self._known[id(fruit)] = fruit, fruit.model_dump_json(exclude_none=True).encode()
        return entry
