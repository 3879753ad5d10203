"""The best detector: a small convolutional network that finds fruit, their sizes and their colours in one pass.

It answers a map of fruit centres at a quarter of its input's size (objects as points: Zhou, Wang and Krähenbühl 2019),
and for each cell the fruit's width and height and its colour. It sees the image twice: as it is, and balanced to a grey mean
(Buchsbaum 1980), so that red means red beside the leaves of the same picture, under a purple lamp too.
`garden train best` writes the weights; OpenCV runs them on the CPU.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from core.perception.detection import COLOURS, Detection, Detector, Image

Array: TypeAlias = NDArray[np.float32]

WEIGHTS = "best.onnx"
INPUT_CHANNELS = 6
OUTPUT_CHANNELS = 8
"""Of each cell: fruit; centre right and down of the cell's middle [cells]; log of width, height [32 px]; three colours."""
STRIDE_PX = 4
"""Input pixels a cell."""
SIZE_UNIT_PX = 32.0
MULTIPLE_PX = 32
"""The network halves its input five times."""
LONG_SIDE_PX = 640
"""Images are brought to this size first, so that fruit of a near and of a far camera look alike."""
CONFIDENCE_MIN = 0.40
COLOUR_LOGIT = (0.3, 0.0, 0.0)
"""Added to the network's word for green, turning, red: green fruit among leaves look faint to it more often than not."""
KEEN_CONFIDENCE_MIN = 0.15
"""For pictures of one plant from several places: what several of them show at one point is a fruit, however faint."""
QUICK_LONG_SIDE_PX, FINE_LONG_SIDE_PX = 512, 960
"""For a hand that waits before the fruit; and for small fruit, where a fifth of a second does not matter."""
OVERLAP_MAX = 0.5
"""Two boxes that share more than this (intersection over union) are one fruit."""
BALANCED_MEAN = 0.4
GAIN_RANGE = (0.3, 4.0)
"""Balancing a nearly one-coloured image further than this only lifts its noise."""


def best_detector() -> Detector:
    """The detector with its packaged weights; raises FileNotFoundError without them."""
    return with_weights(_packaged())


def keen_detectors() -> tuple[Detector, Detector, float]:
    """Two that tell of fainter circles too, and the confidence from which on a circle stands for itself.

    The first is quick; the second has finer sight and takes four times as long.
    """
    onnx = _packaged()
    fine = with_weights(onnx, KEEN_CONFIDENCE_MIN, FINE_LONG_SIDE_PX)
    return with_weights(onnx, KEEN_CONFIDENCE_MIN, QUICK_LONG_SIDE_PX), fine, CONFIDENCE_MIN


def _packaged() -> bytes:
    return importlib.resources.files("core.perception").joinpath(WEIGHTS).read_bytes()


def with_weights(onnx: bytes, confidence_min: float = CONFIDENCE_MIN, long_side_px: int = LONG_SIDE_PX) -> Detector:
    """A detector that runs the given network (ONNX) on images brought to `long_side_px`.

    It keeps no state between images; one thread may use it at a time.
    """
    network = cv2.dnn.readNetFromONNX(np.frombuffer(onnx, np.uint8))
    network.setPreferableBackend(cv2.dnn.DNN_BACKEND_OPENCV)

    def run(planes: Array) -> Array:
        network.setInput(planes[None])
        return np.asarray(network.forward()[0], np.float32)

    return lambda image: detect(image, run, confidence_min, long_side_px)


def detect(
    image: Image,
    run: Callable[[Array], Array],
    confidence_min: float = CONFIDENCE_MIN,
    long_side_px: int = LONG_SIDE_PX,
) -> list[Detection]:
    """Fruit in an image (H, W, 3) BGR uint8 of any size, the surest first. `run`: planes (6, h, w) to maps (8, h/4, w/4)."""
    small, scale = brought_to_size(image, long_side_px)
    height, width = small.shape[:2]
    boxes, confidences, colours = decode(run(padded(planes(small))), confidence_min)
    inside = (boxes[:, 0] < width) & (boxes[:, 1] < height)
    kept = [k for k in distinct(boxes, confidences) if inside[k]]
    return [
        Detection(
            u_px=float(boxes[k, 0] / scale),
            v_px=float(boxes[k, 1] / scale),
            radius_px=float((boxes[k, 2] + boxes[k, 3]) / 4 / scale),
            colour=COLOURS[int(colours[k])],
            confidence=float(confidences[k]),
        )
        for k in kept
    ]


