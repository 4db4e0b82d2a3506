"""Observations as cameras see landmarks: whitened residuals and their derivatives."""

from typing import NamedTuple

import numpy as np

from pancam_graph.base.compiled import entry, part
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks.kernel._sphere import Tangents, by_tangents, tangents, without_w

__all__ = [
    "Seen",
    "evaluate",
    "free_derivatives",
    "observe",
    "observe_ray",
    "ray_directions",
    "residual_by_ray",
    "residuals",
]


class Seen(NamedTuple):
    """Observations sorted by landmark, and the cameras that made them."""

    begin: IntArray
    """(landmarks + 1,) first observation of each landmark; the last entry is n"""
    image: IntArray
    """(n,)"""
    uv_px: FloatArray
    """(n, 2)"""
    whitening: FloatArray
    """(n, 2, 2)"""
    to_pixel: FloatArray
    """(images, 3, 3) world directions to homogeneous pixels"""
    centre_m: FloatArray
    """(images, 3)"""


@part
def observe_ray(
    to_pixel: FloatArray,
    image: int,
    y0: float,
    y1: float,
    y2: float,
    uv_px: FloatArray,
    whitening: FloatArray,
    i: int,
) -> tuple[bool, float, float, float, float, float]:
    """Project a ray y of the world into an image, and compare the pixel with observation i.

    Returns whether the ray points to the front of the camera, the whitened residual (two numbers), the pixel
    u, v and 1 / depth. For a landmark (X, w) the ray is X - w c, c being the camera's centre relative to the
    landmark's origin. The residual of a ray to the back is that of the mirrored point and means nothing.
    """
    p2 = to_pixel[image, 2, 0] * y0 + to_pixel[image, 2, 1] * y1 + to_pixel[image, 2, 2] * y2
    per_depth = 1.0 / (p2 if abs(p2) > 1e-12 else 1e-12)
    u = (to_pixel[image, 0, 0] * y0 + to_pixel[image, 0, 1] * y1 + to_pixel[image, 0, 2] * y2) * per_depth
    v = (to_pixel[image, 1, 0] * y0 + to_pixel[image, 1, 1] * y1 + to_pixel[image, 1, 2] * y2) * per_depth
    du, dv = u - uv_px[i, 0], v - uv_px[i, 1]
    r0 = whitening[i, 0, 0] * du + whitening[i, 0, 1] * dv
    r1 = whitening[i, 1, 0] * du + whitening[i, 1, 1] * dv
    return p2 > 1e-12, r0, r1, u, v, per_depth


@part
def residual_by_ray(
    to_pixel: FloatArray, image: int, u: float, v: float, scale: float, whitening: FloatArray, i: int
) -> tuple[float, float, float, float, float, float]:
    """Derivative (2, 3), by rows, of a whitened residual by the ray that `observe_ray` projects to u, v.

    `scale` is 1 / depth, times a factor for the whole derivative.
    """
    a00, a01 = scale * whitening[i, 0, 0], scale * whitening[i, 0, 1]
    a10, a11 = scale * whitening[i, 1, 0], scale * whitening[i, 1, 1]
    gu0 = to_pixel[image, 0, 0] - u * to_pixel[image, 2, 0]
    gu1 = to_pixel[image, 0, 1] - u * to_pixel[image, 2, 1]
    gu2 = to_pixel[image, 0, 2] - u * to_pixel[image, 2, 2]
    gv0 = to_pixel[image, 1, 0] - v * to_pixel[image, 2, 0]
    gv1 = to_pixel[image, 1, 1] - v * to_pixel[image, 2, 1]
    gv2 = to_pixel[image, 1, 2] - v * to_pixel[image, 2, 2]
    return (
        *(a00 * gu0 + a01 * gv0, a00 * gu1 + a01 * gv1, a00 * gu2 + a01 * gv2),
        *(a10 * gu0 + a11 * gv0, a10 * gu1 + a11 * gv1, a10 * gu2 + a11 * gv2),
    )


