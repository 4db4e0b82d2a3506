"""Images as a pinhole would have taken them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import straightening_map
from pancam_graph.data import Solution
from pancam_graph.io import readable_picture
from pancam_graph.results._brightness import Brightness
from pancam_graph.results._colmap_scene import Straight

__all__ = ["write_straight_images"]

_HALF_PIXEL = 0.5


def write_straight_images(
    solution: Solution,
    folder: Path,
    straight: Sequence[Straight | None],
    names: Mapping[int, str],
    brightness: Brightness,
) -> list[int]:
    """Write the images of `names` that have a readable file, resampled to their pinholes, in 8 bits.

    `names` are paths in the new folder `folder`, by rows of images. Returns the rows that were written.
    """
    import cv2  # noqa: PLC0415  late: other results do without it

    folder.mkdir()
    written = []
    previous, lookup = None, None
    # In the order of cameras, so that only one lookup is in memory, and each is made once.
    camera = {id(s): place for place, s in enumerate(straight)}
    for i in sorted(names, key=lambda i: (camera[id(straight[i])], i)):
        image, s = readable_picture(solution.traverse, i), straight[i]
        if image is None or s is None:
            continue
        if s is not previous:
            previous, lookup = s, straightening_map(s.camera, s.pinhole, s.range_m)
        path = folder / names[i]
        path.parent.mkdir(exist_ok=True)
        samples = image if lookup is None else _resampled(image, lookup)
        png = cv2.imencode(".png", brightness.to_8_bits(samples, image.dtype))[1]
        path.write_bytes(png.tobytes())
        written.append(i)
    return sorted(written)


def _resampled(image: NDArray[Any], lookup: FloatArray) -> NDArray[np.float32]:
    """Samples of an image at pixels (height, width, 2): Lanczos over 8 x 8 pixels; 0 outside the image.

    OpenCV rounds the pixels to a 32nd.
    """
    import cv2  # noqa: PLC0415  late: other results do without it

    height, width = image.shape
    within = np.all((lookup > -_HALF_PIXEL) & (lookup < [width - _HALF_PIXEL, height - _HALF_PIXEL]), axis=-1)
    where = np.where(within[..., None], lookup, 0.0).astype(np.float32)
    # The image is reflected at its edges, and blackened outside afterwards: a black edge would ring.
    samples = cv2.remap(
        image.astype(np.float32),
        where[..., 0],
        where[..., 1],
        cv2.INTER_LANCZOS4,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    return np.where(within, np.asarray(samples, dtype=np.float32), np.float32(0))
