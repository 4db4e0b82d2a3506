"""Pictures as the bytes of their files."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["encoded"]


def encoded(picture: NDArray[np.uint8] | NDArray[np.uint16], suffix: str, quality: int = 90) -> bytes:
    """The bytes of a file of this ending, as `.png`; `quality` is that of a JPEG, 0 to 100."""
    setting = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix == ".jpg" else []
    data: NDArray[Any]
    done, data = cv2.imencode(suffix, picture, setting)
    assert done
    return data.tobytes()
