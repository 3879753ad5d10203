"""A URL in somebody's document is for people: nothing asks it, wherever it stands."""

import asyncio

import httpx
import pytest
from standin import in_garden

from lab.mesh import MemoryTransport

FOREIGN = "http://169.254.169.254/latest/meta-data"


@pytest.fixture
def asked(monkeypatch):
    """Every URL that any node asks by the mesh; other ways out are an error."""
    urls = []
    carry = MemoryTransport.handle_async_request

    async def recorded(self, request):
        urls.append(str(request.url))
        return await carry(self, request)

    async def refused(*args, **more):
        raise AssertionError(f"a connection of its own: {args} {more}")

    monkeypatch.setattr(MemoryTransport, "handle_async_request", recorded)
    monkeypatch.setattr(httpx.AsyncHTTPTransport, "handle_async_request", refused)
    monkeypatch.setattr(asyncio.BaseEventLoop, "create_connection", refused)
    monkeypatch.setattr(asyncio, "open_connection", refused)
    return urls


@pytest.mark.parametrize("foreign", [FOREIGN, "http://robot-1/resume", "file:///etc/passwd", "http://plant-2"])
def test_the_url_of_a_plants_card_is_never_asked(asked, foreign):
    async def story(garden):
        plant = garden.plants["plant-1"]
        plant.card = plant.card.model_copy(update={"url": foreign})
        assert (await garden.bid("plant-1")).cost_s is not None
        assert (await garden.award("plant-1")).status_code == 201
        await garden.until(lambda: plant.ended, 120.0)
        assert plant.ended.state == "done"

    in_garden(story)
    by_robot = [url for url in asked if not url.startswith("http://robot-1/")]
    assert any(url.startswith("http://plant-1/tasks/") for url in by_robot)
    hosts = {url.split("/")[2] for url in by_robot}
    assert hosts <= {"plant-1", "station"}
    assert not any(url.startswith(foreign) for url in asked)


def test_a_card_of_somebody_unknown_is_neither_asked_nor_bid_for(asked):
    async def story(garden):
        plant = garden.plants["plant-1"]
        plant.card = plant.card.model_copy(update={"url": FOREIGN, "plant_id": "plant-9"})
        announced = plant.announcement(99).model_copy(update={"task_id": "plant-9:99"})
        told = await garden.call("robot-1", "POST", "/bids", announced, as_="plant-9")
        assert told.json()["cost_s"] is None
        award = garden.award_of("plant-1")
        award = award.model_copy(update={"announcement": announced})
        assert (await garden.call("robot-1", "POST", "/tasks", award, as_="plant-9")).status_code == 422
        await garden.clock.sleep(20.0)

    in_garden(story)
    assert {url.split("/")[2] for url in asked} <= {"robot-1", "station"} | {f"plant-{n}" for n in range(1, 5)}
    assert not any("169.254" in url or "plant-9" in url.split("/")[2] for url in asked)
