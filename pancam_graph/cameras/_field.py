"""A smooth distortion field: what an eye's images have beside its lens, as a bicubic B-spline over them.

The field is added to where the camera model sees a point: pixel = model + field. It is evaluated at the pixel
as measured, so it is linear in its coefficients, whatever the cameras are.

A field has no affine part: shifts, stretches and shears of the image are the principal point's, the focal
lengths', the skew's and the mount's, which have numbers of their own. What is free and what is drawn at
random has none (`without_affine`, `field_covariance`); coefficients that somebody states may have one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = [
    "FIELD_COEFFICIENTS",
    "FIELD_PER_COEFFICIENT",
    "FIELD_SHAPE",
    "Fields",
    "field_covariance",
    "without_affine",
]

_CELLS = 4
"""Cells of the spline along each side of an image."""
FIELD_SHAPE = (2, _CELLS + 3, _CELLS + 3)
"""Coefficients of a field: those of u, then those of v, each by rows of the image and along them."""
FIELD_COEFFICIENTS = int(np.prod(FIELD_SHAPE))
FIELD_PER_COEFFICIENT = 0.34899698800160045
"""Standard deviation of a field at a pixel (mean square over the image) whose coefficients are independent
and have a standard deviation of 1, without its affine part."""
_AFFINE_LEFT = 1e-3
"""Standard deviation of the affine part of a field that is free, as a share of that of the rest: none, but
for a covariance that can be inverted."""


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


def gram_along_side() -> FloatArray:
    """(7, 7) mean over a side of the image of the products of each two of its splines."""
    t, weight = np.polynomial.legendre.leggauss(4)  # exact for products of cubics
    values = np.zeros((_CELLS, len(t), FIELD_SHAPE[1]))
    for cell in range(_CELLS):
        values[cell, :, cell : cell + 4] = _cubics((t + 1) / 2)
    return np.asarray(np.einsum("k,cki,ckj->ij", weight / 2 / _CELLS, values, values))


@cache
def _affine() -> FloatArray:
    """(49, 3) orthonormal: what coefficients of one component must be at right angles to.

    The field that they make then has no shift and no slope along either side, in the least squares over the
    image.
    """
    n, gram = FIELD_SHAPE[1], gram_along_side()
    # Splines whose coefficients are 1, or rise evenly, are 1 and rise evenly.
    level, rising = gram @ np.ones(n), gram @ (np.arange(n) - (n - 1) / 2)
    parts = [np.kron(level, level), np.kron(level, rising), np.kron(rising, level)]
    return np.asarray(np.linalg.qr(np.stack(parts, axis=1))[0])


@cache
def _free() -> FloatArray:
    """(98, 98) projection of coefficients onto those without an affine part."""
    one = np.eye(len(_affine())) - _affine() @ _affine().T
    return np.asarray(np.kron(np.eye(FIELD_SHAPE[0]), one))


def without_affine(coefficients_px: FloatArray) -> FloatArray:
    """Fields (..., *FIELD_SHAPE) without their affine parts: the nearest coefficients that have none."""
    flat = coefficients_px.reshape(-1, FIELD_COEFFICIENTS) @ _free()
    return np.asarray(flat.reshape(coefficients_px.shape))


def field_covariance(sigma_px: float) -> FloatArray:
    """Covariance (98, 98) of the coefficients of a field, `sigma_px` at a pixel, without an affine part."""
    free = _free()
    unit = free + _AFFINE_LEFT**2 * (np.eye(len(free)) - free)
    return np.asarray((sigma_px / FIELD_PER_COEFFICIENT) ** 2 * unit)
