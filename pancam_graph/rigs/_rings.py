"""Rigid rings of cameras: no joints, the angles on the circle are the same at every stop (thesis 4.1)."""

import gtsam
import numpy as np

from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, rz
from pancam_graph.cameras import Pinhole
from pancam_graph.rigs._rig import Eye, PointingSigma, Rig
from pancam_graph.rigs._uncertainty import RigUncertainty

__all__ = ["RING_TEMPLATES", "ladybug3", "ladybug5"]

_RING_CAMERAS = 5
_HEAD_R_UPWARD_CAMERA: FloatArray = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation of a camera that looks along the head's z axis, the top of its image forwards."""


def ladybug5() -> Rig:
    """Ladybug 5: five portrait cameras on a ring of 61 mm and one that looks up.

    Nominal values within those of published calibration files: their ring radii are 60.5 to 61.6 mm, focal
    lengths of the rectified images 443 to 457 px (here 452), the top camera stands 76 mm up. Principal
    points of units lie within 50 px of the middle, which is used here. 2048 x 2448 px. A unit's own
    file is better than this by far: use it in a rig of your own.
    """
    return _ladybug(
        name="ladybug5",
        radius_m=0.061,
        top_m=0.076,
        camera=Pinhole(width_px=2048, height_px=2448, fx_px=452.0, fy_px=452.0, cx_px=1023.5, cy_px=1223.5),
        source="calibration files of Ladybug 5 units",
    )


def ladybug3() -> Rig:
    """Ladybug 3: five portrait cameras on a ring of 41.8 mm and one that looks up, 62 mm above it.

    One unit's published calibration: focal lengths 403 to 412 px (here 408), principal points near
    (621, 811), 1232 x 1616 px.
    """
    return _ladybug(
        name="ladybug3",
        radius_m=0.0418,
        top_m=0.062,
        camera=Pinhole(width_px=1232, height_px=1616, fx_px=408.0, fy_px=408.0, cx_px=621.0, cy_px=811.0),
        source="calibration of one Ladybug 3, Multimodal-Calib",
    )


def _ladybug(*, name: str, radius_m: float, top_m: float, camera: Pinhole, source: str) -> Rig:
    """The ring's cameras follow each other clockwise seen from above, cam0 forwards, as their files have it.

    The mast frame is the ring's centre. Its height above the ground, 2 m, is a round value (a car's roof).
    """
    eyes = []
    for i in range(_RING_CAMERAS):
        turn = rz(-2 * np.pi * i / _RING_CAMERAS)
        mount = gtsam.Pose3(gtsam.Rot3(turn @ HEAD_R_FORWARD_CAMERA), radius_m * turn[:, 0])
        eyes.append(Eye(name=f"cam{i}", camera=camera, head_T_camera=mount))
    top = gtsam.Pose3(gtsam.Rot3(_HEAD_R_UPWARD_CAMERA), np.array([0.0, 0.0, top_m]))
    eyes.append(Eye(name=f"cam{_RING_CAMERAS}", camera=camera, head_T_camera=top))
    return Rig(
        name=name,
        pan_T_tilt=gtsam.Pose3(),
        eyes=tuple(eyes),
        pointing_sigma=PointingSigma(pan_rad=0.0, tilt_rad=0.0, twist_rad=0.0),
        mast_height_m=2.0,
        turns=False,
        source=source,
        uncertainty=RigUncertainty(
            focal=1e-2,
            aspect=5e-4,
            principal_point_px=25.0,
            skew_px=0.5,
            mount_rad=5e-3,
            mount_m=5e-4,
            tilt_axis_rad=0.0,
            tilt_axis_m=0.0,
            flex_rad=0.0,
            source="published calibration files: focal lengths within 2 %, principal points within 50 px, "
            "radii within 1 mm; turns, aspect and skew: our stated assumption",
        ),
    )


RING_TEMPLATES = {"ladybug3": ladybug3, "ladybug5": ladybug5}
