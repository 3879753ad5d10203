"""The pot's HTTP side: what it takes, what it refuses, and that a refusal changes nothing."""

from __future__ import annotations

import csv
import io
import json
from typing import Any

import pytest

from core.mesh.describe import unguarded

Play = Any
Garden = Any
FRUIT = {"colour": "red", "x_m": 0.1, "y_m": 0.0, "z_m": 0.3, "radius_m": 0.014}
REPORT = {"robot_id": "robot-1", "epoch": 1, "state": "running"}
PERMIT = {"robot_id": "robot-1", "epoch": 1, "act": "water", "amount_ml": 100.0}
RESERVE = {"robot_id": "robot-1", "for_s": 30.0}
ROBOT = {"who": "robot-1", "role": "robot"}

BAD = [
    ("POST", "/tasks", {"kind": "dance"}, 422),
    ("POST", "/tasks", {"kind": "water", "dose_ml": "100"}, 422),
    ("POST", "/tasks", {"kind": "water", "dose_ml": True}, 422),
    ("POST", "/tasks", {"kind": "water", "dose_ml": 0}, 422),
    ("POST", "/tasks", {"kind": "water", "dose_ml": 1e9}, 422),
    ("POST", "/tasks", {"kind": "water", "surprise": 1}, 422),
    ("POST", "/tasks", "NaN", 422),
    ("POST", "/tasks", '{"kind": "water", "dose_ml": NaN}', 422),
    ("POST", "/tasks", '{"kind": "water", "kind": "water"}', 400),
    ("POST", "/tasks", "", 400),
    ("POST", "/tasks", "[" * 10000, 400),
    ("POST", "/tasks", {"kind": "water", "x": "y" * 70000}, 413),
    ("PATCH", "/settings", {"threshold_ratio": 0.9}, 422),
    ("PATCH", "/settings", {"threshold_ratio": 0.3}, 422),
    ("PATCH", "/settings", {"soak_s": -1}, 422),
    ("POST", "/inventory/fruits", FRUIT | {"colour": "blue"}, 422),
    ("POST", "/inventory/fruits", FRUIT | {"radius_m": 3}, 422),
    ("POST", "/inventory/scans", {"scan_id": "s", "fruits": [{}]}, 422),
    ("POST", "/inventory/scans", {"scan_id": "no spaces", "fruits": []}, 422),
    ("DELETE", "/inventory/fruits/f1", None, 412),
    ("DELETE", "/inventory/fruits/nobody", None, 412),
    ("DELETE", "/tasks/plant-1:9:9", None, 404),
    ("DELETE", "/tasks/plant-2:1:1", None, 404),
    ("GET", "/tasks/plant-2:1:1", None, 404),
    ("GET", "/inventory?colour=blue", None, 422),
    ("GET", "/history?limit=0", None, 422),
    ("GET", "/history?format=xml", None, 422),
    ("GET", "/history?since_s=nan", None, 422),
    ("GET", "/nothing", None, 404),
    ("PUT", "/state", None, 405),
]
BAD_ROBOT = [
    ("/tasks/{id}/reports", REPORT | {"robot_id": "robot-2"}, 403),
    ("/tasks/{id}/reports", REPORT | {"epoch": -1}, 422),
    ("/tasks/{id}/reports", REPORT | {"state": "finished"}, 422),
    ("/tasks/{id}/reports", REPORT | {"progress": 2}, 422),
    ("/tasks/plant-2:1:1/reports", REPORT, 404),
    ("/tasks/{id}/permits", PERMIT | {"robot_id": "robot-2"}, 403),
    ("/tasks/{id}/permits", PERMIT, 409),
    ("/tasks/{id}/permits", PERMIT | {"amount_ml": 501}, 422),
    ("/tasks/plant-2:1:1/permits", PERMIT, 404),
    ("/dock/reservations", RESERVE | {"robot_id": "robot-2"}, 403),
    ("/dock/reservations", RESERVE | {"dock_id": "tap"}, 404),
    ("/dock/reservations", RESERVE | {"for_s": 0}, 422),
]


