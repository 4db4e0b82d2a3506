"""The mast's chain for batches of cameras: predicted poses, misfits to given poses, and derivatives.

    world_T_camera = world_T_mast . Rz(pan) . pan_T_tilt . Ry(-tilt) . head_T_camera

"World" is whatever frame the cameras are given in: a rover's, a site's, a laboratory's.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.geometry import (
    FloatArray,
    IntArray,
    compose,
    corrected_poses,
    correction_twists,
    pan_tilt_rotation,
    so3_right_jacobian,
    twists_in_parent,
)

__all__ = ["Chain", "PosedCameras"]

Pose = tuple[FloatArray, FloatArray]
"""Rotations (..., 3, 3) and translations (..., 3)."""

_ABOUT_Z = np.array([[0.0], [0.0], [1.0], [0.0], [0.0], [0.0]])
_ABOUT_MINUS_Y = np.array([[0.0], [-1.0], [0.0], [0.0], [0.0], [0.0]])


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedCameras:
    """Given camera poses of n images."""

    rotation: FloatArray
    """(n, 3, 3) world_R_camera."""
    centre_m: FloatArray
    """(n, 3) centres in the world."""
    eye: IntArray
    """(n,) row of each image's eye."""
    pointing: IntArray
    """(n,) row of each image's pointing of the head."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The poses of the chain as one batch: mast, tilt axis, then one mount per eye."""

    rotation: FloatArray
    """(2 + eyes, 3, 3): of world_T_mast, pan_T_tilt, head_T_camera of each eye."""
    translation_m: FloatArray
    """(2 + eyes, 3): translations of the same poses."""

    @staticmethod
    def of(mast: Pose, axis: Pose, mounts: Pose) -> "Chain":
        """From world_T_mast and pan_T_tilt (3, 3), (3,) and the mounts (eyes, 3, 3), (eyes, 3)."""
        return Chain(
            rotation=np.concatenate([mast[0][None], axis[0][None], mounts[0]]),
            translation_m=np.concatenate([mast[1][None], axis[1][None], mounts[1]]),
        )

    @property
    def mast(self) -> Pose:
        """world_T_mast."""
        return self.rotation[0], self.translation_m[0]

    @property
    def axis(self) -> Pose:
        """pan_T_tilt."""
        return self.rotation[1], self.translation_m[1]

    @property
    def mounts(self) -> Pose:
        """head_T_camera of each eye."""
        return self.rotation[2:], self.translation_m[2:]

    def corrected(self, correction: FloatArray) -> "Chain":
        """Each pose turned and shifted in its own frame: correction (2 + eyes, 6), rotation first."""
        rotation, translation = corrected_poses(self.rotation, self.translation_m, correction)
        return Chain(rotation=rotation, translation_m=translation)

    def world_T_camera(self, pan_tilt_rad: FloatArray, eye: IntArray) -> Pose:
        """Camera poses of n images at pan and tilt (n, 2)."""
        return compose(*self.mast, *self._from_camera(pan_tilt_rad, eye)[-1])

    def misfit(self, cameras: PosedCameras, pan_tilt_rad: FloatArray) -> FloatArray:
        """Misfit (n, 6) of the chain to each camera at pan and tilt (n, 2).

        The rotation vector from the camera to the chain's, in the camera's frame, radians, below half a
        turn; then the shift in the world's frame, metres.
        """
        rotation, centre = self.world_T_camera(pan_tilt_rad, cameras.eye)
        turn = scipy.spatial.transform.Rotation.from_matrix(
            np.swapaxes(cameras.rotation, -1, -2) @ rotation
        ).as_rotvec()
        return np.column_stack([turn, centre - cameras.centre_m])

    def misfit_jacobian(
        self, cameras: PosedCameras, pan_tilt_rad: FloatArray, correction: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The misfit (n, 6) of the corrected chain and its derivatives.

        By the correction (n, 6, 2 + eyes, 6), and by pan and tilt (n, 6, 2).
        """
        chain = self.corrected(correction)
        misfit = chain.misfit(cameras, pan_tilt_rad)
        by_pose, by_angle = chain.camera_twists(pan_tilt_rad, cameras.eye)
        # A camera's own twist moves the rotation vector by Jr^-1, the centre as the camera stands.
        twist = np.zeros((len(misfit), 6, 6))
        twist[:, :3, :3] = np.linalg.inv(so3_right_jacobian(misfit[:, :3]))
        twist[:, 3:, 3:] = chain.world_T_camera(pan_tilt_rad, cameras.eye)[0]
        moved = correction_twists(correction)
        return misfit, np.einsum("nij,npjk,pkl->nipl", twist, by_pose, moved), twist @ by_angle

    def camera_twists(self, pan_tilt_rad: FloatArray, eye: IntArray) -> tuple[FloatArray, FloatArray]:
        """Twists of n cameras, in their own frames, rotation first.

        By the twists of each pose of the chain in its own frame (n, 2 + eyes, 6, 6), and by pan and tilt
        (n, 6, 2).
        """
        n = len(eye)
        mount, from_tilt, from_pan, from_mast = self._from_camera(pan_tilt_rad, eye)
        identity = np.broadcast_to(np.eye(6), (n, 6, 6))
        by_pose = np.zeros((n, len(self.rotation), 6, 6))
        by_pose[:, 0] = twists_in_parent(*_inverse(from_mast), identity)
        by_pose[:, 1] = twists_in_parent(*_inverse(from_tilt), identity)
        by_pose[np.arange(n), 2 + eye] = identity
        # A turn does not move its own axis, so the frame before the turn and that after it serve alike.
        pan = twists_in_parent(*_inverse(from_pan), np.broadcast_to(_ABOUT_Z, (n, 6, 1)))
        tilt = twists_in_parent(*_inverse(mount), np.broadcast_to(_ABOUT_MINUS_Y, (n, 6, 1)))
        return by_pose, np.concatenate([pan, tilt], axis=2)

    def _from_camera(self, pan_tilt_rad: FloatArray, eye: IntArray) -> tuple[Pose, Pose, Pose, Pose]:
        """head_T_camera, tilt_T_camera, pan_T_camera, mast_T_camera."""
        pan, tilt = pan_tilt_rad.T
        zero = np.zeros_like(pan)
        origin = np.zeros((len(pan), 3))
        mount = self.mounts[0][eye], self.mounts[1][eye]
        tilted = compose(pan_tilt_rotation(zero, tilt), origin, *mount)
        on_pan = compose(*self.axis, *tilted)
        return mount, tilted, on_pan, compose(pan_tilt_rotation(pan, zero), origin, *on_pan)


def _inverse(pose: Pose) -> Pose:
    back = np.swapaxes(pose[0], -1, -2)
    return back, -(back @ pose[1][..., None])[..., 0]
