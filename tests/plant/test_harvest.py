"""Fruit over HTTP: the pot asks for a scan, then for its ripe fruit; each is picked once, and the ledger tells by whom."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

Garden = Any
Play = Callable[[Callable[[Garden], Coroutine[Any, Any, None]]], None]
JPEG = b"\xff\xd8\xff\xe0 a picture \xff\xd9"
ROBOT = {"who": "robot-1", "role": "robot"}
TREE = {(0.1, 0.06 * i - 0.15, 0.2): ("red" if i % 2 == 0 else "green") for i in range(6)}
"""Three red fruit and three green ones."""


async def read(garden: Garden, path: str) -> Any:
    return (await garden.call("plant-1", "GET", path)).json()


async def tasks_of(garden: Garden, kind: str) -> list[dict[str, Any]]:
    return [task for task in await read(garden, "/tasks") if task["kind"] == kind]


async def until_done(garden: Garden, kind: str, within_s: float = 200.0) -> dict[str, Any]:
    async def over() -> bool:
        return any(task["state"] in ("done", "failed") for task in await tasks_of(garden, kind))

    await garden.until(over, within_s)
    return (await tasks_of(garden, kind))[-1]


def test_a_new_pot_has_itself_scanned_and_then_its_ripe_fruit_picked_but_two(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True, harvest=True)
        assert (await garden.state())["fruit_uncertainty"] == 1.0
        assert (await until_done(garden, "inventory"))["why"] == "this plant was never scanned"
        state = await garden.state()
        assert state["fruit"] == {"green": 3, "turning": 0, "red": 3}
        assert state["fruit_uncertainty"] < 0.3
        harvest = await until_done(garden, "harvest")
        assert (harvest["state"], harvest["asked_by"], len(robot.basket)) == ("done", "fruit", 1)
        assert len((await read(garden, "/inventory?colour=red"))["fruits"]) == 2

    play(story)


def test_an_order_is_picked_at_once_and_the_ledger_tells_all_about_it(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True)
        await until_done(garden, "inventory")
        order = {"kind": "harvest", "count": 2, "order_id": "o7"}
        asked = await garden.call("plant-1", "POST", "/tasks", json=order)
        assert asked.status_code == 201, asked.text
        task = await until_done(garden, "harvest")
        assert (task["state"], task["order_id"], [p["outcome"] for p in task["picks"]]) == ("done", "o7", ["picked"] * 2)
        lines = await read(garden, "/ledger")
        assert [line["fruit_id"] for line in lines] == robot.basket
        line = lines[0]
        assert {k: line[k] for k in ("outcome", "robot_id", "order_id", "asked_by", "colour")} == {
            "outcome": "picked", "robot_id": "robot-1", "order_id": "o7", "asked_by": "operator", "colour": "red",
        }  # fmt: skip
        assert [bid["robot_id"] for bid in line["bids"]] == ["robot-1"]
        assert line["permitted_s"] < line["ended_s"]
        picture = await garden.call("plant-1", "GET", line["after"])
        assert (picture.content, picture.headers["content-type"]) == (JPEG, "image/jpeg")
        table = (await garden.call("plant-1", "GET", "/ledger?format=csv")).text.splitlines()
        assert len(table) == 3
        assert table[0].startswith("line_id,plant_id,fruit_id")

    play(story)


def test_a_picked_fruit_stays_picked_through_a_restart_with_its_line_and_picture(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True)
        await until_done(garden, "inventory")
        await garden.call("plant-1", "POST", "/tasks", json={"kind": "harvest", "count": 1})
        await until_done(garden, "harvest")
        before = [await read(garden, "/inventory"), await read(garden, "/ledger"), await read(garden, "/forecast")]
        await garden.kill_pot()
        garden.start_pot(inventory=True)
        after = [await read(garden, "/inventory"), await read(garden, "/ledger"), await read(garden, "/forecast")]
        assert after[:2] == before[:2]
        assert after[2]["now"] == before[2]["now"]
        assert (await garden.call("plant-1", "GET", after[1][0]["before"])).content == JPEG
        assert robot.basket[0] not in [fruit["fruit_id"] for fruit in after[0]["fruits"]]

    play(story)


def test_after_a_death_in_the_act_a_scan_decides_and_nobody_picks_a_phantom(play: Play) -> None:
    """The first robot tears the fruit off and dies; the pot has another look first, then the rest is picked."""

    async def story(garden: Garden) -> None:
        tree = dict(TREE)
        first, second = garden.picker("robot-1", tree), garden.picker("robot-2", tree)
        second.cost = lambda asked: 50.0
        garden.pot(ratio=0.3, inventory=True)
        await until_done(garden, "inventory")
        first.die_holding = True
        await garden.call("plant-1", "POST", "/tasks", json={"kind": "harvest", "count": 3})
        task = await until_done(garden, "harvest", 400.0)
        lines = {line["fruit_id"]: line for line in await read(garden, "/ledger")}
        assert lines[first.basket[0]]["outcome"] == "gone"
        assert len(set(first.basket + second.basket)) == len(first.basket + second.basket) == 3
        assert (task["state"], second.scans) == ("done", 1)
        assert [fruit["colour"] for fruit in (await read(garden, "/inventory"))["fruits"]] == ["green"] * 3

    play(story)


def test_an_unreachable_fruit_is_marked_with_the_reason_and_not_asked_for_again(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True)
        await until_done(garden, "inventory")
        red = [fruit["fruit_id"] for fruit in (await read(garden, "/inventory?colour=red"))["fruits"]]
        robot.out_of_reach = {red[0]}
        await garden.call("plant-1", "POST", "/tasks", json={"kind": "harvest"})
        task = await until_done(garden, "harvest")
        assert (task["state"], sorted(robot.basket)) == ("done", sorted(red[1:]))
        assert "too high" in task["reason"]
        (left,) = (await read(garden, "/inventory?colour=red"))["fruits"]
        assert (left["fruit_id"], left["unreachable"]) == (red[0], "too high")
        again = await garden.call("plant-1", "POST", "/tasks", json={"kind": "harvest"})
        assert (again.status_code, "no ripe fruit" in again.json()["detail"]) == (409, True)

    play(story)


def test_the_own_wish_stands_back_behind_a_persons(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True, harvest=True)
        await until_done(garden, "inventory")
        robot.cost = lambda asked: None if asked.kind == "harvest" and not asked.order_id else 10.0

        async def wished() -> bool:
            return bool(await tasks_of(garden, "harvest"))

        await garden.until(wished, 60.0)
        await garden.call("plant-1", "POST", "/tasks", json={"kind": "harvest", "count": 3, "order_id": "o1"})
        own, order = await tasks_of(garden, "harvest")
        assert (own["state"], order["order_id"]) == ("cancelled", "o1")

    play(story)


def test_a_scan_for_a_task_that_is_over_is_refused_and_one_told_twice_changes_nothing(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True)
        task = await until_done(garden, "inventory")
        before = await read(garden, "/inventory")
        scan = {
            "scan_id": f"{task['task_id']}:1",
            "task_id": task["task_id"],
            "robot_id": "robot-1",
            "views": garden.robots["robot-1"].views(),
        }
        again = await garden.call("plant-1", "POST", "/inventory/scans", json=scan, **ROBOT)
        assert (again.status_code, again.json()) == (200, before)
        late = await garden.call("plant-1", "POST", "/inventory/scans", json=scan | {"scan_id": "late"}, **ROBOT)
        assert late.status_code == 409
        assert await read(garden, "/inventory") == before
        assert robot.scans == 1

    play(story)


def test_pictures_are_small_jpegs_of_the_robot_that_picked(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True)
        await until_done(garden, "inventory")
        await garden.call("plant-1", "POST", "/tasks", json={"kind": "harvest", "count": 1})
        await until_done(garden, "harvest")
        (line,) = await read(garden, "/ledger")
        path, jpeg = line["before"], {"content-type": "image/jpeg"}
        for content, headers, who, status in (
            (b"\x89PNG", jpeg, "robot-1", 422),
            (b"\xff\xd8\xff" + b"x" * 61_000 + b"\xff\xd9", jpeg, "robot-1", 413),
            (JPEG, {}, "robot-1", 400),
            (JPEG, jpeg, "robot-2", 404),
        ):
            put = await garden.call("plant-1", "PUT", path, who=who, role="robot", content=content, headers=headers)
            assert put.status_code == status, put.text
        missing = await garden.call("plant-1", "GET", "/ledger/nobody:1:1/before.jpg")
        assert missing.status_code == 404
        assert (await garden.call("plant-1", "GET", path)).content == JPEG

    play(story)


def test_the_forecast_counts_what_is_red_and_widens_with_what_is_unknown(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True)
        await until_done(garden, "inventory")
        await asyncio.sleep(0)
        now, month = await read(garden, "/forecast?ahead_s=0"), await read(garden, "/forecast?ahead_s=2592000")
        assert now["ripe_min"] <= 3 <= now["ripe_max"]
        assert {fruit["colour"] for fruit in now["fruits"]} == {"red", "green"}
        assert month["ripe_max"] - month["ripe_min"] >= now["ripe_max"] - now["ripe_min"]
        assert (await garden.call("plant-1", "GET", "/forecast?ahead_s=-1")).status_code == 422

    play(story)


def test_an_order_that_comes_while_the_pots_own_harvest_runs_is_picked_after_it(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.picker("robot-1", dict(TREE))
        garden.pot(ratio=0.3, inventory=True, harvest=True)
        await until_done(garden, "inventory")

        async def running() -> bool:
            return any(task["state"] == "running" for task in await tasks_of(garden, "harvest"))

        await garden.until(running, 60.0)
        order = {"kind": "harvest", "count": 2, "order_id": "o1"}
        assert (await garden.call("plant-1", "POST", "/tasks", json=order)).status_code == 201

        async def both() -> bool:
            return [task["state"] for task in await tasks_of(garden, "harvest")] == ["done", "done"]

        await garden.until(both, 120.0)
        assert len(set(robot.basket)) == len(robot.basket) == 3

    play(story)
