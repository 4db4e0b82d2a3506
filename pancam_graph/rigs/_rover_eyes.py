"""Eyes from the camera models that rovers' documents and labels give, z down."""

import gtsam
import numpy as np

from pancam_graph.base.geometry import Z_DOWN_R_Z_UP
from pancam_graph.cameras import CAHV
from pancam_graph.rigs._masts import MastKinematics
from pancam_graph.rigs._rig import Eye, Rig

__all__ = ["document_eye", "label_eye", "mast_rig"]

_Z_UP_T_Z_DOWN = gtsam.Pose3(gtsam.Rot3(Z_DOWN_R_Z_UP), np.zeros(3))


def document_eye(name: str, mast: MastKinematics, model: CAHV) -> Eye:
    """An eye whose vectors are in the head frame of the mast's documents (RSM_HEAD, RSM_EL), z down."""
    return Eye.from_head_model(name, model.transformed(mast.head_T_document()))


def label_eye(
    name: str, mast: MastKinematics, model: CAHV, *, azimuth_rad: float, elevation_rad: float
) -> Eye:
    """An eye whose vectors are in the rover frame, z down, while the joints read these angles."""
    head_T_rover = mast.rover_T_head(azimuth_rad, elevation_rad).inverse()
    return Eye.from_head_model(name, model.transformed(head_T_rover * _Z_UP_T_Z_DOWN))


def mast_rig(name: str, mast: MastKinematics, eyes: tuple[Eye, ...], source: str) -> Rig:
    """A rig on a mast with published axes."""
    return Rig(
        name=name,
        pan_T_tilt=mast.chain()[1],
        eyes=eyes,
        pointing_sigma=mast.pointing_sigma,
        mast_height_m=mast.mast_height_m,
        source=f"{source}; {mast.source}",
    )
