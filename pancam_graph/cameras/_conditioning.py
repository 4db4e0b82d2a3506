"""Conditioning of projection matrices: pixels and scene in units of about one (thesis 5.2).

Source: Hartley, In defense of the eight-point algorithm, 1997. With T the pixels' and U the scene's
transformation, a matrix P of pixels and metres is carried as

    P~ = T P U^-1,    T = [s 0 -s u; 0 s -s v; 0 0 1],    U = [I/l -o/l; 0 0 0 1]

up to a factor, here such that the third row of P~ is about as long in its first three entries as that of P.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["Conditioning"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Conditioning:
    """Transformations of n images; all methods are linear in the matrices and exact but for rounding."""

    centre_px: FloatArray
    """(n, 2) u and v of the formula."""
    extent_px: FloatArray
    """(n,) 1 / s: pixels in a unit."""
    origin_m: FloatArray
    """(n, 3) o of the formula, in the world."""
    extent_m: FloatArray
    """(n,) l: metres in a unit."""

    @staticmethod
    def none(n: int) -> "Conditioning":
        """No conditioning: pixels and metres about the world's origin."""
        return Conditioning(
            centre_px=np.zeros((n, 2)),
            extent_px=np.ones(n),
            origin_m=np.zeros((n, 3)),
            extent_m=np.ones(n),
        )

    def of(self, images: IntArray) -> "Conditioning":
        """The transformations of some of the images, by row."""
        return Conditioning(
            centre_px=self.centre_px[images],
            extent_px=self.extent_px[images],
            origin_m=self.origin_m[images],
            extent_m=self.extent_m[images],
        )

    def condition(self, projections: FloatArray) -> FloatArray:
        """Entries (n, 12) of P~, row by row, from matrices P (n, 3, 4) about the origins `origin_m`."""
        out = np.array(projections, dtype=float)
        out[:, :2] -= self.centre_px[:, :, None] * out[:, 2:]
        out[:, :2] /= self.extent_px[:, None, None]
        out[:, :, 3] /= self.extent_m[:, None]
        return out.reshape(-1, 12)

    def undo(self, entries: FloatArray) -> FloatArray:
        """Matrices P (n, 3, 4) about the origins `origin_m` from entries (n, 12); inverse of `condition`."""
        out = np.array(entries, dtype=float).reshape(-1, 3, 4)
        out[:, :, 3] *= self.extent_m[:, None]
        out[:, :2] *= self.extent_px[:, None, None]
        out[:, :2] += self.centre_px[:, :, None] * out[:, 2:]
        return out

    @cached_property
    def d_undo(self) -> FloatArray:
        """(n, 12, 12) derivative of `undo`, entries row by row: the same wherever P is."""
        n = len(self.extent_m)
        rows = np.zeros((n, 3, 3))
        rows[:, 0, 0] = rows[:, 1, 1] = self.extent_px
        rows[:, :2, 2], rows[:, 2, 2] = self.centre_px, 1.0
        columns = np.ones((n, 4))
        columns[:, 3] = self.extent_m
        out = np.zeros((n, 3, 4, 3, 4))
        for b in range(4):
            out[:, :, b, :, b] = rows * columns[:, b, None, None]
        return out.reshape(n, 12, 12)
