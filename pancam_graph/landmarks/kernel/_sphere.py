"""The sphere S^3 of unit 4-vectors (X, w): tangents, and steps along them."""

from typing import TypeAlias

import numpy as np

from pancam_graph.base.compiled import part

__all__ = ["Tangents", "by_tangents", "retracted", "tangents", "without_w"]

Tangents: TypeAlias = tuple[float, ...]
"""Basis (4, 3) of the tangent space of S^3 at a landmark, by rows."""


@part
def tangents(a0: float, a1: float, a2: float, a3: float) -> Tangents:
    """Orthonormal basis (4, 3) of the tangent space of S^3 at a unit vector, by a Householder reflection.

    The reflection takes the vector to the first axis (or its opposite); the images of the other three
    axes span the tangent space.
    """
    a0 += 1.0 if a0 >= 0 else -1.0
    s = 2.0 / (a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3)
    s1, s2, s3 = s * a1, s * a2, s * a3
    return (
        *(-s1 * a0, -s2 * a0, -s3 * a0),
        *(1.0 - s1 * a1, -s1 * a2, -s1 * a3),
        *(-s1 * a2, 1.0 - s2 * a2, -s2 * a3),
        *(-s1 * a3, -s2 * a3, 1.0 - s3 * a3),
    )


@part
def by_tangents(t: Tangents, d0: float, d1: float, d2: float, d3: float) -> tuple[float, float, float]:
    """A derivative by the tangents t, from one by (X, w)."""
    return (
        d0 * t[0] + d1 * t[3] + d2 * t[6] + d3 * t[9],
        d0 * t[1] + d1 * t[4] + d2 * t[7] + d3 * t[10],
        d0 * t[2] + d1 * t[5] + d2 * t[8] + d3 * t[11],
    )


@part
def retracted(
    t: Tangents, a0: float, a1: float, a2: float, a3: float, s0: float, s1: float, s2: float
) -> tuple[float, float, float, float]:
    """A unit vector a moved by a step s along its tangents t, and scaled to unit length again."""
    x0 = a0 + t[0] * s0 + t[1] * s1 + t[2] * s2
    x1 = a1 + t[3] * s0 + t[4] * s1 + t[5] * s2
    x2 = a2 + t[6] * s0 + t[7] * s1 + t[8] * s2
    x3 = a3 + t[9] * s0 + t[10] * s1 + t[11] * s2
    per_length = 1.0 / np.sqrt(x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3)
    return x0 * per_length, x1 * per_length, x2 * per_length, x3 * per_length


@part
def without_w(t: Tangents, b0: float, b1: float, b2: float) -> tuple[float, float, float]:
    """A derivative by the tangents t of a landmark at infinity, without its part along w."""
    part = b0 * t[9] + b1 * t[10] + b2 * t[11]
    return b0 - part * t[9], b1 - part * t[10], b2 - part * t[11]
