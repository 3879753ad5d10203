"""The camera driver against good, silent, frozen, blind and dazzled cameras, on virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from core.clock import Clock, VirtualClock
from core.errors import ConfigError, DriverError, DriverTimeout, LinkDown
from core.virtual import run_virtual
from hw.drivers.camera import (
    SILENCE_S,
    Camera,
    CameraState,
    CameraUnfit,
    Parts,
    V4l2Source,
    open_camera,
)

URL = "http://camera/hand.jpg"


def picture(seed: int, level: float = 120.0, spread: float = 30.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(level, spread, (48, 64, 3))
    return np.clip(noise, 0, 255).astype(np.uint8)


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


class Lens(httpx.AsyncBaseTransport):
    """An IP camera in memory: answers with what `shows` gives for the n-th request, after `delay_s`."""

    def __init__(self, clock: Clock, shows: Callable[[int], bytes], delay_s: float = 0.02) -> None:
        self.clock, self.shows, self.delay_s, self.asked = clock, shows, delay_s, 0

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        self.asked += 1
        shown = self.shows(self.asked)
        await self.clock.sleep(self.delay_s)
        return httpx.Response(200 if shown else 503, headers={"content-type": "image/jpeg"}, content=shown)


def look(shows: Callable[[int], bytes], story: Callable[[Camera, Lens, Clock], Awaitable[None]]) -> None:
    async def main() -> None:
        clock = VirtualClock()
        lens = Lens(clock, shows)
        camera = open_camera(URL, clock, lens)
        assert not camera.link.up
        running = asyncio.create_task(camera.run())
        await story(camera, lens, clock)
        running.cancel()
        await asyncio.wait([running])

    run_virtual(main())


def test_every_look_is_a_new_picture_with_its_time_and_number() -> None:
    async def story(camera: Camera, lens: Lens, clock: Clock) -> None:
        first = await camera.fresh()
        asked_s = clock.now()
        second = await camera.fresh(asked_s)
        assert second.image.shape == (48, 64, 3)
        assert second.sequence > first.sequence
        assert asked_s <= second.stamp_s <= clock.now()
        assert 0 <= second.age_s(clock.now()) < 0.1
        assert camera.state is CameraState.OK
        assert camera.link.up

    look(lambda n: jpeg(picture(n)), story)


def test_a_silent_camera_is_not_a_good_camera() -> None:
    async def story(camera: Camera, lens: Lens, clock: Clock) -> None:
        await camera.fresh()
        lens.delay_s = 1e6
        began_s = clock.now()
        with pytest.raises(DriverTimeout):
            await camera.fresh()
        assert clock.now() - began_s == pytest.approx(SILENCE_S, abs=0.1)
        assert camera.state is CameraState.SILENT
        assert not camera.link.up
        lens.delay_s = 0.02
        await camera.fresh()
        assert camera.link.up

    look(lambda n: jpeg(picture(n)), story)


def test_a_camera_that_refuses_is_silent_and_says_with_what() -> None:
    async def story(camera: Camera, lens: Lens, clock: Clock) -> None:
        with pytest.raises(LinkDown, match="503"):
            await camera.fresh()
        assert camera.state is CameraState.SILENT

    look(lambda n: b"", story)


def test_a_frozen_camera_is_known_from_the_first_look_on_and_again_after_it_was_well() -> None:
    stuck = {"from": 0, "to": 10}

    async def story(camera: Camera, lens: Lens, clock: Clock) -> None:
        with pytest.raises(CameraUnfit) as caught:
            await camera.fresh()
        assert caught.value.state is camera.state is CameraState.FROZEN
        stuck["to"] = 0
        assert (await camera.fresh()).sequence > 1
        stuck.update({"from": lens.asked, "to": 1000})
        with pytest.raises(CameraUnfit, match="repeats"):
            await camera.fresh()

    look(lambda n: jpeg(picture(stuck["from"] if stuck["from"] < n <= stuck["to"] else n)), story)


@pytest.mark.parametrize(
    ("shown", "state"),
    [
        (lambda n: picture(n, 5.0, 9.0), CameraState.BLACK),
        (lambda n: picture(0, 0.0, 0.0), CameraState.BLACK),
        (lambda n: picture(n, 300.0, 30.0), CameraState.OVEREXPOSED),
        (lambda n: (picture(n, 300.0, 30.0) * (0.4, 1.0, 0.3)).astype(np.uint8), CameraState.OVEREXPOSED),
    ],
)
def test_a_covered_and_a_dazzled_lens_are_told_apart_and_recovered_from(
    shown: Callable[[int], np.ndarray], state: CameraState
) -> None:
    healed = False

    async def story(camera: Camera, lens: Lens, clock: Clock) -> None:
        nonlocal healed
        with pytest.raises(CameraUnfit):
            await camera.fresh()
        assert camera.state is state
        healed = True
        await camera.fresh()
        assert camera.state is CameraState.OK

    look(lambda n: jpeg(picture(n) if healed else shown(n)), story)


def test_a_dark_room_and_a_white_wall_are_no_faults() -> None:
    for level in (25.0, 225.0):
        look(lambda n, level=level: jpeg(picture(n, level, 12.0)), lambda camera, lens, clock: camera.fresh())  # type: ignore[misc]


def test_what_is_no_picture_is_an_error_of_the_device() -> None:
    async def story(camera: Camera, lens: Lens, clock: Clock) -> None:
        with pytest.raises(DriverError, match="no picture"):
            await camera.fresh()

    look(lambda n: b"<html>hello</html>", story)


# Films


def part(data: bytes, *, length: bool = True) -> bytes:
    stated = b"content-length: %d\r\n" % len(data) if length else b""
    return b"--frame\r\ncontent-type: image/jpeg\r\n" + stated + b"\r\n" + data + b"\r\n"


@pytest.mark.parametrize("length", [True, False])
@pytest.mark.parametrize("step", [1, 7, 100000])
def test_a_film_is_cut_into_its_pictures_wherever_its_bytes_are_cut(length: bool, step: int) -> None:
    pictures = [jpeg(picture(n)) for n in range(4)]
    film = b"".join(part(data, length=length) for data in pictures) + b"--frame\r\n"
    parts = Parts()
    assert [p for at in range(0, len(film), step) for p in parts.feed(film[at : at + step])] == pictures


class Film(httpx.AsyncBaseTransport):
    """A film of ten pictures a second that breaks off after twelve."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.shown, self.asked = clock, 0, 0

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        self.asked += 1

        class Body(httpx.AsyncByteStream):
            async def __aiter__(body) -> AsyncIterator[bytes]:  # noqa: N805
                for _ in range(12):
                    await self.clock.sleep(0.1)
                    self.shown += 1
                    yield part(jpeg(picture(self.shown)))

        return httpx.Response(200, headers={"content-type": "multipart/x-mixed-replace; boundary=frame"}, stream=Body())


