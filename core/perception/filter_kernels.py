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
MIDDLE, RIM, OUTLINE, RING, FURTHER = range(5)
BRIGHTNESS, WHITENESS, SMOOTH, HIGHLIGHT, AREA = range(2, 7)
"""Places in `core.perception.filters.MAPS`, behind the two colours; of the first colour's area."""
SOFT = (0.23899427, 0.52201147)
"""Side and middle of a Gaussian of 0.8 px over 3 pixels."""
WIDE = (0.08562916, 0.2426676, 0.34340648)
"""Outer, inner and middle weights of a Gaussian of 1.2 px over 5 pixels."""
VOTED, COLOURED = 4.0, 0.5
"""What circle votes and colour weigh."""
STRIDE_FROM_PX = 9.0
"""Zones that reach further are sampled at every second pixel both ways."""


@njit(cache=True)
def means(image: Bytes, step: int, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means (3,) of what `values` (256,) says of each channel, over every `step`th pixel of an image (h, w, 3) both ways."""
    total, count = np.zeros(3), 0
    for y in range(0, image.shape[0], step):
        for x in range(0, image.shape[1], step):
            count += 1
            for k in range(3):
                total[k] += values[image[y, x, k]]
    return total / count


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
def of_area(labels: Ints, count: int, least: float, most: float, out: Floats) -> None:
    """1 on the components of labels (h, w), 0..count - 1 (0 the background), whose share of the image is between `least` and
    `most`, else 0; `out` (h, w)."""
    sizes = np.zeros(count, np.int64)
    for label in labels.ravel():
        sizes[label] += 1
    wanted = ((sizes >= least * labels.size) & (sizes <= most * labels.size)).astype(np.float32)
    wanted[0] = 0
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = wanted[labels[y, x]]


@njit(cache=True)
def rise(brightness: Floats, around: Floats, whiteness: Floats, least: float, out: Floats) -> None:
    """How far a pixel is brighter than around, from `least` on, times its whiteness; all (h, w), `out` 0..1."""
    four, start, zero, one = np.float32(4), np.float32(4 * least), np.float32(0), np.float32(1)
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            step = (brightness[y, x] - around[y, x]) * four - start
            out[y, x] = min(max(step, zero), one) * whiteness[y, x]


@njit(cache=True, fastmath=True)
def bright_colour(colour: Floats, brightness: Floats, out: Floats) -> None:
    """A colour plane weighted by brightness, for a ball's middle is brighter than its rim, and blurred by `SOFT`; (h, w)."""
    height, width = out.shape
    side, middle = np.float32(SOFT[0]), np.float32(SOFT[1])
    dark, bright = np.float32(0.35), np.float32(0.65)
    row = np.empty(width + 2, np.float32)
    for y in range(height):
        before, after = _reflected(y - 1, height), _reflected(y + 1, height)
        c0, c1, c2 = colour[before], colour[y], colour[after]
        b0, b1, b2 = brightness[before], brightness[y], brightness[after]
        for x in range(width):
            aside = c0[x] * (dark + bright * b0[x]) + c2[x] * (dark + bright * b2[x])
            row[x + 1] = side * aside + middle * c1[x] * (dark + bright * b1[x])
        row[0], row[width + 1] = row[2], row[width - 1]
        for x in range(width):
            out[y, x] = side * (row[x] + row[x + 2]) + middle * row[x + 1]


@njit(cache=True, fastmath=True)
def agreement(votes: Floats, colour: Floats, out: Floats) -> None:
    """Votes blurred by `WIDE` and the mean colour of 5 x 5 pixels, weighed: where circles and colour agree; all (h, w)."""
    height, width = out.shape
    far, near, middle = np.float32(WIDE[0]), np.float32(WIDE[1]), np.float32(WIDE[2])
    voted, coloured = np.float32(VOTED), np.float32(COLOURED / 25)
    blurred, summed = np.empty(width + 4, np.float32), np.empty(width + 4, np.float32)
    for y in range(height):
        i0, i1, i3, i4 = (
            _reflected(y - 2, height),
            _reflected(y - 1, height),
            _reflected(y + 1, height),
            _reflected(y + 2, height),
        )
        v0, v1, v2, v3, v4 = votes[i0], votes[i1], votes[y], votes[i3], votes[i4]
        c0, c1, c2, c3, c4 = colour[i0], colour[i1], colour[y], colour[i3], colour[i4]
        for x in range(width):
            blurred[x + 2] = far * (v0[x] + v4[x]) + near * (v1[x] + v3[x]) + middle * v2[x]
            summed[x + 2] = c0[x] + c1[x] + c2[x] + c3[x] + c4[x]
        for row in (blurred, summed):
            row[0], row[1], row[width + 2], row[width + 3] = row[4], row[3], row[width], row[width - 1]
        for x in range(width):
            there = far * (blurred[x] + blurred[x + 4]) + near * (blurred[x + 1] + blurred[x + 3]) + middle * blurred[x + 2]
            total = summed[x] + summed[x + 1] + summed[x + 2] + summed[x + 3] + summed[x + 4]
            out[y, x] = voted * there + coloured * total


@njit(cache=True)
def _reflected(k: int, length: int) -> int:
    """An index beyond an end, reflected there."""
    return -k if k < 0 else 2 * length - 2 - k if k >= length else k


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
    over = np.empty(width, np.bool_)
    least32, n = np.float32(least), 0
    for y in range(height):
        _over_next(votes[max(y - 1, 0)], votes[y], votes[min(y + 1, height - 1)], least32, over)
        for x in range(width):
            if over[x] and n < len(found) and _highest(votes, x, y):
                found[n, 0], found[n, 1], heights[n] = x, y, votes[y, x]
                n += 1
    order = np.argsort(-heights[:n])[:most]
    return found[:n][order]


@njit(cache=True, fastmath=True)
def _over_next(above: Floats, row: Floats, below: Floats, least: np.float32, out: NDArray[np.bool_]) -> None:
    """Whether each of a row (w,) is at least `least` and no lower than its next neighbours: few are."""
    last = len(row) - 1
    for x in range(1, last):
        high = max(max(row[x - 1], row[x + 1]), max(max(above[x], below[x]), least))
        out[x] = row[x] >= high
    out[0] = row[0] >= max(max(row[1], least), max(above[0], below[0]))
    out[last] = row[last] >= max(max(row[last - 1], least), max(above[last], below[last]))


@njit(cache=True)
def _highest(votes: Floats, x: int, y: int) -> bool:
    """Whether no place within 2 pixels is higher."""
    height, width = votes.shape
    for j in range(max(y - 2, 0), min(y + 3, height)):
        for i in range(max(x - 2, 0), min(x + 3, width)):
            if votes[j, i] > votes[y, x]:
                return False
    return True


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
    squares = np.empty(width, np.float32)
    for y in range(1, height - 1):
        above, row, below = image[y - 1], image[y], image[y + 1]
        for x in range(1, width - 1):
            gx, gy = row[x + 1] - row[x - 1], below[x] - above[x]
            squares[x] = gx * gx + gy * gy
        rows_inside = radius_max < y < height - 1 - radius_max
        for x in range(1, width - 1):
            if squares[x] < least:
                continue
            size = one / np.sqrt(squares[x])
            gx, gy = (row[x + 1] - row[x - 1]) * size, (below[x] - above[x]) * size
            at_x, at_y = np.float32(x) + half, np.float32(y) + half
            inside = rows_inside and radius_max < x < width - 1 - radius_max
            for radius in range(radius_min, radius_max + 1):
                u = np.int32(at_x + gx * np.float32(radius))
                v = np.int32(at_y + gy * np.float32(radius))
                if inside or (0 <= u < width and 0 <= v < height):
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
def zones(maps: Floats, family: int, u: float, v: float, radius: float, out: Floats) -> None:
    """Means of the maps (n, h, w) over `ZONES` round (u, v); `out` (zones, n), 0 where a zone has no pixel.

    All maps are looked at within the rim, colour, brightness and smoothness in the ring, colour alone further out.
    """
    count, height, width = maps.shape
    out[:] = 0
    pixels = np.zeros(len(ZONES), np.int32)
    outer = radius * ZONES[FURTHER]
    middle2, rim2, outline2, ring2 = (
        (radius * ZONES[MIDDLE]) ** 2,
        (radius * ZONES[RIM]) ** 2,
        (radius * ZONES[OUTLINE]) ** 2,
        (radius * ZONES[RING]) ** 2,
    )
    colour, brightness, smooth = maps[family], maps[BRIGHTNESS], maps[SMOOTH]
    stride = 1 if outer < STRIDE_FROM_PX else 2
    for y in range(max(int(v - outer), 0), min(int(v + outer) + 2, height), stride):
        for x in range(max(int(u - outer), 0), min(int(u + outer) + 2, width), stride):
            d2 = (x - u) * (x - u) + (y - v) * (y - v)
            if d2 > ring2:
                if d2 <= outer * outer:
                    pixels[FURTHER] += 1
                    out[FURTHER, family] += colour[y, x]
            elif d2 > outline2:
                pixels[RING] += 1
                out[RING, family] += colour[y, x]
                out[RING, BRIGHTNESS] += brightness[y, x]
                out[RING, SMOOTH] += smooth[y, x]
            elif d2 <= rim2:
                zone = MIDDLE if d2 <= middle2 else RIM
                pixels[zone] += 1
                for k in range(count):
                    out[zone, k] += maps[k, y, x]
    for z in range(len(ZONES)):
        for k in range(count):
            out[z, k] /= max(pixels[z], 1)


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
    within = np.zeros((len(ZONES), maps.shape[0]), np.float32)
    for i in range(points.shape[0]):
        u, v = float(points[i, 0]), float(points[i, 1])
        radius, seen, step = outline(source, u, v, radii[0], radii[1], spokes)
        zones(maps, family, u, v, radius, within)
        middle, rim, ring, further = within[MIDDLE], within[RIM], within[RING], within[FURTHER]
        out[i, 0] = rim[family]
        out[i, 1] = middle[family]
        out[i, 2] = ring[family]
        out[i, 3] = further[family]
        out[i, 4] = (middle[1 - family] + rim[1 - family]) / 2
        out[i, 5] = (middle[SMOOTH] + rim[SMOOTH]) / 2
        out[i, 6] = ring[SMOOTH]
        out[i, 7] = (middle[AREA + family] + rim[AREA + family]) / 2
        out[i, 8] = votes[points[i, 1], points[i, 0]]
        out[i, 9] = seen
        out[i, 10] = step
        out[i, 11] = middle[HIGHLIGHT]
        out[i, 12] = (middle[BRIGHTNESS] + rim[BRIGHTNESS]) / 2
        out[i, 13] = out[i, 12] - ring[BRIGHTNESS]
        out[i, 14] = (middle[WHITENESS] + rim[WHITENESS]) / 2
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
