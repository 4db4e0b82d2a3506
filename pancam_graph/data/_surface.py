"""A known surface: heights of the ground on a grid along the world's axes, as of an elevation model."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray

__all__ = ["MapImage", "Surface"]

_LEAST_NODES = 4
"""Nodes along an axis that an interpolated height depends on."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Heights at the nodes of a grid; between them, cubic convolution.

    The constructor raises InputError for fewer than 4 x 4 nodes and for places or steps that are not finite.
    """

    first_m: FloatArray
    """(2,) x and y in the world of the node of row 0 and column 0"""
    step_m: FloatArray
    """(2,) x from column to column, y from row to row: negative where the first row is the northernmost"""
    height_m: FloatArray
    """(rows, columns) z in the world; NaN where there is none"""
    file: Path | None = None
    """The file that it was read from; None for one made in memory."""

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        for name, shape in (("first_m", (2,)), ("step_m", (2,))):
            found = float_array(name, getattr(self, name))
            if found.shape != shape or not np.all(np.isfinite(found)):
                raise InputError(f"{name}: expected two finite numbers, found {found}")
            object.__setattr__(self, name, found)
        if not np.all(self.step_m):
            raise InputError(f"step_m: expected two numbers that are not 0, found {self.step_m}")
        height = float_array("height_m", self.height_m)
        if height.ndim != 2 or min(height.shape) < _LEAST_NODES:
            raise InputError(f"height_m: expected 4 x 4 nodes or more, found the shape {height.shape}")
        object.__setattr__(self, "height_m", np.where(np.isfinite(height), height, np.nan))

    def covers(self, xy_m: FloatArray) -> BoolArray:
        """Whether places (n, 2) of the world have a height: all 4 x 4 nodes around them have one."""
        at = (np.asarray(xy_m, dtype=float) - self.first_m) / self.step_m
        last = np.array(self.height_m.shape[::-1]) - 2
        with np.errstate(invalid="ignore"):
            within = np.all((at >= 1) & (at <= last), axis=1)
        corner = np.minimum(np.where(within[:, None], at, 1).astype(int), last - 1) - 1
        nodes = np.arange(_LEAST_NODES)
        around = self.height_m[
            (corner[:, 1, None] + nodes)[:, :, None], (corner[:, 0, None] + nodes)[:, None, :]
        ]
        return np.asarray(within & np.all(np.isfinite(around), axis=(1, 2)))

    def around(self, xy_m: FloatArray, margin: int) -> "Surface":
        """The part around places (n, 2), n of one or more, with so many nodes more on each side."""
        at = (np.asarray(xy_m, dtype=float) - self.first_m) / self.step_m
        size = np.array(self.height_m.shape[::-1])
        begin = np.clip(np.floor(at.min(axis=0)).astype(int) - margin, 0, size - _LEAST_NODES)
        end = np.clip(np.ceil(at.max(axis=0)).astype(int) + margin + 1, begin + _LEAST_NODES, size)
        return replace(
            self,
            first_m=self.first_m + begin * self.step_m,
            height_m=self.height_m[begin[1] : end[1], begin[0] : end[0]],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class MapImage:
    """A picture of the ground from above, as from orbit, on a grid along the world's axes."""

    first_m: FloatArray
    """(2,) x and y in the world of the middle of the pixel of row 0 and column 0"""
    step_m: FloatArray
    """(2,) x from column to column, y from row to row: negative where the first row is the northernmost"""
    grey: FloatArray
    """(rows, columns) brightness; NaN where there is none"""
