"""Eyes on a rover's mast: from camera models of documents and labels, and from design values."""

from collections.abc import Callable

import gtsam
import numpy as np

from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, rz
from pancam_graph.cameras import CAHV, Pinhole
from pancam_graph.rigs._mast import MastKinematics
from pancam_graph.rigs._rig import Eye, Rig
from pancam_graph.rigs._uncertainty import RigUncertainty
from pancam_graph.rigs._z_down import camera_z_up

__all__ = ["design_eye", "document_eye", "label_eye", "mast_rig"]


def document_eye(name: str, mast: MastKinematics, model: CAHV) -> Eye:
    """An eye whose vectors are in the head frame of the mast's documents (RSM_HEAD, RSM_EL), z down."""
    return Eye.from_head_model(name, model.transformed(mast.head_T_document()))


def label_eye(
    name: str, mast: MastKinematics, model: CAHV, *, azimuth_rad: float, elevation_rad: float
) -> Eye:
    """An eye whose vectors are in the rover frame, z down, while the joints read these angles."""
    head_T_rover = mast.rover_T_head(azimuth_rad, elevation_rad).inverse()
    return Eye.from_head_model(name, camera_z_up(model).transformed(head_T_rover))


def design_eye(
    name: str, focal_px: float, size_px: int, offset_m: tuple[float, float, float], yaw_rad: float
) -> Eye:
    """A pinhole eye with a square image and its principal point in the middle, turned about the head's z.

    `offset_m` is the eye's place in the head frame, z up.
    """
    centre = (size_px - 1) / 2
    camera = Pinhole(
        width_px=size_px, height_px=size_px, fx_px=focal_px, fy_px=focal_px, cx_px=centre, cy_px=centre
    )
    rotation: FloatArray = rz(yaw_rad) @ HEAD_R_FORWARD_CAMERA
    return Eye(name=name, camera=camera, head_T_camera=gtsam.Pose3(gtsam.Rot3(rotation), np.array(offset_m)))


def mast_rig(
    name: str,
    mast: MastKinematics,
    eyes: tuple[Eye, ...],
    source: str,
    uncertainty_of: Callable[[int], RigUncertainty],
) -> Rig:
    """A rig on a mast with published axes, and its uncertainty, given by the longer side of its images."""
    side_px = max(max(e.camera.width_px, e.camera.height_px) for e in eyes)
    return Rig(
        name=name,
        pan_T_tilt=mast.chain()[1],
        eyes=eyes,
        pointing_sigma=mast.pointing_sigma,
        mast_height_m=mast.mast_height_m,
        source=f"{source}; {mast.source}",
        uncertainty=uncertainty_of(side_px),
    )