def brought_to_size(image: Image, long_side_px: int = LONG_SIDE_PX) -> tuple[Image, float]:
    """The image with its longer side at `long_side_px`, and the factor."""
    scale = long_side_px / max(image.shape[:2])
    size = max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1)
    smaller = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return np.asarray(smaller, np.uint8), scale


def planes(image: Image) -> Array:
    """The network's input (6, H, W): blue, green, red in 0..1 as they are, and balanced so that each has the same mean."""
    plain = image.astype(np.float32) / 255
    means = plain.mean((0, 1))
    gains = np.clip(BALANCED_MEAN / np.maximum(means, 1e-3), *GAIN_RANGE).astype(np.float32)
    balanced = np.minimum(plain * gains, 2.0)
    return np.ascontiguousarray(np.concatenate([plain, balanced], 2).transpose(2, 0, 1), np.float32)


def padded(planes: Array) -> Array:
    """Planes (C, H, W) with their sides made multiples of MULTIPLE_PX, zeros right and below."""
    down, right = (-planes.shape[1] % MULTIPLE_PX, -planes.shape[2] % MULTIPLE_PX)
    return np.pad(planes, ((0, 0), (0, down), (0, right)))


def decode(maps: Array, confidence_min: float = CONFIDENCE_MIN) -> tuple[Array, Array, NDArray[np.intp]]:
    """Maps (8, h, w) -> peaks: boxes (N, 4) u, v, width, height [input px], confidences (N,), colours (N,).

    The surest first. A peak is a cell that none of its eight neighbours exceeds.
    """
    fruit = maps[0] + np.asarray(COLOUR_LOGIT, np.float32)[maps[5:8].argmax(0)]
    floor = np.log(confidence_min / (1 - confidence_min))
    peaks = (fruit >= floor) & (fruit >= cv2.dilate(fruit, np.ones((3, 3), np.uint8)))
    rows, columns = np.nonzero(peaks)
    order = np.argsort(-fruit[rows, columns], kind="stable")
    rows, columns = rows[order], columns[order]
    logits = fruit[rows, columns]
    cells = maps[:, rows, columns]
    u = (columns + 0.5 + cells[1]) * STRIDE_PX
    v = (rows + 0.5 + cells[2]) * STRIDE_PX
    sizes = np.exp(np.clip(cells[3:5], -4, 4)) * SIZE_UNIT_PX
    boxes = np.stack([u, v, sizes[0], sizes[1]], 1).astype(np.float32)
    return boxes, (1 / (1 + np.exp(-logits))).astype(np.float32), cells[5:8].argmax(0)


def distinct(boxes: Array, confidences: Array, overlap_max: float = OVERLAP_MAX) -> list[int]:
    """Indices of boxes (N, 4) u, v, width, height, the surest first, without those that overlap a surer one too much."""
    kept: list[int] = []
    for k in np.argsort(-confidences, kind="stable"):
        if not kept or overlaps(boxes[k], boxes[kept]).max() <= overlap_max:
            kept.append(int(k))
    return kept


def overlaps(box: Array, others: Array) -> Array:
    """Intersection over union of a box (4,) with others (N, 4)."""
    low = np.maximum(box[:2] - box[2:] / 2, others[:, :2] - others[:, 2:] / 2)
    high = np.minimum(box[:2] + box[2:] / 2, others[:, :2] + others[:, 2:] / 2)
    shared = np.prod(np.maximum(high - low, 0), 1)
    return np.asarray(shared / (box[2] * box[3] + others[:, 2] * others[:, 3] - shared), np.float32)
