"""Labels of Curiosity. Source: the camera SIS of MSL."""

from pancam_graph.io._pds_rover import JointNames, LabelledRover
from pancam_graph.rigs import MSL_MAST, msl_uncertainty

__all__ = ["MSL"]

MSL = LabelledRover(
    hosts=("MSL", "MARS SCIENCE LABORATORY"),
    named="MSL",
    cameras=("NAV_", "NAVCAM", "MAST_", "MASTCAM", "CHEMCAM"),
    mast=MSL_MAST,
    uncertainty_of=msl_uncertainty,
    joints=JointNames(
        azimuth=("AZIMUTH-MEASURED", "AZIMUTH-FINAL"), elevation=("ELEVATION-MEASURED", "ELEVATION-FINAL")
    ),
)
