"""Orders: "N ripe tomatoes", split over the pots by what they know and expect; each pot runs its own auction for its part.

An order lives in the pots: their harvest tasks carry its id. Whoever asks puts it together from them, so that it outlives
the console, and no token is kept.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass

from core.allocation.picking import may_be_picked
from core.errors import Conflict, GardenError, NotFound, Refused
from core.mesh.client import Mesh
from core.mesh.peers import Peer
from core.wire.fruit import Forecast, Inventory
from core.wire.market import FINAL_STATES, Task, TaskRequest
from core.wire.order import Order, OrderPart, OrderRequest, OrderState

PER_TASK_MAX = 64
TOP_UPS_MAX = 3
Send = Callable[[Peer, TaskRequest], Awaitable[Task]]
"""Posts a task at a pot with the right token."""


@dataclass(frozen=True, slots=True)
class Stock:
    """What a pot could give."""

    ripe: int
    """Fruit known to be ripe that may be picked."""
    tomorrow: float = 0.0
    """Ripe fruit expected a day ahead, those of now included."""
    why: str = ""
    """Why it gives nothing."""


def split(count: int, stocks: Mapping[str, Stock]) -> dict[str, int]:
    """How many from which pot: one by one from where most ripe fruit is left, of equals from where more are expected."""
    left = {name: stock.ripe for name, stock in stocks.items() if stock.ripe > 0}
    parts: dict[str, int] = {}
    for _ in range(count):
        if not left:
            break
        name = max(sorted(left), key=lambda pot: (left[pot], stocks[pot].tomorrow))
        parts[name] = parts.get(name, 0) + 1
        left[name] -= 1
        if left[name] == 0 or parts[name] == PER_TASK_MAX:
            del left[name]
    return parts


async def stocks(mesh: Mesh, pots: Sequence[Peer]) -> dict[str, Stock]:
    """Every pot's, by id; one that does not answer gives nothing, and why."""
    listed = await mesh.ask_all(pots, "GET", "/inventory?colour=red", expect=Inventory)
    hoped = await mesh.ask_all(pots, "GET", "/forecast", expect=Forecast)
    asked = await mesh.ask_all(pots, "GET", "/tasks", expect=list[Task])
    return {pot.id: _stock(listed[pot.id], hoped[pot.id], asked[pot.id]) for pot in pots}


def _stock(inventory: Inventory | GardenError, hope: Forecast | GardenError, tasks: list[Task] | GardenError) -> Stock:
    if isinstance(inventory, GardenError):
        return Stock(0, why=str(inventory)[:200])
    promised = {name for task in tasks if _stands(task) for name in task.fruit_ids} if isinstance(tasks, list) else set()
    ripe = [fruit for fruit in inventory.fruits if fruit.fruit_id not in promised and may_be_picked(fruit)]
    never = "was never scanned" if inventory.scanned_s is None and not inventory.fruits else ""
    return Stock(len(ripe), 0.0 if isinstance(hope, GardenError) else hope.ripe, never)


def _stands(task: Task) -> bool:
    """Whether a harvest keeps its fruit from others: a pot's own wish gives way while no robot is at it."""
    return task.kind == "harvest" and task.state not in FINAL_STATES and (task.state == "running" or bool(task.order_id))


async def place(order_id: str, wish: OrderRequest, pots: Sequence[Peer], mesh: Mesh, send: Send) -> list[OrderPart]:
    """Ask the pots; raises Refused when no pot knows a ripe fruit. A pot that refuses has a part that failed, and why."""
    known = await stocks(mesh, pots)
    shares = split(wish.count, known)
    if not shares:
        silent = "; ".join(f"{name} {stock.why}" for name, stock in known.items() if stock.why)
        hoped = sum(stock.tomorrow for stock in known.values())
        told = f"no ripe fruit is known; {hoped:.1f} are expected within a day" + (f" ({silent})" if silent else "")
        raise Refused(told[:400], hint="`garden plants` shows what hangs where; try again after the next scan")
    by_id = {pot.id: pot for pot in pots}
    parts = []
    for name, count in sorted(shares.items()):
        try:
            asked = TaskRequest(
                kind="harvest", count=count, order_id=order_id, within_s=wish.within_s, priority=wish.priority
            )
            task = await send(by_id[name], asked)
            parts.append(_part(task))
        except GardenError as error:
            parts.append(OrderPart(plant_id=name, count=count, state="failed", reason=str(error)[:500]))
    return parts


