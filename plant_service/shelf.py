"""Serves the inventory from ready bytes and keeps every change durable before it is seen."""

from __future__ import annotations

from starlette.responses import Response

from core.clock import Clock
from core.wire.fruit import Fruit, Inventory, NewFruit, Scan
from plant_service.inventory import Fruits, InventoryDocument, etag
from plant_service.keeper import Keeper

JSON = "application/json"


class Shelf:
    """What is answered is what is durable: the bytes change only after a commit."""

    def __init__(self, keeper: Keeper[Fruits, InventoryDocument], clock: Clock) -> None:
        self._keeper, self._clock = keeper, clock
        self._shown = keeper.machine.inventory
        self._bytes = self._shown.model_dump_json().encode()

    @property
    def broken(self) -> str:
        return self._keeper.broken

    def answer(self, colour: str | None, if_none_match: str) -> Response:
        """The inventory, a part of it, or 304."""
        self._refresh()
        headers = {"etag": etag(self._shown)}
        if if_none_match and headers["etag"] in [part.strip() for part in if_none_match.split(",")]:
            return Response(status_code=304, headers=headers)
        if colour is None:
            return Response(self._bytes, headers=headers, media_type=JSON)
        fruits = [fruit for fruit in self._shown.fruits if fruit.colour == colour]
        part = self._shown.model_copy(update={"fruits": fruits})
        return Response(part.model_dump_json(), headers=headers, media_type=JSON)

    async def add(self, fruit: NewFruit) -> tuple[Fruit, str]:
        """The new fruit and the ETag after it."""
        added = await self._keeper.change(lambda fruits: (fruits.add(fruit, self._clock.now()), etag(fruits.inventory)))
        return added

    async def merge(self, scan: Scan) -> Inventory:
        return await self._keeper.change(lambda fruits: fruits.merge(scan, self._clock.now()))

    async def remove(self, fruit_id: str, if_match: str) -> str:
        """The ETag afterwards; raises PreconditionFailed or NotFound."""
        return etag(await self._keeper.change(lambda fruits: fruits.remove(fruit_id, if_match)))

    def close(self) -> None:
        self._keeper.close()

    def _refresh(self) -> None:
        durable = self._keeper.durable
        if durable is not None and durable.inventory is not self._shown:
            self._shown = durable.inventory
            self._bytes = self._shown.model_dump_json().encode()
