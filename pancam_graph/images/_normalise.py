"""Even out brightness and contrast, so that features are found in shade and haze as in the sun."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["normalise", "usable_mask"]

_DARK_PERCENT, _BRIGHT_PERCENT = 0.1, 99.9
_EMPTY_BLOCK_PX = 5
_EMPTY_MARGIN_PX = 8


def normalise(image: NDArray[Any], tile_px: float, clip: float) -> NDArray[np.uint8]:
    """Stretch an image (height, width) of any real type to 8 bits and equalise its histogram by tiles.

    The darkest and brightest thousandth are cut off. Tiles are about `tile_px` wide, and contrast is raised
    by a factor of `clip` at most (CLAHE: Zuiderveld 1994).
    """
    dark, bright = np.percentile(image, [_DARK_PERCENT, _BRIGHT_PERCENT])
    scaled = (image.astype(np.float32) - dark) * (255.0 / max(float(bright - dark), 1e-6))
    grey = np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
    height, width = grey.shape
    tiles = (max(1, round(width / tile_px)), max(1, round(height / tile_px)))
    return np.asarray(cv2.createCLAHE(clip, tiles).apply(grey), dtype=np.uint8)


def usable_mask(image: NDArray[Any]) -> NDArray[np.bool_]:
    """Where an image (height, width) has data: away from blocks of zeros (missing lines, empty borders)."""
    empty = (image == 0).astype(np.uint8)
    block = np.ones((_EMPTY_BLOCK_PX, _EMPTY_BLOCK_PX), np.uint8)
    reach = np.ones((2 * _EMPTY_MARGIN_PX + _EMPTY_BLOCK_PX,) * 2, np.uint8)
    # Beyond the image's edge no pixel counts as missing.
    blocks = cv2.erode(empty, block, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(cv2.dilate(blocks, reach) == 0)
