"""Curiosity: the remote sensing mast, Navcam and Mastcam."""

from dataclasses import replace

import gtsam
import numpy as np
import scipy

from pancam_graph.cameras import CAHV, CAHVOR
from pancam_graph.rigs._eyes import label_eye, mast_rig
from pancam_graph.rigs._mast import MastKinematics
from pancam_graph.rigs._rig import Eye, PointingSigma, Rig
from pancam_graph.rigs._uncertainty import RigUncertainty

__all__ = ["MSL_MAST", "MSL_TEMPLATES", "msl_mastcam", "msl_navcam", "msl_uncertainty"]

_POINTING = PointingSigma(pan_rad=float(np.deg2rad(0.063)), tilt_rad=float(np.deg2rad(0.063)))
"""Accuracy of the measured angles: VICAR PigPointMSL."""

MSL_MAST = MastKinematics(
    name="msl",
    # Published in the mechanical frame; ROVER_NAV_FRAME = that + (0.09002, 0, -1.1205).
    azimuth_point_m=(0.714803 + 0.09002, 0.559424, -1.109344 - 1.1205),
    azimuth_axis=(-0.001, 0.0, 1.0),
    elevation_point_m=(0.714668 + 0.09002, 0.561701, -0.785576 - 1.1205),
    elevation_axis=(-0.022, -1.0, 0.0),
    elevation_given_at_rad=0.0,
    home_azimuth_rad=3.167345,
    home_elevation_rad=1.588171,
    pointing_sigma=_POINTING,
    mast_height_m=1.97,
    source="VICAR PigPointMSLmastCamera, as-measured values; sign of the elevation axis from labels",
)
"""Remote sensing mast of Curiosity. The elevation axis is published with y = +1, which contradicts the
labels: with y = -1 (it is given at azimuth 0, where the head looks backwards) the head poses in two
Mastcam labels (sols 1664 and 2264) come out to 1 um and 1 urad."""

_NAVCAM_RIGHT_B = CAHVOR(
    width_px=1024,
    height_px=1024,
    C=np.array([0.953083, 0.737269, -1.83989]),
    A=np.array([0.61802, -0.158336, 0.770042]),
    H=np.array([622.069, 1100.35, 388.444]),
    V=np.array([-588.816, 157.005, 1176.66]),
    O=np.array([0.615108, -0.158211, 0.772395]),
    R=np.array([1.35787e-5, 0.00183074, -0.0057552]),
)
"""Label NRB_424748435EDR (sol 307), rover frame."""
_NAVCAM_RIGHT_B_AT = {"azimuth_rad": 2.91281, "elevation_rad": 0.715421}
_NAVCAM_LEFT_B_DEG = (89.86145547, -0.38921323, -90.02355994)
_NAVCAM_RIGHT_B_DEG = (89.91279432, -0.33489566, -90.29024820)
"""Orientation of the eyes in RSM_HEAD: about y, then x, then z (MSL frame kernel 0.8). The kernel's z is the
line of sight of the central pixel: that of the right eye's label above comes out to 0.02 degrees."""

_MASTCAM_LEFT = CAHV(
    width_px=1338,
    height_px=1193,
    C=np.array([0.7820476, 0.4215647, -1.967798]),
    A=np.array([0.4654729, -0.1921365, 0.8639552]),
    H=np.array([2249.626, 4087.266, 483.6099]),
    V=np.array([-3356.067, 1607.817, 2832.301]),
)
"""Label 2264ML0121141200805116C00_DRCL, rover frame."""
_MASTCAM_LEFT_AT = {"azimuth_rad": 2.719078, "elevation_rad": 0.542313}
_MASTCAM_RIGHT = CAHV(
    width_px=1323,
    height_px=1180,
    C=np.array([0.6831825, 0.5243722, -1.955875]),
    A=np.array([-0.3655151, 0.5396012, 0.7584387]),
    H=np.array([-11568.81, -7518.712, 661.8359]),
    V=np.array([5843.885, -8213.856, 9438.374]),
)
"""Label 1664MR0086340000802438C00_DRCL, rover frame."""
_MASTCAM_RIGHT_AT = {"azimuth_rad": 5.367043, "elevation_rad": 0.727572}


def msl_uncertainty(side_px: int) -> RigUncertainty:
    """Uncertainty of the cameras in labels of the unit, and of the mast's axes."""
    return replace(
        RigUncertainty.of_unit(side_px),
        aspect=2e-4,
        source="focal length: a closed ring of 12 images of the left Navcam, sol 3560, is 0.4 % off its "
        "label; else our stated assumption, in which the ring lies",
    )


def _mastcam_uncertainty(side_px: int) -> RigUncertainty:
    return replace(
        msl_uncertainty(side_px),
        mount_rad=2.5e-3,
        source="mounts: label and frame kernel differ by 5 mrad in the yaw of the left eye; else our stated "
        "assumption",
    )


def msl_navcam() -> Rig:
    """Navcam of Curiosity (string B): two eyes 0.42 m apart, 45 degrees, 1024 x 1024.

    The right eye is the CAHVOR model of one label (sol 307), brought to the head by the encoders' angles in
    that label. Of the left one only the orientation relative to the right one is published (frame kernel):
    its place is the right one's, mirrored, which makes the baseline 0.419 m, and its lens is the right one's.
    """
    right = label_eye("right", MSL_MAST, _NAVCAM_RIGHT_B, **_NAVCAM_RIGHT_B_AT)
    head_T_document = MSL_MAST.head_T_document()
    document_T_right = head_T_document.inverse() * right.head_T_camera
    left_R, right_R = (
        scipy.spatial.transform.Rotation.from_euler("YXZ", angles, degrees=True).as_matrix()
        for angles in (_NAVCAM_LEFT_B_DEG, _NAVCAM_RIGHT_B_DEG)
    )
    document_T_left = gtsam.Pose3(
        gtsam.Rot3(left_R @ right_R.T @ document_T_right.rotation().matrix()),
        document_T_right.translation() * [1.0, -1.0, 1.0],
    )
    left = Eye(name="left", camera=right.camera, head_T_camera=head_T_document * document_T_left)
    source = "PDS label NRB_424748435EDR; MSL frame kernel 0.8"
    return mast_rig("msl-navcam", MSL_MAST, (left, right), source, msl_uncertainty)


def msl_mastcam() -> Rig:
    """Mastcam of Curiosity: the left eye of 34 mm (16 degrees), the right one of 100 mm (5.5 degrees).

    Each eye is the CAHV model of one label of a linearised colour product (sols 2264 and 1664), 1338 x 1193
    and 1323 x 1180, brought to the head by the encoders' angles in that label. They are turned inwards by
    1.77 and 1.21 degrees; the frame kernel says 1.484 and 1.332 (it gives the central pixel of another
    image size, and the focus moves the image). Raw frames are larger and distorted: read their labels.
    """
    eyes = (
        label_eye("left", MSL_MAST, _MASTCAM_LEFT, **_MASTCAM_LEFT_AT),
        label_eye("right", MSL_MAST, _MASTCAM_RIGHT, **_MASTCAM_RIGHT_AT),
    )
    source = "PDS labels 2264ML0121141200805116C00_DRCL, 1664MR0086340000802438C00_DRCL"
    return mast_rig("msl-mastcam", MSL_MAST, eyes, source, _mastcam_uncertainty)


MSL_TEMPLATES = {"msl-navcam": msl_navcam, "msl-mastcam": msl_mastcam}
