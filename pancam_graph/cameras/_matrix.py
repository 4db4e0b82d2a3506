"""Projection matrices: P to K, R, C and back (thesis eq. 2.1 to 2.11), one by one and in batches."""

import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import FloatArray

__all__ = [
    "CALIBRATION_ENTRIES",
    "decompose_projection",
    "projection_matrix",
    "projection_tangents",
    "split_projections",
]

CALIBRATION_ENTRIES = [0, 1, 0, 0, 1], [0, 1, 1, 2, 2]
"""Rows, and columns, of fx, fy, skew, cx and cy in K."""


def projection_matrix(
    calibration: FloatArray, camera_R_world: FloatArray, centre_m: FloatArray
) -> FloatArray:
    """P = K R [I | -C] (..., 3, 4), thesis eq. 2.7.

    From K (..., 3, 3), R = camera_R_world (..., 3, 3) and C (..., 3).
    """
    left = calibration @ camera_R_world
    return np.concatenate([left, -(left @ centre_m[..., None])], axis=-1)


def decompose_projection(projection: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """K with positive diagonal and K[2, 2] = 1, R = camera_R_world of determinant 1, and C of P (3, 4).

    P is defined up to a factor of either sign; the sign is chosen so that R is a rotation. Thesis
    eq. 2.8 to 2.11: C spans the null space of P; the left 3 x 3 block is K R by RQ decomposition.

    Raises CameraError for another shape, entries that are not finite, a left block of rank below 3 (a camera
    at infinity has no centre), or a zero third row.
    """
    p = float_array("projection matrix", projection, CameraError)
    if p.shape != (3, 4):
        raise CameraError(f"projection matrix: expected 3 x 4 numbers, found shape {p.shape}")
    if not np.all(np.isfinite(p)):
        raise CameraError(f"projection matrix: expected finite numbers, found {p.tolist()}")
    left = p[:, :3]
    row_norms = np.linalg.norm(left, axis=1)
    if row_norms[2] < 1e-12 * max(row_norms.max(), 1e-300):
        raise CameraError("projection matrix: expected a third row with a direction, found zeros")
    singular = np.linalg.svd(left / row_norms.clip(1e-300)[:, None], compute_uv=False)
    if singular[2] < 1e-10 * singular[0]:
        raise CameraError(
            "projection matrix: expected a left 3 x 3 block of rank 3, "
            f"found singular values {singular.tolist()} after scaling its rows"
        )
    if np.linalg.det(left) < 0:
        p = -p
    calibration, camera_R_world, centre, _ = split_projections(p[None])
    return calibration[0], camera_R_world[0], centre[0]


def split_projections(projections: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """K (n, 3, 3), R (n, 3, 3), C (n, 3) and the factor s (n,) of P = s K R [I | -C], (n, 3, 4).

    s is above 0, K[2, 2] is 1 and K[1, 1] above 0: a point with a positive depth by the third row stays in
    front. K[0, 0] has the sign of the left block's determinant, below 0 for a mirrored camera. So all four
    are smooth functions of P, except where the third row vanishes or the second is parallel to it; there they
    are not finite.

    RQ decomposition by Gram and Schmidt, from the last row upwards.
    """
    left = projections[:, :, :3]
    with np.errstate(all="ignore"):  # a matrix of no camera gives numbers that are not finite
        factor = np.linalg.norm(left[:, 2], axis=1)
        m1, m2 = left[:, 0] / factor[:, None], left[:, 1] / factor[:, None]
        r3 = left[:, 2] / factor[:, None]
        calibration = np.zeros((len(left), 3, 3))
        calibration[:, 2, 2] = 1.0
        calibration[:, 1, 2] = _dot(m2, r3)
        across = m2 - calibration[:, 1, 2, None] * r3
        across -= _dot(across, r3)[:, None] * r3  # again: the principal point may be far from 0
        calibration[:, 1, 1] = np.linalg.norm(across, axis=1)
        r2 = across / calibration[:, 1, 1, None]
        r1 = np.cross(r2, r3)
        calibration[:, 0, 0] = _dot(m1, r1)
        calibration[:, 0, 1] = _dot(m1, r2)
        calibration[:, 0, 2] = _dot(m1, r3)
        camera_R_world = np.stack([r1, r2, r3], axis=1)
        # K R C = -p4, K by substitution: a triangular system needs no pivots and raises nothing.
        y = -projections[:, :, 3] / factor[:, None]
        z2 = (y[:, 1] - calibration[:, 1, 2] * y[:, 2]) / calibration[:, 1, 1]
        z1 = (y[:, 0] - calibration[:, 0, 1] * z2 - calibration[:, 0, 2] * y[:, 2]) / calibration[:, 0, 0]
        centre = np.einsum("nij,ni->nj", camera_R_world, np.column_stack([z1, z2, y[:, 2]]))
    return calibration, camera_R_world, centre, factor


def projection_tangents(
    calibration: FloatArray, camera_R_world: FloatArray, centre_m: FloatArray, factor: FloatArray
) -> FloatArray:
    """Derivatives of the results of `split_projections` by the entries of P, row by row: (n, 12, 12).

    Rows: the camera's twist (its own frame, rotation first, then translation in metres), changes of fx, fy,
    skew, cx and cy in pixels, and the relative change of the factor. With M the left block,
    A = K^-1 dM R' / s is the sum of K^-1 dK (upper-triangular), a skew-symmetric matrix (the turn) and
    ds / s I.
    """
    n = len(calibration)
    K = calibration
    K_inverse = np.zeros((n, 3, 3))
    K_inverse[:, 0, 0], K_inverse[:, 1, 1], K_inverse[:, 2, 2] = 1 / K[:, 0, 0], 1 / K[:, 1, 1], 1.0
    K_inverse[:, 0, 1] = -K[:, 0, 1] / (K[:, 0, 0] * K[:, 1, 1])
    K_inverse[:, 1, 2] = -K[:, 1, 2] / K[:, 1, 1]
    K_inverse[:, 0, 2] = (K[:, 0, 1] * K[:, 1, 2] / K[:, 1, 1] - K[:, 0, 2]) / K[:, 0, 0]
    per_factor = K_inverse / factor[:, None, None]
    # By entry (a, b) of P: A[i, j] is K^-1[i, a] R[j, b] / s, and 0 where b is 3.
    A = np.zeros((n, 3, 3, 3, 4))
    A[..., :3] = np.einsum("nia,njb->nijab", per_factor, camera_R_world)
    out = np.empty((n, 12, 3, 4))
    out[:, 0], out[:, 1], out[:, 2] = -A[:, 2, 1], A[:, 2, 0], -A[:, 1, 0]
    homogeneous = np.column_stack([centre_m, np.ones(n)])
    out[:, 3:6] = -np.einsum("nia,nb->niab", per_factor, homogeneous)
    fx, fy, skew = (K[:, i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 1)))
    d_22, d_12 = A[:, 1, 1] - A[:, 2, 2], A[:, 0, 1] + A[:, 1, 0]
    d_13, d_23 = A[:, 0, 2] + A[:, 2, 0], A[:, 1, 2] + A[:, 2, 1]
    out[:, 6] = fx * (A[:, 0, 0] - A[:, 2, 2])
    out[:, 7] = fy * d_22
    out[:, 8] = fx * d_12 + skew * d_22
    out[:, 9] = fx * d_13 + skew * d_23
    out[:, 10] = fy * d_23
    out[:, 11] = A[:, 2, 2]
    return out.reshape(n, 12, 12)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Products (n,) of vectors (n, 3)."""
    return np.asarray(np.einsum("ni,ni->n", a, b))
