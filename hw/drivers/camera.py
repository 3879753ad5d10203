"""A camera by URL: pictures as arrays, and the truth about whether they can be used.

- `http://HOST/PATH`: any IP camera's single pictures, asked for one by one
- `http://HOST/PATH.mjpg`, `http://HOST/PATH#film`: its film (MJPEG), kept open
- `v4l2:/dev/video0`: a camera of this machine, through OpenCV
- `file:/folder/*.jpg`: a recording, in the order of the names, again and again

A picture is handed out only if the camera is well: it must answer, its pictures must change (every real sensor has noise:
two equal pictures mean a stuck one; recordings may stand still), and be neither black nor burnt out.
"""

from __future__ import annotations

import asyncio
import glob
import logging
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import structlog
from numpy.typing import NDArray

from core.clock import Clock
from core.errors import ConfigError, DriverError, DriverTimeout, LinkDown, Unavailable
from hw.drivers.session import BACKOFF_S_MAX, BACKOFF_S_MIN, Pulse
from hw.ports import LinkStatus

Image = NDArray[np.uint8]
"""(H, W, 3), blue green red."""
SILENCE_S = 3.0
"""A camera that gives no picture for so long [s of the wall] is silent."""
SAME_MAX, AGAIN_S = 3, 0.15
"""So many equal pictures in a row, this far apart, are a frozen camera."""
BLACK_LEVEL, BLOCK_PX = 24.0, 8
"""A picture is black when no block of so many pixels is brighter on average (0-255): a covered sensor still has noise."""
BURNT_LEVEL, BURNT_SHARE = 250, 0.5
"""A picture is burnt out when more than this share of it is as bright as this in any colour: grass burns green first."""
PICTURE_BYTES_MAX = 16 * 1024 * 1024
DECODE_COST_S, READ_COST_S = 0.004, 0.03


class CameraState(Enum):
    """How the camera was when it was last looked through."""

    UNKNOWN = "unknown"
    OK = "ok"
    SILENT = "silent"
    FROZEN = "frozen"
    BLACK = "black"
    OVEREXPOSED = "over-exposed"


class CameraUnfit(DriverError):
    """The camera answers, but what it shows is of no use."""

    def __init__(self, state: CameraState, why: str) -> None:
        super().__init__(why, hint="look at its picture; clean the lens or start the camera anew")
        self.state = state


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One picture. `stamp_s`: garden time before which it was not taken."""

    image: Image
    stamp_s: float
    sequence: int

    def age_s(self, now_s: float) -> float:
        """At most so old."""
        return now_s - self.stamp_s


@dataclass(frozen=True, slots=True)
class Shot:
    """What a source gives: a JPEG or the pixels themselves, and the garden time before which it was not taken."""

    data: bytes | Image
    stamp_s: float


class Source(ABC):
    """Where shots come from."""

    may_stand_still = False

    @abstractmethod
    async def shoot(self, after_s: float) -> Shot:
        """A shot taken after `after_s`; raises Unavailable, DriverError or OSError. The caller holds the time-out."""

    async def run(self) -> None:
        """Whatever must go on between shots."""
        await asyncio.Event().wait()


class Camera:
    """One camera. `fresh` is all a skill needs; `run` belongs into the service's loops."""

    def __init__(self, source: Source, name: str, clock: Clock, silence_s: float = SILENCE_S) -> None:
        self._source, self._name, self._clock, self._silence_s = source, name, clock, silence_s
        self._status = LinkStatus(up=False, why="not looked through yet", since_s=0.0)
        self._state = CameraState.UNKNOWN
        self._sequence = 0
        self._print: int | None = None
        """A checksum of the last picture."""
        self._taking = asyncio.Lock()
        self._log = structlog.get_logger().bind(device="camera", url=name)

    @property
    def link(self) -> LinkStatus:
        return self._status

    @property
    def state(self) -> CameraState:
        return self._state

    async def run(self) -> None:
        await self._source.run()

    async def fresh(self, after_s: float | None = None) -> Frame:
        """The first good picture taken after `after_s` (now, if not said).

        Raises DriverTimeout when the camera is silent, LinkDown when it cannot be reached, CameraUnfit when it is frozen,
        black or burnt out.
        """
        async with self._taking:
            try:
                frame = await self._changed(self._clock.now() if after_s is None else after_s)
            except CameraUnfit as error:
                self._say(error.state, str(error))
                raise
            except (Unavailable, DriverError) as error:
                self._say(CameraState.SILENT, str(error))
                raise
            self._say(CameraState.OK, "the camera gives pictures")
            return frame

    async def _changed(self, after_s: float) -> Frame:
        """A fit picture that is not the one before; the very first one is compared with a second."""
        for _ in range(SAME_MAX + 1):
            frame = await self._take(after_s)
            unfit(frame.image)
            before, self._print = self._print, zlib.crc32(frame.image.tobytes())
            if self._source.may_stand_still or before not in (None, self._print):
                return frame
            await self._clock.sleep(AGAIN_S)
        raise CameraUnfit(CameraState.FROZEN, f"{self._name} repeats one picture")

    async def _take(self, after_s: float) -> Frame:
        try:
            # As for all HTTP these are the wall's seconds: a hasty simulated clock makes no camera slower.
            async with asyncio.timeout(self._silence_s):
                shot = await self._source.shoot(after_s)
        except TimeoutError:
            raise DriverTimeout(self._name, self._silence_s) from None
        except OSError as error:
            raise LinkDown(f"cannot read {self._name}: {error}") from error
        data = shot.data
        image = await self._clock.offload(lambda: decoded(data), DECODE_COST_S) if isinstance(data, bytes) else data
        self._sequence += 1
        return Frame(image=image, stamp_s=shot.stamp_s, sequence=self._sequence)

    def _say(self, state: CameraState, why: str) -> None:
        """Take the new standing; log it when it changed."""
        if state is not self._state:
            ok = state is CameraState.OK
            self._log.log(logging.INFO if ok else logging.WARNING, f"camera {state.value}", why=why)
            self._status = LinkStatus(up=state is not CameraState.SILENT, why=why, since_s=self._clock.now())
            self._state = state


