"""Labelled images made into many: other distances, lights, cameras and neighbours than those they were taken with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.perception.best import LONG_SIDE_PX
from core.perception.detection import COLOURS, Box, Image

Array = NDArray[Any]

SIDE_PX = 192
"""Of the squares that are learnt from."""
FRUIT_PX = (9.0, 150.0)
"""Widths that fruit are brought to."""
SHOWN_MIN = 0.3
"""A fruit of which less than this is left inside the square is not counted either way."""
LEVELS_PX = (1024, 512, 256)
GAMMA = 2.2
LINEAR = ((np.arange(256) / 255) ** GAMMA).astype(np.float32)
"""Light by pixel value."""


@dataclass(frozen=True, slots=True)
class Scene:
    """An image at falling sizes (shrinking it then does not alias), its fruit, and how far its colours are to be believed.

    `boxes` (N, 4) centre u, v, width, height, in parts of the image's longer side; `colours` (N,); `trust` (N,) in 0..1;
    `counted` (N,): False for those that may be found or not.
    """

    levels: tuple[Image, ...]
    boxes: Array
    colours: Array
    trust: Array
    counted: Array


@dataclass(frozen=True, slots=True)
class Sample:
    """A square image, and its fruit as in `Scene`, in pixels."""

    image: Image
    boxes: Array
    colours: Array
    trust: Array
    counted: Array


def scene(image: Image, boxes: Sequence[Box], trust: float, trust_ambiguous: float) -> Scene:
    longer = max(image.shape[:2])
    levels = [image]
    for side in LEVELS_PX:
        if side < longer:
            size = round(image.shape[1] * side / longer), round(image.shape[0] * side / longer)
            levels.append(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8))
    return Scene(
        levels=tuple(levels if longer <= LEVELS_PX[0] else levels[1:]),
        boxes=np.array(
            [[b.x_px + b.width_px / 2, b.y_px + b.height_px / 2, b.width_px, b.height_px] for b in boxes], np.float64
        ).reshape(-1, 4)
        / longer,
        colours=np.array([COLOURS.index(b.label) for b in boxes], np.int64),
        trust=np.array([trust_ambiguous if b.ambiguous else trust for b in boxes], np.float32),
        counted=np.array([not b.difficult for b in boxes], bool),
    )


def sample(scenes: Sequence[Scene], weights: Array, rng: np.random.Generator) -> Sample:
    """A square to learn from: a scene drawn by weight, cut, with fruit and leaves pasted in, under another light."""
    base = cut(scenes[rng.choice(len(scenes), p=weights)], rng)
    for _ in range(int(rng.integers(1, 5)) if rng.random() < 0.35 else 0):
        other = scenes[rng.choice(len(scenes), p=weights)]
        base = with_fruit_of(other, base, rng)
    if rng.random() < 0.25:
        base = with_cover(base, rng)
    return replace(base, image=relit(base.image, rng))


# --- where from and how near


def cut(source: Scene, rng: np.random.Generator) -> Sample:
    """A square of a scene, scaled, turned and mirrored."""
    scale = drawn_scale(source, rng)
    longer = scale * LONG_SIDE_PX
    level = min(
        (x for x in source.levels if max(x.shape[:2]) >= longer), key=lambda x: max(x.shape), default=source.levels[0]
    )
    zoom = longer / max(level.shape[:2])
    turn = np.deg2rad(rng.normal(0, 8))
    mirror = -1.0 if rng.random() < 0.5 else 1.0
    R = zoom * np.array([[np.cos(turn) * mirror, -np.sin(turn)], [np.sin(turn) * mirror, np.cos(turn)]])
    focus = drawn_focus(source, level, SIDE_PX / zoom, rng)
    T = np.hstack([R, (np.array([SIDE_PX / 2, SIDE_PX / 2]) - R @ focus)[:, None]])
    fill = rng.integers(0, 256, 3).tolist()
    image = cv2.warpAffine(level, T, (SIDE_PX, SIDE_PX), flags=cv2.INTER_LINEAR, borderValue=fill)
    boxes = source.boxes * max(level.shape[:2])
    centres = boxes[:, :2] @ R.T + T[:, 2]
    return clipped(
        Sample(
            np.asarray(image, np.uint8),
            np.hstack([centres, boxes[:, 2:] * zoom]),
            source.colours,
            source.trust,
            source.counted,
        )
    )


def drawn_scale(source: Scene, rng: np.random.Generator) -> float:
    """Half the time near the size the detector works at, else whatever brings one of the fruit to a drawn width."""
    if len(source.boxes) == 0 or rng.random() < 0.5:
        return float(np.exp(rng.normal(0, 0.35)))
    wanted_px = np.exp(rng.uniform(*np.log(FRUIT_PX)))
    return float(np.clip(wanted_px / (source.boxes[drawn_fruit(source, rng), 2] * LONG_SIDE_PX), 0.3, 2.5))


def drawn_fruit(source: Scene, rng: np.random.Generator) -> int:
    """One of the fruit: a colour first, so that the rarer ones are seen as often."""
    wanted = rng.choice(np.unique(source.colours))
    return int(rng.choice(np.nonzero(source.colours == wanted)[0]))


def drawn_focus(source: Scene, level: Image, window_px: float, rng: np.random.Generator) -> Array:
    """The point of the image that comes to the square's middle: three times in five near a fruit."""
    shape = np.array([level.shape[1], level.shape[0]], np.float64)
    if len(source.boxes) and rng.random() < 0.6:
        focus = source.boxes[drawn_fruit(source, rng), :2] * shape.max()
        focus = focus + rng.uniform(-0.5, 0.5, 2) * window_px
    else:
        focus = rng.uniform(0, shape)
    low, high = np.minimum(window_px / 2, shape / 2), np.maximum(shape - window_px / 2, shape / 2)
    return np.asarray(np.clip(focus, low, high))


