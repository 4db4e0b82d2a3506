"""The surfaces of several frames as one, on the part of a grid that they cover."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pancam_graph.terrain import kernel
from pancam_graph.terrain._grid import Grid, Layer

__all__ = ["Fused", "fuse"]

_ROWS = 64
"""Rows of a grid that are fused at a time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """The surfaces of some frames as one, on the part of a grid that they cover; NaN where all is hidden."""

    grid: Grid
    height_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    """Standard deviation of the height: that of frames' own errors, and of those that they have in common."""
    count: NDArray[np.float32]
    """How many frames see each cell."""
    disagreement_m: NDArray[np.float32]
    """Standard deviation between frames; NaN where fewer than two see the cell."""
    grey: NDArray[np.float32]
    """Brightness in samples of the pictures."""
    telemetry_m: NDArray[np.float32]
    """Height with telemetry's pointing; NaN where that is not known."""
    coarser: tuple["Fused", ...] = ()
    """Farther ground in larger cells, each of twice the cell of the one before: rings about the masts."""

    @property
    def levels(self) -> tuple["Fused", ...]:
        """This grid and the coarser ones, the finest first."""
        return (self, *self.coarser)


def fuse(grid: Grid, layers: Sequence[Layer], telemetry: Sequence[Layer] = ()) -> Fused:
    """Fuse the layers of some frames on the part of the grid that they cover, and there telemetry's too."""
    boxes = [layer.box for layer in layers]
    box = tuple(
        slice(min(s.start for s in along), max(s.stop for s in along)) for along in zip(*boxes, strict=True)
    )
    rows, columns = box
    height, variance, count, disagreement, grey, shared = _fused_bands(layers, (rows, columns), 6)
    (before,) = _fused_bands(telemetry, (rows, columns), 1)
    return Fused(
        grid=grid.part(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start),
        height_m=height,
        sigma_m=np.sqrt(variance + shared),
        count=count,
        disagreement_m=disagreement,
        grey=grey,
        telemetry_m=before,
    )


def _fused_bands(layers: Sequence[Layer], box: tuple[slice, slice], bands: int) -> NDArray[np.float32]:
    """The first bands (bands, rows, columns) of what layers are as one, in some rows and columns of the grid.

    The bands are height, variance of frames' own errors, count, disagreement, grey, and variance of errors in
    common, of frames the mean by their own variances: more frames do not lower it. What layers have beyond is
    cut off.
    """
    (top, bottom), (left, right) = ((s.start, s.stop) for s in box)
    fused = np.empty((bands, bottom - top, right - left), dtype=np.float32)
    for begin in range(top, bottom, _ROWS):
        end = min(begin + _ROWS, bottom)
        here = [lay for lay in layers if lay.first_row < end and lay.box[0].stop > begin]
        stack = np.full((4, max(len(here), 1), end - begin, right - left), np.nan, dtype=np.float32)
        for k, layer in enumerate(here):
            r, c = layer.box
            first, last = max(r.start, begin), min(r.stop, end)
            west, east = max(c.start, left), min(c.stop, right)
            if west >= east:
                continue
            to = slice(first - begin, last - begin), slice(west - left, east - left)
            part = slice(first - r.start, last - r.start), slice(west - c.start, east - c.start)
            known = (layer.height_m, layer.variance_m2, layer.grey, layer.shared_m2)
            for band, values in enumerate(known):
                stack[(band, k, *to)] = 0.0 if values is None else values[part]
        flat = stack.reshape(4, stack.shape[1], -1)
        out = np.empty((6, flat.shape[2]), dtype=np.float32)
        kernel.fuse_cells(flat[0], flat[1], flat[2], flat[3], out)
        fused[:, begin - top : end - top] = out[:bands].reshape(bands, end - begin, right - left)
    return fused
