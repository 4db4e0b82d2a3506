"""A pair of cameras on a pan-tilt unit, of any size: for field tests."""

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, rz
from pancam_graph.cameras import Pinhole
from pancam_graph.rigs._rig import Eye, PointingSigma, Rig

__all__ = ["STEREO_TEMPLATES", "stereo_pan_tilt"]

_POINTING = PointingSigma(pan_rad=float(np.deg2rad(0.1)), tilt_rad=float(np.deg2rad(0.1)))


def stereo_pan_tilt(
    *,
    baseline_m: float = 0.20,
    field_rad: float = float(np.deg2rad(60.0)),
    width_px: int = 1920,
    height_px: int = 1200,
    forward_m: float = 0.05,
    above_m: float = 0.05,
    toe_in_rad: float = 0.0,
    tilt_axis_m: tuple[float, float, float] = (0.0, 0.0, 0.05),
    pointing_sigma: PointingSigma = _POINTING,
    mast_height_m: float = 1.5,
    name: str = "stereo-pan-tilt",
) -> Rig:
    """Two equal cameras, left and right, on a pan-tilt unit.

    `baseline_m` is the distance of the eyes from each other; they stand `forward_m` in front of the tilt axis
    and `above_m` above it: the arm on which tilt turns them. `toe_in_rad` is how far each is turned inwards.
    `tilt_axis_m` is where the tilt axis crosses the middle of the head at pan 0, from the mast's origin on
    the pan axis; the axes are square to each other. `field_rad` is the field of view across the width,
    pixels are square, the principal point is in the middle, and there is no distortion.

    The defaults (also of the template "stereo-pan-tilt") are round values of a unit that fits on a tripod:
    0.2 m, 60 degrees at 1920 x 1200, axes 5 cm apart, an arm of 7 cm, encoders good to 0.1 degrees. No
    device has just these: pass your own, and measure them with `fit_rig` where camera poses are known.

    Raises InputError naming the parameter that makes no sense.
    """
    for parameter, value, fits, expected in (
        ("baseline_m", baseline_m, baseline_m > 0, "a distance above 0"),
        ("field_rad", field_rad, 0 < field_rad < np.pi, "an angle above 0, below pi"),
        ("width_px", width_px, width_px >= 1, "1 or more"),
        ("height_px", height_px, height_px >= 1, "1 or more"),
        ("forward_m", forward_m, np.isfinite(forward_m), "a finite distance"),
        ("above_m", above_m, np.isfinite(above_m), "a finite distance"),
        ("toe_in_rad", toe_in_rad, abs(toe_in_rad) < np.pi / 2, "an angle between -pi/2 and pi/2"),
        ("tilt_axis_m", tilt_axis_m, np.isfinite(tilt_axis_m).all(), "finite distances"),
        ("mast_height_m", mast_height_m, 0 <= mast_height_m < np.inf, "a height of 0 or above"),
    ):
        if not (fits and np.isfinite(value).all()):
            raise InputError(f"{name}: {parameter}: expected {expected}, found {value!r}")
    focal = width_px / 2 / float(np.tan(field_rad / 2))
    camera = Pinhole(
        width_px=width_px,
        height_px=height_px,
        fx_px=focal,
        fy_px=focal,
        cx_px=(width_px - 1) / 2,
        cy_px=(height_px - 1) / 2,
    )
    eyes = tuple(
        Eye(
            name=eye,
            camera=camera,
            head_T_camera=gtsam.Pose3(
                gtsam.Rot3(rz(-side * toe_in_rad) @ HEAD_R_FORWARD_CAMERA),
                np.array([forward_m, side * baseline_m / 2, above_m]),
            ),
        )
        for eye, side in (("left", 1), ("right", -1))
    )
    return Rig(
        name=name,
        pan_T_tilt=gtsam.Pose3(gtsam.Rot3(), np.array(tilt_axis_m)),
        eyes=eyes,
        pointing_sigma=pointing_sigma,
        mast_height_m=mast_height_m,
        source="parameters of stereo_pan_tilt",
    )


STEREO_TEMPLATES = {"stereo-pan-tilt": stereo_pan_tilt}
