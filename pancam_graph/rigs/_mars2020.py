"""Perseverance: the remote sensing mast, Navcam and Mastcam-Z.

The cameras are the models that nasa-jpl/m2020-urdf-models publishes, in RSM_EL, z down.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.cameras import CAHVOR, CAHVORE
from pancam_graph.rigs._eyes import document_eye, mast_rig
from pancam_graph.rigs._mast import MastKinematics
from pancam_graph.rigs._rig import PointingSigma, Rig
from pancam_graph.rigs._uncertainty import RigUncertainty

__all__ = [
    "MARS2020_MAST",
    "MARS2020_TEMPLATES",
    "mars2020_mastcam_z",
    "mars2020_navcam",
    "mars2020_uncertainty",
]

_POINTING = PointingSigma(pan_rad=float(np.deg2rad(0.063)), tilt_rad=float(np.deg2rad(0.063)))
"""Accuracy of the measured angles: VICAR PigPointM20."""

MARS2020_MAST = MastKinematics(
    name="mars2020",
    azimuth_point_m=(0.804037, 0.559028, -1.91927),
    azimuth_axis=(0.0, 0.0, 1.0),
    elevation_point_m=(0.804037, 0.559028, -1.91927),
    elevation_axis=(0.0, 1.0, 0.0),
    elevation_given_at_rad=2 * np.pi - 3.12414,
    home_azimuth_rad=2 * np.pi - 3.12414,
    home_elevation_rad=np.pi - 1.55334,
    pointing_sigma=_POINTING,
    mast_height_m=1.98,
    source="nasa-jpl/m2020-urdf-models (design values)",
)
"""Remote sensing mast of Perseverance, as designed: axes that meet. The label of a Navcam image of sol 629
puts the head 1.1 mm and 1.8 mrad (azimuth), 1.2 mrad (elevation), 2.5 mrad (roll) off these values, so
the flight unit's axes have to be fitted to the labels."""

_SOURCE = "m2020-camera-models.json"

# Rows: C, A, H, V, O, R (and E).
_NAVCAM = {
    "left": (
        (0.12848, -0.214947, -0.056891),
        (0.999943, -0.005833, 0.00885),
        (2612.926691, 2943.39557, 14.632299),
        (1916.489292, -3.389678, 2975.009835),
        (0.99995, -0.004409, 0.008967),
        (0.000002, 0.049535, -0.015973),
        (-0.003612, 0.013016, -0.023961),
    ),
    "right": (
        (0.130325, 0.209431, -0.057282),
        (0.999955, -0.006091, 0.007272),
        (2595.670632, 2936.004746, 14.78981),
        (1926.918699, -8.030063, 2965.171848),
        (0.999958, -0.006517, 0.006498),
        (0.0, 0.05117, -0.018889),
        (0.001504, 0.020873, -0.009439),
    ),
}
_NAVCAM_LINEARITY = 0.37

_MASTCAM_Z = {
    26: {
        "left": (
            (0.049868, -0.123255, -0.065678),
            (0.999662, 0.02596, 0.001692),
            (778.054336, 3549.988707, -20.201584),
            (574.892955, 36.828834, 3530.112103),
            (0.99967, 0.025574, 0.002407),
            (-0.000029, -0.451004, 0.311847),
        ),
        "right": (
            (0.050256, 0.119328, -0.065674),
            (0.999756, -0.021875, 0.003044),
            (923.353064, 3512.685665, 21.701863),
            (581.345529, -31.884036, 3534.519505),
            (0.999745, -0.02173, 0.006188),
            (-0.00003, -0.460786, 0.433936),
        ),
    },
    34: {
        "left": (
            (0.033045, -0.123723, -0.065576),
            (0.999713, 0.023939, -0.00028),
            (764.24274, 4672.629691, -27.637569),
            (560.931623, 42.375134, 4654.634557),
            (0.999693, 0.024689, -0.001921),
            (-0.000082, -0.473804, 0.793584),
        ),
        "right": (
            (0.03613, 0.119613, -0.066001),
            (0.999731, -0.023094, 0.00215),
            (951.971521, 4639.997084, 27.754689),
            (575.720741, -38.128814, 4662.778186),
            (0.999751, -0.021707, 0.005211),
            (-0.000067, -0.4812, 0.73982),
        ),
    },
    48: {
        "left": (
            (0.015466, -0.123954, -0.065711),
            (0.999615, 0.027569, -0.003186),
            (730.217857, 6670.783455, -42.537022),
            (547.497558, 57.226785, 6648.243609),
            (0.999582, 0.028601, -0.004161),
            (-0.000404, -0.477999, 1.957974),
        ),
        "right": (
            (0.019785, 0.120089, -0.066061),
            (0.99981, -0.019522, 0.000094),
            (999.834923, 6626.849682, 36.650888),
            (566.803031, -45.715723, 6645.851173),
            (0.99984, -0.01714, 0.005185),
            (-0.000208, -0.480591, 1.471084),
        ),
    },
    63: {
        "left": (
            (0.006882, -0.123977, -0.066054),
            (0.999708, 0.023908, -0.003378),
            (697.831181, 8607.968902, -54.146042),
            (532.756506, 67.412216, 8587.916185),
            (0.999507, 0.031107, -0.004248),
            (-0.000403, -0.331403, -2.107449),
        ),
        "right": (
            (0.010382, 0.12025, -0.065533),
            (0.999822, -0.018669, -0.002932),
            (1047.292962, 8562.474207, 44.407954),
            (559.642371, -54.958919, 8579.714699),
            (0.999893, -0.014297, 0.003076),
            (0.00004, -0.349006, -0.174313),
        ),
    },
    79: {
        "left": (
            (0.006504, -0.123981, -0.065957),
            (0.999637, 0.026854, 0.002215),
            (662.981256, 10766.160524, -61.201352),
            (517.248038, 84.842899, 10748.06416),
            (0.999249, 0.038716, 0.001626),
            (0.000048, -0.223707, -0.93721),
        ),
        "right": (
            (0.008773, 0.120336, -0.06595),
            (0.999882, -0.015341, 0.000323),
            (1101.238425, 10719.922496, 59.853874),
            (549.090357, -62.614983, 10735.434929),
            (0.999894, 0.003156, 0.014217),
            (0.000529, -0.181141, -0.153726),
        ),
    },
    100: {
        "left": (
            (0.016293, -0.123853, -0.065947),
            (0.999848, 0.016905, 0.004334),
            (615.643922, 13493.157749, -74.273688),
            (502.146931, 96.562207, 13489.347376),
            (0.999895, 0.013975, 0.003959),
            (0.000006, 0.158195, -0.074484),
        ),
        "right": (
            (0.016813, 0.120036, -0.065646),
            (0.999744, -0.021985, 0.005468),
            (1165.042931, 13443.738488, 76.700186),
            (541.539124, -81.574142, 13467.44721),
            (0.999417, -0.03104, -0.014207),
            (0.000453, 0.209115, -0.321321),
        ),
    },
    110: {
        "left": (
            (0.024345, -0.123651, -0.065922),
            (0.999881, 0.01462, 0.004944),
            (594.789598, 14822.867991, -82.582439),
            (493.197049, 104.146334, 14817.974904),
            (0.999827, 0.017379, 0.006676),
            (-0.000021, 0.55815, -0.0064),
        ),
        "right": (
            (0.027502, 0.119865, -0.065958),
            (0.999885, -0.01512, 0.001503),
            (1198.201396, 14770.898742, 81.444747),
            (534.935418, -85.170616, 14788.96298),
            (0.999421, -0.033927, 0.002792),
            (0.000308, 0.683458, 0.044042),
        ),
    },
}
"""By zoom position, in millimetres of nominal focal length."""


