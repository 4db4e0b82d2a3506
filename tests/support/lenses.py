"""One camera of every model, distorted as real ones are, and pixels all over its image."""

from typing import Any

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHV, CAHVOR, CAHVORE, Brown, Pinhole

NUMBERS: dict[str, Any] = {"fx_px": 500.0, "fy_px": 510.0, "cx_px": 321.0, "cy_px": 237.0, "skew_px": 2.0}
SIZE: dict[str, Any] = {"width_px": 640, "height_px": 480}
AXES: dict[str, Any] = {
    "C": np.zeros(3),
    "A": np.array([0.0, 0.0, 1.0]),
    "H": np.array([500.0, 0.0, 321.0]),
    "V": np.array([3.0, 510.0, 237.0]),
}
OPTICAL: dict[str, Any] = {
    "O": np.array([0.01, -0.02, 1.0]) / np.linalg.norm([0.01, -0.02, 1.0]),
    "R": np.array([1e-4, -0.1, 0.08]),
}
PINHOLE = Pinhole(**SIZE, **NUMBERS)
BROWN = Brown(**SIZE, **NUMBERS, distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.01))
CAHV_CAMERA = CAHV(**SIZE, **AXES).split()[0]
CAHVOR_CAMERA = CAHVOR(**SIZE, **AXES, **OPTICAL).split()[0]
CAHVORE_CAMERA = CAHVORE(
    **SIZE, **AXES, **OPTICAL, E=np.array([-0.004, 0.013, -0.024]), linearity=0.37
).split()[0]
CENTRAL = {"pinhole": PINHOLE, "brown": BROWN, "cahv": CAHV_CAMERA, "cahvor": CAHVOR_CAMERA}
ALL = {**CENTRAL, "cahvore": CAHVORE_CAMERA}
FAR = 1e5


def pixels(n: int = 40) -> FloatArray:
    return np.random.default_rng(0).uniform(0, 1, (n, 2)) * [639, 479]