def missing(order: Order) -> int:
    """How many fruit others may be asked for: none while it runs, nor when somebody called a part off."""
    over = order.state in ("partial", "failed") and all(part.state != "cancelled" for part in order.parts)
    return max(0, order.count - order.delivered) if over else 0


async def top_up(order: Order, wish: OrderRequest, pots: Sequence[Peer], mesh: Mesh, send: Send) -> Order | None:
    """Ask for what a pot could not give, wherever ripe fruit is left; None when nothing can be asked for.

    Not at pots that failed, and not beyond a deadline: how much of it is left only the pots know.
    """
    if not (lacking := missing(order)) or wish.within_s is not None:
        return None
    failed = {part.plant_id for part in order.parts if part.state == "failed"}
    others = [pot for pot in pots if pot.id not in failed]
    try:
        parts = await place(order.order_id, wish.model_copy(update={"count": lacking}), others, mesh, send)
    except Refused:
        return None
    return order.model_copy(update={"state": "running", "parts": [*order.parts, *parts], "reason": ""})


async def call_off(order: Order, cancel: Callable[[OrderPart], Awaitable[object]]) -> None:
    """Cancel at its pot every part that has not ended; one that ended meanwhile, or that its pot forgot, is as good.

    All pots are asked; then the first error is raised, and the same again reaches those that did not answer.
    """

    async def end(part: OrderPart) -> GardenError | None:
        try:
            await cancel(part)
        except (Conflict, Refused, NotFound):
            return None
        except GardenError as error:
            return error
        return None

    left = [part for part in order.parts if part.task_id and part.state not in FINAL_STATES]
    if failed := [error for error in await asyncio.gather(*map(end, left)) if error is not None]:
        failed[0].hint = failed[0].hint or "all other parts are called off; ask again once that pot answers"
        raise failed[0]


def order_of(order_id: str, tasks: Sequence[Task], before: Order | None = None) -> Order | None:
    """An order as its tasks tell it, and what `before` remembers of it; None when nobody knows it."""
    mine = sorted((t for t in tasks if t.order_id == order_id and t.kind == "harvest"), key=lambda t: t.created_s)
    if not mine and before is None:
        return None
    told = {task.task_id for task in mine}
    kept = [part for part in before.parts if part.task_id not in told] if before else []
    parts = [*(_part(task) for task in mine), *(_lost(part) for part in kept)]
    count = before.count if before else max(1, sum(task.count for task in mine))
    delivered = sum(len(part.picked) for part in parts)
    created_s = before.created_s if before else mine[0].created_s
    return Order(
        order_id=order_id, count=count, plant_id=before.plant_id if before else "",
        asked_by=before.asked_by if before else mine[0].asked_by, created_s=created_s,
        updated_s=max([created_s, *(task.updated_s for task in mine)]), state=_state(count, delivered, parts),
        delivered=delivered, parts=parts, ripe_tomorrow=before.ripe_tomorrow if before else 0.0,
        reason=_reason(count, delivered, parts),
    )  # fmt: skip


def _part(task: Task) -> OrderPart:
    return OrderPart(
        plant_id=task.plant_id, count=task.count, task_id=task.task_id, state=task.state,
        picked=[pick.fruit_id for pick in task.picks if pick.outcome == "picked"], robot_id=task.robot_id,
        phase=task.phase, reason=task.reason,
    )  # fmt: skip


def _lost(part: OrderPart) -> OrderPart:
    """A part whose task its pot did not tell of."""
    if part.state in FINAL_STATES:
        return part
    return part.model_copy(update={"state": "silent", "reason": f"{part.plant_id} does not answer"})


def _state(count: int, delivered: int, parts: Sequence[OrderPart]) -> OrderState:
    if any(part.state not in FINAL_STATES for part in parts):
        return "running"
    if delivered >= count:
        return "done"
    if parts and all(part.state == "cancelled" for part in parts):
        return "cancelled"
    return "partial" if delivered else "failed"


def _reason(count: int, delivered: int, parts: Sequence[OrderPart]) -> str:
    asked = sum(part.count for part in parts)
    told = [f"{part.plant_id}: {part.reason}" for part in parts if len(part.picked) < part.count and part.reason]
    if asked < count:
        told.insert(0, f"only {asked} of {count} ripe fruit are known")
    return "; ".join(told)[:500] if delivered < count else ""
