"""The numba kernels of the feature detector. Compiled once and cached on disk; `features.warm()` does it ahead of need."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]
Bytes: TypeAlias = NDArray[np.uint8]
Ints: TypeAlias = NDArray[np.int32]

NARROW, WIDE = 8, 16
"""A patch's rows are read so far, over zeros: loops of known length run on the processor's vectors."""
GIVEN_UP = np.float32(-1e9)
"""The margin of a point that is not looked at further."""


@njit(cache=True, fastmath=True)
def slopes(blue: Floats, green: Floats, red: Floats, out: Floats) -> None:
    """Three channels (h, w) -> `features.PLANES` (5, h, w); slopes by Sobel, none along the array's outermost ring."""
    height, width = blue.shape
    for y in range(height):
        for x in range(width):
            b, g, r = blue[y, x], green[y, x], red[y, x]
            out[0, y, x] = (b + g + r) * np.float32(1 / 3)
            out[3, y, x] = max(b, g, r) - min(b, g, r)
    out[1], out[2], out[4] = 0, 0, 0
    for channel in (blue, green, red):
        for y in range(1, height - 1):
            above, here, below = channel[y - 1], channel[y], channel[y + 1]
            for x in range(1, width - 1):
                down_left, down_right = below[x - 1] - above[x - 1], below[x + 1] - above[x + 1]
                turn = np.float32(2) * (here[x + 1] - here[x - 1])
                across = np.float32(0.25) * (above[x + 1] + below[x + 1] - above[x - 1] - below[x - 1] + turn)
                along = np.float32(0.25) * (down_left + down_right + np.float32(2) * (below[x] - above[x]))
                out[1, y, x] += across * np.float32(1 / 3)
                out[2, y, x] += along * np.float32(1 / 3)
                out[4, y, x] = max(out[4, y, x], across * across + along * along)
    for y in range(height):
        for x in range(width):
            out[4, y, x] = math.sqrt(out[4, y, x])


@njit(cache=True, fastmath=True)
def normalise(mean: Floats, square: Floats, size: int, noise: float, out: Floats) -> None:
    """1 over the norm of windows of `size` x `size` whose pixels have this mean and mean square (h, w), noise added."""
    share, extra = np.float32(1 / size), np.float32(noise * noise)
    for y in range(mean.shape[0]):
        for x in range(mean.shape[1]):
            variance = max(square[y, x] - mean[y, x] * mean[y, x], np.float32(0))
            out[y, x] = share / math.sqrt(variance + extra)


@njit(cache=True, fastmath=True)
def correlated(plane: Floats, weight: Floats, patch: Floats, out: Floats) -> None:
    """Correlation of a plane (h, w) with a patch (n, n) around each pixel, times `weight` (h, w), into `out` (h, w).

    Half a patch along the border is left at zero.
    """
    size = patch.shape[0]
    half = size // 2
    height, width = plane.shape
    out[:] = 0
    inner = width - 2 * half
    for y in range(half, height - half):
        row = out[y, half : width - half]
        for j in range(size):
            line = plane[y + j - half]
            for i in range(size):
                factor = patch[j, i]
                source = line[i : i + inner]
                for x in range(inner):
                    row[x] += factor * source[x]
        scale = weight[y, half : width - half]
        for x in range(inner):
            row[x] *= scale[x]


@njit(cache=True, fastmath=True)
def look_up(votes: Floats, right: int, down: int, table: Floats, out: Floats) -> None:
    """Add to `out` (h, w) what `table` (bins, over -1..1) says of the votes found `right`, `down` of each pixel."""
    height, width = out.shape
    bins = len(table)
    for y in range(max(0, -down), min(height, height - down)):
        for x in range(max(0, -right), min(width, width - right)):
            level = int((votes[y + down, x + right] + 1) * (bins / 2))
            out[y, x] += table[min(max(level, 0), bins - 1)]


@njit(cache=True, fastmath=True)
def vote(
    planes: Floats, weights: Floats, x: int, y: int, feature: Ints, patch: Floats, mask: Floats, lanes: Floats
) -> float:
    """What one feature says of an object centred at (x, y): its correlation, blurred by its centroid mask.

    `planes` (c, h, w), `weights` (c, s, h, w) 1 over the windows' norms, `feature` plane, size index, size, right, down;
    `patch` (n, WIDE), zero outside the first size x size; `mask` (m,) in each direction;
    `lanes` (WIDE,) is scratch.
    """
    image, weight, size, reach = planes[feature[0]], weights[feature[0], feature[1]], feature[2], len(mask) // 2
    left, top = x + feature[3] - size // 2 - reach, y + feature[4] - size // 2 - reach
    total = np.float32(0)
    for b in range(len(mask)):
        for a in range(len(mask)):
            found = np.float32(0)
            first = np.uintp(left + a)
            if size <= NARROW:
                for j in range(size):
                    row = np.uintp(top + b + j)
                    for i in range(NARROW):
                        found += patch[np.uintp(j), np.uintp(i)] * image[row, first + np.uintp(i)]
            else:
                lanes[:] = 0
                for j in range(size):
                    row = np.uintp(top + b + j)
                    for i in range(np.uintp(0), np.uintp(WIDE)):
                        lanes[i] += patch[np.uintp(j), i] * image[row, first + i]
                found = lanes.sum()
            total += mask[a] * mask[b] * found * weight[top + b + size // 2, left + a + size // 2]
    return float(total)


@njit(cache=True, fastmath=True)
def describe(
    planes: Floats, weights: Floats, points: Ints, features: Ints, patches: Floats, mask: Floats, bins: int, out: Bytes
) -> None:
    """Every feature's bin (n, k) at every point (n, 2: x, y)."""
    lanes = np.zeros(WIDE, np.float32)
    for n in range(len(points)):
        for k in range(len(features)):
            said = vote(planes, weights, points[n, 0], points[n, 1], features[k], patches[k], mask, lanes)
            out[n, k] = min(max(int((said + 1) * (bins / 2)), 0), bins - 1)


@njit(cache=True, fastmath=True)
def cascade(
    planes: Floats,
    weights: Floats,
    points: Ints,
    features: Ints,
    patches: Floats,
    mask: Floats,
    tables: Floats,
    floors: Floats,
    first: int,
    margins: Floats,
) -> None:
    """Add the features from `first` on to the margins (n,) of points (n, 2: x, y).

    A point whose margin is below `floors` (k,) after a feature is given up: its margin becomes GIVEN_UP.
    """
    bins, lanes = tables.shape[1], np.zeros(WIDE, np.float32)
    for n in range(len(points)):
        for k in range(first, len(features)):
            said = vote(planes, weights, points[n, 0], points[n, 1], features[k], patches[k], mask, lanes)
            margins[n] += tables[k, min(max(int((said + 1) * (bins / 2)), 0), bins - 1)]
            if margins[n] < floors[k]:
                margins[n] = GIVEN_UP
                break
