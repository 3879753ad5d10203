"""The robot's eye: fresh pictures from the camera in its hand, and the fruit that a detector finds in them.

Detection runs off the loop: while it works the brain answers bids.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from core.clock import Clock
from core.errors import GardenError
from core.geometry.pinhole import NO_DISTORTION, Camera, undistort
from core.perception.detection import Detection, Detector, Image
from core.perception.registry import keen_detectors
from core.wire.fruit import Accuracy
from robot_service.failed import SkillFailed

DETECT_COST_S, FINE_COST_S = 0.06, 0.22
JPEG_COST_S = 0.01
JPEG_QUALITY = 80
SHOW_EVERY_S = 0.5
"""People are shown a new picture this often [garden s]."""
FRESH_S = 8.0
"""A camera that gives no new picture within this time [s of the wall] is silent; the driver itself waits less."""


ACCURACY = {"best": Accuracy(recall=0.92, precision=0.94), "features": Accuracy(recall=0.70, precision=0.56)}
"""Of a detector by its name, any fruit in frames of gardens it had not seen (docs/detectors.md); of others the paper's."""


class Frame(Protocol):
    """One picture of the driver."""

    @property
    def image(self) -> Image: ...

    @property
    def stamp_s(self) -> float: ...


class Pictures(Protocol):
    """What the eye needs of a camera driver."""

    async def fresh(self, after_s: float) -> Frame:
        """The first picture taken after `after_s` [garden s]; raises GardenError when none comes or it is of no use."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """One picture and what was found in it; circles in pixels of a lens without distortion."""

    image: Image
    detections: tuple[Detection, ...]
    stamp_s: float
    sure_min: float = 0.0
    """Confidence from which on a circle stands for itself; fainter ones count where a fruit is expected, or seen again."""

    @property
    def sure(self) -> tuple[Detection, ...]:
        """The circles that stand for themselves."""
        return tuple(circle for circle in self.detections if circle.confidence >= self.sure_min)


class Eye:
    """`lens` describes the camera as calibrated. The detector and its libraries are loaded at the first look."""

    def __init__(
        self, pictures: Pictures | None, detector_name: str, lens: Camera, clock: Clock, accuracy: Accuracy | None = None
    ) -> None:
        self._pictures, self._name, self._clock, self._lens = pictures, detector_name, clock, lens
        self._detectors: tuple[Detector, Detector, float] | None = None
        self.camera = replace(lens, distortion=NO_DISTORTION)
        """What the circles of a `Look` obey."""
        self.accuracy = accuracy or ACCURACY.get(detector_name, Accuracy())
        self.last: Look | None = None
        self._shown: tuple[float, bytes] | None = None
        self._showing = asyncio.Lock()

    @property
    def fitted(self) -> bool:
        """Whether there is a camera at all."""
        return self._pictures is not None

    async def look(self, *, fine: bool = False) -> Look:
        """A picture taken from now on, with its fruit; `fine` takes longer and finds smaller ones.

        Raises SkillFailed when the camera gives none that can be used.
        """
        if self._pictures is None:
            raise SkillFailed("this robot has no camera")
        try:
            async with asyncio.timeout(FRESH_S):
                frame = await self._pictures.fresh(self._clock.now())
        except TimeoutError:
            raise SkillFailed(f"the camera gave no picture for {FRESH_S:g} s") from None
        except GardenError as error:
            raise SkillFailed(f"the camera cannot be used: {error}") from error
        image = frame.image
        found, sure_min = await self._clock.offload(
            lambda: self._detect(image, fine=fine), FINE_COST_S if fine else DETECT_COST_S
        )
        circles = tuple(map(self._straight, found))
        self.last = Look(image=image, detections=circles, stamp_s=frame.stamp_s, sure_min=sure_min)
        return self.last

    async def show(self) -> bytes:
        """What the eye sees, fruit ringed, as JPEG; people who ask at about the same time get the same picture."""
        async with self._showing:
            if self._shown is None or self._clock.now() - self._shown[0] > SHOW_EVERY_S:
                recent = self.last is not None and self._clock.now() - self.last.stamp_s < SHOW_EVERY_S
                look = self.last if recent and self.last is not None else await self.look()
                self._shown = self._clock.now(), await self._clock.offload(lambda: drawn_jpeg(look), JPEG_COST_S)
            return self._shown[1]

    def _detect(self, image: Image, *, fine: bool) -> tuple[list[Detection], float]:
        if self._detectors is None:
            self._detectors = keen_detectors(self._name)
        quick, finer, sure_min = self._detectors
        return (finer if fine else quick)(image), sure_min

    def _straight(self, circle: Detection) -> Detection:
        """The circle where a lens without distortion would have put it."""
        lens = self._lens
        if lens.distortion == NO_DISTORTION:
            return circle
        bent = np.array([(circle.u_px - lens.cx) / lens.fx, (circle.v_px - lens.cy) / lens.fy])
        x, y = undistort(lens.distortion, bent)
        return replace(circle, u_px=float(lens.cx + lens.fx * x), v_px=float(lens.cy + lens.fy * y))


_BGR = {"green": (60, 200, 60), "turning": (30, 150, 240), "red": (40, 40, 230)}


def drawn_jpeg(look: Look) -> bytes:
    """The picture with a ring round every fruit that was found, as JPEG; slow: offload it."""
    import cv2

    picture = look.image.copy()
    for circle in look.sure:
        centre = (round(circle.u_px), round(circle.v_px))
        cv2.circle(picture, centre, max(2, round(circle.radius_px)), _BGR[circle.colour], 2, cv2.LINE_AA)
        text = f"{circle.colour} {circle.confidence:.2f}"
        cv2.putText(picture, text, (centre[0] + 4, centre[1]), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _BGR[circle.colour], 1)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()
