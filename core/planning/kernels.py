"""The numba kernels of grid planning. Compiled once and cached on disk; `core.planning.warm()` does it ahead of need.

The field lives on a flat grid with a border of blocked cells, so no step needs a bounds check. A blocked cell holds -1: one
comparison rules out obstacles and settled cells alike.
Source: Dial's bucket variant of Dijkstra's algorithm, with chamfer 5-7 steps.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

STRAIGHT, DIAGONAL = 5, 7
FAR = np.int32(2**31 - 1)
WEIGHT_MAX = 4
BUCKETS = 32
"""More than the dearest step, DIAGONAL * WEIGHT_MAX, and a power of two."""

Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]


@njit(cache=True)
def plain_field(dist: Ints, width: int, goal: int) -> None:
    """Fill `dist` (flat, FAR where free, -1 where blocked) with the cost from every cell to `goal`; all cells weigh 1."""
    size = dist.size
    queue = np.empty((8, size), np.int32)
    counts = np.zeros(8, np.int64)
    dist[goal] = 0
    queue[0, 0] = goal
    counts[0] = 1
    level, idle = 0, 0
    while idle < 8:
        here = level & 7
        n = counts[here]
        if n == 0:
            idle += 1
            level += 1
            continue
        idle = 0
        counts[here] = 0
        a, b = level + STRAIGHT, level + DIAGONAL
        qa, qb = queue[a & 7], queue[b & 7]
        na, nb = counts[a & 7], counts[b & 7]
        row = queue[here]
        for i in range(n):
            c = row[i]
            if dist[c] != level:
                continue
            for k in (c - 1, c + 1, c - width, c + width):
                if dist[k] > a:
                    dist[k] = a
                    qa[na] = k
                    na += 1
            for k in (c - width - 1, c - width + 1, c + width - 1, c + width + 1):
                if dist[k] > b:
                    dist[k] = b
                    qb[nb] = k
                    nb += 1
        counts[a & 7], counts[b & 7] = na, nb
        level += 1


@njit(cache=True)
def weighted_field(dist: Ints, weight: Bytes, width: int, goal: int) -> None:
    """The same where entering a cell costs `weight` (1 .. WEIGHT_MAX) times the step."""
    size = dist.size
    queue = np.empty((BUCKETS, size), np.int32)
    counts = np.zeros(BUCKETS, np.int64)
    steps = (-1, 1, -width, width, -width - 1, -width + 1, width - 1, width + 1)
    dist[goal] = 0
    queue[0, 0] = goal
    counts[0] = 1
    level, idle = 0, 0
    while idle < BUCKETS:
        here = level & (BUCKETS - 1)
        n = counts[here]
        if n == 0:
            idle += 1
            level += 1
            continue
        idle = 0
        counts[here] = 0
        for i in range(n):
            c = queue[here, i]
            if dist[c] != level:
                continue
            straight = level + STRAIGHT * weight[c]
            diagonal = level + DIAGONAL * weight[c]
            for j in range(8):
                k = c + steps[j]
                cost = straight if j < 4 else diagonal
                if dist[k] > cost:
                    dist[k] = cost
                    bucket = cost & (BUCKETS - 1)
                    queue[bucket, counts[bucket]] = k
                    counts[bucket] += 1
        level += 1


@njit(cache=True)
def descend(dist: Ints, width: int, start: int) -> Ints:
    """Cells from `start` down the field to its goal. `start` must be reached."""
    steps = (-1, 1, -width, width, -width - 1, -width + 1, width - 1, width + 1)
    path = np.empty(64, np.int32)
    n, c, last = 0, start, -1
    while True:
        if n == path.size:
            longer = np.empty(2 * n, np.int32)
            longer[:n] = path
            path = longer
        path[n] = c
        n += 1
        if dist[c] == 0:
            return path[:n].copy()
        best, best_rate = -1, -1.0
        for j in range(8):
            k = c + steps[j]
            if 0 <= dist[k] < dist[c]:
                rate = (dist[c] - dist[k]) / (5.0 if j < 4 else 7.0)
                if rate > best_rate + 1e-9 or (rate > best_rate - 1e-9 and j == last):
                    best, best_rate = j, rate
        last = best
        c = c + steps[best]


@njit(cache=True)
def line_cost(dist: Ints, weight: Bytes, width: int, a: int, b: int) -> float:
    """Cost of the straight line between two cells in the field's unit; infinite when it meets a blocked cell."""
    ra, ca = a // width, a % width
    dr, dc = b // width - ra, b % width - ca
    n = max(abs(dr), abs(dc)) * 2
    if n == 0:
        return 0.0
    total = 0.0
    for i in range(n + 1):
        r = int(np.floor(ra + dr * i / n + 0.5))
        c = int(np.floor(ca + dc * i / n + 0.5))
        k = r * width + c
        if dist[k] < 0:
            return np.inf
        total += weight[k]
    cost: float = STRAIGHT * np.sqrt(float(dr * dr + dc * dc)) * total / (n + 1)
    return cost


@njit(cache=True)
def shortcut(dist: Ints, weight: Bytes, width: int, path: Ints) -> Ints:
    """Keep only the cells where the path must turn: a straight line replaces what it does not make dearer."""
    kept = np.empty(path.size, np.int32)
    kept[0] = path[0]
    n, i = 1, 0
    while i < path.size - 1:
        good, stride, j = i + 1, 1, i + 1
        while True:
            j = min(good + stride, path.size - 1)
            if j == good:
                break
            budget = 1.02 * (dist[path[i]] - dist[path[j]]) + STRAIGHT
            if line_cost(dist, weight, width, path[i], path[j]) <= budget:
                good, stride = j, stride * 2
            elif stride == 1:
                break
            else:
                stride //= 2
        kept[n] = path[good]
        n += 1
        i = good
    return kept[:n].copy()
