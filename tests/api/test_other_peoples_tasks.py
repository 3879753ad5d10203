"""Whose task is it: plants and robots act in their own name, under the living epoch, on what exists."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from doors import Doors, check_problem, open_doors
from test_bad_bodies import ANNOUNCED, CARD

CARD_2 = CARD | {"plant_id": "plant-2"}
OFFER_2 = ANNOUNCED | {"task_id": "plant-2:9:9", "plant": CARD_2}
REPORT = {"robot_id": "robot-1", "epoch": 1, "state": "running"}
PERMIT = {"robot_id": "robot-1", "epoch": 1, "act": "water", "amount_ml": 50.0}


def award(offer: dict[str, Any], epoch: int = 1) -> dict[str, Any]:
    return {"announcement": offer, "epoch": epoch, "lease_s": 1000.0, "cost_s": 20.0}


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Doors]:
    """A garden in which the robot is stopped, and has promised a task to plant-1; plant-1 asks for water in vain."""
    with open_doors(tmp_path_factory.mktemp("busy")) as doors:
        doors.ask("robot", "POST", "/stop", json={"reason": "r" * 500})
        doors.wait(1.0)
        assert doors.ask("plant", "POST", "/tasks", json={"kind": "water"}).status_code == 201
        doors.wait(4.0)
        yield doors


def its_task(doors: Doors) -> dict[str, Any]:
    return dict(doors.ask("plant", "GET", "/tasks").json()[0])


def test_a_plant_offers_and_awards_only_its_own_tasks(busy: Doors) -> None:
    before = busy.standing()
    mine, yours = busy.token("plant"), busy.token("plant", "plant-2")
    stolen = ANNOUNCED | {"plant": CARD_2}
    for token, offer in (
        (mine, OFFER_2),
        (yours, ANNOUNCED),
        (yours, stolen),
        (mine, ANNOUNCED | {"task_id": "plant-2:9:9"}),
    ):
        check_problem(busy.ask("robot", "POST", "/bids", token=token, json=offer), offer["task_id"], 403)
        for epoch in (1, 2, 2**53):
            check_problem(busy.ask("robot", "POST", "/tasks", token=token, json=award(offer, epoch)), offer["task_id"], 403)
    assert busy.standing() == before


def test_a_plant_kills_only_its_own_tasks_at_a_robot(tmp_path: Any) -> None:
    with open_doors(tmp_path) as doors:
        mine, yours = doors.token("plant"), doors.token("plant", "plant-2")
        taken = doors.ask("robot", "POST", "/tasks", token=mine, json=award(ANNOUNCED, 3))
        assert taken.status_code == 201
        queue = doors.ask("robot", "GET", "/tasks").json()
        check_problem(doors.ask("robot", "DELETE", "/tasks/plant-1:9:9", token=yours), "kill", 403)
        check_problem(doors.ask("robot", "DELETE", "/tasks/plant-2:9:9", token=yours), "kill", 404)
        check_problem(doors.ask("robot", "DELETE", "/tasks/plant-1:9:9", token=doors.token("robot")), "kill", 403)
        assert ids(doors) == [task["task_id"] for task in queue] == ["plant-1:9:9"]
        hijack = award(ANNOUNCED | {"plant": CARD_2}, 4)
        check_problem(doors.ask("robot", "POST", "/tasks", token=yours, json=hijack), "hijack", 403)
        assert [task["epoch"] for task in doors.ask("robot", "GET", "/tasks").json()] == [3]
        assert doors.ask("robot", "DELETE", "/tasks/plant-1:9:9", token=mine).status_code == 200
        check_problem(doors.ask("robot", "POST", "/tasks", token=mine, json=award(ANNOUNCED, 2)), "an old epoch", 409)


def ids(doors: Doors) -> list[str]:
    return [task["task_id"] for task in doors.ask("robot", "GET", "/tasks").json()]


@pytest.mark.parametrize("what", ["reports", "permits"])
def test_a_robot_speaks_in_its_own_name_only(busy: Doors, what: str) -> None:
    task_id, before = its_task(busy)["task_id"], busy.standing()
    body = REPORT if what == "reports" else PERMIT
    path = f"/tasks/{task_id}/{what}"
    stranger = busy.token("robot", "robot-2")
    check_problem(busy.ask("plant", "POST", path, token=stranger, json=body), what, 403)
    check_problem(busy.ask("plant", "POST", path, token=busy.token("robot"), json=body | {"robot_id": "robot-2"}), what, 403)
    assert busy.standing() == before


def test_who_does_not_hold_a_task_is_told_to_drop_it_and_gets_no_permit(busy: Doors) -> None:
    task, before = its_task(busy), busy.standing()
    for robot in ("robot-1", "robot-2"):
        token = busy.token("robot", robot)
        for epoch in (0, 1, 7, 2**53):
            for state in ("awarded", "running", "done", "failed"):
                report = REPORT | {"robot_id": robot, "epoch": epoch, "state": state, "delivered_ml": 100.0}
                answer = busy.ask("plant", "POST", f"/tasks/{task['task_id']}/reports", token=token, json=report)
                assert (answer.status_code, answer.json()["keep"]) == (200, False)
                assert answer.json()["reason"]
            asked = PERMIT | {"robot_id": robot, "epoch": epoch}
            answer = busy.ask("plant", "POST", f"/tasks/{task['task_id']}/permits", token=token, json=asked)
            check_problem(answer, (robot, epoch), 409)
    assert busy.standing() == before


def test_unknown_tasks_and_jobs_are_404(busy: Doors) -> None:
    before, robot = busy.standing(), busy.token("robot")
    for task_id in ("plant-1:9:9", "plant-2:1:1", "nobody"):
        check_problem(busy.ask("plant", "POST", f"/tasks/{task_id}/reports", token=robot, json=REPORT), task_id, 404)
        check_problem(busy.ask("plant", "POST", f"/tasks/{task_id}/permits", token=robot, json=PERMIT), task_id, 404)
        check_problem(busy.ask("plant", "DELETE", f"/tasks/{task_id}"), task_id, 404)
        check_problem(busy.ask("robot", "DELETE", f"/tasks/{task_id}"), task_id, 404)
        check_problem(busy.ask("robot", "DELETE", f"/jobs/{task_id}"), task_id, 404)
        check_problem(busy.ask("sim", "DELETE", f"/faults/{task_id}"), task_id, 404)
    assert busy.standing() == before


@pytest.mark.parametrize("owner", ["plant", "station"])
def test_a_dock_is_given_back_by_its_holder_or_an_operator(busy: Doors, owner: str) -> None:
    dock = busy.ask(owner, "GET", "/dock").json()[0]["dock_id"]
    mine, yours = busy.token("robot", "robot-2"), busy.token("robot")
    asked = {"robot_id": "robot-2", "dock_id": dock, "for_s": 100.0}
    check_problem(busy.ask(owner, "POST", "/dock/reservations", token=yours, json=asked), owner, 403)
    held = busy.ask(owner, "POST", "/dock/reservations", token=mine, json=asked)
    assert held.status_code == 200, held.text
    path = f"/dock/reservations/{held.json()['reservation_id']}"
    check_problem(busy.ask(owner, "DELETE", path, token=yours), owner, 403)
    check_problem(
        busy.ask(owner, "POST", "/dock/reservations", token=yours, json=asked | {"robot_id": "robot-1"}), owner, 409
    )
    assert busy.ask(owner, "GET", "/dock").json()[0]["holder"] == "robot-2"
    assert busy.ask(owner, "DELETE", path, token=mine).status_code == 204


def test_the_tap_opens_only_for_who_holds_its_dock(busy: Doors) -> None:
    before = busy.standing()
    asked = {"robot_id": "robot-1", "open_s": 5.0}
    check_problem(busy.ask("station", "POST", "/tap", token=busy.token("robot"), json=asked), "tap", 409)
    check_problem(busy.ask("station", "POST", "/tap", token=busy.token("robot", "robot-2"), json=asked), "tap", 403)
    assert busy.standing() == before


def test_only_an_operator_lets_a_stopped_robot_go_on(busy: Doors) -> None:
    for role in ("plant", "robot", "viewer"):
        check_problem(busy.ask("robot", "POST", "/resume", token=busy.token(role)), role, 403)
        check_problem(busy.ask("console", "POST", "/api/resume", token=busy.token(role)), role, 403)
        busy.wait(1.0)
        assert busy.ask("robot", "GET", "/state").json()["stopped"] is True


def test_the_longest_reason_for_a_stop_breaks_nothing_that_tells_it(busy: Doors) -> None:
    assert busy.ask("robot", "GET", "/state").json()["stopped_by"].startswith("operator: rrr")
    bid = busy.ask("robot", "POST", "/bids", json=ANNOUNCED)
    assert bid.status_code == 200
    assert bid.json()["reason"].startswith("stopped by operator")
    assert "stopped by operator" in busy.ask("plant", "GET", "/state").json()["waiting"]
    assert busy.ask("console", "GET", "/api/garden").json()["silent"] == []
