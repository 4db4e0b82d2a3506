"""The Mars Exploration Rovers, Spirit and Opportunity: the mast, Pancam and Navcam.

Offsets of eyes are in our head frame, z up. Where sources disagree the docstring says so.
"""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.rigs._eyes import design_eye
from pancam_graph.rigs._mast import MastKinematics
from pancam_graph.rigs._rig import PointingSigma, Rig
from pancam_graph.rigs._uncertainty import RigUncertainty

__all__ = ["MER_MAST", "MER_POINTING", "MER_TEMPLATES", "mer_navcam", "mer_pancam", "mer_uncertainty"]

MER_POINTING = PointingSigma(
    pan_rad=float(np.deg2rad(0.077)), tilt_rad=float(np.deg2rad(0.077)), twist_rad=float(np.deg2rad(0.06))
)
"""Accuracy of the measured angles: VICAR PigPointMER."""

MER_MAST = MastKinematics(
    name="mer",
    azimuth_point_m=(0.458, 0.028, -1.097),
    azimuth_axis=(0.0, 0.0, 1.0),
    elevation_point_m=(0.458, 0.028, -1.097),
    elevation_axis=(0.0, 1.0, 0.0),
    elevation_given_at_rad=0.0,
    home_azimuth_rad=0.0,
    home_elevation_rad=0.0,
    pointing_sigma=PointingSigma(pan_rad=MER_POINTING.pan_rad, tilt_rad=MER_POINTING.tilt_rad),
    mast_height_m=1.54,
    source="VICAR PigPointMERpmaCamera; labels of Opportunity and Spirit",
)
"""Pancam mast assembly. Both axes meet in one pivot, which each label gives to the millimetre."""


def mer_uncertainty(side_px: int) -> RigUncertainty:
    """Uncertainty of one unit's own calibration, as its labels have it.

    The templates below are designs: the eyes of the flight units sit centimetres from them, which this does
    not cover. Only labels say where.
    """
    return replace(
        RigUncertainty.of_unit(side_px),
        focal=3e-3,
        source="focal length: those published of one Pancam, 3571 to 3583 px; principal point: the left "
        "Navcam of Opportunity is 7 px off its label, 10 px where nothing else is free; mounts and axes: "
        "our stated assumption for a calibrated unit",
    )


def mer_pancam() -> Rig:
    """Pancam of the Mars Exploration Rovers: two eyes 0.30 m apart, 16 degrees, 0.28 mrad per pixel.

    43 mm focal length at 12 um pixels (3583 px), 1024 x 1024 and the mast height of 1.54 m are the
    thesis's; Bell et al. 2003 give the baseline of 0.30 m and the toe-in of 1 degree between the eyes
    (half each; some texts read it as 1 degree each). Both axes meet in one pivot (VICAR's MER pointing
    model). The eyes sit 0.10 m in front of it: a round value; flight units differ, read their labels.
    """
    toe_in = np.deg2rad(1.0) / 2
    return Rig(
        name="mer-pancam",
        pan_T_tilt=gtsam.Pose3(),
        eyes=(
            design_eye("left", 43e-3 / 12e-6, 1024, (0.10, 0.15, 0.0), -toe_in),
            design_eye("right", 43e-3 / 12e-6, 1024, (0.10, -0.15, 0.0), toe_in),
        ),
        pointing_sigma=MER_POINTING,
        mast_height_m=1.54,
        source="Bell et al. 2003; Albl, PanCam Bundle Adjustment; VICAR PigPointMER",
        uncertainty=mer_uncertainty(1024),
    )


def mer_navcam() -> Rig:
    """Navcam of the Mars Exploration Rovers: two eyes 0.20 m apart, 45 degrees, 0.82 mrad per pixel.

    14.67 mm focal length at 12 um (1222.5 px), 1024 x 1024, baseline 0.20 m: Maki et al. 2003 (labels
    give a baseline within a few millimetres of it). Pivot and forward offset as for Pancam.
    """
    return Rig(
        name="mer-navcam",
        pan_T_tilt=gtsam.Pose3(),
        eyes=(
            design_eye("left", 14.67e-3 / 12e-6, 1024, (0.10, 0.10, 0.0), 0.0),
            design_eye("right", 14.67e-3 / 12e-6, 1024, (0.10, -0.10, 0.0), 0.0),
        ),
        pointing_sigma=MER_POINTING,
        mast_height_m=1.54,
        source="Maki et al. 2003; VICAR PigPointMER",
        uncertainty=mer_uncertainty(1024),
    )


MER_TEMPLATES = {"mer-pancam": mer_pancam, "mer-navcam": mer_navcam}
