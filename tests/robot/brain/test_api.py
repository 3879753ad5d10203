"""Who may ask a robot what, and what it says to nonsense."""

import pytest
from standin import in_garden

from core.wire.documents import Document
from core.wire.robot import JobRequest, ResumeRequest, StopRequest


def asked(story):
    return in_garden(story)


def test_a_plant_may_only_award_and_kill_its_own_tasks():
    async def story(garden):
        stolen = await garden.call("robot-1", "POST", "/tasks", garden.award_of("plant-1"), as_="plant-2")
        assert stolen.status_code == 403
        await garden.award("plant-1")
        assert (await garden.call("robot-1", "DELETE", "/tasks/plant-1:1", as_="plant-2")).status_code == 403
        assert (await garden.call("robot-1", "GET", "/tasks/plant-1:1")).json()["plant_id"] == "plant-1"
        assert (await garden.call("robot-1", "DELETE", "/tasks/plant-1:1", as_="operator")).status_code == 200
        assert (await garden.call("robot-1", "GET", "/tasks/plant-1:1")).status_code in (200, 404)
        await garden.until(lambda: not garden.brains["robot-1"].queue.entries, 5.0)
        assert (await garden.call("robot-1", "GET", "/tasks")).json() == []

    asked(story)


def test_only_plants_and_operators_ask_for_bids_and_only_operators_give_jobs():
    async def story(garden):
        ask = garden.plants["plant-1"].announcement()
        assert (await garden.call("robot-1", "POST", "/bids", ask, as_="viewer")).status_code == 403
        assert (await garden.call("robot-1", "POST", "/bids", ask, as_="robot-2")).status_code == 403
        assert (await garden.call("robot-1", "POST", "/jobs", JobRequest(kind="home"), as_="plant-1")).status_code == 403
        assert (await garden.call("robot-1", "POST", "/stop", StopRequest(), as_="plant-1")).status_code == 200
        assert (await garden.call("robot-1", "POST", "/resume", as_="plant-1")).status_code == 403

    asked(story)


def test_a_job_is_202_with_its_place_and_can_be_watched_and_called_off():
    async def story(garden):
        answer = await garden.call("robot-1", "POST", "/jobs", JobRequest(kind="goto", x_m=0.0, y_m=0.0))
        assert answer.status_code == 202
        where = answer.headers["location"]
        await garden.clock.sleep(2.0)
        assert (await garden.call("robot-1", "GET", where)).json()["state"] == "running"
        await garden.call("robot-1", "DELETE", where)
        await garden.clock.sleep(1.0)
        assert (await garden.call("robot-1", "GET", where)).json()["state"] == "cancelled"
        again = await garden.call("robot-1", "POST", "/jobs", JobRequest(kind="goto", x_m=0.0, y_m=0.6))
        await garden.clock.sleep(30.0)
        assert (await garden.call("robot-1", "GET", again.headers["location"])).json()["state"] == "done"

    asked(story)


def test_a_job_comes_once_for_one_key_as_long_as_it_is_remembered():
    async def story(garden):
        async def post(x_m, key="k1"):
            return await garden.call("robot-1", "POST", "/jobs", JobRequest(kind="goto", x_m=x_m, y_m=0.0), key=key)

        first = await post(0.0)
        await garden.clock.sleep(700.0)
        again = await post(0.0)
        assert (again.status_code, again.headers["location"]) == (202, first.headers["location"])
        assert again.json()["state"] == "done"
        assert (await post(0.1)).status_code == 422
        assert (await post(0.0, "k2")).headers["location"] != first.headers["location"]
        assert len((await garden.call("robot-1", "GET", "/jobs")).json()) == 2

    asked(story)


@pytest.mark.parametrize(
    "wish",
    [JobRequest(kind="goto"), JobRequest(kind="dock", at="nowhere"), JobRequest(kind="goto", x_m=-0.55, y_m=0.75)],
)
def test_a_job_that_makes_no_sense_is_422_with_a_hint(wish):
    async def story(garden):
        answer = await garden.call("robot-1", "POST", "/jobs", wish)
        assert answer.status_code == 422
        assert answer.headers["content-type"].startswith("application/problem+json")

    asked(story)


def test_a_stale_award_is_409_and_a_repeated_one_is_the_same():
    async def story(garden):
        first = await garden.award("plant-1", epoch=2)
        second = await garden.award("plant-1", epoch=2)
        assert (first.status_code, second.status_code) == (201, 201)
        assert (await garden.award("plant-1", epoch=1)).status_code == 409
        assert len(garden.brains["robot-1"].queue.entries) == 1

    asked(story)


def test_an_e_stop_that_the_body_cannot_write_down_stands_and_is_not_confirmed():
    async def story(garden):
        garden.bodies["robot-1"].disk_broken = True
        answer = await garden.call("robot-1", "POST", "/stop", StopRequest(reason="cat"), as_="viewer")
        assert answer.status_code == 503
        assert "a restart would forget it" in answer.json()["detail"]
        assert (await garden.call("robot-1", "GET", "/state")).json()["stopped"]

    asked(story)


