"""`garden bench wavefront`: our planner's full field beside a bare flood fill and scikit-image's, interleaved.

The floor is a 4-connected breadth-first search in numba: nobody visits every cell for less. The peer is
`skimage.graph.MCP_Geometric`; without it its rows say so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.planning import kernels, warm
from core.planning.grid import CSpace, GridMap
from core.planning.wavefront import path_length_m, wavefront
from core.robots import gardener

SIZES = ((300, 400), (1500, 3000))
"""Rows and columns of 1 cm: the garden, a greenhouse."""
FLOOR_RATIO_MAX = 3.0
PEER_RATIO_MIN = 15.0
LENGTH_RATIO_MAX = 1.08
RADIUS_M = gardener.BODY_RADIUS_M + 0.02


@njit(cache=True)
def _flood(dist: NDArray[np.int32], width: int, goal: int) -> None:
    queue = np.empty(dist.size, np.int32)
    queue[0] = goal
    dist[goal] = 0
    head, tail = 0, 1
    while head < tail:
        c = queue[head]
        head += 1
        d = dist[c] + 1
        for k in (c - 1, c + 1, c - width, c + width):
            if dist[k] > d:
                dist[k] = d
                queue[tail] = k
                tail += 1


def bench_wavefront(n: int = 5) -> list[dict[str, Any]]:
    """Rows `{name, ours, peer, ratio, unit, n}`: medians of `n` interleaved runs.

    `field/...` compares with the floor (ratio = ours / floor), `mcp/...` with MCP_Geometric (ratio = peer / ours), and
    `length/...` the lengths of the paths found (ratio = ours / peer, over 10 starts).
    """
    warm()
    rows: list[dict[str, Any]] = []
    for size in SIZES:
        rows += _sized(_world(*size), f"{size[0]}x{size[1]}", n)
    return rows


def _world(rows: int, columns: int) -> CSpace:
    """Pots on a grid of 1.1 m, as the garden's."""
    grid = GridMap.of_arena(columns / 100, rows / 100)
    for x in np.arange(-columns / 200 + 0.9, columns / 200 - 0.5, 1.1):
        for y in np.arange(-rows / 200 + 0.8, rows / 200 - 0.5, 1.4):
            grid.add_disc(float(x), float(y), gardener.POT_RADIUS_M)
    return grid.inflate(RADIUS_M)


def _sized(space: CSpace, name: str, n: int) -> list[dict[str, Any]]:
    goal_cell = space.nearest_free(0.0, 0.0, 1.0)
    assert goal_cell is not None
    goal = space.point(goal_cell)
    blocked = np.where(space.free, kernels.FAR, np.int32(-1)).ravel()
    runs: dict[str, Callable[[], object]] = {
        "floor": lambda: _flood(blocked.copy(), space.width, goal_cell),
        "ours": lambda: wavefront(space, goal),
    }
    if (mcp := _mcp(space, goal_cell)) is not None:
        runs["mcp"] = mcp
    ms = _interleaved(runs, n)
    rows = [_row(f"field/{name}", ms["ours"], ms["floor"], ms["ours"] / ms["floor"], "ms", n, most=FLOOR_RATIO_MAX)]
    if mcp is None:
        missing = {"missing": "scikit-image is not installed (extra bench)"}
        return [*rows, _row(f"mcp/{name}", ms["ours"], None, None, "ms", n) | missing]
    rows.append(_row(f"mcp/{name}", ms["ours"], ms["mcp"], ms["mcp"] / ms["ours"], "ms", n, least=PEER_RATIO_MIN))
    return [*rows, _lengths(space, goal, mcp(), f"length/{name}")]


def _interleaved(runs: dict[str, Callable[[], object]], n: int) -> dict[str, float]:
    """Median milliseconds of each, one round after another so that a noisy moment hits all."""
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(n):
        for name, run in runs.items():
            began = time.perf_counter()
            run()
            taken[name].append((time.perf_counter() - began) * 1000)
    return {name: float(np.median(times)) for name, times in taken.items()}


def _mcp(space: CSpace, goal_cell: int) -> Callable[[], Any] | None:
    try:
        from skimage.graph import MCP_Geometric
    except ImportError:
        return None
    costs = np.where(space.free, 1.0, -1.0)

    def run() -> Any:
        mcp = MCP_Geometric(costs)
        mcp.find_costs([divmod(goal_cell, space.width)])
        return mcp

    return run


def _lengths(space: CSpace, goal: tuple[float, float], mcp: Any, name: str) -> dict[str, Any]:
    """The worst ratio of our straightened path to the peer's, from ten starts spread over the map."""
    field = wavefront(space, goal)
    assert field is not None
    reached = np.flatnonzero((field.dist > 0) & (field.dist < kernels.FAR))
    starts = np.random.default_rng(7).choice(reached, 10, replace=False)
    worst, ours_m, theirs_m = -math.inf, 0.0, 0.0
    for start in starts:
        path = field.path_from(space.point(int(start)))
        assert path is not None
        theirs = path_length_m(np.array(mcp.traceback(divmod(int(start), space.width)), float)) * space.grid.cell_m
        if path.length_m / theirs > worst:
            worst, ours_m, theirs_m = path.length_m / theirs, path.length_m, theirs
    return _row(name, ours_m, theirs_m, worst, "m", 10, most=LENGTH_RATIO_MAX)


def _row(
    name: str,
    ours: float,
    peer: float | None,
    ratio: float | None,
    unit: str,
    n: int,
    *,
    most: float | None = None,
    least: float | None = None,
) -> dict[str, Any]:
    row: dict[str, Any] = {"name": f"wavefront/{name}", "ours": ours, "peer": peer, "ratio": ratio, "unit": unit, "n": n}
    if ratio is not None and most is not None:
        row |= {"target": f"ratio <= {most:g}", "ok": ratio <= most}
    if ratio is not None and least is not None:
        row |= {"target": f"ratio >= {least:g}", "ok": ratio >= least}
    return row
