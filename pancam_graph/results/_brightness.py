"""How bright images and landmarks are: one scale to 8 bits for all images of a traverse."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Solution
from pancam_graph.io import GreyImage, readable_picture

__all__ = ["Brightness", "brightness_of"]

_WHITE_PERCENT = 99.5
_WHITE_8_BIT = 255.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Brightness:
    """The sample that is shown as white, and the grey of each landmark."""

    white: float
    """Sample of images of 16 bits that becomes 255: the median, over images, of their 99.5th percentiles."""
    grey: NDArray[np.uint8] | None
    """(landmarks,) 0 to 255; 0 where no readable image sees one. None: no image can be read."""

    def to_8_bits(self, samples: NDArray[Any], source: np.dtype[Any]) -> NDArray[np.uint8]:
        """Samples in 8 bits: linear, 0 stays 0; those of images of 8 bits (`source`) keep their values."""
        factor = 1.0 if source == np.dtype(np.uint8) else _WHITE_8_BIT / self.white
        return np.clip(np.rint(samples * factor), 0, 255).astype(np.uint8)


def brightness_of(solution: Solution) -> Brightness:
    """The brightness of a solution; a landmark's grey is the mean of samples at its used observations."""
    traverse, observations = solution.traverse, solution.traverse.observations
    n = len(solution.landmark_track)
    total, count = np.zeros((2, n)), np.zeros((2, n))  # images of 8 bits, of 16 bits
    whites, seen = list[float](), False
    row = solution.landmark_row
    used = solution.used & (row >= 0)
    for i in range(len(traverse.images)):
        image = readable_picture(traverse, i)
        if image is None:
            continue
        seen, deep = True, int(image.dtype != np.uint8)
        if deep:
            whites.append(float(np.percentile(image, _WHITE_PERCENT)))
        if observations is not None:
            in_image = used & (observations.image == i)
            total[deep] += np.bincount(
                row[in_image], weights=_sampled(image, observations.uv_px[in_image]), minlength=n
            )
            count[deep] += np.bincount(row[in_image], minlength=n)
    # A median, so that a bright part of the rover in one image does not darken all others.
    shape = Brightness(white=float(np.median(whites or [0.0])) or 1.0, grey=None)
    if not seen:
        return shape
    bits_8, bits_16 = total
    summed = bits_8 + bits_16 * (_WHITE_8_BIT / shape.white)
    grey = shape.to_8_bits(summed / np.maximum(count.sum(axis=0), 1), np.dtype(np.uint8))
    return Brightness(white=shape.white, grey=grey)


def _sampled(image: GreyImage, uv_px: FloatArray) -> FloatArray:
    """Samples (n,) of an image at pixels (n, 2), interpolated linearly; outside, those of the edge."""
    height, width = image.shape
    u, v = uv_px[:, 0].clip(0, width - 1), uv_px[:, 1].clip(0, height - 1)
    left, top = np.minimum(u.astype(int), max(width - 2, 0)), np.minimum(v.astype(int), max(height - 2, 0))
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    x, y = u - left, v - top
    upper = image[top, left] * (1 - x) + image[top, right] * x
    lower = image[below, left] * (1 - x) + image[below, right] * x
    return np.asarray(upper * (1 - y) + lower * y)