def decoded(data: bytes) -> Image:
    """The pixels of a JPEG or PNG; raises DriverError."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise DriverError("the camera sent something that is no picture")
    return np.asarray(image, np.uint8)


def unfit(image: Image) -> None:
    """Raises CameraUnfit for a picture (H, W, 3) that is black or burnt out."""
    rows, columns = image.shape[0] // BLOCK_PX * BLOCK_PX, image.shape[1] // BLOCK_PX * BLOCK_PX
    bright = image[:rows, :columns].max(axis=2).reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)
    if bright.mean(axis=(1, 3)).max(initial=0.0) < BLACK_LEVEL:
        raise CameraUnfit(CameraState.BLACK, "the picture is black; is the lens covered?")
    if (image[::4, ::4].max(axis=2) >= BURNT_LEVEL).mean() > BURNT_SHARE:
        raise CameraUnfit(CameraState.OVEREXPOSED, "the picture is burnt out: too much light, or a stuck exposure")


# Where pictures come from


class HttpSource(Source):
    """An IP camera, for single pictures or a film: which of them, its first answer tells."""

    def __init__(self, url: str, clock: Clock, transport: httpx.AsyncBaseTransport | None = None) -> None:
        self._url, self._clock = url, clock
        self._client = httpx.AsyncClient(transport=transport, timeout=None, follow_redirects=True)
        parts = urlsplit(url)
        self._film = parts.path.endswith((".mjpg", ".mjpeg")) or parts.fragment == "film"
        self._latest: Shot | None = None
        self._came = Pulse()
        self._log = structlog.get_logger().bind(device="camera", url=url)

    async def shoot(self, after_s: float) -> Shot:
        if self._film:
            return await self._from_film(after_s)
        asked_s = self._clock.now()
        try:
            async with self._client.stream("GET", self._url) as answer:
                _check(answer, self._url)
                if answer.headers.get("content-type", "").startswith("multipart/"):
                    raise ConfigError(f"{self._url} is a film", hint="add #film to its address")
                return Shot(await _whole(answer), asked_s)
        except httpx.HTTPError as error:
            raise LinkDown(f"cannot reach {self._url}: {error or type(error).__name__}") from error

    async def run(self) -> None:
        """Keeps the film open; single pictures need nothing."""
        try:
            await self._follow()
        finally:
            await self._client.aclose()

    async def _follow(self) -> None:
        backoff_s = BACKOFF_S_MIN
        while self._film:
            before = self._latest
            try:
                await self._watch()
            except (httpx.HTTPError, Unavailable, DriverError) as error:
                self._log.debug("the film broke off", error=str(error) or type(error).__name__)
            backoff_s = BACKOFF_S_MIN if self._latest is not before else min(2.0 * backoff_s, BACKOFF_S_MAX)
            await self._clock.sleep(backoff_s)
        await asyncio.Event().wait()

    async def _from_film(self, after_s: float) -> Shot:
        while self._latest is None or self._latest.stamp_s < after_s:
            await self._came.wait()
        return self._latest

    async def _watch(self) -> None:
        """A picture of a film was taken after the one before it had arrived."""
        parts = Parts()
        async with self._client.stream("GET", self._url) as answer:
            _check(answer, self._url)
            before_s = self._clock.now()
            async for piece in answer.aiter_bytes():
                for jpeg in parts.feed(piece):
                    self._latest = Shot(jpeg, before_s)
                    before_s = self._clock.now()
                    self._came.fire()


def _check(answer: httpx.Response, url: str) -> None:
    if answer.status_code != 200:
        raise LinkDown(f"{url} answers {answer.status_code}")


async def _whole(answer: httpx.Response) -> bytes:
    data = bytearray()
    async for piece in answer.aiter_bytes():
        data += piece
        if len(data) > PICTURE_BYTES_MAX:
            raise DriverError(f"a picture of more than {PICTURE_BYTES_MAX} bytes")
    return bytes(data)


class Parts:
    """Cuts a multipart/x-mixed-replace stream into its pictures: by their stated length, else from JPEG mark to mark."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """The pictures that `data` completes; raises DriverError when one grows without end."""
        self._buffer += data
        pictures = []
        while (picture := self._next()) is not None:
            pictures.append(picture)
        if len(self._buffer) > PICTURE_BYTES_MAX:
            raise DriverError(f"a picture of more than {PICTURE_BYTES_MAX} bytes")
        return pictures

    def _next(self) -> bytes | None:
        head_end = self._buffer.find(b"\r\n\r\n")
        if head_end < 0:
            return None
        begin = head_end + 4
        length = _stated_length(bytes(self._buffer[:head_end]))
        if length is None:
            end = self._buffer.find(b"\xff\xd9\r\n--", begin)
            end = -1 if end < 0 else end + 2
        else:
            end = begin + length if len(self._buffer) >= begin + length else -1
        if end < 0:
            return None
        picture = bytes(self._buffer[begin:end])
        del self._buffer[:end]
        return picture


def _stated_length(head: bytes) -> int | None:
    for line in head.splitlines():
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length" and value.strip().isdigit():
            return min(int(value), PICTURE_BYTES_MAX)
    return None


class V4l2Source(Source):
    """A camera of this machine. OpenCV keeps a picture or two back, which are read and thrown away."""

    STALE = 2

    def __init__(self, device: str, clock: Clock, capture: Callable[[str], Any] | None = None) -> None:
        self._device, self._clock = device, clock
        self._open = capture or _capture
        self._camera: Any = None

    async def shoot(self, after_s: float) -> Shot:
        while True:
            asked_s = self._clock.now()
            image = await self._clock.offload(self._read, READ_COST_S)
            if asked_s >= after_s:
                return Shot(image, asked_s)

    def _read(self) -> Image:
        if self._camera is None:
            self._camera = self._open(self._device)
        for _ in range(self.STALE):
            self._camera.grab()
        ok, image = self._camera.read()
        if not ok:
            self._camera.release()
            self._camera = None
            raise LinkDown(f"{self._device} gives no picture")
        return np.asarray(image, np.uint8)


def _capture(device: str) -> Any:
    import cv2

    camera = cv2.VideoCapture(device, cv2.CAP_V4L2)
    if not camera.isOpened():
        raise LinkDown(f"cannot open {device}: no such camera, or another program holds it")
    return camera


class FileSource(Source):
    """A recording: the files of a pattern, in order, again and again."""

    may_stand_still = True

    def __init__(self, pattern: str, clock: Clock) -> None:
        self._pattern, self._clock = pattern, clock
        self._at = 0

    async def shoot(self, after_s: float) -> Shot:
        data = await self._clock.offload(self._read, READ_COST_S)
        return Shot(data, max(after_s, self._clock.now()))

    def _read(self) -> bytes:
        if not (names := sorted(glob.glob(self._pattern))):
            raise LinkDown(f"no file is called {self._pattern}")
        name = names[self._at % len(names)]
        self._at += 1
        with open(name, "rb") as file:
            return file.read(PICTURE_BYTES_MAX)


def open_camera(url: str, clock: Clock, transport: httpx.AsyncBaseTransport | None = None) -> Camera:
    """A camera by its URL; `transport` carries HTTP, else the network does. ConfigError: no URL for a camera."""
    scheme, _, rest = url.partition(":")
    source: Source
    if scheme in ("http", "https"):
        source = HttpSource(url, clock, transport)
    elif scheme == "v4l2" and rest:
        source = V4l2Source(rest, clock)
    elif scheme == "file" and rest:
        source = FileSource(rest.removeprefix("//"), clock)
    else:
        raise ConfigError(f"no camera at {url!r}", hint="use http://HOST/PATH, v4l2:/dev/video0 or file:/folder/*.jpg")
    return Camera(source, url, clock)
