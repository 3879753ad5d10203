"""A station lends its docks and opens its tap only to the robot that stands there."""

from __future__ import annotations

from typing import Any

Play = Any
Garden = Any


async def ask(garden: Garden, robot: str, path: str, **body: Any) -> Any:
    body = {"robot_id": robot, **body}
    return await garden.call("station", "POST", path, who=robot, role="robot", json=body)


async def reserve(garden: Garden, robot: str, dock_id: str = "tap", **more: Any) -> Any:
    return await ask(garden, robot, "/dock/reservations", dock_id=dock_id, **more)


def valve_open(garden: Garden) -> bool:
    return bool(garden.soils["station"].levels.get(8))


def test_the_tap_opens_for_the_holder_of_its_dock_and_shuts_by_itself(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.start_station()
        await garden.clock.sleep(2.0)
        assert (await reserve(garden, "robot-1", for_s=120.0)).status_code == 200
        grant = await ask(garden, "robot-1", "/tap", open_s=10.0)
        assert grant.json() == {"open_s": 10.0, "flow_mlps": 50.0}
        await garden.clock.sleep(0.5)
        assert valve_open(garden)
        state = (await garden.call("station", "GET", "/state")).json()
        assert (state["tap_open"], state["dispensed_ml"]) == (True, 500.0)
        assert (await ask(garden, "robot-1", "/tap", open_s=5.0)).status_code == 409
        await garden.clock.sleep(11.0)
        assert not valve_open(garden)
        assert not (await garden.call("station", "GET", "/state")).json()["tap_open"]

    play(story)


def test_nobody_else_opens_the_tap(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.start_station()
        await garden.clock.sleep(2.0)
        await reserve(garden, "robot-1")
        await reserve(garden, "robot-2", "spare")
        refused = await ask(garden, "robot-2", "/tap", open_s=5.0)
        assert refused.status_code == 409
        assert "robot-1" in refused.json()["detail"]
        posed = await garden.call(
            "station", "POST", "/tap", who="robot-2", role="robot", json={"robot_id": "robot-1", "open_s": 5.0}
        )
        assert posed.status_code == 403
        assert (await ask(garden, "robot-1", "/tap", open_s=61.0)).status_code == 422
        assert not valve_open(garden)

    play(story)


def test_leaving_the_dock_shuts_the_tap(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.start_station()
        await garden.clock.sleep(2.0)
        loan = (await reserve(garden, "robot-1", for_s=120.0)).json()
        await ask(garden, "robot-1", "/tap", open_s=30.0)
        await garden.clock.sleep(1.0)
        path = f"/dock/reservations/{loan['reservation_id']}"
        assert (await garden.call("station", "DELETE", path, who="robot-1", role="robot")).status_code == 204
        await garden.clock.sleep(0.5)
        assert not valve_open(garden)

    play(story)


def test_what_the_tap_gave_and_who_stands_where_survive_a_restart(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.start_station()
        await garden.clock.sleep(2.0)
        await reserve(garden, "robot-1", for_s=60.0)
        await ask(garden, "robot-1", "/tap", open_s=4.0)
        await garden.kill_pot("station")
        garden.start_station()
        state = (await garden.call("station", "GET", "/state")).json()
        assert state["dispensed_ml"] == 200.0
        assert state["docks"][0]["holder"] == "robot-1"
        assert (await reserve(garden, "robot-2")).status_code == 409

    play(story)


def test_a_dead_valve_board_is_said_and_nothing_opens(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.start_station()
        garden.net.close("station")
        await garden.clock.sleep(1.0)
        ready = await garden.call("station", "GET", "/readyz")
        assert ready.status_code == 503
        assert "tap" in ready.json()["detail"]
        await reserve(garden, "robot-1")
        assert (await ask(garden, "robot-1", "/tap", open_s=4.0)).status_code == 503
        assert not (await garden.call("station", "GET", "/state")).json()["tap_open"]

    play(story)


def test_a_dock_must_be_named_and_known(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.start_station()
        assert (await reserve(garden, "robot-1", "")).status_code == 422
        unknown = await reserve(garden, "robot-1", "moon")
        assert unknown.status_code == 404
        assert "tap, spare" in unknown.json()["hint"]

    play(story)


def test_a_resting_robot_learns_who_waits_and_the_dock_goes_to_the_one_who_asked(play: Play) -> None:
    async def story(garden: Garden) -> None:
        garden.robot("robot-1")
        garden.pot(ratio=0.3)

        async def dock(robot: str, **more: Any) -> Any:
            body = {"robot_id": robot, **more}
            return await garden.call("plant-1", "POST", "/dock/reservations", who=robot, role="robot", json=body)

        held = (await dock("robot-1", yielding=True)).json()
        assert held["wanted_by"] == ""
        refused = await dock("robot-2")
        assert refused.status_code == 409
        assert "robot-1" in refused.json()["detail"]
        assert (await dock("robot-1", yielding=True)).json()["wanted_by"] == "robot-2"
        path = f"/dock/reservations/{held['reservation_id']}"
        assert (await garden.call("plant-1", "DELETE", path, who="robot-2", role="robot")).status_code == 403
        assert (await garden.call("plant-1", "DELETE", path, who="robot-1", role="robot")).status_code == 204
        assert (await dock("robot-3")).status_code == 409
        assert (await dock("robot-2")).json()["epoch"] == held["epoch"] + 1

    play(story)
