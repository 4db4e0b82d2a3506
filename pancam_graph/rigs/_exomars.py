"""ExoMars (Rosalind Franklin): PanCam. Offsets of eyes are in our head frame, z up."""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.rigs._eyes import design_eye
from pancam_graph.rigs._mast import MastKinematics
from pancam_graph.rigs._mer import MER_POINTING, mer_uncertainty
from pancam_graph.rigs._rig import Rig

__all__ = ["EXOMARS_MAST", "EXOMARS_TEMPLATES", "exomars_pancam"]

EXOMARS_MAST = MastKinematics(
    name="exomars",
    azimuth_point_m=(0.0, 0.0, -1.64),
    azimuth_axis=(0.0, 0.0, 1.0),
    elevation_point_m=(0.0, 0.0, -1.64),
    elevation_axis=(0.0, 1.0, 0.0),
    elevation_given_at_rad=0.0,
    home_azimuth_rad=0.0,
    home_elevation_rad=0.0,
    pointing_sigma=MER_POINTING,
    mast_height_m=2.0,
    source="ESA ExoMars frame and structure kernels (design values)",
)
"""Pan-tilt unit of ExoMars: axes that meet 1.64 m above the rover frame. Of the pivot's other coordinates
nothing is known here; they move stops and no image."""


def exomars_pancam() -> Rig:
    """PanCam of ExoMars (Rosalind Franklin): two wide-angle eyes (WAC) and the zoomed one (HRC).

    Focal lengths 1474 px (38.3 degrees) and 12016 px (4.88 degrees), 1024 x 1024, and the WAC's 0.500 m
    baseline are from Coates et al. 2017 (the structure kernel implies 0.490 m); the thesis gives 22 mm
    (34 degrees) and 180 mm (5 degrees) of an earlier design. The toe-in of 2.8 degrees is taken as the
    angle between the WACs. Offsets from the pan-tilt pivot, WAC (0, +-0.25, 0.06) m and HRC (0, -0.15,
    0.06) m, and axes that meet: ESA's frame and structure kernels. Pointing accuracy is not published;
    that of MER stands in. Mast about 2 m.
    """
    toe_in = np.deg2rad(2.8) / 2
    return Rig(
        name="exomars-pancam",
        pan_T_tilt=gtsam.Pose3(),
        eyes=(
            design_eye("wac-left", 1474.0, 1024, (0.0, 0.25, 0.06), -toe_in),
            design_eye("wac-right", 1474.0, 1024, (0.0, -0.25, 0.06), toe_in),
            design_eye("hrc", 12016.0, 1024, (0.0, -0.15, 0.06), 0.0),
        ),
        pointing_sigma=MER_POINTING,
        mast_height_m=2.0,
        source="Coates et al. 2017; ESA ExoMars frame and structure kernels",
        uncertainty=replace(
            mer_uncertainty(1024),
            source="that of a calibrated unit of MER stands in; documents differ by 10 mm in the baseline of "
            "the WACs, which a unit's own calibration will settle",
        ),
    )


EXOMARS_TEMPLATES = {"exomars-pancam": exomars_pancam}
