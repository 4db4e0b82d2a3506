"""Rigs that ship with the package by name, and those of MER and ExoMars, every number with its source.

Where sources disagree the docstring says so. Offsets of rover documents are z-down; they are turned
to our z-up head frame here.
"""

from collections.abc import Callable

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, rz
from pancam_graph.cameras import Pinhole
from pancam_graph.rigs._mars2020 import MASTCAM_Z_TEMPLATES, mars2020_navcam
from pancam_graph.rigs._msl import msl_mastcam, msl_navcam
from pancam_graph.rigs._rig import Eye, PointingSigma, Rig
from pancam_graph.rigs._rings import ladybug3, ladybug5
from pancam_graph.rigs._stereo import stereo_pan_tilt

__all__ = ["TEMPLATES", "exomars_pancam", "mer_navcam", "mer_pancam", "rig_template"]

_CONCENTRIC = gtsam.Pose3()
_MER_POINTING = PointingSigma(
    pan_rad=float(np.deg2rad(0.077)), tilt_rad=float(np.deg2rad(0.077)), twist_rad=float(np.deg2rad(0.06))
)


def _eye(
    name: str, focal_px: float, size_px: int, offset_m: tuple[float, float, float], yaw_rad: float
) -> Eye:
    centre = (size_px - 1) / 2
    camera = Pinhole(
        width_px=size_px, height_px=size_px, fx_px=focal_px, fy_px=focal_px, cx_px=centre, cy_px=centre
    )
    rotation: FloatArray = rz(yaw_rad) @ HEAD_R_FORWARD_CAMERA
    return Eye(name=name, camera=camera, head_T_camera=gtsam.Pose3(gtsam.Rot3(rotation), np.array(offset_m)))


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
        pan_T_tilt=_CONCENTRIC,
        eyes=(
            _eye("left", 43e-3 / 12e-6, 1024, (0.10, 0.15, 0.0), -toe_in),
            _eye("right", 43e-3 / 12e-6, 1024, (0.10, -0.15, 0.0), toe_in),
        ),
        pointing_sigma=_MER_POINTING,
        mast_height_m=1.54,
        source="Bell et al. 2003; Albl, PanCam Bundle Adjustment; VICAR PigPointMER",
    )


def mer_navcam() -> Rig:
    """Navcam of the Mars Exploration Rovers: two eyes 0.20 m apart, 45 degrees, 0.82 mrad per pixel.

    14.67 mm focal length at 12 um (1222.5 px), 1024 x 1024, baseline 0.20 m: Maki et al. 2003 (labels
    give a baseline within a few millimetres of it). Pivot and forward offset as for Pancam.
    """
    return Rig(
        name="mer-navcam",
        pan_T_tilt=_CONCENTRIC,
        eyes=(
            _eye("left", 14.67e-3 / 12e-6, 1024, (0.10, 0.10, 0.0), 0.0),
            _eye("right", 14.67e-3 / 12e-6, 1024, (0.10, -0.10, 0.0), 0.0),
        ),
        pointing_sigma=_MER_POINTING,
        mast_height_m=1.54,
        source="Maki et al. 2003; VICAR PigPointMER",
    )


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
        pan_T_tilt=_CONCENTRIC,
        eyes=(
            _eye("wac-left", 1474.0, 1024, (0.0, 0.25, 0.06), -toe_in),
            _eye("wac-right", 1474.0, 1024, (0.0, -0.25, 0.06), toe_in),
            _eye("hrc", 12016.0, 1024, (0.0, -0.15, 0.06), 0.0),
        ),
        pointing_sigma=_MER_POINTING,
        mast_height_m=2.0,
        source="Coates et al. 2017; ESA ExoMars frame and structure kernels",
    )


TEMPLATES: dict[str, Callable[[], Rig]] = {
    "mer-pancam": mer_pancam,
    "mer-navcam": mer_navcam,
    "msl-navcam": msl_navcam,
    "msl-mastcam": msl_mastcam,
    "mars2020-navcam": mars2020_navcam,
    **MASTCAM_Z_TEMPLATES,
    "exomars-pancam": exomars_pancam,
    "ladybug3": ladybug3,
    "ladybug5": ladybug5,
    "stereo-pan-tilt": stereo_pan_tilt,
}
"""The templates by the name that `traverse.json` uses."""


def rig_template(name: str) -> Rig:
    """A shipped rig by name. Raises InputError for an unknown one, naming those there are."""
    if name not in TEMPLATES:
        raise InputError(f"template: expected one of {', '.join(TEMPLATES)}; found {name!r}")
    return TEMPLATES[name]()
