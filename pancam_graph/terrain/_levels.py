"""Grids of one surface with cells that double outward: fine near the masts, coarse far away."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.terrain._fused import Fused
from pancam_graph.terrain._grid import Grid, grid_around, least_cell_m
from pancam_graph.terrain._surface import ground_spacing_m

__all__ = ["Level", "composed", "levels_around"]

_CELL_AT_M = 6.0
"""Distance from the mast at which a cell that nobody asked for is as wide as points lie apart."""
_SPARSEST = 4.0
"""Cells between the points of neighbouring rows at which a grid ends and one of twice the cell goes on."""
_NEAREST_STANDS = 2.0
"""Heights of the mast up to which the finest grid reaches at least."""
_NEARLY = 0.8
"""Share of the whole reach from which on a grid covers all of it."""
_OVERLAP = 0.85
"""Share of the reach of a grid at which the coarser one begins: no cell between them stays empty."""


@dataclass(frozen=True, kw_only=True)
class Level:
    """A grid, and between which distances from the mast of its frame ground is drawn on it."""

    grid: Grid
    nearest_m: float
    farthest_m: float


def levels_around(
    centres_m: FloatArray, reach_m: float, cell_m: float | None, stands_m: float, focal_px: float
) -> tuple[Level, ...]:
    """Grids around masts (n, 2 or 3), the finest first, each with cells twice as wide as those before.

    Rows of a picture `focal_px` pixels a radian fine, `stands_m` above level ground, lie (d^2 + h^2) / (h f)
    apart at the distance d: a grid reaches as far as that is some cells, the last one to `reach_m`. Corners
    of cells are corners of finer cells. Without a `cell_m` the finest is as wide as rows lie apart at 6 m, or
    wider where that does not fit into memory. Raises InputError for a `cell_m` that does not fit.
    """

    def reach_of(cell_m: float) -> float:
        own_m = np.sqrt(max(_SPARSEST * cell_m * stands_m * focal_px - stands_m**2, 0.0))
        own_m = max(float(own_m), _NEAREST_STANDS * stands_m)
        return reach_m if own_m >= _NEARLY * reach_m else own_m

    if cell_m is None:
        cell_m = _round(float(ground_spacing_m(np.array(_CELL_AT_M), stands_m, focal_px)))
        while least_cell_m(centres_m, reach_of(cell_m)) > cell_m:
            cell_m *= 2
    levels, nearest_m = list[Level](), 0.0
    while nearest_m < reach_m:
        farthest_m = reach_of(cell_m)
        grid = grid_around(centres_m, farthest_m, cell_m)
        levels.append(Level(grid=grid, nearest_m=_OVERLAP * nearest_m, farthest_m=farthest_m))
        cell_m, nearest_m = 2 * cell_m, farthest_m
    return tuple(levels)


def _round(cell_m: float) -> float:
    """A cell of one significant digit, 1, 2 or 5."""
    power = 10.0 ** np.floor(np.log10(cell_m))
    return float(power * min((1.0, 2.0, 5.0, 10.0), key=lambda k: abs(np.log(k * power / cell_m))))


def composed(fused: Fused, cell_m: float) -> Fused:
    """A surface and its coarser levels as one grid, with the cells of the first that has `cell_m` or more.

    Of finer levels cells have the means (of sigmas too: no errors are averaged out), of coarser ones what
    lies between the middles of theirs. Without coarser levels it is the surface itself.
    """
    levels = fused.levels
    if len(levels) == 1:
        return fused
    own = next(
        (f.grid.cell_m for f in levels if f.grid.cell_m >= cell_m * (1 - 1e-9)), levels[-1].grid.cell_m
    )
    left = min(f.grid.left_m for f in levels)
    top = max(f.grid.top_m for f in levels)
    right = max(f.grid.left_m + f.grid.columns * f.grid.cell_m for f in levels)
    bottom = min(f.grid.top_m - f.grid.rows * f.grid.cell_m for f in levels)
    first, last = (
        np.floor([left / own + 1e-6, -top / own + 1e-6]),
        np.ceil([right / own - 1e-6, -bottom / own - 1e-6]),
    )
    columns, rows = (int(n) for n in last - first)
    grid = Grid(
        left_m=float(first[0] * own), top_m=float(-first[1] * own), cell_m=own, rows=rows, columns=columns
    )
    bands = np.full((6, rows, columns), np.nan, dtype=np.float32)
    for level in reversed(levels):
        over = _on(level, grid)
        bands = np.where(np.isfinite(over[0]), over, bands)
    height, sigma, count, disagreement, grey, telemetry = bands
    return Fused(
        grid=grid,
        height_m=height,
        sigma_m=sigma,
        count=np.nan_to_num(count),
        disagreement_m=disagreement,
        grey=grey,
        telemetry_m=telemetry,
    )


def _on(fused: Fused, grid: Grid) -> NDArray[np.float32]:
    """Bands (6, rows, columns) of a surface in cells of another grid: means of finer ones, or one coarser."""
    bands = fused.height_m, fused.sigma_m, fused.count, fused.disagreement_m, fused.grey, fused.telemetry_m
    own, out = fused.grid, np.full((6, grid.rows, grid.columns), np.nan, dtype=np.float32)
    if own.cell_m > grid.cell_m:
        x, y = grid.middles()
        column, row = (x - own.left_m) / own.cell_m - 0.5, (own.top_m - y) / own.cell_m - 0.5
        for k, band in enumerate(bands):
            out[k] = _between(band, row, column)
        return out
    x, y = own.middles()
    column = np.floor((x - grid.left_m) / grid.cell_m).astype(int)
    row = np.floor((grid.top_m - y) / grid.cell_m).astype(int)
    cell = row[:, None] * grid.columns + column
    for k, band in enumerate(bands):
        seen = np.isfinite(band)
        count = np.bincount(cell[seen], minlength=grid.rows * grid.columns)
        total = np.bincount(cell[seen], weights=band[seen], minlength=grid.rows * grid.columns)
        with np.errstate(invalid="ignore", divide="ignore"):
            out[k] = np.where(count > 0, total / count, np.nan).reshape(grid.rows, grid.columns)
    return out


def _between(band: NDArray[np.float32], row: FloatArray, column: FloatArray) -> NDArray[np.float32]:
    """Values (rows, columns) between cells, linear between those that have one; NaN in cells without."""
    seen = np.isfinite(band)
    weight, value = seen.astype(np.float32), np.nan_to_num(band)
    nearest = seen
    for axis, at in enumerate((row, column)):
        last = band.shape[axis] - 1
        low = np.floor(at).astype(int)
        share = (at - low).astype(np.float32).reshape((-1, 1) if axis == 0 else (1, -1))
        first, second = low.clip(0, last), (low + 1).clip(0, last)
        weight, value = (
            (1 - share) * np.take(a, first, axis) + share * np.take(a, second, axis) for a in (weight, value)
        )
        inside = (at > -0.5) & (at < last + 0.5)
        nearest = np.take(nearest, np.rint(at).astype(int).clip(0, last), axis)
        nearest = nearest & inside.reshape(share.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(nearest & (weight > 0), value / weight, np.float32(np.nan))
