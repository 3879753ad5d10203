"""A pot killed in every state of its task comes back, loses nothing and waters once."""

from __future__ import annotations

import errno
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from core.allocation.permits import OpenPermit
from core.store import Disk

Play = Any
Garden = Any


async def restart(garden: Garden, down_s: float = 1.0) -> None:
    await garden.kill_pot()
    await garden.clock.sleep(down_s)
    garden.start_pot()


@pytest.mark.parametrize("down_s", [0.5, 15.0])
@pytest.mark.parametrize("state", ["announced", "awarded", "running", "permit", "acting", "soaking"])
def test_a_pot_killed_in_any_state_comes_back_and_waters_once(play: Play, state: str, down_s: float) -> None:
    async def story(garden: Garden) -> None:
        one = garden.robot("robot-1", 5.0)
        one.start_s = 4.0
        garden.pot(ratio=0.195)
        await reach(garden, one, state)
        before = await garden.task()
        await restart(garden, down_s)
        done = await garden.until_task("done", within_s=300.0)
        assert done["task_id"] == before["task_id"]
        assert done["epoch"] >= before["epoch"]
        # A dose given while the pot was down counts: the soil tells.
        assert one.poured_ml == 150.0
        assert (await garden.state())["watered_today_ml"] >= 150.0

    play(story)


async def reach(garden: Garden, robot: Any, state: str) -> None:
    if state == "announced":
        robot.cost = lambda _: None
        await garden.until_task("announced")
        robot.cost = lambda _: 5.0
    elif state in ("awarded", "running"):
        await garden.until_task(state)
    else:

        async def there() -> bool:
            tasks = (await garden.call("plant-1", "GET", "/tasks")).json()
            if not tasks or tasks[-1]["permits"] == 0:
                return False
            if state == "acting":
                return bool(tasks[-1]["permits"])
            return state == "permit" or "soaking" in tasks[-1]["phase"]

        await garden.until(there, 120.0)
        if state == "acting":
            await garden.clock.sleep(8.0)


def test_ids_never_repeat_over_restarts(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.30)
        await garden.clock.sleep(2.0)
        seen = set()
        for _ in range(4):
            task = (await garden.call("plant-1", "POST", "/tasks", json={"kind": "water"})).json()
            assert task["task_id"] not in seen
            seen.add(task["task_id"])
            await garden.call("plant-1", "DELETE", f"/tasks/{task['task_id']}")
            await restart(garden, 0.1)
            await garden.clock.sleep(2.0)

    play(story)


def test_inventory_settings_docks_and_history_survive(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.30)
        await garden.clock.sleep(2.0)
        fruit = {"colour": "red", "x_m": 0.1, "y_m": 0.0, "z_m": 0.3, "radius_m": 0.014}
        await garden.call("plant-1", "POST", "/inventory/fruits", json=fruit)
        await garden.call("plant-1", "PATCH", "/settings", json={"dose_ml": 90.0})
        reservation = {"robot_id": "robot-1", "for_s": 60.0}
        await garden.call("plant-1", "POST", "/dock/reservations", who="robot-1", role="robot", json=reservation)
        before = (await garden.call("plant-1", "GET", "/inventory")).json()
        entries = (await garden.call("plant-1", "GET", "/history")).json()
        await restart(garden)
        await garden.clock.sleep(1.0)
        assert (await garden.call("plant-1", "GET", "/inventory")).json() == before
        state = await garden.state()
        assert state["settings"]["dose_ml"] == 90.0
        assert state["dock_holder"] == "robot-1"
        after = (await garden.call("plant-1", "GET", "/history")).json()
        assert after[: len(entries)] == entries
        assert [entry["id"] for entry in after] == sorted({entry["id"] for entry in after})

    play(story)


def test_a_second_process_on_the_same_folder_is_refused(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.30)
        with pytest.raises(Exception, match="another writer"):
            garden.start_pot()

    play(story)


def test_a_damaged_document_raises_an_alarm_that_people_can_read(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.30)
        await garden.clock.sleep(2.0)
        await garden.call("plant-1", "POST", "/tasks", json={"kind": "water"})
        await garden.kill_pot()
        path = garden.folder / "plant-1" / "market.json"
        path.write_bytes(path.read_bytes()[:-40])
        garden.start_pot()
        alarms = (await garden.call("plant-1", "GET", "/history?kind=alarm")).json()
        assert "market.json was damaged" in alarms[-1]["what"]

    play(story)


def test_history_is_plain_sqlite(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.30)
        await garden.clock.sleep(5.0)
        await garden.kill_pot()
        with sqlite3.connect(garden.folder / "plant-1" / "history.sqlite3") as db:
            kinds = {row[0] for row in db.execute("SELECT kind FROM entries")}
        db.close()
        assert {"probe", "soil"} <= kinds

    play(story)


def test_a_permit_asked_for_again_has_what_is_left_of_its_time(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        robot.die_before_act = True
        garden.pot(ratio=0.15)
        held = garden.nodes["plant-1"].app.state.pot.place.market

        async def permitted() -> bool:
            return bool(held.permit_open)

        await garden.until(permitted, 60.0)
        given = held.document().open_permit
        assert given is not None
        wish = {"robot_id": "robot-1", "epoch": given.permit.epoch, "act": "water", "amount_ml": given.permit.dose_ml}
        path, key = f"/tasks/{given.permit.task_id}/permits", {"idempotency-key": given.key}

        async def asked(wish: dict[str, Any]) -> Any:
            return await garden.call("plant-1", "POST", path, json=wish, who="robot-1", role="robot", headers=key)

        lefts = []
        for _ in range(4):
            await garden.clock.sleep(6.0)
            answer = await asked(wish)
            assert answer.status_code == 200, answer.text
            assert answer.json()["permit_id"] == given.permit.permit_id
            lefts.append(answer.json()["valid_for_s"])
        assert lefts[0] < 9.1
        assert lefts[0] - lefts[1] == pytest.approx(6.0, abs=0.1)
        assert lefts[2:] == [0.0, 0.0]
        answer = await asked(wish | {"amount_ml": 1.0})
        assert answer.status_code == 422, "another question under the same key"

    play(story)


class Full(Disk):
    """While `full`, nothing can be written."""

    full = False

    def create(self, path: Path) -> int:
        if self.full:
            raise OSError(errno.ENOSPC, "no space left on device")
        return super().create(path)


def test_an_open_permit_is_put_into_a_new_clocks_time_once_whatever_fails_to_be_saved(play: Play) -> None:
    async def story(garden: Garden) -> None:
        disk = garden.disk = Full()
        robot = garden.robot("robot-1")
        robot.die_before_act = True
        garden.pot(ratio=0.15)

        def held() -> OpenPermit | None:
            return garden.nodes["plant-1"].app.state.pot.place.market.document().open_permit

        async def permitted() -> bool:
            return held() is not None

        async def fails() -> None:
            disk.full = True
            answer = await garden.call("plant-1", "POST", "/tasks", json={"kind": "inventory"})
            assert answer.status_code == 507, answer.text
            disk.full = False

        await garden.until(permitted, 60.0)
        given = held()
        await garden.clock.sleep(3.0)
        await fails()
        assert held() == given
        disk.full = True
        await restart(garden, down_s=400.0)
        began_s = garden.clock.now()
        await fails()
        again = held()
        assert again is not None
        assert again.issued_s >= began_s
        await garden.clock.sleep(3.0)
        await fails()
        assert held() == again, "put into this clock's time once"

    play(story)
