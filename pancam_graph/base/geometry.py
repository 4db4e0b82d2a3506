"""Rotations, poses and the pan-tilt chain: batches as NumPy arrays, single poses as gtsam.Pose3.

Conventions (docs/conventions.md): `a_T_b` takes coordinates in b to coordinates in a; tangents are
in GTSAM's order, rotation before translation, in the body frame; pan is positive anticlockwise
seen from above, tilt is positive upwards.
"""

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pancam_graph.base.errors import GeometryError

__all__ = [
    "HEAD_R_FORWARD_CAMERA",
    "Z_DOWN_R_Z_UP",
    "BoolArray",
    "FloatArray",
    "Int32Array",
    "IntArray",
    "axes_across",
    "block_diagonal",
    "compose",
    "corrected_poses",
    "correction_twists",
    "d_pan_tilt_rotation",
    "pan_tilt_from_rotation",
    "pan_tilt_rotation",
    "pose_arrays",
    "pose_from_wxyz",
    "rotation_from_wxyz",
    "rx",
    "ry",
    "rz",
    "skew",
    "so3_exp",
    "so3_log",
    "so3_right_jacobian",
    "so3_right_jacobian_inverse",
    "twists_in_parent",
    "wrap_angle",
    "wxyz_from_rotation",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
BoolArray = NDArray[np.bool_]

HEAD_R_FORWARD_CAMERA: FloatArray = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of a camera (x right, y down, z forward) that looks along the head's x axis."""

Z_DOWN_R_Z_UP: FloatArray = np.diag([1.0, -1.0, -1.0])
"""Rotation from frames with z down (planetary data systems) to ours with z up; its own inverse."""


def rx(angle_rad: float) -> FloatArray:
    """Rotation about x."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def ry(angle_rad: float) -> FloatArray:
    """Rotation about y; a tilt upwards by t is `ry(-t)`."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rz(angle_rad: float) -> FloatArray:
    """Rotation about z; pan."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def axes_across(directions: FloatArray) -> FloatArray:
    """Two unit vectors (n, 2, 3) across unit directions (n, 3) and across each other, right-handed."""
    least = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = np.cross(directions, least)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


def block_diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
    """Blocks (m_i, n_i) on the diagonal of a matrix (sum of m_i, sum of n_i) that is 0 elsewhere."""
    down, across = (np.cumsum([0, *(block.shape[k] for block in blocks)]) for k in (0, 1))
    out = np.zeros((int(down[-1]), int(across[-1])))
    for i, block in enumerate(blocks):
        out[down[i] : down[i + 1], across[i] : across[i + 1]] = block
    return out


def skew(v: FloatArray) -> FloatArray:
    """Cross-product matrices: (..., 3) to (..., 3, 3) with `skew(a) @ b == cross(a, b)`."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def so3_log(rotations: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3) of less than half a turn.

    Near half a turn, where the axis changes sign, the result loses as many digits as the sine of the angle.
    """
    r = rotations
    sine = 0.5 * np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], axis=-1
    )
    length = np.sqrt(np.sum(sine * sine, axis=-1))
    angle = np.arctan2(length, 0.5 * (r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2] - 1.0))
    scale = np.where(length < 1e-150, 1.0, angle / np.where(length < 1e-150, 1.0, length))
    return np.asarray(sine * scale[..., None])


def so3_right_jacobian_inverse(w: FloatArray) -> FloatArray:
    """Inverse right Jacobians of SO(3) at rotation vectors, (..., 3) to (..., 3, 3).

    `Log(R Exp(d)) = Log(R) + Jr^-1(Log R) d` to first order. Defined for |w| < pi; at pi the
    logarithm itself jumps. Source: Chirikjian, Stochastic Models, Information Theory, and Lie Groups
    2, section 10.8.6.
    """
    theta2 = np.sum(w * w, axis=-1)[..., None, None]
    k = skew(w)
    small = theta2 < 1e-8
    safe = np.where(small, 1.0, theta2)
    theta = np.sqrt(safe)
    c = np.where(small, 1 / 12 + theta2 / 720, 1 / safe - (1 + np.cos(theta)) / (2 * theta * np.sin(theta)))
    return np.asarray(np.eye(3) + 0.5 * k + c * (k @ k))


def so3_exp(w: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula; of 0, exactly I."""
    k = skew(w)
    theta = np.linalg.norm(w, axis=-1)[..., None, None]
    half = np.sinc(theta / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(theta / np.pi) * k + 0.5 * half * half * (k @ k))


def so3_right_jacobian(w: FloatArray) -> FloatArray:
    """Right Jacobians of SO(3) at rotation vectors, (..., 3) to (..., 3, 3).

    `Exp(w + d) = Exp(w) Exp(Jr(w) d)` to first order. Source: Chirikjian, Stochastic Models, Information
    Theory, and Lie Groups 2, section 10.8.6.
    """
    k = skew(w)
    theta2 = np.sum(w * w, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    half = np.sinc(theta / (2 * np.pi))
    small = theta2 < 1e-4  # near 0 the formula subtracts nearly equal numbers
    safe = np.where(small, 1.0, theta)
    c = np.where(small, 1 / 6 - theta2 / 120 + theta2**2 / 5040, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) - 0.5 * half * half * k + c * (k @ k))


def corrected_poses(
    a_R_b: FloatArray, a_t_b: FloatArray, correction: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses (..., 3, 3), (..., 3) turned and shifted in their own frames by corrections (..., 6).

    A correction is a rotation vector w, radians, and a shift s, metres: `a_T_b * (Exp(w), s)`. Rotation and
    shift are independent of each other, unlike in the exponential of Pose3: s is how far the origin of b
    moves, however b turns. A correction of 0 changes no bit.
    """
    if not correction.any():
        shape = np.broadcast_shapes(a_t_b.shape, (*correction.shape[:-1], 3))
        return np.broadcast_to(a_R_b, (*shape, 3)).copy(), np.broadcast_to(a_t_b, shape).copy()
    turn, shift = so3_exp(correction[..., :3]), correction[..., 3:]
    return compose(a_R_b, a_t_b, turn, shift)


def correction_twists(correction: FloatArray) -> FloatArray:
    """Body-frame twists (..., 6, 6), rotation first, of a corrected pose by its correction (..., 6)."""
    if not correction.any():
        return np.broadcast_to(np.eye(6), (*correction.shape, 6)).copy()
    w = correction[..., :3]
    out = np.zeros((*correction.shape, 6))
    out[..., :3, :3] = so3_right_jacobian(w)
    out[..., 3:, 3:] = np.swapaxes(so3_exp(w), -1, -2)
    return out


def twists_in_parent(a_R_b: FloatArray, a_t_b: FloatArray, twists: FloatArray) -> FloatArray:
    """Twists (..., 6, m) of a that move b as its own `twists` do; poses of b (..., 3, 3), (..., 3)."""
    turn = a_R_b @ twists[..., :3, :]
    return np.concatenate([turn, a_R_b @ twists[..., 3:, :] + skew(a_t_b) @ turn], axis=-2)


def wrap_angle(angle_rad: ArrayLike) -> FloatArray:
    """Angles to [-pi, pi)."""
    wrapped = (np.asarray(angle_rad, dtype=float) + np.pi) % (2 * np.pi) - np.pi
    # For an angle just below -pi the remainder is rounded up to a whole turn.
    return np.where(wrapped >= np.pi, -np.pi, wrapped)


def rotation_from_wxyz(wxyz: Sequence[float] | FloatArray) -> FloatArray:
    """Rotation matrix of a quaternion (w, x, y, z), which need not be of unit length.

    Raises GeometryError for a quaternion of norm 0 or with a component that is not finite.
    """
    q = np.asarray(wxyz, dtype=float)
    norm = float(np.linalg.norm(q))
    if q.shape != (4,) or not np.isfinite(norm) or norm < 1e-12:
        raise GeometryError(f"expected a quaternion of 4 finite numbers of norm above 0, found {q.tolist()}")
    w, x, y, z = (float(c) for c in q / norm)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def wxyz_from_rotation(rotation: FloatArray) -> FloatArray:
    """Unit quaternion (w, x, y, z) of a rotation matrix; its first component that is not 0 is positive."""
    # SciPy's rotations load its constants, which take a twentieth of a short run.
    q: Any = gtsam.Rot3(rotation).toQuaternion()  # GTSAM's stubs do not know its class
    wxyz: FloatArray = np.array([q.w(), q.x(), q.y(), q.z()])
    wxyz /= np.linalg.norm(wxyz)
    return np.where(wxyz[np.flatnonzero(wxyz)[0]] > 0, wxyz, -wxyz)


def pose_from_wxyz(wxyz: Sequence[float], translation_m: Sequence[float]) -> gtsam.Pose3:
    """Pose from a quaternion (w, x, y, z) and a translation.

    Raises GeometryError as `rotation_from_wxyz` does.
    """
    return gtsam.Pose3(gtsam.Rot3(rotation_from_wxyz(wxyz)), np.asarray(translation_m, dtype=float))


def pose_arrays(poses: Sequence[gtsam.Pose3]) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) and translations (n, 3) of n poses."""
    rotations = np.array([p.rotation().matrix() for p in poses]).reshape(-1, 3, 3)
    return rotations, np.array([p.translation() for p in poses]).reshape(-1, 3)


def compose(
    a_R_b: FloatArray, a_t_b: FloatArray, b_R_c: FloatArray, b_t_c: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compose batches of poses (..., 3, 3), (..., 3), broadcast: `a_T_b * b_T_c`."""
    return a_R_b @ b_R_c, (a_R_b @ b_t_c[..., None])[..., 0] + a_t_b


def pan_tilt_rotation(pan_rad: ArrayLike, tilt_rad: ArrayLike) -> FloatArray:
    """Rotation of the head, `Rz(pan) Ry(-tilt)`, for scalars or arrays: (...,) to (..., 3, 3)."""
    pan, tilt = np.asarray(pan_rad, dtype=float), np.asarray(tilt_rad, dtype=float)
    cp, sp, ct, st = np.cos(pan), np.sin(pan), np.cos(tilt), np.sin(tilt)
    out = np.empty((*np.broadcast(pan, tilt).shape, 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cp * ct, -sp, -cp * st
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = sp * ct, cp, -sp * st
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = st, 0.0, ct
    return out


def d_pan_tilt_rotation(tilt_rad: float) -> FloatArray:
    """Derivative of the head's rotation by pan and tilt, as body-frame rotation vectors, (3, 2).

    `Rz(pan + dp) Ry(-(tilt + dt)) = Rz(pan) Ry(-tilt) Exp(J [dp, dt])` to first order.
    """
    return np.array([[np.sin(tilt_rad), 0.0], [0.0, -1.0], [np.cos(tilt_rad), 0.0]])


def pan_tilt_from_rotation(mast_R_head: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pan and tilt (...,) of the head's x axis, (..., 3, 3); a twist about it is left out.

    Tilt is in [-pi/2, pi/2]. Looking straight up or down, where the x axis has no pan, the y axis gives
    it as if there were no twist.
    """
    x, y = mast_R_head[..., :, 0], mast_R_head[..., :, 1]
    level = np.hypot(x[..., 0], x[..., 1])
    pan = np.where(level > 1e-9, np.arctan2(x[..., 1], x[..., 0]), np.arctan2(-y[..., 0], y[..., 1]))
    return pan, np.arctan2(x[..., 2], level)
