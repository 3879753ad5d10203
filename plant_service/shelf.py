"""Serves the inventory from ready bytes and keeps every change durable before it is seen."""

from __future__ import annotations

from starlette.responses import Response

from core.clock import Clock
from core.wire.fruit import Inventory, NewFruit
from plant_service.inventory import Fruits, InventoryDocument, etag
from plant_service.keeper import Keeper
from plant_service.texts import FruitTexts

JSON = "application/json"


class Shelf:
    """What is answered is what is durable: the bytes change only after a commit."""

    def __init__(self, keeper: Keeper[Fruits, InventoryDocument], clock: Clock, texts: FruitTexts) -> None:
        self._keeper, self._clock, self._texts = keeper, clock, texts
        self._shown = keeper.machine.inventory
        self._whole = self._answer(self._shown)

    @property
    def broken(self) -> str:
        return self._keeper.broken

    def whole(self) -> Response:
        """All fruits; the same object as long as nothing changes."""
        durable = self._keeper.durable
        if durable is not None and durable.inventory is not self._shown:
            self._shown = durable.inventory
            self._whole = self._answer(self._shown)
        return self._whole

    def answer(self, colour: str | None, if_none_match: str) -> Response:
        """The inventory, a part of it, or 304."""
        whole = self.whole()
        if if_none_match and etag(self._shown) in [part.strip() for part in if_none_match.split(",")]:
            return Response(status_code=304, headers={"etag": etag(self._shown)})
        if colour is None:
            return whole
        fruits = [fruit for fruit in self._shown.fruits if fruit.colour == colour]
        part = self._shown.model_copy(update={"fruits": fruits})
        return Response(part.model_dump_json(exclude_none=True), headers={"etag": etag(part)}, media_type=JSON)

    async def add(self, fruit: NewFruit) -> Response:
        """The new fruit, where it is, and the ETag after it."""
        added, now = await self._keeper.change(lambda fruits: (fruits.add(fruit, self._clock.now()), etag(fruits.inventory)))
        headers = {"location": f"/inventory/fruits/{added.fruit_id}", "etag": now}
        return Response(added.model_dump_json(exclude_none=True), 201, headers, media_type=JSON)

    async def remove(self, fruit_id: str, if_match: str) -> str:
        """The ETag afterwards; raises PreconditionFailed or NotFound."""
        return etag(await self._keeper.change(lambda fruits: fruits.remove(fruit_id, if_match)))

    def close(self) -> None:
        self._keeper.close()

    def _answer(self, inventory: Inventory) -> Response:
        return Response(self._texts.inventory(inventory), headers={"etag": etag(inventory)}, media_type=JSON)
