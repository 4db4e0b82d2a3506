"""The grid of a surface, seen from above: x of the world to the right, y up."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray

__all__ = ["Grid", "Layer", "grid_around", "least_cell_m"]

_MOST_CELLS = 60_000_000
"""Cells of the largest grid: four bands of it and an orthoimage take 1.2 GB."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Square cells. The upper left corner of the first lies at (`left_m`, `top_m`) of the world."""

    left_m: float
    top_m: float
    cell_m: float
    rows: int
    columns: int

    def place(self, xyz_m: FloatArray) -> FloatArray:
        """World points (..., 3) as column, row, both 0 in the middle of the first cell, and height."""
        column = (xyz_m[..., 0] - self.left_m) / self.cell_m - 0.5
        row = (self.top_m - xyz_m[..., 1]) / self.cell_m - 0.5
        return np.stack([column, row, xyz_m[..., 2]], axis=-1)

    def middles(self) -> tuple[FloatArray, FloatArray]:
        """World x of the columns' middles and y of the rows'."""
        x, y = ((np.arange(n, dtype=float) + 0.5) * self.cell_m for n in (self.columns, self.rows))
        return np.asarray(self.left_m + x), np.asarray(self.top_m - y)

    def part(self, first_row: int, first_column: int, rows: int, columns: int) -> "Grid":
        """Some of its rows and columns as a grid."""
        return Grid(
            left_m=self.left_m + first_column * self.cell_m,
            top_m=self.top_m - first_row * self.cell_m,
            cell_m=self.cell_m,
            rows=rows,
            columns=columns,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """What one frame sees of a grid, in the box that it covers; NaN where it sees nothing."""

    frame: int
    first_row: int
    first_column: int
    height_m: NDArray[np.float32]
    variance_m2: NDArray[np.float32]
    grey: NDArray[np.float32]
    shared_m2: NDArray[np.float32] | None = None
    """Variance of the height due to errors that neighbouring cells have in common; None: unknown."""

    @property
    def box(self) -> tuple[slice, slice]:
        """Its rows and columns of the grid."""
        rows, columns = self.height_m.shape
        return (
            slice(self.first_row, self.first_row + rows),
            slice(self.first_column, self.first_column + columns),
        )

    def cut(self, other: "Layer") -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
        """The rows and columns, of each, that two layers share; None where there are none."""
        own, theirs = [], []
        for a, b in zip(self.box, other.box, strict=True):
            first, last = max(a.start, b.start), min(a.stop, b.stop)
            if first >= last:
                return None
            own.append(slice(first - a.start, last - a.start))
            theirs.append(slice(first - b.start, last - b.start))
        return (own[0], own[1]), (theirs[0], theirs[1])


def least_cell_m(centres_m: FloatArray, reach_m: float) -> float:
    """Side of the smallest cell whose grid, within reach of places (n, 2 or 3), fits into memory."""
    size = np.ptp(centres_m[:, :2], axis=0) + 2 * reach_m
    return float(np.sqrt(np.prod(size) / _MOST_CELLS))


def grid_around(centres_m: FloatArray, reach_m: float, cell_m: float) -> Grid:
    """The grid that holds everything within reach of some places (n, 2 or 3), on whole multiples of a cell.

    Raises InputError for a cell so small that the grid would not fit into memory, naming one that fits.
    """
    low, high = centres_m[:, :2].min(axis=0) - reach_m, centres_m[:, :2].max(axis=0) + reach_m
    size, fits = high - low, least_cell_m(centres_m, reach_m)
    if cell_m < fits:
        digits = 10.0 ** np.floor(np.log10(fits) - 1)
        fits = float(np.ceil(fits / digits) * digits)
        raise InputError(
            f"terrain: cell: expected at most {_MOST_CELLS // 1_000_000} million cells over "
            f"{size[0]:.0f} m x {size[1]:.0f} m, that is a cell of {fits:.2g} m or more, found {cell_m:g} m"
        )
    first, last = np.floor(low / cell_m), np.ceil(high / cell_m)
    columns, rows = (int(n) for n in last - first)
    return Grid(
        left_m=float(first[0] * cell_m),
        top_m=float(last[1] * cell_m),
        cell_m=cell_m,
        rows=rows,
        columns=columns,
    )
