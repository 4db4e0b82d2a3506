"""Projection matrices: P to K, R, C and back (thesis eq. 2.1 to 2.11)."""

import numpy as np
from scipy.linalg import rq

from pancam_graph.errors import CameraError
from pancam_graph.geometry import FloatArray

__all__ = ["decompose_projection", "projection_matrix"]


def projection_matrix(
    calibration: FloatArray, camera_R_world: FloatArray, centre_m: FloatArray
) -> FloatArray:
    """P = K R [I | -C] (3, 4), thesis eq. 2.7, from K (3, 3), R = camera_R_world (3, 3) and C (3,)."""
    camera_P_world = np.column_stack([camera_R_world, -camera_R_world @ centre_m])
    return np.asarray(calibration @ camera_P_world)


def decompose_projection(projection: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """K with positive diagonal and K[2, 2] = 1, R = camera_R_world of determinant 1, and C of P (3, 4).

    P is defined up to a factor of either sign; the sign is chosen so that R is a rotation. Thesis
    eq. 2.8 to 2.11: C spans the null space of P; the left 3 x 3 block is K R by RQ decomposition.

    Raises CameraError for entries that are not finite, a left block of rank below 3 (a camera at
    infinity has no centre), or a zero third row.
    """
    p = np.asarray(projection, dtype=float)
    if p.shape != (3, 4) or not np.all(np.isfinite(p)):
        raise CameraError(f"projection matrix: expected 3 x 4 finite numbers, found shape {p.shape}")
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
        p, left = -p, -left
    k, camera_R_world = rq(left)
    sign = np.diag(np.sign(np.diag(k)))
    k, camera_R_world = k @ sign, sign @ camera_R_world
    centre = -np.linalg.solve(left, p[:, 3])
    return k / k[2, 2], camera_R_world, centre