def clipped(whole: Sample) -> Sample:
    """Boxes cut at the square's edge, as labels are at an image's edge; those nearly outside are not counted."""
    low = np.clip(whole.boxes[:, :2] - whole.boxes[:, 2:] / 2, 0, SIDE_PX)
    high = np.clip(whole.boxes[:, :2] + whole.boxes[:, 2:] / 2, 0, SIDE_PX)
    sizes = high - low
    shown = sizes.prod(1) / np.maximum(whole.boxes[:, 2:].prod(1), 1e-9)
    seen = (sizes > 1).all(1)
    counted = whole.counted & (shown >= SHOWN_MIN) & (sizes >= 5).all(1)
    return Sample(
        whole.image, np.hstack([(low + high) / 2, sizes])[seen], whole.colours[seen], whole.trust[seen], counted[seen]
    )


# --- what with


def with_fruit_of(other: Scene, base: Sample, rng: np.random.Generator) -> Sample:
    """A fruit of another scene pasted in, as an ellipse with a soft edge; what it hides is no longer counted."""
    good = np.nonzero(other.counted & (other.boxes[:, 2:].min(1) > 0.06) & (other.trust > 0.5))[0]
    if len(good) == 0:
        return base
    k = int(rng.choice(good[other.colours[good] == rng.choice(np.unique(other.colours[good]))]))
    level = other.levels[0]
    u, v, w, h = other.boxes[k] * max(level.shape[:2])
    patch = level[max(int(v - h / 2), 0) : int(v + h / 2), max(int(u - w / 2), 0) : int(u + w / 2)]
    width = np.exp(rng.uniform(np.log(14), np.log(110)))
    zoom = width / patch.shape[1]
    size = max(round(width), 4), max(round(patch.shape[0] * zoom), 4)
    patch = np.asarray(cv2.resize(patch, size, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_LINEAR), np.uint8)
    patch = np.asarray(patch[:, ::-1] if rng.random() < 0.5 else patch, np.uint8)
    mask = ellipse_mask(patch.shape[:2], 0.94)
    corner = rng.integers(-size[0] // 4, SIDE_PX - size[0] // 2), rng.integers(-size[1] // 4, SIDE_PX - size[1] // 2)
    image, box = pasted(base.image, patch, mask, (int(corner[0]), int(corner[1])))
    covered = hidden_share(base.boxes, box)
    return clipped(
        Sample(
            image,
            np.vstack([base.boxes[covered < 0.85], box]),
            np.append(base.colours[covered < 0.85], other.colours[k]),
            np.append(base.trust[covered < 0.85], other.trust[k]),
            np.append((base.counted & (covered < 0.6))[covered < 0.85], True),
        )
    )


def with_cover(base: Sample, rng: np.random.Generator) -> Sample:
    """A piece of the same picture without fruit laid over another place, as a leaf would."""
    size = rng.integers(20, 90, 2)
    corner = rng.integers(0, SIDE_PX - size)
    box = np.array([*(corner + size / 2), *size], np.float64)
    if hidden_share(base.boxes, box).max(initial=0) > 0.02:
        return base
    patch = base.image[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]]
    place = rng.integers(-10, SIDE_PX - 20, 2)
    image, over = pasted(base.image, patch.copy(), ellipse_mask(patch.shape[:2], 0.97), (int(place[0]), int(place[1])))
    covered = hidden_share(base.boxes, over)
    kept = covered < 0.9
    return Sample(image, base.boxes[kept], base.colours[kept], base.trust[kept], (base.counted & (covered < 0.55))[kept])


