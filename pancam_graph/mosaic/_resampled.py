"""Other views of a finished panorama: the picture resampled, without drawing its images again."""

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.mosaic._projections import Cylinder

__all__ = ["Resampled"]


class Resampled:
    """A panorama (rows, columns), 0 where there is no image, that is asked for its grey in any direction."""

    def __init__(self, cylinder: Cylinder, picture: NDArray[np.uint8], px_per_degree: float) -> None:
        """`px_per_degree` is the scale of the view that asks: the panorama is first made as small as that."""
        factor = min(1.0, px_per_degree / cylinder.px_per_degree)
        height, width = picture.shape
        size = max(2, round(width * factor)), max(2, round(height * factor))
        there = (picture > 0).astype(np.float32)
        self._cylinder = cylinder
        self._per_px = size[0] / width, size[1] / height
        # Grey times coverage, and coverage: their ratio at an edge is not mixed with what is empty.
        self._weighted, self._there = (
            self._edged(np.asarray(cv2.resize(band, size, interpolation=cv2.INTER_AREA), dtype=np.float32))
            for band in (picture * there, there)
        )

    def _edged(self, band: NDArray[np.float32]) -> NDArray[np.float32]:
        """The band with one more column at each end: of the other end, if the panorama is closed."""
        sides = cv2.BORDER_WRAP if self._cylinder.closed else cv2.BORDER_CONSTANT
        return np.asarray(cv2.copyMakeBorder(band, 0, 0, 1, 1, sides), dtype=np.float32)

    def at(self, azimuth_deg: FloatArray, elevation_deg: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Grey (rows, columns) in directions of that shape, and where the panorama has an image.

        Azimuth is anticlockwise from the world's x axis, elevation upwards from the horizontal.
        """
        c = self._cylinder
        half = 0.5 / c.px_per_degree
        column = ((c.left_deg - azimuth_deg + half) % 360 - half) * c.px_per_degree
        row = (c.top_deg - elevation_deg) * c.px_per_degree
        u = ((column + 0.5) * self._per_px[0] + 0.5).astype(np.float32)
        v = ((row + 0.5) * self._per_px[1] - 0.5).astype(np.float32)
        weighted, there = (
            cv2.remap(band, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            for band in (self._weighted, self._there)
        )
        return np.asarray(weighted / np.maximum(there, 1e-6), dtype=np.float64), np.asarray(there > 0.5)