def dry(story: Any) -> Any:
    """The story with a pot that announces a task nobody takes."""

    async def told(garden: Garden) -> None:
        garden.robot("robot-1", None)
        garden.pot(ratio=0.15)
        await garden.until_task("announced")
        await story(garden)

    return told


def encoded(body: Any) -> dict[str, Any]:
    if body is None:
        return {}
    return {"content": body if isinstance(body, str) else json.dumps(body)}


def test_bad_input_is_refused_with_a_problem_and_changes_nothing(play: Play) -> None:
    async def story(garden: Garden) -> None:
        task_id = (await garden.task())["task_id"]
        await garden.call("plant-1", "POST", "/inventory/fruits", json=FRUIT)
        before = await snapshot(garden)
        for method, path, body, status in BAD:
            answer = await garden.call("plant-1", method, path, **encoded(body))
            check(answer, status, (method, path, str(body)[:60]))
        for path, body, status in BAD_ROBOT:
            answer = await garden.call("plant-1", "POST", path.replace("{id}", task_id), **ROBOT, **encoded(body))
            check(answer, status, (path, body))
        assert await snapshot(garden) == before

    play(dry(story))


def check(answer: Any, status: int, asked: Any) -> None:
    assert answer.status_code == status, (asked, answer.text)
    assert answer.headers["content-type"] == "application/problem+json", asked
    problem = answer.json()
    assert problem["title"], asked
    assert problem["detail"], asked


async def snapshot(garden: Garden) -> Any:
    state = await garden.state()
    inventory = (await garden.call("plant-1", "GET", "/inventory")).json()
    tasks = [(t["task_id"], t["state"], t["epoch"]) for t in (await garden.call("plant-1", "GET", "/tasks")).json()]
    return state["settings"], state["dock_holder"], state["open_tasks"], inventory, tasks


ROLES = ("plant", "robot", "operator", "viewer")
MAY = {
    ("POST", "/tasks"): {"operator"},
    ("DELETE", "/tasks/plant-1:9:9"): {"operator"},
    ("PATCH", "/settings"): {"operator"},
    ("POST", "/inventory/fruits"): {"operator", "robot"},
    ("POST", "/inventory/scans"): {"operator", "robot"},
    ("DELETE", "/inventory/fruits/f1"): {"operator", "robot"},
    ("POST", "/tasks/plant-1:9:9/reports"): {"robot"},
    ("POST", "/tasks/plant-1:9:9/permits"): {"robot"},
    ("POST", "/dock/reservations"): {"robot"},
    ("DELETE", "/dock/reservations/plant-1:x:1"): {"operator", "robot"},
}


def test_every_changing_endpoint_asks_for_its_roles(play: Play) -> None:
    async def story(garden: Garden) -> None:
        node = garden.pot(ratio=0.3)
        assert unguarded(node.app) == []
        for (method, path), allowed in MAY.items():
            for role in ROLES:
                answer = await garden.call("plant-1", method, path, who="robot-1", role=role, content="{}")
                refused = answer.status_code == 403
                assert refused == (role not in allowed), (method, path, role, answer.text)
            bare = await garden.call("plant-1", method, path, headers={"authorization": "Bearer nonsense"}, content="{}")
            assert bare.status_code == 401, (method, path)

    play(story)


def test_another_plants_task_is_refused_with_a_hint_whose_it_is(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.3)
        answer = await garden.call("plant-1", "GET", "/tasks/plant-2:1:7")
        assert "ask plant-2" in answer.json()["hint"]

    play(story)


def test_one_open_water_task_a_pot(play: Play) -> None:
    async def story(garden: Garden) -> None:
        answer = await garden.call("plant-1", "POST", "/tasks", json={"kind": "water"})
        assert answer.status_code == 409
        assert "already asks" in answer.json()["detail"]

    play(dry(story))


