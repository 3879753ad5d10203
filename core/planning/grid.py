"""The map: what may not be touched, on a 1 cm grid, and the configuration space of a round robot in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.geometry.planar import Point

CELL_M = 0.01
Mask = NDArray[np.bool_]
Array32 = NDArray[np.float32]


class GridMap:
    """Occupied cells of a rectangle. `occupied[row, column]`: row along y, column along x, both from the corner (x0, y0)."""

    def __init__(self, x0_m: float, y0_m: float, occupied: Mask, cell_m: float = CELL_M) -> None:
        self.x0_m, self.y0_m, self.cell_m, self.occupied = x0_m, y0_m, cell_m, occupied

    @classmethod
    def of_arena(cls, length_m: float, width_m: float, cell_m: float = CELL_M) -> GridMap:
        """An empty arena centred on the world's origin; beyond its edge everything counts as occupied."""
        columns, rows = round(length_m / cell_m), round(width_m / cell_m)
        return cls(-length_m / 2, -width_m / 2, np.zeros((rows, columns), np.bool_), cell_m)

    def copy(self) -> GridMap:
        return GridMap(self.x0_m, self.y0_m, self.occupied.copy(), self.cell_m)

    def cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """(row, column) of the cell that holds the point, clipped into the grid."""
        rows, columns = self.occupied.shape
        row = min(rows - 1, max(0, math.floor((y_m - self.y0_m) / self.cell_m)))
        return row, min(columns - 1, max(0, math.floor((x_m - self.x0_m) / self.cell_m)))

    def centre(self, row: int, column: int) -> Point:
        """World position of a cell's centre [m]."""
        return self.x0_m + (column + 0.5) * self.cell_m, self.y0_m + (row + 0.5) * self.cell_m

    def contains(self, x_m: float, y_m: float) -> bool:
        rows, columns = self.occupied.shape
        inside_x = 0 <= x_m - self.x0_m < int(columns) * self.cell_m
        return inside_x and 0 <= y_m - self.y0_m < int(rows) * self.cell_m

    def add_disc(self, x_m: float, y_m: float, radius_m: float) -> None:
        """A pot, or another robot."""
        x, y = self._centres(x_m, y_m, radius_m)
        rows, columns = self._window(x_m, y_m, radius_m)
        self.occupied[rows, columns] |= x * x + y * y <= radius_m * radius_m

    def add_box(self, x_m: float, y_m: float, yaw_rad: float, length_m: float, width_m: float) -> None:
        """A box centred on (x, y), `length_m` along its yaw: a dock, a wall."""
        reach_m = math.hypot(length_m, width_m) / 2
        x, y = self._centres(x_m, y_m, reach_m)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        along, across = cos * x + sin * y, cos * y - sin * x
        rows, columns = self._window(x_m, y_m, reach_m)
        self.occupied[rows, columns] |= (np.abs(along) <= length_m / 2) & (np.abs(across) <= width_m / 2)

    def _window(self, x_m: float, y_m: float, reach_m: float) -> tuple[slice, slice]:
        low, high = self.cell(x_m - reach_m, y_m - reach_m), self.cell(x_m + reach_m, y_m + reach_m)
        return slice(low[0], high[0] + 1), slice(low[1], high[1] + 1)

    def _centres(self, x_m: float, y_m: float, reach_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Cell centres of the window round a point, relative to that point [m]."""
        rows, columns = self._window(x_m, y_m, reach_m)
        x = self.x0_m + (np.arange(columns.start, columns.stop) + 0.5) * self.cell_m - x_m
        y = self.y0_m + (np.arange(rows.start, rows.stop) + 0.5) * self.cell_m - y_m
        return x[None, :], y[:, None]

    def inflate(self, radius_m: float, comfort_m: float = 0.0) -> CSpace:
        """The configuration space of a round robot; see `CSpace`. Cells up to `comfort_m` further out cost more."""
        padded = np.pad(self.occupied, 1, constant_values=True)
        clearance = cv2.distanceTransform((~padded).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        clearance_m = np.asarray(clearance, np.float32) * np.float32(self.cell_m)
        free = clearance_m > radius_m
        weight = np.ones(free.shape, np.uint8)
        if comfort_m > 0:
            weight[clearance_m < radius_m + comfort_m] = 2
            weight[clearance_m < radius_m + comfort_m / 2] = 4
        return CSpace(grid=self, free=free, weight=weight, clearance_m=clearance_m, weighted=comfort_m > 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CSpace:
    """Where the robot's centre may be. All arrays have one blocked cell more on every side than the grid."""

    grid: GridMap
    free: Mask
    weight: NDArray[np.uint8]
    """What entering a cell costs, 1 .. 4."""
    clearance_m: Array32
    """From a cell's centre to the nearest occupied cell."""
    weighted: bool

    @property
    def width(self) -> int:
        return int(self.free.shape[1])

    def index(self, x_m: float, y_m: float) -> int:
        """Flat index of the padded cell that holds the point."""
        row, column = self.grid.cell(x_m, y_m)
        return (row + 1) * self.width + column + 1

    def point(self, index: int) -> Point:
        return self.grid.centre(index // self.width - 1, index % self.width - 1)

    def is_free(self, x_m: float, y_m: float) -> bool:
        return self.grid.contains(x_m, y_m) and bool(self.free.flat[self.index(x_m, y_m)])

    def clearance_at_m(self, x_m: float, y_m: float) -> float:
        """Distance from the point to the nearest obstacle or edge [m]."""
        return float(self.clearance_m.flat[self.index(x_m, y_m)])

    def nearest_free(self, x_m: float, y_m: float, within_m: float) -> int | None:
        """The free cell nearest to the point, as a flat index; None when there is none so near."""
        row, column = (n + 1 for n in self.grid.cell(x_m, y_m))
        reach = math.ceil(within_m / self.grid.cell_m)
        top, left = max(0, row - reach), max(0, column - reach)
        window = self.free[top : row + reach + 1, left : column + reach + 1]
        rows, columns = np.nonzero(window)
        if rows.size == 0:
            return None
        squares = (rows + top - row) ** 2 + (columns + left - column) ** 2
        best = int(np.argmin(squares))
        if squares[best] > reach * reach:
            return None
        return int(rows[best] + top) * self.width + int(columns[best] + left)