def mars2020_uncertainty(side_px: int) -> RigUncertainty:
    """Uncertainty of cameras and axes in the unit's labels."""
    return replace(
        RigUncertainty.of_unit(side_px),
        focal=3e-3,
        aspect=2e-4,
        source="turns of mounts: the toe-in of Mastcam-Z is published to 0.03 degrees; focal length: "
        "those of the two Navcams differ by 0.23 %; else our stated assumption",
    )


def _uncertainty(side_px: int) -> RigUncertainty:
    """Uncertainty on the axes as designed, which a label of the unit puts elsewhere (`MARS2020_MAST`)."""
    labels = mars2020_uncertainty(side_px)
    return replace(
        labels,
        tilt_axis_rad=2e-3,
        source=f"tilt axis: a label of sol 629 is 1.2 to 2.5 mrad and 1.1 mm off it; {labels.source}",
    )


def mars2020_navcam() -> Rig:
    """Navcam of Perseverance: two eyes 0.424 m apart, 82 x 66 degrees, 5120 x 3840.

    Both eyes are full CAHVORE models (entrance pupils that move) as published for the flight unit, on the
    axes as designed; the axes of the flight unit are about a millimetre and some milliradians off these
    (`MARS2020_MAST`). Images of a quarter or half this size need a rig of their own.
    """
    eyes = []
    for name, vectors in _NAVCAM.items():
        C, A, H, V, O, R, E = (np.array(v) for v in vectors)  # noqa: E741  the literature's names
        model = CAHVORE(
            width_px=5120, height_px=3840, C=C, A=A, H=H, V=V, O=O, R=R, E=E, linearity=_NAVCAM_LINEARITY
        )
        eyes.append(document_eye(name, MARS2020_MAST, model))
    return mast_rig("mars2020-navcam", MARS2020_MAST, tuple(eyes), _SOURCE, _uncertainty)


def mars2020_mastcam_z(zoom_mm: int) -> Rig:
    """Mastcam-Z of Perseverance at a zoom position: two eyes 0.243 m apart, 1648 x 1200.

    Published positions: 26, 34, 48, 63, 79, 100 and 110 mm, from 26 x 19 to 6.4 x 4.6 degrees; CAHVOR models.
    With the zoom the centres move by 4 cm along the line of sight; each eye is turned inwards by 0.8 to 1.6
    degrees (documents say 1.17 +- 0.03). Axes as for `mars2020_navcam`. Nothing is interpolated between the
    positions. Raises InputError for another one.
    """
    if zoom_mm not in _MASTCAM_Z:
        raise InputError(
            f"Mastcam-Z: zoom_mm: expected one of {', '.join(map(str, _MASTCAM_Z))}; found {zoom_mm!r}"
        )
    eyes = []
    for name, vectors in _MASTCAM_Z[zoom_mm].items():
        C, A, H, V, O, R = (np.array(v) for v in vectors)  # noqa: E741  the literature's names
        model = CAHVOR(width_px=1648, height_px=1200, C=C, A=A, H=H, V=V, O=O, R=R)
        eyes.append(document_eye(name, MARS2020_MAST, model))
    return mast_rig(_mastcam_z_name(zoom_mm), MARS2020_MAST, tuple(eyes), _SOURCE, _uncertainty)


def _mastcam_z_name(zoom_mm: int) -> str:
    return f"mars2020-mastcam-z-{zoom_mm}mm"


MARS2020_TEMPLATES: dict[str, Callable[[], Rig]] = {
    "mars2020-navcam": mars2020_navcam,
    **{_mastcam_z_name(zoom): partial(mars2020_mastcam_z, zoom) for zoom in _MASTCAM_Z},
}
