"""Labels of the Mars Exploration Rovers. Source: the camera SIS of MER, and labels of both rovers."""

from dataclasses import replace

import numpy as np

from pancam_graph.base.geometry import rotation_from_wxyz
from pancam_graph.io._pds_label import PdsLabel
from pancam_graph.io._pds_rover import ROVER_FRAMES, LabelledRover, reference_frame
from pancam_graph.rigs import MER_MAST, MastKinematics, mer_uncertainty

__all__ = ["MER"]

_PMA_GROUPS = ("PMA_COORDINATE_SYSTEM", "PMA_COORDINATE_SYSTEM_PARMS")


def _joints_rad(label: PdsLabel) -> tuple[float, float]:
    """Angles of the mast's quaternion, which is what the camera model was made with.

    INSTRUMENT_ELEVATION changes its sign between the two rovers, and the encoders have offsets.
    """
    group = label.group(*_PMA_GROUPS)
    reference_frame(group, ROVER_FRAMES)
    rotation = rotation_from_wxyz(group.numbers("ORIGIN_ROTATION_QUATERNION", 4))
    azimuth = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    return azimuth, float(np.arcsin(np.clip(-rotation[2, 0], -1, 1)))


def _mast_of(label: PdsLabel) -> MastKinematics:
    """The mast about the pivot that the label gives, in which both axes meet."""
    x, y, z = (float(c) for c in label.group(*_PMA_GROUPS).numbers("ORIGIN_OFFSET_VECTOR", 3))
    return replace(MER_MAST, azimuth_point_m=(x, y, z), elevation_point_m=(x, y, z))


MER = LabelledRover(
    hosts=("MER",),
    named="MER1, MER2",
    cameras=("PANCAM", "NAVCAM"),
    mast=MER_MAST,
    uncertainty_of=mer_uncertainty,
    joints=_joints_rad,
    mast_of=_mast_of,
)
