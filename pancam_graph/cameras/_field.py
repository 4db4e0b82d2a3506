"""A smooth distortion field: what an eye's images have beside its lens, as a bicubic B-spline over them.

The field is added to where the camera model sees a point: pixel = model + field. It is evaluated at the pixel
as measured, so it is linear in its coefficients, whatever the cameras are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["FIELD_COEFFICIENTS", "FIELD_PER_COEFFICIENT", "FIELD_SHAPE", "Fields"]

_CELLS = 4
"""Cells of the spline along each side of an image."""
FIELD_SHAPE = (2, _CELLS + 3, _CELLS + 3)
"""Coefficients of a field: those of u, then those of v, each by rows of the image and along them."""
FIELD_COEFFICIENTS = int(np.prod(FIELD_SHAPE))
FIELD_PER_COEFFICIENT = 151 / 315
"""Standard deviation of a field at a pixel (mean square over the image) whose coefficients are independent
and have a standard deviation of 1: the mean of the sum of squares of the cubic B-splines along one side."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fields:
    """The fields of the cameras of n images."""

    coefficients_px: FloatArray
    """(fields, *FIELD_SHAPE)"""
    row: IntArray
    """(n,) the field of each image; -1: it has none"""
    size_px: FloatArray
    """(n, 2) width and height of each image"""

    @staticmethod
    def joined(fields: "Sequence[Fields]") -> "Fields":
        """The fields of the images of several sets, one after the other."""
        begin = np.cumsum([0, *(len(f.coefficients_px) for f in fields)])
        return Fields(
            coefficients_px=np.concatenate([f.coefficients_px for f in fields]),
            row=np.concatenate(
                [np.where(f.row < 0, -1, f.row + b) for f, b in zip(fields, begin, strict=False)]
            ),
            size_px=np.concatenate([f.size_px for f in fields]),
        )

    def basis(self, image: IntArray, uv_px: FloatArray) -> tuple[IntArray, FloatArray]:
        """Where pixels (m, 2) of images (m,) lie in the spline: first coefficients, weights.

        The coefficients that count are 4 x 4 for u and v each, from row and column (m, 2) on, with weights
        (m, 4, 4). Beyond the edges of the image these are those of the edge.
        """
        cell, t, _ = self._cells(image, uv_px)
        along_u, along_v = np.moveaxis(_cubics(t), 1, 0)
        weight = along_v[:, :, None] * along_u[:, None, :]
        if (self.row < 0).any():
            weight[self.row[image] < 0] = 0.0
        return cell[:, ::-1], weight

    def slope(self, image: IntArray, uv_px: FloatArray) -> FloatArray:
        """Derivatives (m, 2, 2) of `at` by the pixel: 0 across an edge, beyond it."""
        cell, t, t_by_uv = self._cells(image, uv_px)
        along_u, along_v = np.moveaxis(_cubics(t), 1, 0)
        by_u, by_v = np.moveaxis(_slopes(t) * t_by_uv[..., None], 1, 0)
        weights = along_v[:, :, None] * by_u[:, None, :], by_v[:, :, None] * along_u[:, None, :]
        return np.stack([self.weighted(image, cell[:, ::-1], weight) for weight in weights], axis=2)

    def _cells(self, image: IntArray, uv_px: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Cell (m, 2) of each pixel, place in it from 0 to 1, and the derivative of that by the pixel."""
        scale = _CELLS / self.size_px[image]
        place = (uv_px + 0.5) * scale
        inside = np.clip(place, 0.0, _CELLS)
        cell = np.minimum(np.floor(inside), _CELLS - 1)
        return cell.astype(np.int64), inside - cell, np.where(inside == place, scale, 0.0)

    def at(self, image: IntArray, uv_px: FloatArray) -> FloatArray:
        """The fields (m, 2), pixels, at pixels (m, 2) of images (m,)."""
        return self.weighted(image, *self.basis(image, uv_px))

    def weighted(self, image: IntArray, first: IntArray, weight: FloatArray) -> FloatArray:
        """`at`, given what `basis` returns."""
        four = np.arange(4)
        rows, columns = first[:, :1, None] + four[:, None], first[:, 1:, None] + four
        of_field = self.row[image][:, None, None]
        parts = [
            np.sum(self.coefficients_px[of_field, k, rows, columns] * weight, axis=(1, 2)) for k in (0, 1)
        ]
        return np.stack(parts, axis=1)


def _cubics(t: FloatArray) -> FloatArray:
    """The four uniform cubic B-splines (..., 4) that count in a cell, at t (...) from 0 to 1 across it."""
    s = 1 - t
    second, third = 4 - 6 * t**2 + 3 * t**3, 4 - 6 * s**2 + 3 * s**3
    return np.stack([s**3, second, third, t**3], axis=-1) / 6


def _slopes(t: FloatArray) -> FloatArray:
    """Derivatives (..., 4) of `_cubics` by t."""
    s = 1 - t
    return np.stack([-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2], axis=-1) / 2
