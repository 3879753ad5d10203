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

RADIUS_STEPS = 9
"""Radii that are tried for an outline."""
ZONES = (0.5, 0.9, 1.15, 1.5, 2.2)
"""Outer radii of middle, rim, outline (not looked at), ring and what lies further, in radii."""
STRIDE_FROM_PX = 9.0
"""Zones that reach further are sampled at every second pixel both ways."""


@njit(cache=True, fastmath=True)
def planes(image: Bytes, bins: Ints, luma: Floats, table: Floats, shares: Floats, out: Floats) -> None:
    """Colour planes of an image in one pass.

    `bins` (3, 256) and `luma` (3, 256) hold each channel's balanced value as a bin of 0..31 and as its share of brightness;
    `table` (32768, 2) how likely a colour is red and green fruit; `shares` (32, 32) the least of a colour's bins over its
    largest. `out` (4, h, w): red, green, brightness, whiteness.
    """
    height, width = image.shape[:2]
    for y in range(height):
        for x in range(width):
            b, g, r = image[y, x, 0], image[y, x, 1], image[y, x, 2]
            kb, kg, kr = bins[0, b], bins[1, g], bins[2, r]
            index = (kb << 10) | (kg << 5) | kr
            out[0, y, x] = table[index, 0]
            out[1, y, x] = table[index, 1]
            out[2, y, x] = luma[0, b] + luma[1, g] + luma[2, r]
            out[3, y, x] = shares[min(kb, kg, kr), max(kb, kg, kr)]


@njit(cache=True, fastmath=True)
def blobs(plane: Floats, smooth: Floats, least: float, out: Bytes) -> None:
    """1 where a colour on smooth ground, both (h, w), averaged two by two, is above `least`, else 0; `out` (h/2, w/2)."""
    quarter, least32, some, more = np.float32(0.25), np.float32(least), np.float32(0.4), np.float32(0.6)
    for y in range(out.shape[0]):
        a, b, c, d = plane[2 * y], plane[2 * y + 1], smooth[2 * y], smooth[2 * y + 1]
        for x in range(out.shape[1]):
            i, j = 2 * x, 2 * x + 1
            top = a[i] * (some + more * c[i]) + a[j] * (some + more * c[j])
            bottom = b[i] * (some + more * d[i]) + b[j] * (some + more * d[j])
            out[y, x] = (top + bottom) * quarter > least32


@njit(cache=True)
def rise(brightness: Floats, around: Floats, whiteness: Floats, least: float, out: Floats) -> None:
    """How far a pixel is brighter than around, from `least` on, times its whiteness; all (h, w), `out` 0..1."""
    four, start, zero, one = np.float32(4), np.float32(4 * least), np.float32(0), np.float32(1)
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            step = (brightness[y, x] - around[y, x]) * four - start
            out[y, x] = min(max(step, zero), one) * whiteness[y, x]


@njit(cache=True, fastmath=True)
def bright_colour(colour: Floats, brightness: Floats, source: Floats) -> None:
    """A colour plane (h, w) weighted by brightness: a ball's middle is brighter than its rim."""
    for y in range(colour.shape[0]):
        for x in range(colour.shape[1]):
            source[y, x] = colour[y, x] * (np.float32(0.35) + np.float32(0.65) * brightness[y, x])


@njit(cache=True, fastmath=True)
def halve(maps: Floats) -> Floats:
    """The maps (n, h, w) at half their size."""
    count, height, width = maps.shape[0], maps.shape[1] // 2, maps.shape[2] // 2
    out = np.empty((count, height, width), np.float32)
    quarter = np.float32(0.25)
    for k in range(count):
        for y in range(height):
            top, bottom = maps[k, 2 * y], maps[k, 2 * y + 1]
            for x in range(width):
                out[k, y, x] = (top[2 * x] + top[2 * x + 1] + bottom[2 * x] + bottom[2 * x + 1]) * quarter
    return out


