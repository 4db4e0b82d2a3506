"""From light to samples: optics, vignetting, exposure, and the noise of a CCD."""

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.simulate._simulation_options import RenderOptions

__all__ = ["HALO_PX", "GreyImage", "expose"]

GreyImage = NDArray[np.uint8] | NDArray[np.uint16]

HALO_PX = 2
"""Pixels around the image that are rendered too: the optics smear one in, its edges need one more."""
_SMEAR = 0.11  # share of a pixel's light that each neighbour along a line gets: a blur of 0.47 px
_FULL_WELL = 200e3  # electrons at full scale (MER, Bell et al. 2003)
_READ_NOISE = 25.0  # electrons
_BRIGHT = 0.78  # share of full scale at which automatic exposure puts the brightest hundredth
_DARK = 1e-6


def expose(light: FloatArray, options: RenderOptions, rng: np.random.Generator) -> GreyImage:
    """Samples of an image (h, w) from light with margins of HALO_PX, exposed for itself as rovers do."""
    inner = light[HALO_PX - 1 : 1 - HALO_PX, HALO_PX - 1 : 1 - HALO_PX]
    image = (1 - 2 * _SMEAR) * inner[1:-1] + _SMEAR * (inner[:-2] + inner[2:])
    image = (1 - 2 * _SMEAR) * image[:, 1:-1] + _SMEAR * (image[:, :-2] + image[:, 2:])
    height, width = image.shape
    v = (np.arange(height) - (height - 1) / 2) / np.hypot(height, width) * 2
    u = (np.arange(width) - (width - 1) / 2) / np.hypot(height, width) * 2
    image = image * (1 - options.vignetting * (v[:, None] ** 2 + u**2))
    image *= _BRIGHT / max(float(np.quantile(image[::4, ::4], 0.99)), _DARK)
    electrons = _FULL_WELL * image
    sigma = options.sensor_noise * np.sqrt(np.maximum(electrons, 0) + _READ_NOISE**2)
    electrons += sigma * rng.standard_normal(image.shape)
    full = 2**options.bits - 1
    samples: FloatArray = np.clip(np.rint(electrons / _FULL_WELL * full), 0, full)
    return samples.astype(np.uint8) if options.bits == 8 else samples.astype(np.uint16)
