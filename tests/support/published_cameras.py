"""Published camera models that several test modules use.

A is of an unnamed rover camera, B Curiosity's right Navcam in the rover frame, C Perseverance's left Navcam
in the head frame. B and C come from the same publications as the shipped rigs: that their numbers are equal
to a rig's shows nothing. What shows something is the pixel that a published point has, computed from these
numbers by two independent programs: `PIXEL_B` and `PIXELS_C`.
"""

import numpy as np

from pancam_graph.cameras import CAHVOR, CAHVORE

MODEL_A = CAHVOR(
    width_px=1024,
    height_px=1024,
    C=np.array([3.451904, 3.258335, 1.254338]),
    A=np.array([-0.698217, -0.681994, -0.217661]),
    H=np.array([-1378.872803, 894.719666, -106.732689]),
    V=np.array([86.414558, 49.038635, -1620.883789]),
    O=np.array([-0.695858, -0.679843, -0.231508]),
    R=np.array([0.0002, -0.108075, 0.086320]),
)
MODEL_B = CAHVOR(
    width_px=1024,
    height_px=1024,
    C=np.array([0.953083, 0.737269, -1.83989]),
    A=np.array([0.61802, -0.158336, 0.770042]),
    H=np.array([622.069, 1100.35, 388.444]),
    V=np.array([-588.816, 157.005, 1176.66]),
    O=np.array([0.615108, -0.158211, 0.772395]),
    R=np.array([1.35787e-5, 0.00183074, -0.0057552]),
)
MODEL_C = CAHVORE(
    width_px=5120,
    height_px=3840,
    C=np.array([0.12848, -0.214947, -0.056891]),
    A=np.array([0.999943, -0.005833, 0.00885]),
    H=np.array([2612.926691, 2943.39557, 14.632299]),
    V=np.array([1916.489292, -3.389678, 2975.009835]),
    O=np.array([0.99995, -0.004409, 0.008967]),
    R=np.array([2e-6, 0.049535, -0.015973]),
    E=np.array([-0.003612, 0.013016, -0.023961]),
    linearity=0.37,
)

POINT_B = (4.517368, 0.544692, 1.752992)
PIXEL_B = (680.20780863, 419.72866434)
"""Of `POINT_B` with model B, in the rover frame."""
LINEAR_PIXEL_B = (680.1977727, 419.73463548)
"""The same without distortion: C, A, H and V alone."""
POINTS_C = ((5.0, -1.5, 1.0), (3.0, 1.0, 0.5))
PIXELS_C = ((1852.618962, 2538.835153), (3804.139186, 2467.839948))
"""Of `POINTS_C` with model C, in the head frame."""
