"""Optimal assignment between two small sets, pure Python: successive shortest augmenting paths (Ahuja, Magnanti, Orlin)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

Costs = Mapping[tuple[int, int], float]
EPS = 1e-12


def assign(costs: Costs, rows: int, unmatched: float) -> dict[int, int]:
    """Pairs row -> column of least total cost, where a row left alone costs `unmatched`.

    `costs` holds the allowed pairs only; one that costs `unmatched` or more is never taken. Fast when few pairs are allowed.
    """
    near: list[dict[int, float]] = [{} for _ in range(rows)]
    for (row, column), cost in sorted(costs.items()):
        if cost < unmatched:
            near[row][column] = cost - unmatched
    owners: dict[int, int] = {}
    for row in range(rows):
        _let_in(row, near, owners)
    return {row: column for column, row in owners.items()}


def _let_in(start: int, near: list[dict[int, float]], owners: dict[int, int]) -> None:
    """One more row: others move along the cheapest path, and one of them may be left alone."""
    cost = {start: 0.0}
    came: dict[int, tuple[int, int]] = {}  # row -> the row that takes its column, and the column
    least, last, free = 0.0, start, -1  # the path's end: this row takes a free column, or stays alone
    queue = deque([start])
    while queue:
        row = queue.popleft()
        if cost[row] < least - EPS:
            least, last, free = cost[row], row, -1
        for column, gain in near[row].items():
            through, owner = cost[row] + gain, owners.get(column)
            if owner is None:
                if through < least - EPS:
                    least, last, free = through, row, column
            elif owner not in (row, start):
                freed = through - near[owner][column]
                if freed < cost.get(owner, math.inf) - EPS:
                    cost[owner], came[owner] = freed, (row, column)
                    queue.append(owner)
    if free >= 0:
        owners[free] = last
    while last != start:
        last, column = came[last]
        owners[column] = last
