"""Observations as cameras see landmarks: whitened residuals and their derivatives."""

from typing import NamedTuple, TypeAlias

import numpy as np

from pancam_graph.base.compiled import uncounted
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.cameras import Distorted, distort
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._sphere import Tangents, by_tangents, tangents, without_w

__all__ = [
    "Cameras",
    "Matrix",
    "Seen",
    "Three",
    "evaluate",
    "free_derivatives",
    "lines_of_sight",
    "observe",
    "observe_ray",
    "residual_by_ray",
    "residuals",
]

_NEWTON_STEPS = 50
_FOUND = 1e-13
"""Step of Newton's method, radians, that ends the search for a line of sight."""
_SEEN_AGAIN = 1e-10
"""Largest distance, normalised, of a pixel from where its own line of sight is seen."""


Three: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[Three, Three, Three]
"""A matrix (3, 3) by rows."""


class Cameras(NamedTuple):
    """The cameras of all images."""

    to_pixel: FloatArray
    """(images, 3, 3) K camera_R_world: world directions to homogeneous pixels, without distortion"""
    centre_m: FloatArray
    """(images, 3) in the world"""
    calibration: FloatArray
    """(images, 3, 3) K, upper-triangular"""
    world_R_camera: FloatArray
    """(images, 3, 3)"""
    lens: IntArray
    """(images,) row of each image's lens in the two tables below; -1: it has no distortion"""
    lens_kind: IntArray
    """(lenses,) model of each lens"""
    lens_parameters: FloatArray
    """(lenses, width) its numbers"""


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
    cameras: Cameras


@uncounted.merged
def _distort_ray(cameras: Cameras, image: int, y0: float, y1: float, y2: float, w: float) -> Distorted:
    """A ray of the world in a camera's frame, after its distortion; see `cameras.Distortion`."""
    R, lens = cameras.world_R_camera, cameras.lens[image]
    d0 = R[image, 0, 0] * y0 + R[image, 1, 0] * y1 + R[image, 2, 0] * y2
    d1 = R[image, 0, 1] * y0 + R[image, 1, 1] * y1 + R[image, 2, 1] * y2
    d2 = R[image, 0, 2] * y0 + R[image, 1, 2] * y1 + R[image, 2, 2] * y2
    return distort(cameras.lens_kind[lens], cameras.lens_parameters, lens, d0, d1, d2, w)


@uncounted.merged
def _homogeneous_pixel(
    cameras: Cameras, image: int, y0: float, y1: float, y2: float, w: float
) -> tuple[bool, float, float, float]:
    """Whether a ray is in the domain of a camera that has a distortion, and its homogeneous pixel."""
    within, (q0, q1, q2), _, _ = _distort_ray(cameras, image, y0, y1, y2, w)
    K = cameras.calibration
    return (
        within,
        K[image, 0, 0] * q0 + K[image, 0, 1] * q1 + K[image, 0, 2] * q2,
        K[image, 1, 1] * q1 + K[image, 1, 2] * q2,
        K[image, 2, 2] * q2,
    )


@uncounted.merged
def observe_ray(
    cameras: Cameras,
    image: int,
    y0: float,
    y1: float,
    y2: float,
    w: float,
    uv_px: FloatArray,
    whitening: FloatArray,
    i: int,
) -> tuple[bool, float, float, float, float, float]:
    """Project a ray (y, w) of the world into an image, and compare the pixel with observation i.

    Returns whether the ray is in front of the camera and in the domain of its lens, the whitened residual
    (two numbers), the pixel u, v and 1 / depth. For a landmark (X, w) the ray is X - w c, c being the
    camera's centre relative to the landmark's origin. The residual of another ray means nothing: that of one
    to the back of a pinhole is the residual of the mirrored point.
    """
    if cameras.lens[image] < 0:
        to_pixel = cameras.to_pixel
        p0 = to_pixel[image, 0, 0] * y0 + to_pixel[image, 0, 1] * y1 + to_pixel[image, 0, 2] * y2
        p1 = to_pixel[image, 1, 0] * y0 + to_pixel[image, 1, 1] * y1 + to_pixel[image, 1, 2] * y2
        p2 = to_pixel[image, 2, 0] * y0 + to_pixel[image, 2, 1] * y1 + to_pixel[image, 2, 2] * y2
        within = True
    else:
        within, p0, p1, p2 = _homogeneous_pixel(cameras, image, y0, y1, y2, w)
    per_depth = 1.0 / (p2 if abs(p2) > 1e-12 else 1e-12)
    u, v = p0 * per_depth, p1 * per_depth
    du, dv = u - uv_px[i, 0], v - uv_px[i, 1]
    r0 = whitening[i, 0, 0] * du + whitening[i, 0, 1] * dv
    r1 = whitening[i, 1, 0] * du + whitening[i, 1, 1] * dv
    return within and p2 > 1e-12, r0, r1, u, v, per_depth