def ellipse_mask(shape: tuple[int, ...], part: float) -> Array:
    """(H, W) 1 inside the ellipse that fills this part of the patch, 0 outside, soft between."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    r = np.hypot((x + 0.5) / shape[1] * 2 - 1, (y + 0.5) / shape[0] * 2 - 1)
    return np.asarray(np.clip((part - r) * min(shape) / 4 + 0.5, 0, 1))


def pasted(image: Image, patch: Image, mask: Array, corner: tuple[int, int]) -> tuple[Image, Array]:
    """The image with the patch blended in at a corner (that may lie outside), and the patch's box."""
    h, w = patch.shape[:2]
    x, y = corner
    left, top, right, bottom = max(x, 0), max(y, 0), min(x + w, image.shape[1]), min(y + h, image.shape[0])
    out = image.copy()
    if right > left and bottom > top:
        a = mask[top - y : bottom - y, left - x : right - x, None]
        new = patch[top - y : bottom - y, left - x : right - x]
        out[top:bottom, left:right] = (out[top:bottom, left:right] * (1 - a) + new * a).astype(np.uint8)
    return out, np.array([x + w / 2, y + h / 2, w, h], np.float64)


def hidden_share(boxes: Array, over: Array) -> Array:
    """The share of each box (N, 4) that an ellipse filling `over` (4,) may hide."""
    low = np.maximum(boxes[:, :2] - boxes[:, 2:] / 2, over[:2] - over[2:] * 0.45)
    high = np.minimum(boxes[:, :2] + boxes[:, 2:] / 2, over[:2] + over[2:] * 0.45)
    return np.asarray(np.maximum(high - low, 0).prod(1) / np.maximum(boxes[:, 2:].prod(1), 1e-9))


# --- under what light, by what camera


def relit(image: Image, rng: np.random.Generator) -> Image:
    """Another lamp, exposure, lens, sensor and compression."""
    linear = np.asarray(cv2.LUT(image, LINEAR), np.float32) * lamp(rng)
    if rng.random() < 0.25:
        linear *= uneven(rng)[..., None]
    level = float(np.quantile(linear[::4, ::4].max(2), 0.95)) + 1e-3
    aim = np.exp(rng.normal(np.log(0.6), 0.5)) if rng.random() < 0.7 else level
    linear *= np.float32(np.clip(aim / level, 0.05, 8))
    out = np.asarray(cv2.pow(np.clip(linear, 0, 1), 1 / GAMMA * float(np.exp(rng.normal(0, 0.15)))), np.float32)
    out = saturated(out, float(np.exp(rng.normal(0, 0.25))))
    if rng.random() < 0.35:
        out = blurred(out, rng)
    if rng.random() < 0.5:
        out = out + rng.standard_normal(out.shape, np.float32) * np.float32(rng.uniform(0.004, 0.06))
    finished = (np.clip(out, 0, 1) * 255 + 0.5).astype(np.uint8)
    if rng.random() < 0.35:
        _, encoded = cv2.imencode(".jpg", finished, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 90))])
        finished = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8)
    return finished


def lamp(rng: np.random.Generator) -> Array:
    """Linear gains of blue, green, red: daylight, a warm or a cold lamp, sometimes a purple grow lamp that lacks green."""
    gains = np.exp(rng.normal(0, 0.15, 3))
    if rng.random() < 0.5:
        warmth = rng.normal(0, 0.35)
        gains *= np.exp([-warmth, 0, warmth])
    if rng.random() < 0.18:
        gains *= [rng.uniform(0.9, 1.8), rng.uniform(0.25, 0.8), rng.uniform(0.9, 1.5)]
    return np.asarray(gains, np.float32)


def uneven(rng: np.random.Generator) -> Array:
    """Light that falls off across the square (SIDE, SIDE), or a shadow's edge."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX].astype(np.float32) / SIDE_PX - 0.5
    angle = rng.uniform(0, 2 * np.pi)
    along = np.cos(angle) * x + np.sin(angle) * y - rng.uniform(-0.3, 0.3)
    sharpness = np.exp(rng.uniform(np.log(2), np.log(60)))
    dark = rng.uniform(0.15, 0.8)
    return np.asarray(dark + (1 - dark) / (1 + np.exp(-np.clip(sharpness * along, -30, 30))), np.float32)


def saturated(image: Array, factor: float) -> Array:
    """Colours (H, W, 3) drawn from grey by a factor."""
    mix = factor * np.eye(3) + (1 - factor) / 3
    return np.clip(np.asarray(cv2.transform(image, mix), np.float32), 0, 1)


def blurred(image: Array, rng: np.random.Generator) -> Array:
    if rng.random() < 0.7:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 2.2)))
    length = int(rng.integers(3, 10))
    kernel = np.zeros((length, length), np.float32)
    angle = rng.uniform(0, np.pi)
    middle = (length - 1) / 2
    for t in np.linspace(-middle, middle, 4 * length):
        kernel[round(middle + t * np.sin(angle)), round(middle + t * np.cos(angle))] = 1
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()))
