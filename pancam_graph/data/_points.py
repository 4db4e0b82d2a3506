"""Named points: terrain points that a person, or another program, marked in several images."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.arrays import float_array, int_array
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["NamedPoints"]


@dataclass(frozen=True, kw_only=True, eq=False)
class NamedPoints:
    """Marks of named points in images: n rows. Raises InputError for columns that do not fit."""

    name: tuple[str, ...]
    """(n,) name of the point of each mark."""
    image: IntArray
    """(n,) row in the traverse's images."""
    uv_px: FloatArray
    """(n, 2) pixel (u, v)."""
    sigma_px: FloatArray
    """(n,) standard deviation of each coordinate, pixels."""

    def __post_init__(self) -> None:
        """Turn the columns to int64 and float64, and check them."""
        n = len(self.name)
        for column, turned, shape in (
            ("image", int_array, (n,)),
            ("uv_px", float_array, (n, 2)),
            ("sigma_px", float_array, (n,)),
        ):
            values = turned(f"points: {column}", getattr(self, column))
            if values.shape != shape:
                raise InputError(f"points: {column}: expected shape {shape}, found {values.shape}")
            object.__setattr__(self, column, values)
        for row, name in enumerate(self.name):
            if not name.strip():
                raise InputError(f"points: name[{row}]: expected a name, found an empty one")
            if not np.all(np.isfinite(self.uv_px[row])):
                raise InputError(
                    f"points: {name}: row {row}: expected finite pixels, found {self.uv_px[row].tolist()}"
                )
            if not (np.isfinite(self.sigma_px[row]) and self.sigma_px[row] > 0):
                raise InputError(
                    f"points: {name}: row {row}: sigma_px: expected a finite number above 0, "
                    f"found {self.sigma_px[row]}"
                )
        seen: set[tuple[str, int]] = set()
        for row, mark in enumerate(zip(self.name, self.image.tolist(), strict=True)):
            if mark in seen:
                raise InputError(f"points: {mark[0]}: row {row}: expected an image once, found it twice")
            seen.add(mark)

    def __len__(self) -> int:
        """Number of marks."""
        return len(self.name)

    @property
    def names(self) -> tuple[str, ...]:
        """Each name once, in the order of their first marks."""
        return tuple(dict.fromkeys(self.name))

    def select(self, rows: IntArray) -> "NamedPoints":
        """The marks of some rows."""
        return NamedPoints(
            name=tuple(self.name[int(row)] for row in rows),
            image=self.image[rows],
            uv_px=self.uv_px[rows],
            sigma_px=self.sigma_px[rows],
        )
