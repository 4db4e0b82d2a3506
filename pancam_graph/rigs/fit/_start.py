"""A first chain for the fit, where no mast or no mounts are given: closed forms, applied in turns."""

from itertools import permutations, product

import numpy as np

from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, pan_tilt_rotation
from pancam_graph.rigs._chain import Chain, Pose, PosedCameras

__all__ = ["first_chain"]

_TURNS = 30
_NEAR = 0.05
"""Mean squared chordal distance of rotations at which a start is good enough: 0.2 rad."""


def first_chain(
    cameras: PosedCameras,
    pan_tilt_rad: FloatArray,
    axis: Pose,
    *,
    mast: Pose | None,
    mounts: Pose | None,
    n_eyes: int,
) -> Chain:
    """The chain with a given tilt axis whose mast and mounts, where not given, fit the cameras.

    Rotations minimise the chordal distance, mast and mounts in turns, from cameras that look forwards or, if
    that fit is bad, along and across any other axis of the head. Centres follow linearly; where they do not
    determine a translation, the mast is at the mean of the cameras and the mounts are at the head's origin.
    """
    zero = np.zeros(len(pan_tilt_rad))
    pan_R = pan_tilt_rotation(pan_tilt_rad[:, 0], zero)
    head_R = pan_R @ axis[0] @ pan_tilt_rotation(zero, pan_tilt_rad[:, 1])
    mast_R, mount_R = _rotations(
        cameras, head_R, None if mast is None else mast[0], None if mounts is None else mounts[0], n_eyes
    )
    # centre - arm = mast_t + lever @ mount_t
    arm = (mast_R @ pan_R @ axis[1][:, None])[..., 0]
    lever = mast_R @ head_R
    rest = cameras.centre_m - arm
    if mounts is not None:
        mount_t = mounts[1]
        along = (lever @ mount_t[cameras.eye][..., None])[..., 0]
        mast_t = (rest - along).mean(axis=0) if mast is None else mast[1]
    elif mast is not None:
        mast_t = mast[1]
        seen = np.swapaxes(lever, -1, -2) @ (rest - mast_t)[..., None]
        mount_t = _sums(seen[..., 0], cameras, n_eyes) / np.bincount(cameras.eye, minlength=n_eyes)[:, None]
    else:
        middle = rest.mean(axis=0)
        design = np.zeros((len(rest), 3, 1 + n_eyes, 3))
        design[:, :, 0] = np.eye(3)
        design[np.arange(len(rest)), :, 1 + cameras.eye] = lever
        centres = np.linalg.lstsq(design.reshape(3 * len(rest), -1), (rest - middle).ravel(), rcond=1e-9)[0]
        mast_t, mount_t = middle + centres[:3], centres[3:].reshape(n_eyes, 3)
    return Chain.of((mast_R, mast_t), axis, (mount_R, mount_t))


def _rotations(
    cameras: PosedCameras,
    head_R: FloatArray,
    mast_R: FloatArray | None,
    mount_R: FloatArray | None,
    n_eyes: int,
) -> tuple[FloatArray, FloatArray]:
    if mast_R is not None and mount_R is not None:
        return mast_R, mount_R
    if mast_R is not None:
        return mast_R, _mounts(cameras, head_R, mast_R, n_eyes)
    if mount_R is not None:
        return _mast(cameras, head_R, mount_R), mount_R
    best, least = (np.eye(3), np.broadcast_to(np.eye(3), (n_eyes, 3, 3))), np.inf
    for turn in _quarter_turns():
        mounts: FloatArray = np.broadcast_to(turn @ HEAD_R_FORWARD_CAMERA, (n_eyes, 3, 3))
        mast = _mast(cameras, head_R, mounts)
        for _ in range(_TURNS):
            mounts = _mounts(cameras, head_R, mast, n_eyes)
            mast = _mast(cameras, head_R, mounts)
        apart = cameras.rotation - mast @ head_R @ mounts[cameras.eye]
        distance = float(np.mean(np.sum(apart**2, axis=(1, 2))))
        if distance < 0.5 * least:
            best, least = (mast, mounts), distance
        if least < _NEAR:
            break
    return best


def _mast(cameras: PosedCameras, head_R: FloatArray, mount_R: FloatArray) -> FloatArray:
    seen = cameras.rotation @ np.swapaxes(head_R @ mount_R[cameras.eye], -1, -2)
    return _nearest_rotations(seen.sum(axis=0))


def _mounts(cameras: PosedCameras, head_R: FloatArray, mast_R: FloatArray, n_eyes: int) -> FloatArray:
    return _nearest_rotations(_sums(np.swapaxes(mast_R @ head_R, -1, -2) @ cameras.rotation, cameras, n_eyes))


def _sums(per_camera: FloatArray, cameras: PosedCameras, n_eyes: int) -> FloatArray:
    """Sums (eyes, ...) over the cameras (n, ...) of each eye."""
    out = np.zeros((n_eyes, *per_camera.shape[1:]))
    np.add.at(out, cameras.eye, per_camera)
    return out


def _nearest_rotations(matrices: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) nearest to matrices, in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrices)
    u[..., :, 2] *= np.linalg.det(u @ vt)[..., None]
    return np.asarray(u @ vt)


def _quarter_turns() -> list[FloatArray]:
    """The 24 rotations that take axes to axes, the identity first."""
    turns = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[np.arange(3), order] = signs
            if np.linalg.det(turn) > 0:
                turns.append(turn)
    return turns
