"""An order: split by what the pots know, put together from their tasks, and honest about what did not come."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from console.orders import Stock, call_off, missing, order_of, split, top_up
from console.service import Counter
from core.clock import VirtualClock
from core.errors import Conflict, PeerDown
from core.mesh.client import Answer
from core.mesh.peers import Peer, Peers
from core.wire.fruit import Forecast, Fruit, Inventory, Pick
from core.wire.market import Task, TaskRequest
from core.wire.order import Order, OrderPart, OrderRequest

stocks = st.dictionaries(
    st.sampled_from(["plant-1", "plant-2", "plant-3", "plant-4"]), st.builds(Stock, st.integers(0, 9), st.floats(0, 20))
)


@given(st.integers(1, 40), stocks)
def test_no_pot_is_asked_for_more_than_it_has_nor_all_for_more_than_is_wanted(count: int, known: dict[str, Stock]) -> None:
    parts = split(count, known)
    assert all(0 < parts[name] <= known[name].ripe for name in parts)
    assert sum(parts.values()) == min(count, sum(stock.ripe for stock in known.values()))


def test_those_with_most_ripe_fruit_give_first_and_the_forecast_breaks_ties() -> None:
    assert split(3, {"a": Stock(1), "b": Stock(5), "c": Stock(2)}) == {"b": 3}
    assert split(1, {"a": Stock(2, 2.0), "b": Stock(2, 4.5)}) == {"b": 1}
    assert split(4, {"a": Stock(2), "b": Stock(2)}) == {"a": 2, "b": 2}


def task(plant: str, state: Any, picks: int, count: int = 2, **more: Any) -> Task:
    return Task(
        task_id=f"{plant}:1:1", kind="harvest", state=state, plant_id=plant, created_s=5.0, updated_s=9.0, count=count,
        order_id="o1", picks=[Pick(fruit_id=f"f{i}", outcome="picked") for i in range(picks)], **more,
    )  # fmt: skip


def wished(count: int, *parts: OrderPart) -> Order:
    return Order(order_id="o1", count=count, created_s=5.0, updated_s=5.0, parts=list(parts))


def test_an_order_runs_until_every_part_has_ended() -> None:
    told = order_of("o1", [task("plant-1", "done", 2), task("plant-2", "running", 1)], wished(4))
    assert told is not None
    assert (told.state, told.delivered) == ("running", 3)
    told = order_of("o1", [task("plant-1", "done", 2), task("plant-2", "done", 2)], told)
    assert told is not None
    assert (told.state, told.delivered, told.reason) == ("done", 4, "")


def test_what_is_missing_is_said_with_the_reason() -> None:
    short = task("plant-2", "done", 1, reason="1 of 2 picked; f9 unreachable: too high")
    told = order_of("o1", [task("plant-1", "done", 2), short], wished(5))
    assert told is not None
    assert (told.state, told.delivered) == ("partial", 3)
    assert "too high" in told.reason
    assert "only 4 of 5" in told.reason


def test_a_pot_that_was_silent_or_refused_is_part_of_the_story() -> None:
    refused = OrderPart(plant_id="plant-3", count=1, state="failed", reason="no ripe fruit is known here")
    silent = OrderPart(plant_id="plant-1", count=2, task_id="plant-1:1:1", state="running")
    told = order_of("o1", [], wished(3, silent, refused))
    assert told is not None
    assert (told.state, [part.state for part in told.parts]) == ("running", ["silent", "failed"])
    assert order_of("o1", [], None) is None
    told = order_of("o1", [task("plant-1", "failed", 0, reason="nobody could")], wished(3, silent, refused))
    assert told is not None
    assert told.state == "failed"


def test_a_console_that_forgot_an_order_reads_it_from_the_pots() -> None:
    told = order_of("o1", [task("plant-1", "done", 2, asked_by="operator")])
    assert told is not None
    assert (told.count, told.delivered, told.state, told.asked_by) == (2, 2, "done", "operator")


def test_calling_off_an_order_cancels_what_has_not_ended_and_the_same_again_nothing() -> None:
    pots = {
        "plant-1": task("plant-1", "done", 2),
        "plant-2": task("plant-2", "running", 1),
        "plant-3": task("plant-3", "awarded", 0),
    }
    asked: list[str] = []

    async def cancel(part: OrderPart) -> Task:
        asked.append(part.task_id)
        if part.plant_id == "plant-3":
            raise Conflict(f"{part.task_id} is done already")
        pots[part.plant_id] = pots[part.plant_id].model_copy(update={"state": "cancelled"})
        return pots[part.plant_id]

    async def off() -> Order:
        before = order_of("o1", list(pots.values()), wished(6))
        assert before is not None
        await call_off(before, cancel)
        return order_of("o1", list(pots.values()), before) or before

    asyncio.run(off())
    assert asked == ["plant-2:1:1", "plant-3:1:1"]
    pots["plant-3"] = pots["plant-3"].model_copy(update={"state": "done"})
    again = asyncio.run(off())
    assert asked == ["plant-2:1:1", "plant-3:1:1"]
    assert (again.state, again.delivered) == ("partial", 3)


def test_a_pot_that_does_not_answer_is_told_of_after_all_others_were_asked() -> None:
    asked: list[str] = []

    async def cancel(part: OrderPart) -> None:
        asked.append(part.plant_id)
        if part.plant_id == "plant-1":
            raise PeerDown("plant-1 does not answer")

    order = order_of("o1", [task("plant-1", "running", 0), task("plant-2", "running", 0)], wished(4))
    assert order is not None
    with pytest.raises(PeerDown) as caught:
        asyncio.run(call_off(order, cancel))
    assert asked == ["plant-1", "plant-2"]
    assert "ask again" in caught.value.hint


class Pots:
    """A mesh with pots that know so many ripe fruit."""

    def __init__(self, **ripe: int) -> None:
        self.peers = [Peer(id=name, kind="plant", url=f"http://{name}") for name in ripe]
        self.ripe, self.asked = ripe, list[tuple[str, int]]()

    async def ask_all(self, pots: list[Peer], method: str, path: str, *, expect: Any) -> dict[str, Any]:
        return {pot.id: self.answer(pot.id, path) for pot in pots}

    def answer(self, name: str, path: str) -> Any:
        if path.startswith("/inventory"):
            red = {
                "colour": "red",
                "confidence": 0.95,
                "sigma_m": 0.004,
                "x_m": 0.1,
                "y_m": 0.0,
                "z_m": 0.3,
                "radius_m": 0.013,
            }
            fruits = [Fruit.model_validate({"fruit_id": f"{name}:f{i}", **red}) for i in range(self.ripe[name])]
            return Inventory(plant_id=name, scanned_s=1.0, fruits=fruits)
        return [] if path == "/tasks" else Forecast(plant_id=name, now_s=0.0, ahead_s=1.0)

    async def send(self, pot: Peer, request: TaskRequest) -> Task:
        self.asked.append((pot.id, request.count or 0))
        return task(pot.id, "announced", 0, request.count or 0)

    def top_up(self, order: Order, wish: OrderRequest) -> Order | None:
        return asyncio.run(top_up(order, wish, self.peers, self, self.send))  # type: ignore[arg-type]


def test_what_one_pot_could_not_give_is_asked_of_others_but_not_of_those_that_failed() -> None:
    pots = Pots(**{"plant-1": 2, "plant-2": 5, "plant-3": 1})
    order = order_of("o1", [task("plant-1", "done", 1), task("plant-2", "failed", 0)], wished(4))
    assert order is not None
    assert missing(order) == 3
    more = pots.top_up(order, OrderRequest(count=4))
    assert more is not None
    assert sorted(pots.asked) == [("plant-1", 2), ("plant-3", 1)]
    assert (more.state, more.count, len(more.parts)) == ("running", 4, 4)


def test_an_order_is_not_topped_up_while_it_runs_once_called_off_nor_under_a_deadline() -> None:
    pots, wish = Pots(**{"plant-3": 9}), OrderRequest(count=4)
    for states in (("done", "running"), ("done", "cancelled")):
        order = order_of("o1", [task("plant-1", states[0], 1), task("plant-2", states[1], 0)], wished(4))
        assert order is not None
        assert pots.top_up(order, wish) is None
    short = order_of("o1", [task("plant-1", "done", 1)], wished(4))
    assert short is not None
    assert pots.top_up(short, wish.model_copy(update={"within_s": 60.0})) is None
    assert Pots(**{"plant-3": 0}).top_up(short, wish) is None
    assert pots.asked == []


class Asked(Pots):
    """They take what they are asked for, each key once, and remember it."""

    def __init__(self, **ripe: int) -> None:
        super().__init__(**ripe)
        self.taken: dict[tuple[str, str], Task] = {}

    def answer(self, name: str, path: str) -> Any:
        if path == "/tasks":
            return [task for (pot, _), task in self.taken.items() if pot == name]
        return super().answer(name, path)

    async def exchange(self, pot: Peer, method: str, path: str, body: bytes, *, headers: Any, key: str) -> Answer:
        assert key
        request = TaskRequest.model_validate_json(body)
        made = task(pot.id, "announced", 0, request.count or 0).model_copy(update={"order_id": request.order_id})
        return Answer(201, self.taken.setdefault((pot.id, key), made).model_dump_json().encode())


def test_an_order_recorded_and_sent_again_is_the_same_order_also_at_a_console_that_forgot() -> None:
    pots, wish = Asked(**{"plant-1": 2, "plant-2": 1}), OrderRequest(count=3)

    def send(key: str, by: str = "operator") -> Order:
        counter = Counter(pots, Peers(pots.peers), VirtualClock())  # type: ignore[arg-type]
        return asyncio.run(counter.take(wish, by, "Bearer token", key))

    first = send("k1")
    assert (first.count, len(pots.taken)) == (3, 2)
    assert send("k1").order_id == first.order_id
    assert len(pots.taken) == 2
    assert send("k1", "anna").order_id != first.order_id
    assert send("").order_id != send("k2").order_id
