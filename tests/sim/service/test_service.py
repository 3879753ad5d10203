from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from core.clock import VirtualClock
from core.mesh.auth import Enrolled, Verifier, make_garden
from core.scenario import find
from core.virtual import run_virtual
from sim.service import make_node
from sim.wiring import Rig, assemble

Story = Callable[[httpx.AsyncClient, Rig, VirtualClock], Awaitable[None]]


def tell(story: Story, verifier: Verifier | None = None) -> None:
    async def main() -> None:
        clock = VirtualClock()
        rig = assemble(find("garden"), 7, clock)
        node = make_node(rig, clock, verifier)
        loops = [asyncio.ensure_future(loop()) for loop in node.loops]
        await clock.sleep(0.01)
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app=node.app), base_url="http://sim") as http:
            await story(http, rig, clock)
        for loop in loops:
            loop.cancel()

    run_virtual(main())


def test_the_truth_is_of_this_very_moment() -> None:
    async def story(http: httpx.AsyncClient, rig: Rig, clock: VirtualClock) -> None:
        await clock.sleep(12.34)
        truth = (await http.get("/truth")).json()
        assert truth["time_s"] == pytest.approx(12.35, abs=0.001)
        assert [robot["id"] for robot in truth["robots"]] == ["robot-1", "robot-2"]
        assert truth["plants"][0]["moisture_ratio"] == pytest.approx(0.15, abs=0.001)

    tell(story)


def test_the_clock_can_be_changed_and_paused() -> None:
    async def story(http: httpx.AsyncClient, rig: Rig, clock: VirtualClock) -> None:
        assert (await http.patch("/clock", json={"speed": 5.0})).json()["speed"] == 5.0
        await clock.sleep(10.0)
        assert (await http.get("/clock")).json()["garden_s"] == pytest.approx(50.0, abs=0.1)
        paused = (await http.patch("/clock", json={"paused": True})).json()
        await clock.sleep(10.0)
        still = (await http.get("/clock")).json()
        assert (still["garden_s"], still["rate"], still["paused"]) == (paused["garden_s"], 0.0, True)

    tell(story)


@pytest.mark.parametrize(
    "change",
    [{}, {"speed": 0}, {"speed": -1.0}, {"speed": 1e9}, {"speed": "fast"}, {"paused": "no"}, {"sped": 3.0}, {"speed": True}],
)
def test_nonsense_for_the_clock_is_refused_and_changes_nothing(change: dict[str, Any]) -> None:
    async def story(http: httpx.AsyncClient, rig: Rig, clock: VirtualClock) -> None:
        answer = await http.patch("/clock", json=change)
        assert answer.status_code == 422
        assert answer.headers["content-type"] == "application/problem+json"
        assert (rig.clockwork.speed, rig.clockwork.paused) == (1.0, False)

    tell(story)


def test_a_fault_is_made_listed_and_lifted() -> None:
    async def story(http: httpx.AsyncClient, rig: Rig, clock: VirtualClock) -> None:
        made = await http.post("/faults", json={"kind": "pump_stuck", "target": "robot-1", "duration_s": 60})
        assert made.status_code == 201
        assert (await http.get("/faults")).json() == [made.json()]
        assert (await http.delete(f"/faults/{made.json()['id']}")).status_code == 200
        assert (await http.get("/faults")).json() == []
        assert (await http.delete(f"/faults/{made.json()['id']}")).status_code == 404
        refused = await http.post("/faults", json={"kind": "rain", "target": "robot-1"})
        assert refused.status_code == 422
        assert "marker_blindness" in refused.json()["hint"]

    tell(story)


def test_changes_need_the_operators_token_and_reads_need_none(tmp_path: Any) -> None:
    make_garden(tmp_path, [Enrolled("sim", "viewer")], 0.0)
    tokens = {who: (tmp_path / who / "token").read_text().strip() for who in ("operator", "viewer")}

    async def story(http: httpx.AsyncClient, rig: Rig, clock: VirtualClock) -> None:
        for method, path, body in (
            ("PATCH", "/clock", {"speed": 2.0}),
            ("POST", "/faults", {"kind": "dead_battery", "target": "robot-1"}),
            ("DELETE", "/faults/fault-1", None),
        ):
            assert (await http.request(method, path, json=body)).status_code == 401
            for who, status in (("viewer", 403), ("operator", 200 if method != "POST" else 201)):
                headers = {"authorization": f"Bearer {tokens[who]}"}
                assert (await http.request(method, path, json=body, headers=headers)).status_code == status
        assert (await http.get("/truth")).status_code == 200

    tell(story, Verifier.load(tmp_path / "sim"))


def picture_of(answer: httpx.Response) -> np.ndarray:
    assert answer.headers["content-type"] == "image/jpeg"
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def test_the_garden_is_pictured_from_above_and_askers_share_a_picture() -> None:
    async def story(http: httpx.AsyncClient, rig: Rig, clock: VirtualClock) -> None:
        first, second = await asyncio.gather(http.get("/overview.jpg"), http.get("/overview.jpg"))
        picture = picture_of(first)
        assert picture.shape == (720, 960, 3)
        green = (picture[..., 1] > 1.3 * picture[..., 0]) & (picture[..., 1] > 1.3 * picture[..., 2])
        assert 0.3 < green.mean() < 0.8
        assert first.content == second.content

    tell(story)


def test_a_hand_camera_answers_in_the_size_asked_for() -> None:
    async def story(http: httpx.AsyncClient, rig: Rig, clock: VirtualClock) -> None:
        picture = picture_of(await http.get("/cameras/robot-1/hand.jpg?w=160&h=120"))
        assert picture.shape == (120, 160, 3)
        assert picture.std() > 5
        assert (await http.get("/cameras/robot-9/hand.jpg")).status_code == 404
        assert (await http.get("/cameras/robot-1/hand.jpg?w=100000")).status_code == 422

    tell(story)


def test_the_node_says_what_it_is_and_that_it_runs() -> None:
    async def story(http: httpx.AsyncClient, rig: Rig, clock: VirtualClock) -> None:
        assert (await http.get("/")).json()["kind"] == "sim"
        assert (await http.get("/readyz")).status_code == 200
        assert "sim_garden_seconds" in (await http.get("/metrics")).text
        paths = (await http.get("/openapi.json")).json()["paths"]
        assert {"/truth", "/overview.jpg", "/clock", "/clock/feed", "/faults"} <= set(paths)

    tell(story)