def test_a_posted_task_is_created_once_for_one_idempotency_key(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.robot("robot-1")
        garden.pot(ratio=0.3)
        await garden.clock.sleep(2.0)
        send = {"json": {"kind": "water", "dose_ml": 60.0}, "headers": {"idempotency-key": "k1"}}
        first = await garden.call("plant-1", "POST", "/tasks", **send)
        again = await garden.call("plant-1", "POST", "/tasks", **send)
        assert first.status_code == 201
        assert first.headers["location"] == f"/tasks/{first.json()['task_id']}"
        assert again.json() == first.json()
        done = await garden.until_task("done")
        assert (done["asked_by"], done["delivered_ml"]) == ("operator", 60.0)

    play(story)


def test_a_recorded_request_asks_for_nothing_new_ten_minutes_and_a_restart_later(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.3)
        await garden.clock.sleep(2.0)
        send = {"json": {"kind": "water", "dose_ml": 60.0}, "headers": {"idempotency-key": "k1"}}
        first = (await garden.call("plant-1", "POST", "/tasks", **send)).json()
        await garden.until_task("done")
        await garden.clock.sleep(700.0)
        for _ in range(2):
            again = await garden.call("plant-1", "POST", "/tasks", **send)
            assert (again.status_code, again.headers["location"]) == (201, f"/tasks/{first['task_id']}")
            assert (again.json()["task_id"], again.json()["state"]) == (first["task_id"], "done")
            await garden.kill_pot()
            garden.start_pot()
            await garden.clock.sleep(2.0)
        other = await garden.call("plant-1", "POST", "/tasks", **send | {"json": {"kind": "water", "dose_ml": 61.0}})
        assert (other.status_code, "another body" in other.json()["detail"]) == (422, True)
        assert len((await garden.call("plant-1", "GET", "/tasks")).json()) == 1
        theirs = await garden.call("plant-1", "POST", "/tasks", **send, who="bob")
        assert theirs.json()["task_id"] != first["task_id"], "keys are told apart by who sends them"
        await garden.until_task("done")
        assert robot.poured_ml == 120.0

    play(story)


def test_a_permit_is_one_shot_but_its_question_may_be_repeated(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        robot.work_s = 1000.0
        garden.pot(ratio=0.15)
        task = await garden.until_task("running")
        ask = {"json": PERMIT, **ROBOT}
        path = f"/tasks/{task['task_id']}/permits"
        first = (await garden.call("plant-1", "POST", path, **ask, headers={"idempotency-key": "a"})).json()
        assert first["dose_ml"] == 100.0
        await garden.clock.sleep(3.0)
        again = (await garden.call("plant-1", "POST", path, **ask, headers={"idempotency-key": "a"})).json()
        assert again["permit_id"] == first["permit_id"]
        other = await garden.call("plant-1", "POST", path, **ask, headers={"idempotency-key": "b"})
        assert other.status_code == 409
        assert "measure again" in other.json()["detail"]
        assert (await garden.state())["watered_today_ml"] == 100.0

    play(story)


def test_the_inventory_has_an_etag_and_edits_need_it(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.3)
        added = await garden.call("plant-1", "POST", "/inventory/fruits", json=FRUIT)
        green = await garden.call("plant-1", "POST", "/inventory/fruits", json=FRUIT | {"colour": "green"})
        assert (added.status_code, green.status_code) == (201, 201)
        whole = await garden.call("plant-1", "GET", "/inventory")
        etag = whole.headers["etag"]
        assert len(whole.json()["fruits"]) == 2
        same = await garden.call("plant-1", "GET", "/inventory", headers={"if-none-match": etag})
        assert (same.status_code, same.content) == (304, b"")
        red = await garden.call("plant-1", "GET", "/inventory?colour=red")
        assert [fruit["colour"] for fruit in red.json()["fruits"]] == ["red"]
        path = added.headers["location"]
        stale = await garden.call("plant-1", "DELETE", path, headers={"if-match": added.headers["etag"]})
        assert stale.status_code == 412
        gone = await garden.call("plant-1", "DELETE", path, headers={"if-match": etag})
        assert gone.status_code == 204
        assert len((await garden.call("plant-1", "GET", "/inventory")).json()["fruits"]) == 1

    play(story)


def test_a_scan_upserts_by_id_and_coming_twice_changes_nothing(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.3)
        seen = [FRUIT | {"fruit_id": f"s{n}", "confidence": 0.9} for n in range(3)]
        scan = {"scan_id": "robot-1:1", "fruits": seen}
        first = await garden.call("plant-1", "POST", "/inventory/scans", json=scan, **ROBOT)
        await garden.clock.sleep(5.0)
        again = await garden.call("plant-1", "POST", "/inventory/scans", json=scan, **ROBOT)
        assert again.json() == first.json()
        redder = {"scan_id": "robot-1:2", "fruits": [seen[0] | {"colour": "turning"}]}
        after = (await garden.call("plant-1", "POST", "/inventory/scans", json=redder, **ROBOT)).json()
        assert after["generation"] == first.json()["generation"] + 1
        changed = after["fruits"][0]
        assert (changed["colour"], len(after["fruits"])) == ("turning", 3)
        assert changed["last_seen_s"] - changed["first_seen_s"] >= 5.0

    play(story)


def test_settings_change_in_parts_and_take_effect(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.22)
        await garden.clock.sleep(15.0)
        assert robot.asked == 0
        patch = {"threshold_ratio": 0.23, "target_ratio": 0.25, "dose_ml": 120.0}
        answer = await garden.call("plant-1", "PATCH", "/settings", json=patch)
        assert answer.json()["dose_ml"] == 120.0
        done = await garden.until_task("done")
        assert done["dose_ml"] == 120.0

    play(story)


def test_history_tells_the_story_as_json_and_csv(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.robot("robot-1")
        garden.pot(ratio=0.195)
        done = await garden.until_task("done")
        told = (await garden.call("plant-1", "GET", f"/history?task_id={done['task_id']}")).json()
        kinds = [entry["kind"] for entry in told]
        assert kinds[0] == "announced"
        assert "awarded" in kinds
        assert kinds[-1] == "done"
        text = await garden.call("plant-1", "GET", "/history?format=csv")
        assert text.headers["content-type"].startswith("text/csv")
        rows = list(csv.DictReader(io.StringIO(text.text)))
        assert "done" in [row["kind"] for row in rows]
        last = int(rows[-1]["id"])
        assert (await garden.call("plant-1", "GET", f"/history?since={last}")).json() == []

    play(story)


@pytest.mark.parametrize("path", ["/", "/state", "/dock", "/inventory", "/tasks", "/healthz", "/metrics", "/docs"])
def test_reads_are_open_and_answer(play: Play, path: str) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.3)
        answer = await garden.call("plant-1", "GET", path, headers={"authorization": ""})
        assert answer.status_code == 200

    play(story)


def test_the_node_card_tells_what_a_visitor_needs(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.3)
        card = (await garden.call("plant-1", "GET", "/")).json()
        assert (card["id"], card["kind"]) == ("plant-1", "plant")
        assert card["place"]["dock"]["x_m"] == 0.55
        assert "/state" in card["links"].values()

    play(story)


def test_a_full_disk_gives_507_and_the_pot_goes_on_when_there_is_room(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.pot(ratio=0.3)
        await garden.clock.sleep(2.0)
        before = (await garden.call("plant-1", "GET", "/inventory")).json()
        folder = garden.folder / "plant-1"
        (folder / "inventory.json.tmp").mkdir()
        refused = await garden.call("plant-1", "POST", "/inventory/fruits", json=FRUIT)
        assert refused.status_code == 507
        assert (await garden.call("plant-1", "GET", "/inventory")).json() == before
        (folder / "inventory.json.tmp").rmdir()
        taken = await garden.call("plant-1", "POST", "/inventory/fruits", json=FRUIT)
        assert taken.status_code == 201
        assert len((await garden.call("plant-1", "GET", "/inventory")).json()["fruits"]) == 1

    play(story)


def test_a_market_that_cannot_be_saved_sends_nothing_and_recovers(play: Play) -> None:
    async def story(garden: Garden) -> None:
        robot = garden.robot("robot-1")
        garden.pot(ratio=0.3)
        await garden.clock.sleep(2.0)
        folder = garden.folder / "plant-1"
        (folder / "market.json.tmp").mkdir()
        garden.soils["plant-1"].ratio = 0.195
        answer = await garden.call("plant-1", "POST", "/tasks", json={"kind": "water"})
        assert answer.status_code == 507
        await garden.clock.sleep(40.0)
        assert robot.log == []
        (folder / "market.json.tmp").rmdir()
        done = await garden.until_task("done")
        assert done["permits"] == 1
        assert robot.poured_ml == 150.0

    play(story)