@part
def observe(
    seen: Seen,
    i: int,
    t: Tangents,
    x0: float,
    x1: float,
    x2: float,
    w: float,
    O0: float,
    O1: float,
    O2: float,
) -> tuple[bool, float, float, float, float, float, float, float, float]:
    """Compare the landmark (x, w) of origin O with observation i of it; t are its tangents.

    Returns whether it is in front of the camera, the whitened residual, and its derivative (2, 3) by the
    tangents.
    """
    image = seen.image[i]
    c0, c1, c2 = seen.centre_m[image, 0] - O0, seen.centre_m[image, 1] - O1, seen.centre_m[image, 2] - O2
    in_front, r0, r1, u, v, per_depth = observe_ray(
        seen.to_pixel, image, x0 - w * c0, x1 - w * c1, x2 - w * c2, seen.uv_px, seen.whitening, i
    )
    d00, d01, d02, d10, d11, d12 = residual_by_ray(seen.to_pixel, image, u, v, per_depth, seen.whitening, i)
    b00, b01, b02 = by_tangents(t, d00, d01, d02, -(d00 * c0 + d01 * c1 + d02 * c2))
    b10, b11, b12 = by_tangents(t, d10, d11, d12, -(d10 * c0 + d11 * c1 + d12 * c2))
    return in_front, r0, r1, b00, b01, b02, b10, b11, b12


@entry
def ray_directions(
    image: IntArray,
    uv_px: FloatArray,
    calibration: FloatArray,
    world_R_camera: FloatArray,
    first: int,
    last: int,
    direction: FloatArray,
) -> None:
    """Unit directions in the world of pixels (n, 2), rows first to last, to `direction` (n, 3).

    Calibrations (images, 3, 3) are upper-triangular.
    """
    for i in range(first, last):
        K, R = calibration[image[i]], world_R_camera[image[i]]
        z = 1.0 / K[2, 2]
        y = (uv_px[i, 1] - K[1, 2] * z) / K[1, 1]
        x = (uv_px[i, 0] - K[0, 1] * y - K[0, 2] * z) / K[0, 0]
        length = np.sqrt(x * x + y * y + z * z)
        for k in range(3):
            direction[i, k] = (R[k, 0] * x + R[k, 1] * y + R[k, 2] * z) / length


@entry
def evaluate(
    which: IntArray,
    seen: Seen,
    vector: FloatArray,
    origin_m: FloatArray,
    residual: FloatArray,
    b: FloatArray,
    in_front: BoolArray,
) -> None:
    """Compare the landmarks `which` with their observations.

    Writes whitened residuals (n, 2), their derivatives `b` (n, 2, 3) by the tangents, and which landmarks are
    in front of the camera (n,).
    """
    for j in which:
        x0, x1, x2, w = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
        t, O0, O1, O2 = tangents(x0, x1, x2, w), origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
        for i in range(seen.begin[j], seen.begin[j + 1]):
            in_front[i], residual[i, 0], residual[i, 1], b00, b01, b02, b10, b11, b12 = observe(
                seen, i, t, x0, x1, x2, w, O0, O1, O2
            )
            b[i, 0, 0], b[i, 0, 1], b[i, 0, 2] = b00, b01, b02
            b[i, 1, 0], b[i, 1, 1], b[i, 1, 2] = b10, b11, b12


@entry
def residuals(
    which: IntArray,
    seen: Seen,
    vector: FloatArray,
    origin_m: FloatArray,
    residual: FloatArray,
    in_front: BoolArray,
) -> None:
    """Do as `evaluate` does, without derivatives."""
    for j in which:
        x0, x1, x2, w = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
        for i in range(seen.begin[j], seen.begin[j + 1]):
            image = seen.image[i]
            y0 = x0 - w * (seen.centre_m[image, 0] - origin_m[j, 0])
            y1 = x1 - w * (seen.centre_m[image, 1] - origin_m[j, 1])
            y2 = x2 - w * (seen.centre_m[image, 2] - origin_m[j, 2])
            in_front[i], residual[i, 0], residual[i, 1], _, _, _ = observe_ray(
                seen.to_pixel, image, y0, y1, y2, seen.uv_px, seen.whitening, i
            )


@entry
def free_derivatives(which: IntArray, begin: IntArray, vector: FloatArray, b: FloatArray) -> None:
    """Remove the part along w from the derivatives (n, 2, 3) of landmarks that are held at infinity."""
    for j in which:
        if vector[j, 3] == 0:
            t = tangents(vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3])
            for i in range(begin[j], begin[j + 1]):
                for m in range(2):
                    b[i, m, 0], b[i, m, 1], b[i, m, 2] = without_w(t, b[i, m, 0], b[i, m, 1], b[i, m, 2])
