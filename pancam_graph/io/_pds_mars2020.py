"""Labels of Perseverance. Source: the camera SIS of Mars 2020."""

from pancam_graph.io._pds_rover import JointNames, LabelledRover
from pancam_graph.rigs import MARS2020_MAST, mars2020_uncertainty

__all__ = ["MARS2020"]

MARS2020 = LabelledRover(
    hosts=("M20", "MARS2020", "MARS 2020", "MARS_2020"),
    named="M20",
    cameras=("NAVCAM", "NAV_", "MCZ_", "ZCAM", "MASTCAM", "SUPERCAM", "SCAM"),
    mast=MARS2020_MAST,
    uncertainty_of=mars2020_uncertainty,
    joints=JointNames(
        azimuth=("AZIMUTH FINAL-RESOLVER", "AZIMUTH-MEASURED", "AZIMUTH FINAL-ENCODER"),
        elevation=("ELEVATION FINAL-RESOLVER", "ELEVATION-MEASURED", "ELEVATION FINAL-ENCODER"),
    ),
)
