"""The hand's camera over HTTP: pictures, film, depth, and what can befall it; and the driver that is to notice."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import cv2
import httpx
import mujoco
import numpy as np
import pytest

from core.clock import VirtualClock
from core.scenario import find
from core.virtual import run_virtual
from hw.drivers.camera import Camera, CameraState, CameraUnfit, Parts, open_camera
from sim.service import make_node
from sim.wiring import Rig, assemble

HAND = "http://sim/cameras/robot-1/hand"
SIZE = "w=64&h=48"
Story = Callable[[httpx.AsyncClient, Camera, Rig], Awaitable[None]]


def tell(story: Story) -> None:
    async def main() -> None:
        clock = VirtualClock()
        rig = assemble(find("garden"), 7, clock)
        node = make_node(rig, clock, None)
        transport = httpx.ASGITransport(app=node.app)
        loops = [asyncio.ensure_future(loop()) for loop in node.loops]
        await clock.sleep(0.01)
        async with httpx.AsyncClient(transport=transport) as http:
            await story(http, open_camera(f"{HAND}.jpg?{SIZE}", clock, transport), rig)
        for loop in loops:
            loop.cancel()

    run_virtual(main())


async def befall(http: httpx.AsyncClient, kind: str) -> str:
    answer = await http.post("http://sim/faults", json={"kind": kind, "target": "robot-1"})
    return str(answer.raise_for_status().json()["id"])


@pytest.mark.parametrize(
    ("kind", "state"),
    [
        ("camera_frozen", CameraState.FROZEN),
        ("camera_black", CameraState.BLACK),
        ("camera_overexposed", CameraState.OVEREXPOSED),
        ("camera_silent", CameraState.SILENT),
    ],
)
def test_the_driver_notices_what_befalls_the_camera_and_that_it_is_over(kind: str, state: CameraState) -> None:
    async def story(http: httpx.AsyncClient, camera: Camera, rig: Rig) -> None:
        await camera.fresh()
        fault = await befall(http, kind)
        with pytest.raises(Exception, match=r"picture|503") as caught:
            await camera.fresh()
        assert camera.state is state
        assert isinstance(caught.value, CameraUnfit) == (state is not CameraState.SILENT)
        await http.delete(f"http://sim/faults/{fault}")
        assert (await camera.fresh()).image.shape == (48, 64, 3)
        assert camera.state is CameraState.OK

    tell(story)


def test_a_camera_that_hangs_upside_down_shows_the_same_turned_by_half() -> None:
    async def story(http: httpx.AsyncClient, camera: Camera, rig: Rig) -> None:
        upright = (await camera.fresh()).image.astype(float)
        await befall(http, "camera_upside_down")
        turned = (await camera.fresh()).image.astype(float)[::-1, ::-1]
        assert np.abs(turned - upright).mean() < 0.5 * np.abs(turned[::-1, ::-1] - upright).mean()

    tell(story)


def test_a_film_goes_on_until_the_camera_falls_silent() -> None:
    async def story(http: httpx.AsyncClient, camera: Camera, rig: Rig) -> None:
        film = asyncio.ensure_future(http.get(f"{HAND}.mjpg?{SIZE}&fps=10"))
        await asyncio.sleep(1.0)
        await befall(http, "camera_silent")
        answer = await film
        assert answer.headers["content-type"].startswith("multipart/x-mixed-replace")
        pictures = Parts().feed(answer.content)
        assert 8 <= len(pictures) <= 11
        assert len(set(pictures)) == len(pictures)

    tell(story)


def test_depth_is_in_millimetres_along_the_axis() -> None:
    async def story(http: httpx.AsyncClient, camera: Camera, rig: Rig) -> None:
        answer = await http.get(f"{HAND}.png?w=320&h=240")
        depth_mm = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert depth_mm.dtype == np.uint16
        assert depth_mm.shape == (240, 320)
        eye = rig.world.model.camera("robot-1/eye").id
        model, data = rig.world.model, rig.world.data
        p, R = data.cam_xpos[eye], data.cam_xmat[eye].reshape(3, 3)
        f = 120 / np.tan(np.radians(model.cam_fovy[eye]) / 2)
        for v, u in ((100, 40), (120, 160), (60, 300)):
            ray = R @ np.array([(u + 0.5 - 160) / f, -(v + 0.5 - 120) / f, -1.0])
            groups, found = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8), np.zeros(1, dtype=np.int32)
            length = np.linalg.norm(ray)
            camera_body = int(model.geom("robot-1/camera").bodyid[0])
            along = mujoco.mj_ray(model, data, p, ray / length, groups, 1, camera_body, found, None)
            assert abs(depth_mm[v, u] - 1000 * max(along, 0) / length) < 2

    tell(story)
