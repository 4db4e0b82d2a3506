"""Images as cubic splines, blurred as a comparison with coarser images needs."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.io import GreyImage

__all__ = ["Splines"]

_BLUR_PX = 0.7
_CACHED_IMAGES = 48
_BLUR_SIGMAS = 4
_INVERSE_PX = 12


@dataclass(eq=False)
class _Kept:
    lock: Lock = field(default_factory=Lock)
    coefficients: NDArray[np.float32] | None = None


class Splines:
    """Spline coefficients of images. The latest are kept. Several threads may ask at once."""

    def __init__(self, images: Sequence[GreyImage | None]) -> None:
        """Coefficients are asked for only of images that are not None."""
        self._images = images
        self._kept = OrderedDict[tuple[int, int], _Kept]()
        self._lock = Lock()

    def __call__(self, row: int, half_octaves: int = 0) -> NDArray[np.float32]:
        """Coefficients (height, width) of an image; each half octave blurs it by a factor of sqrt(2) more."""
        key = row, half_octaves
        with self._lock:
            kept = self._kept.setdefault(key, _Kept())
            self._kept.move_to_end(key)
            if len(self._kept) > _CACHED_IMAGES:
                self._kept.popitem(last=False)
        with kept.lock:  # a thread that asks for the same coefficients waits
            if kept.coefficients is None:
                grey = self._images[row]
                assert grey is not None  # it has features
                taps = _taps(_BLUR_PX * 2 ** (half_octaves / 2))
                blurred = cv2.sepFilter2D(
                    grey.astype(np.float32), cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101
                )
                kept.coefficients = np.ascontiguousarray(blurred)
            return kept.coefficients


@cache
def _taps(blur_px: float) -> FloatArray:
    """The filter, along one axis, that blurs an image and turns it to coefficients of cubic splines.

    A cubic spline with coefficients c is (c[-1] + 4 c[0] + c[1]) / 6 at a pixel. The inverse of that filter
    is sqrt(3) z^|k| with z = sqrt(3) - 2 (Unser, Aldroubi and Eden 1993), cut off where it is below 1e-7.
    """
    z, reach = np.sqrt(3) - 2, int(_BLUR_SIGMAS * blur_px + 0.5)
    blur = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur_px) ** 2)
    inverse = np.sqrt(3) * z ** np.abs(np.arange(-_INVERSE_PX, _INVERSE_PX + 1))
    return np.convolve(blur / blur.sum(), inverse / inverse.sum())