def test_a_captured_release_does_not_end_a_later_stop():
    async def story(garden):
        async def press():
            answer = await garden.call("robot-1", "POST", "/stop", StopRequest(reason="cat"), as_="viewer")
            return answer.json()["stop_number"]

        async def release(number, **more):
            return await garden.call("robot-1", "POST", "/resume", ResumeRequest(stop_number=number), **more)

        first = await press()
        assert (await garden.call("robot-1", "GET", "/state")).json()["stop_number"] == first
        assert (await release(first, key="k1")).json() | {"after_s": 0.0} == {
            "robot_id": "robot-1", "stopped": False, "by": "", "stop_number": 0, "after_s": 0.0,
        }  # fmt: skip
        assert (await garden.call("robot-1", "GET", "/state")).json()["stop_number"] == 0
        assert (await release(first)).status_code == 200, "said again it is still so"
        await garden.clock.sleep(601.0)
        second = await press()
        assert second > first
        for more in ({"key": "k1"}, {"key": "k2"}, {}):
            answer = await release(first, **more)
            assert answer.status_code == 409
            assert str(second) in answer.json()["hint"]
        assert garden.bodies["robot-1"].stopped
        assert (await release(second, key="k1")).json()["stopped"] is False

    asked(story)


def test_a_second_stop_while_it_stands_is_another_stop():
    async def story(garden):
        for reason in ("cat", "dog"):
            answer = await garden.call("robot-1", "POST", "/stop", StopRequest(reason=reason), as_="viewer")
        told = answer.json()
        assert (told["by"], told["stop_number"]) == ("viewer: dog", 2)
        refused = await garden.call("robot-1", "POST", "/resume", ResumeRequest(stop_number=1))
        assert (refused.status_code, "viewer: dog" in refused.json()["detail"]) == (409, True)
        assert (await garden.call("robot-1", "POST", "/resume", ResumeRequest(stop_number=2))).status_code == 200
        assert not garden.bodies["robot-1"].stopped

    asked(story)


def test_a_release_that_names_no_stop_is_422_and_told_where_the_number_stands():
    async def story(garden):
        await garden.call("robot-1", "POST", "/stop", StopRequest(), as_="viewer")
        for nothing in (None, Document()):
            answer = await garden.call("robot-1", "POST", "/resume", nothing)
            assert answer.status_code == 422
            assert "stop_number" in answer.json()["detail"]
            assert "GET /state" in answer.json()["hint"]
        assert garden.bodies["robot-1"].stopped

    asked(story)


def test_state_position_and_history_are_open_and_whole():
    async def story(garden):
        state = (await garden.call("robot-1", "GET", "/state", as_="viewer")).json()
        assert state["pose"]["y_m"] == pytest.approx(1.2, abs=0.05)
        assert state["tank_ml"] == pytest.approx(1200.0)
        position = (await garden.call("robot-1", "GET", "/position", as_="robot-2")).json()
        assert (position["moving"], position["rank"]) == (False, 2)
        assert (await garden.call("robot-1", "GET", "/readyz")).status_code == 200
        history = await garden.call("robot-1", "GET", "/history?format=csv")
        assert history.text.startswith("id,t_s,kind,what")

    asked(story)


@pytest.mark.alone
def test_bids_come_within_a_few_milliseconds_of_work():
    import time

    async def story(garden):
        await garden.bid("plant-1")
        brain = garden.brains["robot-1"]
        spent = []
        for plant in list(garden.plants) * 25:
            began = time.perf_counter()
            bid = await brain.bid(garden.plants[plant].announcement())
            spent.append(time.perf_counter() - began)
            assert bid.cost_s is not None
        assert sorted(spent)[98] < 0.05, f"p99 {sorted(spent)[98] * 1000:.1f} ms"
        print(f"median {sorted(spent)[50] * 1000:.2f} ms")

    asked(story)


def test_an_award_for_more_than_it_is_worth_by_now_is_declined_unless_it_is_held_already():
    async def story(garden):
        bid_s = (await garden.bid("plant-1")).cost_s
        award = garden.award_of("plant-1").model_copy(update={"at_most_s": 1.2 * bid_s})
        assert (await garden.award("plant-2")).status_code == 201
        declined = await garden.call("robot-1", "POST", "/tasks", award, as_="plant-1")
        assert (declined.status_code, declined.json()["title"]) == (409, "Overtaken")
        assert [entry.plant_id for entry in garden.brains["robot-1"].queue.entries] == ["plant-2"]
        anyway = award.model_copy(update={"at_most_s": None})
        assert (await garden.call("robot-1", "POST", "/tasks", anyway, as_="plant-1")).status_code == 201
        assert (await garden.call("robot-1", "POST", "/tasks", award, as_="plant-1")).status_code == 201

    asked(story)


def test_a_plant_that_nobody_enrolled_gets_no_bid():
    async def story(garden):
        ask = garden.plants["plant-1"].announcement()
        unknown = ask.model_copy(update={"plant": ask.plant.model_copy(update={"plant_id": "plant-77"})})
        bid = await garden.brains["robot-1"].bid(unknown)
        assert bid.cost_s is None
        assert "nobody we know" in bid.reason

    asked(story)