def test_a_film_is_followed_and_asked_for_again_when_it_breaks_off() -> None:
    async def main() -> None:
        clock = VirtualClock()
        film = Film(clock)
        camera = open_camera("http://camera/hand.mjpg", clock, film)
        running = asyncio.create_task(camera.run())
        for _ in range(15):
            asked_s = clock.now()
            frame = await camera.fresh(asked_s)
            assert asked_s <= frame.stamp_s
            assert clock.now() - asked_s < 0.6
        assert film.asked >= 2
        running.cancel()
        await asyncio.wait([running])

    run_virtual(main())


# Other sources


def test_a_recording_is_played_in_order_and_may_stand_still(tmp_path: Path) -> None:
    for n in (2, 1):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.full((8, 8, 3), 60 * n, np.uint8))

    async def main() -> None:
        camera = open_camera(f"file:{tmp_path}/*.png", VirtualClock())
        assert [int((await camera.fresh()).image[0, 0, 0]) for _ in range(3)] == [60, 120, 60]
        (tmp_path / "2.png").unlink()
        assert [int((await camera.fresh()).image[0, 0, 0]) for _ in range(3)] == [60, 60, 60]
        with pytest.raises(LinkDown):
            await open_camera(f"file:{tmp_path}/*.gif", VirtualClock()).fresh()

    run_virtual(main())


class Capture:
    """OpenCV's VideoCapture as far as it is used."""

    def __init__(self) -> None:
        self.taken, self.dead = 0, False

    def grab(self) -> bool:
        self.taken += 1
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.taken += 1
        return (False, None) if self.dead else (True, picture(self.taken))

    def release(self) -> None:
        self.dead = False


def test_a_camera_of_this_machine_is_read_past_what_it_kept_back_and_reopened_when_it_fails() -> None:
    async def main() -> None:
        clock, opened = VirtualClock(), [Capture(), Capture()]
        camera = Camera(V4l2Source("/dev/video0", clock, lambda device: opened.pop(0)), "v4l2:/dev/video0", clock)
        first, second = await camera.fresh(), await camera.fresh()
        assert (first.image != second.image).any()
        left = opened[0]
        camera._source._camera.dead = True  # type: ignore[attr-defined]
        with pytest.raises(LinkDown):
            await camera.fresh()
        await camera.fresh()
        assert left.taken > 0

    run_virtual(main())


@pytest.mark.parametrize("url", ["", "camera", "v4l2:", "rtsp://x/y", "file:"])
def test_an_address_of_no_known_kind_is_refused_with_what_would_do(url: str) -> None:
    async def main() -> None:
        with pytest.raises(ConfigError) as caught:
            open_camera(url, VirtualClock())
        assert "v4l2" in str(caught.value.hint)

    run_virtual(main())