@njit(cache=True)
def tops(votes: Floats, least: float, most: int) -> Ints:
    """Places (n, 2: x, y) of at least `least` that are the highest of their 5 x 5 neighbours; at most `most`, best first."""
    height, width = votes.shape
    found = np.empty((height * width // 4 + 1, 2), np.int32)
    heights = np.empty(len(found), np.float32)
    n = 0
    for y in range(height):
        for x in range(width):
            here = votes[y, x]
            if here < least or n == len(found):
                continue
            # The next neighbours first: most places fail there.
            if (x > 0 and votes[y, x - 1] > here) or (x + 1 < width and votes[y, x + 1] > here):
                continue
            if (y > 0 and votes[y - 1, x] > here) or (y + 1 < height and votes[y + 1, x] > here):
                continue
            highest = True
            for j in range(max(y - 2, 0), min(y + 3, height)):
                for i in range(max(x - 2, 0), min(x + 3, width)):
                    if votes[j, i] > here:
                        highest = False
                        break
                if not highest:
                    break
            if highest:
                found[n, 0], found[n, 1], heights[n] = x, y, here
                n += 1
    order = np.argsort(-heights[:n])[:most]
    return found[:n][order]


@njit(cache=True, fastmath=True)
def vote(image: Floats, steep: float, radius_min: int, radius_max: int, out: Floats) -> None:
    """Hough transform for bright discs: every steep pixel votes uphill for the centres of circles it may lie on.

    `image`, `out` (h, w); a vote weighs 1 over the circle's length, so a whole circle gathers about 1.
    """
    height, width = image.shape
    out[:] = 0
    weights = np.empty(radius_max + 1, np.float32)
    for radius in range(radius_min, radius_max + 1):
        weights[radius] = 1.0 / (2.0 * math.pi * radius)
    least, half, one = np.float32(steep * steep), np.float32(0.5), np.float32(1)
    for y in range(1, height - 1):
        above, row, below = image[y - 1], image[y], image[y + 1]
        for x in range(1, width - 1):
            gx = row[x + 1] - row[x - 1]
            gy = below[x] - above[x]
            square = gx * gx + gy * gy
            if square < least:
                continue
            size = one / np.sqrt(square)
            gx *= size
            gy *= size
            at_x, at_y = np.float32(x) + half, np.float32(y) + half
            for radius in range(radius_min, radius_max + 1):
                u = np.int32(at_x + gx * np.float32(radius))
                v = np.int32(at_y + gy * np.float32(radius))
                if 0 <= u < width and 0 <= v < height:
                    out[v, u] += weights[radius]


@njit(cache=True, fastmath=True)
def outline(
    image: Floats, u: float, v: float, radius_min: float, radius_max: float, spokes: Floats
) -> tuple[float, float, float]:
    """Radius of the bright disc round (u, v), how much of its edge is seen (0..1), and how steep that is on average.

    `spokes` (n, 2) are the directions in which the edge is looked for.
    """
    height, width = image.shape
    best_radius, best_step, best_seen = radius_min, -1.0, 0.0
    for k in range(RADIUS_STEPS):
        radius = radius_min * (radius_max / radius_min) ** (k / (RADIUS_STEPS - 1))
        width_px = max(1.0, 0.18 * radius)
        total, seen, asked = 0.0, 0, 0
        for i in range(spokes.shape[0]):
            x0, y0 = int(u + (radius - width_px) * spokes[i, 0] + 0.5), int(v + (radius - width_px) * spokes[i, 1] + 0.5)
            x1, y1 = int(u + (radius + width_px) * spokes[i, 0] + 0.5), int(v + (radius + width_px) * spokes[i, 1] + 0.5)
            if min(x0, x1, y0, y1) < 0 or max(x0, x1) >= width or max(y0, y1) >= height:
                continue
            asked += 1
            step = image[y0, x0] - image[y1, x1]
            total += min(max(step, -0.3), 0.5)
            if step > 0.08:
                seen += 1
        if asked < spokes.shape[0] // 3:
            continue
        mean = total / asked
        if mean > best_step:
            best_radius, best_step, best_seen = radius, mean, seen / asked
    return best_radius, best_seen, best_step


@njit(cache=True, fastmath=True)
def zones(maps: Floats, u: float, v: float, edges: Floats, out: Floats) -> None:
    """Means of the maps (n, h, w) over zones round (u, v); `out` (m, n), 0 where a zone has no pixel.

    `edges` (m,) are the zones' outer radii [px], growing; the first zone is a disc.
    """
    count, height, width = maps.shape
    zones_n = edges.shape[0]
    out[:] = 0
    pixels = np.zeros(zones_n, np.int32)
    outer = edges[-1]
    stride = 1 if outer < STRIDE_FROM_PX else 2
    for y in range(max(int(v - outer), 0), min(int(v + outer) + 2, height), stride):
        for x in range(max(int(u - outer), 0), min(int(u + outer) + 2, width), stride):
            d = (x - u) * (x - u) + (y - v) * (y - v)
            for z in range(zones_n):
                if d <= edges[z] * edges[z]:
                    pixels[z] += 1
                    for k in range(count):
                        out[z, k] += maps[k, y, x]
                    break
    for z in range(zones_n):
        if pixels[z] > 0:
            for k in range(count):
                out[z, k] /= pixels[z]


@njit(cache=True, fastmath=True)
def describe(
    maps: Floats,
    source: Floats,
    votes: Floats,
    points: Ints,
    family: int,
    radii: tuple[float, float],
    spokes: Floats,
    out: Floats,
) -> None:
    """What the filters say of each point (n, 2: x, y) of one pyramid level, its circle's radius sought between `radii` [px].

    `maps` (8, h, w) are `core.perception.filters.MAPS`; `out` (n, FEATURES): `FEATURES`, but the radius [px] itself last.
    """
    within = np.zeros((5, maps.shape[0]), np.float32)
    edges = np.zeros(5, np.float32)
    for i in range(points.shape[0]):
        u, v = float(points[i, 0]), float(points[i, 1])
        radius, seen, step = outline(source, u, v, radii[0], radii[1], spokes)
        for z in range(5):
            edges[z] = radius * ZONES[z]
        zones(maps, u, v, edges, within)
        middle, rim, ring, further = within[0], within[1], within[3], within[4]
        out[i, 0] = rim[family]
        out[i, 1] = middle[family]
        out[i, 2] = ring[family]
        out[i, 3] = further[family]
        out[i, 4] = (middle[1 - family] + rim[1 - family]) / 2
        out[i, 5] = (middle[4] + rim[4]) / 2
        out[i, 6] = ring[4]
        out[i, 7] = (middle[6 + family] + rim[6 + family]) / 2
        out[i, 8] = votes[points[i, 1], points[i, 0]]
        out[i, 9] = seen
        out[i, 10] = step
        out[i, 11] = middle[5]
        out[i, 12] = (middle[2] + rim[2]) / 2
        out[i, 13] = out[i, 12] - ring[2]
        out[i, 14] = (middle[3] + rim[3]) / 2
        out[i, 15] = radius


@njit(cache=True, fastmath=True)
def tints(image: Bytes, red: Floats, circles: Floats, share: float) -> Floats:
    """Mean blue, green and red (n, 3), 0..255, of the squares in circles (n, 3: u, v, radius [px]), `share` of a radius to
    each side, a pixel at least; pixels weigh by how likely red fruit they are."""
    height, width = red.shape
    out = np.zeros((len(circles), 3), np.float32)
    for i in range(len(circles)):
        u, v, half = circles[i, 0], circles[i, 1], max(circles[i, 2] * share, 1.0)
        whole = np.float32(1e-6)
        y0, x0 = min(max(int(v - half), 0), height - 1), min(max(int(u - half), 0), width - 1)
        for y in range(y0, max(min(int(v + half) + 1, height), y0 + 1)):
            for x in range(x0, max(min(int(u + half) + 1, width), x0 + 1)):
                weight = red[y, x] + np.float32(1e-3)
                whole += weight
                for k in range(3):
                    out[i, k] += weight * image[y, x, k]
        for k in range(3):
            out[i, k] /= whole
    return out


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