@uncounted.merged
def residual_by_ray(
    cameras: Cameras,
    image: int,
    y0: float,
    y1: float,
    y2: float,
    w: float,
    u: float,
    v: float,
    scale: float,
    whitening: FloatArray,
    i: int,
) -> tuple[float, float, float, float, float, float, float, float]:
    """Derivative of a whitened residual by the ray (y, w) that `observe_ray` projects to u, v.

    By y (2, 3), by rows, and then by w (2,) with y held: 0 unless the camera's pupil moves. `scale` is
    1 / depth, times a factor for the whole derivative.
    """
    a00, a01 = scale * whitening[i, 0, 0], scale * whitening[i, 0, 1]
    a10, a11 = scale * whitening[i, 1, 0], scale * whitening[i, 1, 1]
    if cameras.lens[image] >= 0:
        return _by_ray_of_lens(cameras, image, y0, y1, y2, w, u, v, a00, a01, a10, a11)
    to_pixel = cameras.to_pixel
    gu0 = to_pixel[image, 0, 0] - u * to_pixel[image, 2, 0]
    gu1 = to_pixel[image, 0, 1] - u * to_pixel[image, 2, 1]
    gu2 = to_pixel[image, 0, 2] - u * to_pixel[image, 2, 2]
    gv0 = to_pixel[image, 1, 0] - v * to_pixel[image, 2, 0]
    gv1 = to_pixel[image, 1, 1] - v * to_pixel[image, 2, 1]
    gv2 = to_pixel[image, 1, 2] - v * to_pixel[image, 2, 2]
    return (
        *(a00 * gu0 + a01 * gv0, a00 * gu1 + a01 * gv1, a00 * gu2 + a01 * gv2),
        *(a10 * gu0 + a11 * gv0, a10 * gu1 + a11 * gv1, a10 * gu2 + a11 * gv2),
        *(0.0, 0.0),
    )


@uncounted.merged
def _by_ray_of_lens(
    cameras: Cameras,
    image: int,
    y0: float,
    y1: float,
    y2: float,
    w: float,
    u: float,
    v: float,
    a00: float,
    a01: float,
    a10: float,
    a11: float,
) -> tuple[float, float, float, float, float, float, float, float]:
    """`residual_by_ray` for a camera that has a distortion; a (2, 2) is the whitening, times the scale."""
    _, _, by_ray, by_w = _distort_ray(cameras, image, y0, y1, y2, w)
    K, R = cameras.calibration, cameras.world_R_camera
    d00, d01, d02, w0 = _through(K, R, image, u, v, a00, a01, by_ray, by_w)
    d10, d11, d12, w1 = _through(K, R, image, u, v, a10, a11, by_ray, by_w)
    return d00, d01, d02, d10, d11, d12, w0, w1


@uncounted.merged
def _through(
    K: FloatArray,
    R: FloatArray,
    image: int,
    u: float,
    v: float,
    a: float,
    b: float,
    by_ray: Matrix,
    by_w: Three,
) -> tuple[float, float, float, float]:
    """Derivative of a u + b v, times the depth, by the ray in the world (3) and by its w."""
    k22 = K[image, 2, 2]
    g0 = a * K[image, 0, 0]
    g1 = a * K[image, 0, 1] + b * K[image, 1, 1]
    g2 = a * (K[image, 0, 2] - u * k22) + b * (K[image, 1, 2] - v * k22)
    h0 = g0 * by_ray[0][0] + g1 * by_ray[1][0] + g2 * by_ray[2][0]
    h1 = g0 * by_ray[0][1] + g1 * by_ray[1][1] + g2 * by_ray[2][1]
    h2 = g0 * by_ray[0][2] + g1 * by_ray[1][2] + g2 * by_ray[2][2]
    return (
        R[image, 0, 0] * h0 + R[image, 0, 1] * h1 + R[image, 0, 2] * h2,
        R[image, 1, 0] * h0 + R[image, 1, 1] * h1 + R[image, 1, 2] * h2,
        R[image, 2, 0] * h0 + R[image, 2, 1] * h1 + R[image, 2, 2] * h2,
        g0 * by_w[0] + g1 * by_w[1] + g2 * by_w[2],
    )


@uncounted.merged
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
    image, cameras = seen.image[i], seen.cameras
    centre_m = cameras.centre_m
    c0, c1, c2 = centre_m[image, 0] - O0, centre_m[image, 1] - O1, centre_m[image, 2] - O2
    y0, y1, y2 = x0 - w * c0, x1 - w * c1, x2 - w * c2
    in_front, r0, r1, u, v, per_depth = observe_ray(
        cameras, image, y0, y1, y2, w, seen.uv_px, seen.whitening, i
    )
    d00, d01, d02, d10, d11, d12, w0, w1 = residual_by_ray(
        cameras, image, y0, y1, y2, w, u, v, per_depth, seen.whitening, i
    )
    b00, b01, b02 = by_tangents(t, d00, d01, d02, w0 - (d00 * c0 + d01 * c1 + d02 * c2))
    b10, b11, b12 = by_tangents(t, d10, d11, d12, w1 - (d10 * c0 + d11 * c1 + d12 * c2))
    return in_front, r0, r1, b00, b01, b02, b10, b11, b12


