"""The turn of a camera between two pictures, and its focal length, from two points that both show.

Source: Brown, Hartley and Nister, Minimal solutions for panoramic stitching, CVPR 2007, the two-point
solution.
"""

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray

__all__ = ["d_directions", "directions", "focal_scales", "turns_of"]

_PARALLEL = 1e-12
_REAL = 1e-6


def directions(plane: FloatArray, scale: FloatArray | float) -> FloatArray:
    """Unit directions (..., 3) of points (..., 2) of the plane z = 1 by a camera's told focal length.

    `scale` is the real focal length over the told one, of each point or of all.
    """
    depth = np.broadcast_to(np.asarray(scale, dtype=float), plane.shape[:-1])
    rays = np.concatenate([plane, depth[..., None]], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def d_directions(rays: FloatArray, plane: FloatArray, scale: FloatArray | float) -> FloatArray:
    """Derivatives (n, 3) of `directions`, which are the `rays` (n, 3), by the logarithm of the scale."""
    along = np.asarray(scale / np.sqrt(np.einsum("ni,ni->n", plane, plane) + scale**2))
    return np.asarray(along[:, None] * (np.array([0.0, 0.0, 1.0]) - rays * rays[:, 2:]))


def focal_scales(a: FloatArray, b: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Focal lengths with which two points stand equally far apart in both pictures.

    `a`, `b` are (n, 2, 2): two points of the plane z = 1 by the told focal length, seen in each picture.
    Returns up to three focal lengths (n, 3) over the told one, and which of them are real and positive.

    The cosine of the angle between points x, y at a focal length f is (x y + w) / sqrt((x x + w) (y y + w))
    with w = f^2. Both pictures' squared and set equal, the fourth powers of w drop out.
    """
    (in_a, xa, ya), (in_b, xb, yb) = (
        ((p[:, 0] * p[:, 1]).sum(1), (p[:, 0] ** 2).sum(1), (p[:, 1] ** 2).sum(1)) for p in (a, b)
    )

    def side(inner: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """Coefficients of (inner + w)^2 (x + w) (y + w), from w^0 to w^3."""
        return np.stack(
            [
                inner**2 * x * y,
                2 * inner * x * y + inner**2 * (x + y),
                x * y + 2 * inner * (x + y) + inner**2,
                x + y + 2 * inner,
            ],
            axis=1,
        )

    cubic = side(in_a, xb, yb) - side(in_b, xa, ya)
    lead = np.where(np.abs(cubic[:, 3]) < _PARALLEL, _PARALLEL, cubic[:, 3])
    companion = np.zeros((len(a), 3, 3))
    companion[:, 1, 0] = companion[:, 2, 1] = 1.0
    companion[:, :, 2] = -cubic[:, :3] / lead[:, None]
    w = np.linalg.eigvals(companion)
    real = (np.abs(w.imag) <= _REAL * np.abs(w)) & (w.real > 0)
    # Squares lose the sign of the cosine.
    real &= (in_a[:, None] + w.real) * (in_b[:, None] + w.real) > 0
    return np.sqrt(np.where(real, w.real, 1.0)), real


def turns_of(a: FloatArray, b: FloatArray) -> FloatArray:
    """Rotations `b_R_a` (n, 3, 3) that take two unit directions a (n, 2, 3) to b (n, 2, 3).

    Where the angles between the two differ, the bisector and the plane of both are taken over. Directions
    that coincide give what is no rotation about them, but is one.
    """

    def axes(two: FloatArray) -> FloatArray:
        middle = two[:, 0] + two[:, 1]
        normal = np.cross(two[:, 0], two[:, 1])
        normal = normal + _PARALLEL * np.array([1.0, 0.3, 0.1])
        middle = middle / np.linalg.norm(middle, axis=1, keepdims=True)
        normal = normal - middle * np.einsum("ni,ni->n", middle, normal)[:, None]
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return np.stack([middle, normal, np.cross(middle, normal)], axis=2)

    return np.asarray(axes(b) @ np.swapaxes(axes(a), 1, 2))
