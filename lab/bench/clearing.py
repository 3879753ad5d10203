"""Every plant of a very large market asks every robot once, one plant after another, as one numba function.

The rules are those of `core.allocation.bidding` for tasks without water on robots with full packs, straight ways between
docks, and nobody moving meanwhile; a test holds the two against each other. What is left out is what people see: documents.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.allocation.bidding import DOCKING_S, UNDOCKING_S, ride_s, work_s
from lab.crowd import KIND, Instance

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
WORK_S = work_s(KIND, 0.0)
START_S = ride_s(0.0)
S_A_METRE = ride_s(1.0) - START_S


def clear(instance: Instance) -> list[list[int]]:
    """The robots' queues when each plant has asked all robots and given its task to the cheapest, in the plants' order."""
    starts, plants = np.array(instance.starts), np.array(instance.plants)
    queues, lengths = np.full((len(starts), len(plants)), -1), np.zeros(len(starts), dtype=np.int64)
    _clear(starts, plants, queues, lengths)
    return [queues[robot, : lengths[robot]].tolist() for robot in range(len(starts))]


@njit(cache=True)
def _hop_s(ax: float, ay: float, bx: float, by: float, docked: bool) -> float:
    """From a dock or a floor to another dock."""
    way_m = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
    return (UNDOCKING_S if docked else 0.0) + START_S + S_A_METRE * way_m + DOCKING_S


@njit(cache=True)
def _clear(starts: Floats, plants: Floats, queues: Ints, lengths: Ints) -> None:
    """Fills `queues` (R, P) and `lengths` (R,) for robots at `starts` (R, 2) and `plants` (P, 2) [m]."""
    for plant in range(len(plants)):
        best_s, best_robot, best_place = math.inf, -1, -1
        for robot in range(len(starts)):
            price_s, place = _price(plant, starts[robot], plants, queues[robot], lengths[robot])
            if price_s < best_s:
                best_s, best_robot, best_place = price_s, robot, place
        queue = queues[best_robot]
        for place in range(lengths[best_robot], best_place, -1):
            queue[place] = queue[place - 1]
        queue[best_place] = plant
        lengths[best_robot] += 1


@njit(cache=True)
def _price(plant: int, start: Floats, plants: Floats, queue: Ints, length: int) -> tuple[float, int]:
    """The least price [s] of a plant for one robot, and its place in the queue; the last of equals."""
    x, y = plants[plant, 0], plants[plant, 1]
    ahead_s, fx, fy = 0.0, start[0], start[1]
    best_s, best_place = math.inf, -1
    to_s = _hop_s(fx, fy, x, y, False)
    for place in range(length + 1):
        later_s = to_s + WORK_S
        own_s = ahead_s + later_s
        leg_s, back_s = 0.0, 0.0
        if place < length:
            nx, ny = plants[queue[place], 0], plants[queue[place], 1]
            leg_s = _hop_s(fx, fy, nx, ny, place > 0)
            back_s = _hop_s(x, y, nx, ny, True)
            later_s += back_s - leg_s
            fx, fy = nx, ny
            ahead_s += leg_s + WORK_S
            to_s = back_s
        price_s = own_s + (length - place + (length > 0)) * max(0.0, later_s)
        if price_s <= best_s:
            best_s, best_place = price_s, place
    return best_s, best_place


def compiled() -> Any:
    """Compile before anything is measured."""
    return clear(Instance(((0.0, 0.0),), ((1.0, 0.0), (2.0, 0.0))))
