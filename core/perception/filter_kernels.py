"""The numba kernels of the filter detector. Compiled once and cached on disk; `filters.warm()` does it ahead of need."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]
Bytes: TypeAlias = NDArray[np.uint8]
Ints: TypeAlias = NDArray[np.int32]

SPOKES = 24
"""Directions in which an outline is looked for."""


@njit(cache=True, fastmath=True)
def planes(image: Bytes, bins: Bytes, luma: Floats, table: Floats, out: Floats) -> None:
    """Colour planes of an image in one pass.

    `bins` (3, 256) and `luma` (3, 256) hold each channel's balanced value as a bin of 0..31 and as its share of brightness;
    `table` (32768, 2) how likely a colour is red and green fruit. `out` (4, h, w): red, green, brightness, whiteness.
    """
    height, width = image.shape[:2]
    for y in range(height):
        for x in range(width):
            b, g, r = image[y, x, 0], image[y, x, 1], image[y, x, 2]
            kb, kg, kr = bins[0, b], bins[1, g], bins[2, r]
            index = (np.int32(kb) << 10) | (np.int32(kg) << 5) | np.int32(kr)
            out[0, y, x] = table[index, 0]
            out[1, y, x] = table[index, 1]
            out[2, y, x] = luma[0, b] + luma[1, g] + luma[2, r]
            most = max(kb, kg, kr)
            out[3, y, x] = np.float32(min(kb, kg, kr)) / np.float32(max(most, 1))


@njit(cache=True, fastmath=True)
def vote(image: Floats, steep: float, radius_min: int, radius_max: int, out: Floats) -> None:
    """Hough transform for bright discs: every steep pixel votes uphill for the centres of circles it may lie on.

    `image`, `out` (h, w); a vote weighs 1 over the circle's length, so a whole circle gathers about 1.
    """
    height, width = image.shape
    out[:] = 0
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            gx = image[y, x + 1] - image[y, x - 1]
            gy = image[y + 1, x] - image[y - 1, x]
            size = math.sqrt(gx * gx + gy * gy)
            if size < steep:
                continue
            gx /= size
            gy /= size
            for radius in range(radius_min, radius_max + 1):
                u = int(x + gx * radius + 0.5)
                v = int(y + gy * radius + 0.5)
                if 0 <= u < width and 0 <= v < height:
                    out[v, u] += 1.0 / (2.0 * math.pi * radius)


@njit(cache=True, fastmath=True)
def outline(image: Floats, u: float, v: float, radius_min: float, radius_max: float) -> tuple[float, float, float]:
    """Radius of the bright disc round (u, v), how much of its edge is seen (0..1), and how steep that is on average."""
    height, width = image.shape
    best_radius, best_step, best_seen = radius_min, -1.0, 0.0
    steps = 13
    for k in range(steps):
        radius = radius_min * (radius_max / radius_min) ** (k / (steps - 1))
        width_px = max(1.0, 0.18 * radius)
        total, seen, asked = 0.0, 0, 0
        for spoke in range(SPOKES):
            cos, sin = math.cos(2 * math.pi * spoke / SPOKES), math.sin(2 * math.pi * spoke / SPOKES)
            x0, y0 = int(u + (radius - width_px) * cos + 0.5), int(v + (radius - width_px) * sin + 0.5)
            x1, y1 = int(u + (radius + width_px) * cos + 0.5), int(v + (radius + width_px) * sin + 0.5)
            if min(x0, x1, y0, y1) < 0 or max(x0, x1) >= width or max(y0, y1) >= height:
                continue
            asked += 1
            step = image[y0, x0] - image[y1, x1]
            total += min(max(step, -0.3), 0.5)
            if step > 0.08:
                seen += 1
        if asked < SPOKES // 3:
            continue
        mean = total / asked
        if mean > best_step:
            best_radius, best_step, best_seen = radius, mean, seen / asked
    return best_radius, best_seen, best_step


@njit(cache=True, fastmath=True)
def disc_means(maps: Floats, u: float, v: float, inner: float, outer: float, out: Floats) -> None:
    """Means of the maps (n, h, w) over the ring between two radii round (u, v); `out` (n,), 0 where it has no pixel."""
    count, height, width = maps.shape
    out[:] = 0
    n = 0
    y0, y1 = max(int(v - outer), 0), min(int(v + outer) + 2, height)
    x0, x1 = max(int(u - outer), 0), min(int(u + outer) + 2, width)
    for y in range(y0, y1):
        for x in range(x0, x1):
            d = (x - u) * (x - u) + (y - v) * (y - v)
            if inner * inner <= d <= outer * outer:
                n += 1
                for k in range(count):
                    out[k] += maps[k, y, x]
    if n > 0:
        for k in range(count):
            out[k] /= n


@njit(cache=True, fastmath=True)
def describe(
    maps: Floats, source: Floats, votes: Floats, points: Ints, family: int, radius_min: float, radius_max: float, out: Floats
) -> None:
    """What the filters say of each point (n, 2: x, y) of one pyramid level.

    `maps` (7, h, w): red, green, brightness, whiteness, smoothness, area (of this family), highlight. `out`
    (n, FEATURES): the features of `core.perception.filters.FEATURES`, in order, but the radius [px of the level] last.
    """
    count = maps.shape[0]
    inside, middle, ring = np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
    for i in range(points.shape[0]):
        u, v = float(points[i, 0]), float(points[i, 1])
        radius, seen, step = outline(source, u, v, radius_min, radius_max)
        disc_means(maps, u, v, 0.0, 0.9 * radius, inside)
        disc_means(maps, u, v, 0.0, 0.5 * radius, middle)
        disc_means(maps, u, v, 1.15 * radius, 1.5 * radius, ring)
        out[i, 0] = inside[family]
        out[i, 1] = middle[family]
        out[i, 2] = ring[family]
        out[i, 3] = inside[1 - family]
        out[i, 4] = inside[4]
        out[i, 5] = ring[4]
        out[i, 6] = inside[5]
        out[i, 7] = votes[points[i, 1], points[i, 0]]
        out[i, 8] = seen
        out[i, 9] = step
        out[i, 10] = middle[6]
        out[i, 11] = inside[2]
        out[i, 12] = inside[2] - ring[2]
        out[i, 13] = inside[3]
        out[i, 14] = radius


@njit(cache=True)
def distinct(circles: Floats, apart: float) -> NDArray[np.bool_]:
    """Which of the circles (n, 3: u, v, radius), best first, are no second view of a better one."""
    kept = np.zeros(circles.shape[0], np.bool_)
    for i in range(circles.shape[0]):
        alone = True
        for j in range(i):
            if not kept[j]:
                continue
            d = math.hypot(circles[i, 0] - circles[j, 0], circles[i, 1] - circles[j, 1])
            if d < apart * max(circles[i, 2], circles[j, 2]):
                alone = False
                break
        kept[i] = alone
    return kept
