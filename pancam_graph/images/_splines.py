"""Images as cubic splines, blurred as a comparison with coarser images needs."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.splines import spline_taps
from pancam_graph.base.threads import n_workers
from pancam_graph.images._held import Held
from pancam_graph.io import GreyImage

__all__ = ["Splines"]

_BLUR_PX = 0.7
_BYTES_PER_THREAD = 96 << 20
_LEAST_THREADS = 2
"""Room for so many threads is there where fewer work."""


class Splines:
    """Spline coefficients of images. The latest are held. Several threads may ask at once."""

    def __init__(self, samples: Callable[[int], GreyImage]) -> None:
        """`samples` gives the image (height, width) of a row; asked for again where it is held no longer."""
        most_bytes = max(n_workers(), _LEAST_THREADS) * _BYTES_PER_THREAD
        self._samples = samples
        self._held = Held[tuple[int, int], NDArray[np.float32]](most_bytes, lambda array: array.nbytes)

    def __call__(self, row: int, half_octaves: int = 0) -> NDArray[np.float32]:
        """Coefficients (height, width) of an image; each half octave blurs it by a factor of sqrt(2) more."""
        return self._held.get((row, half_octaves), lambda: self._made(row, half_octaves))

    def _made(self, row: int, half_octaves: int) -> NDArray[np.float32]:
        taps = spline_taps(_BLUR_PX * 2 ** (half_octaves / 2))
        grey = self._samples(row).astype(np.float32)
        blurred = cv2.sepFilter2D(grey, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101)
        return np.ascontiguousarray(blurred)
