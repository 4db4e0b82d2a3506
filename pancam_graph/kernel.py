"""What runs per observation, compiled: one module, so that the cache on disk is never half old.

Everything else of the package works on whole arrays or once per image, frame or stop.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np

__all__ = [
    "loss_cost",
    "loss_weight",
    "sight",
    "tangent_basis",
]

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Compile for the machine, without the interpreter's lock, and keep the result on disk."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return] # numba is untyped


NONE, HUBER, CAUCHY = 0, 1, 2
"""Kinds of losses."""


@compiled
def loss_cost(kind: int, width: float, squared: float) -> float:
    """rho of a whitened residual's squared length; rho is half of it near zero."""
    if kind == HUBER and squared > width * width:
        return width * (np.sqrt(squared) - 0.5 * width)
    if kind == CAUCHY:
        return 0.5 * width * width * np.log1p(squared / (width * width))
    return 0.5 * squared


@compiled
def loss_weight(kind: int, width: float, squared: float) -> float:
    """The weight that makes the square's gradient that of the loss."""
    if kind == HUBER and squared > width * width:
        return width / np.sqrt(squared)
    if kind == CAUCHY:
        return 1.0 / (1.0 + squared / (width * width))
    return 1.0


@compiled
def tangent_basis(vector, basis):
    """Orthonormal basis (4, 3) of the tangent space of S^3 at a unit vector, by a Householder reflection.

    The reflection takes the vector to the first axis (or its opposite); the images of the other three
    axes span the tangent space.
    """
    a0, a1, a2, a3 = vector[0], vector[1], vector[2], vector[3]
    a0 += 1.0 if a0 >= 0 else -1.0
    scale = 2.0 / (a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3)
    basis[0, 0], basis[0, 1], basis[0, 2] = -scale * a0 * a1, -scale * a0 * a2, -scale * a0 * a3
    basis[1, 0], basis[1, 1], basis[1, 2] = 1 - scale * a1 * a1, -scale * a1 * a2, -scale * a1 * a3
    basis[2, 0], basis[2, 1], basis[2, 2] = -scale * a2 * a1, 1 - scale * a2 * a2, -scale * a2 * a3
    basis[3, 0], basis[3, 1], basis[3, 2] = -scale * a3 * a1, -scale * a3 * a2, 1 - scale * a3 * a3


@compiled
def sight(to_pixel, offset, vector, uv_px, whitening, residual, d_ray):
    """Whitened residual (2,) of one observation and its derivative (2, 3) by the world ray; whether in front.

    The ray is X - w offset, the camera's centre being at `offset` from the landmark's origin. What is behind
    the camera gives the residual of the mirrored point, which means nothing.
    """
    y0 = vector[0] - vector[3] * offset[0]
    y1 = vector[1] - vector[3] * offset[1]
    y2 = vector[2] - vector[3] * offset[2]
    p2 = to_pixel[2, 0] * y0 + to_pixel[2, 1] * y1 + to_pixel[2, 2] * y2
    in_front = p2 > 1e-12
    per_depth = 1.0 / (p2 if abs(p2) > 1e-12 else 1e-12)
    u = (to_pixel[0, 0] * y0 + to_pixel[0, 1] * y1 + to_pixel[0, 2] * y2) * per_depth
    v = (to_pixel[1, 0] * y0 + to_pixel[1, 1] * y1 + to_pixel[1, 2] * y2) * per_depth
    du, dv = u - uv_px[0], v - uv_px[1]
    w00, w01, w10, w11 = whitening[0, 0], whitening[0, 1], whitening[1, 0], whitening[1, 1]
    residual[0] = w00 * du + w01 * dv
    residual[1] = w10 * du + w11 * dv
    for k in range(3):
        gu = (to_pixel[0, k] - u * to_pixel[2, k]) * per_depth
        gv = (to_pixel[1, k] - v * to_pixel[2, k]) * per_depth
        d_ray[0, k] = w00 * gu + w01 * gv
        d_ray[1, k] = w10 * gu + w11 * gv
    return in_front
