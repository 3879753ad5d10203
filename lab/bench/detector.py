"""`garden bench detector`: the detectors' time for a frame of 640x480, one thread, beside bare OpenCV calls, interleaved.

The filter detector's floor is what any detector by colour and shape pays in OpenCV (an HSV mask with its components, and
Hough circles on it); the feature detector's is 40 patches at 15 scales by `cv2.matchTemplate`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from core.errors import ConfigError
from core.perception.detection import Image
from core.perception.registry import DETECTORS, detector

FRAME_MS = {"filter": 10.0, "features": 500.0}
PATCHES, SCALES, SCALE_STEP = 40, 15, 0.85
PATCH_PX = 13
SEED = 7


def bench_detector(n: int = 5) -> list[dict[str, Any]]:
    """Rows `{name, ours, peer, ratio, unit, n}` (ratio = peer / ours): medians of `n` rounds; `target` is on ours."""
    frame = picture(np.random.default_rng(SEED))
    peers: dict[str, Callable[[], object]] = {
        "filter": lambda: mask_and_circles(frame),
        "features": lambda: templates(frame),
        "best": lambda: mask_and_circles(frame),
    }
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return [_row(name, frame, peers[name], n) for name in DETECTORS]
    finally:
        cv2.setNumThreads(threads)


def _row(name: str, frame: Image, peer: Callable[[], object], n: int) -> dict[str, Any]:
    row: dict[str, Any] = {"name": f"detector/{name}", "ours": None, "peer": None, "ratio": None, "unit": "ms", "n": n}
    try:
        detect = detector(name)
    except ConfigError as error:
        return row | {"missing": str(error), "ok": False}
    ours_ms, peer_ms = _interleaved(lambda: detect(frame), peer, n)
    row |= {"ours": ours_ms, "peer": peer_ms, "ratio": peer_ms / ours_ms}
    if name in FRAME_MS:
        row |= {"target": f"ours <= {FRAME_MS[name]:g}", "ok": ours_ms <= FRAME_MS[name]}
    return row


def _interleaved(ours: Callable[[], object], peer: Callable[[], object], n: int) -> tuple[float, float]:
    taken: tuple[list[float], list[float]] = ([], [])
    ours()
    for _ in range(n):
        for times, run in zip(taken, (ours, peer), strict=True):
            began = time.perf_counter()
            run()
            times.append((time.perf_counter() - began) * 1000)
    return float(np.median(taken[0])), float(np.median(taken[1]))


def picture(rng: np.random.Generator) -> Image:
    """A crowded frame (480, 640, 3): leaves of all greens, forty fruit, highlights, noise."""
    image = np.full((480, 640, 3), (60, 90, 70), np.uint8)
    for _ in range(250):
        centre, axes = _point(rng), (int(rng.integers(8, 60)), int(rng.integers(4, 25)))
        shade = (int(rng.integers(20, 70)), int(rng.integers(60, 150)), int(rng.integers(30, 90)))
        cv2.ellipse(image, centre, axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
    for _ in range(40):
        (u, v), radius = _point(rng), int(rng.integers(7, 45))
        skin = (30, 40, 200) if rng.random() < 0.6 else (70, 170, 140)
        cv2.circle(image, (u, v), radius, skin, -1, cv2.LINE_AA)
        cv2.circle(image, (u - radius // 3, v - radius // 3), max(radius // 7, 1), (240, 240, 240), -1, cv2.LINE_AA)
    noisy = cv2.GaussianBlur(image, (3, 3), 0).astype(float) + rng.normal(0, 5, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def _point(rng: np.random.Generator) -> tuple[int, int]:
    return int(rng.integers(0, 640)), int(rng.integers(0, 480))


def mask_and_circles(image: Image) -> int:
    """What any detector by colour and shape pays: HSV, two masks, components, Hough circles on the mask."""
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    orange, crimson = cv2.inRange(hsv, (0, 90, 50), (12, 255, 255)), cv2.inRange(hsv, (168, 90, 50), (180, 255, 255))
    red = cv2.bitwise_or(orange, crimson)
    count = cv2.connectedComponentsWithStats(red)[0]
    circles = cv2.HoughCircles(red, cv2.HOUGH_GRADIENT, 1.5, 12, param1=100, param2=18, minRadius=6, maxRadius=60)
    return int(count) + (0 if circles is None else circles.shape[1])


def templates(image: Image) -> float:
    """What the paper's features cost when each patch is sought at each scale."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    patch, best = grey[:PATCH_PX, :PATCH_PX].copy(), 0.0
    for scale in range(SCALES):
        factor = SCALE_STEP**scale
        small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        for _ in range(PATCHES):
            best = max(best, float(cv2.matchTemplate(small, patch, cv2.TM_CCOEFF_NORMED).max()))
    return best