@uncounted.part
def _seen_at(kind: int, p: FloatArray, lens: int, x: float, y: float) -> tuple[bool, Three, Three]:
    """Whether a lens sees anything at the distorted normalised coordinates x, y; its direction; its origin.

    The line of sight is the origin, metres, plus any length of the unit direction, in the camera's own frame.
    Newton's method on the sphere of directions: by the derivative, the least change of direction that brings
    the pixel to x, y. The least change that makes up for a unit of w is the origin.
    """
    per_length = 1.0 / np.sqrt(x * x + y * y + 1.0)
    d0, d1, d2 = x * per_length, y * per_length, per_length
    s0, s1, s2, u, v = 0.0, 0.0, 0.0, 0.0, 0.0
    for _ in range(_NEWTON_STEPS):
        within, q, by_ray, by_w = distort(kind, p, lens, d0, d1, d2, 0.0)
        within = within and q[2] > 1e-12
        if not within:
            break
        # Rows of the derivative of the normalised coordinates by the direction; they are orthogonal to it.
        per_depth = 1.0 / q[2]
        u, v = q[0] * per_depth, q[1] * per_depth
        a0, b0 = (by_ray[0][0] - u * by_ray[2][0]) * per_depth, (by_ray[1][0] - v * by_ray[2][0]) * per_depth
        a1, b1 = (by_ray[0][1] - u * by_ray[2][1]) * per_depth, (by_ray[1][1] - v * by_ray[2][1]) * per_depth
        a2, b2 = (by_ray[0][2] - u * by_ray[2][2]) * per_depth, (by_ray[1][2] - v * by_ray[2][2]) * per_depth
        aa, ab = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2
        bb = b0 * b0 + b1 * b1 + b2 * b2
        det = aa * bb - ab * ab
        if not det > 0.0:
            within = False
            break
        r, s = x - u, y - v
        at_a, at_b = (bb * r - ab * s) / det, (aa * s - ab * r) / det
        m0, m1, m2 = at_a * a0 + at_b * b0, at_a * a1 + at_b * b1, at_a * a2 + at_b * b2
        r, s = (u * by_w[2] - by_w[0]) * per_depth, (v * by_w[2] - by_w[1]) * per_depth
        at_a, at_b = (bb * r - ab * s) / det, (aa * s - ab * r) / det
        s0, s1, s2 = at_a * a0 + at_b * b0, at_a * a1 + at_b * b1, at_a * a2 + at_b * b2
        length = np.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
        if length < _FOUND:
            break
        share = min(1.0, 0.3 / length)
        d0, d1, d2 = d0 + share * m0, d1 + share * m1, d2 + share * m2
        per_length = 1.0 / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        d0, d1, d2 = d0 * per_length, d1 * per_length, d2 * per_length
    within = within and (x - u) * (x - u) + (y - v) * (y - v) < _SEEN_AGAIN * _SEEN_AGAIN
    return within, (d0, d1, d2), (s0, s1, s2)


@entry
def lines_of_sight(
    image: IntArray,
    uv_px: FloatArray,
    cameras: Cameras,
    first: int,
    last: int,
    centre_m: FloatArray,
    direction: FloatArray,
    seen: BoolArray,
) -> None:
    """Lines of sight in the world of pixels (n, 2), rows first to last: where they begin, unit directions.

    Writes `centre_m` and `direction` (n, 3), and whether there is such a line, `seen` (n,). A pixel outside
    the domain of its lens gets the line of a pinhole.
    """
    for i in range(first, last):
        K, R = cameras.calibration[image[i]], cameras.world_R_camera[image[i]]
        lens = cameras.lens[image[i]]
        z = 1.0 / K[2, 2]
        y = (uv_px[i, 1] - K[1, 2] * z) / K[1, 1]
        x = (uv_px[i, 0] - K[0, 1] * y - K[0, 2] * z) / K[0, 0]
        length = np.sqrt(x * x + y * y + z * z)
        seen[i] = True
        for k in range(3):
            centre_m[i, k] = cameras.centre_m[image[i], k]
        if lens >= 0:
            found, d, origin = _seen_at(cameras.lens_kind[lens], cameras.lens_parameters, lens, x / z, y / z)
            seen[i] = found
            if found:
                x, y, z, length = d[0], d[1], d[2], 1.0
                for k in range(3):
                    centre_m[i, k] += R[k, 0] * origin[0] + R[k, 1] * origin[1] + R[k, 2] * origin[2]
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
    cameras, centre_m = seen.cameras, seen.cameras.centre_m
    for j in which:
        x0, x1, x2, w = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
        for i in range(seen.begin[j], seen.begin[j + 1]):
            image = seen.image[i]
            y0 = x0 - w * (centre_m[image, 0] - origin_m[j, 0])
            y1 = x1 - w * (centre_m[image, 1] - origin_m[j, 1])
            y2 = x2 - w * (centre_m[image, 2] - origin_m[j, 2])
            in_front[i], residual[i, 0], residual[i, 1], _, _, _ = observe_ray(
                cameras, image, y0, y1, y2, w, seen.uv_px, seen.whitening, i
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
