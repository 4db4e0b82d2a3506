"""Images as cubic splines, blurred as a comparison with coarser images needs."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.splines import spline_taps
from pancam_graph.io import GreyImage

__all__ = ["Splines"]

_BLUR_PX = 0.7
_CACHED_IMAGES = 48


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
                taps = spline_taps(_BLUR_PX * 2 ** (half_octaves / 2))
                blurred = cv2.sepFilter2D(
                    grey.astype(np.float32), cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101
                )
                kept.coefficients = np.ascontiguousarray(blurred)
            return kept.coefficients
