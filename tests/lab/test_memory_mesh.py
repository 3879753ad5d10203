"""The in-memory mesh behaves like a network, and fails like one."""

import asyncio
import random

import httpx
import pytest
from fastapi import FastAPI

from core.clock import VirtualClock
from core.virtual import run_virtual
from lab.mesh import MemoryMesh


def garden(scenario):
    async def main():
        clock = VirtualClock()
        mesh = MemoryMesh(clock, random.Random(1), latency_s=0.01)
        app = FastAPI()
        done = []

        @app.post("/act")
        async def act() -> dict[str, int]:
            done.append(clock.now())
            await clock.sleep(0.5)
            done.append(clock.now())
            return {"acts": len(done)}

        mesh.attach("pot", "pot", app)
        async with httpx.AsyncClient(transport=mesh.transport("robot"), timeout=2.0) as client:
            return await scenario(clock, mesh, client, done)

    return run_virtual(main())


def test_a_request_takes_the_latency_of_both_legs_and_the_handlers_time():
    async def scenario(clock, mesh, client, done):
        answer = await client.post("http://pot/act")
        return answer.status_code, clock.now()

    status, now_s = garden(scenario)
    assert status == 200
    assert now_s == pytest.approx(0.52)


def test_an_unknown_host_refuses_the_connection():
    async def scenario(clock, mesh, client, done):
        with pytest.raises(httpx.ConnectError):
            await client.get("http://nobody/")

    garden(scenario)


def test_a_lost_reply_times_out_although_the_act_was_done():
    async def scenario(clock, mesh, client, done):
        mesh.leg("pot", "robot").cut = True
        with pytest.raises(httpx.ReadTimeout):
            await client.post("http://pot/act")
        return len(done)

    assert garden(scenario) == 2


def test_a_lost_request_is_never_acted_upon():
    async def scenario(clock, mesh, client, done):
        mesh.leg("robot", "pot").cut = True
        with pytest.raises(httpx.ReadTimeout):
            await client.post("http://pot/act")
        return len(done)

    assert garden(scenario) == 0


def test_a_caller_that_gives_up_does_not_stop_the_handler():
    async def scenario(clock, mesh, client, done):
        with pytest.raises(httpx.ReadTimeout):
            await client.post("http://pot/act", timeout=0.1)
        await clock.sleep(1.0)
        return len(done)

    assert garden(scenario) == 2


def test_a_node_that_dies_while_answering_breaks_the_connection():
    async def scenario(clock, mesh, client, done):
        call = asyncio.create_task(client.post("http://pot/act"))
        await clock.sleep(0.2)
        mesh.detach("pot")
        with pytest.raises(httpx.ReadError):
            await call
        return len(done)

    assert garden(scenario) == 1


def test_a_dead_nodes_own_requests_never_leave_it():
    async def scenario(clock, mesh, client, done):
        transport = mesh.transport("robot-2")
        transport.alive = False
        async with httpx.AsyncClient(transport=transport) as dead:
            with pytest.raises(httpx.ConnectError):
                await dead.post("http://pot/act")
        return len(done)

    assert garden(scenario) == 0
