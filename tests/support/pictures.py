"""Pictures that a test reads back."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np


def read_picture(path: Path) -> np.ndarray[Any, Any]:
    """Samples of a picture as they are stored: any depth, (rows, columns) or (rows, columns, 3)."""
    samples = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert samples is not None, f"{path} is no picture"
    return samples
